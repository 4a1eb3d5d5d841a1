//! How the files of the groups become one experiment.
//!
//! A file may hold, beside settings:
//!
//! - `extends`: files of its group (of a recipe: experiments) that it is laid over.
//! - `title`: its part of the description.
//! - `inputs`: the inputs that a task or a policy has. A task has `state` alone unless it says more, a policy all of them.
//! - `[for.KEY]`: settings of one combination. In a task's file KEY names inputs. In a policy's file it names inputs, a task, or both
//!   (`stack_image`). In a puzzle's file it names a model, and each is an experiment: `[for.trm]` of `puzzle/sudoku9.toml` is
//!   `trm_sudoku9`. All of them lie over the settings of all files.

use toml::{Table, Value};

use super::{Library, check_experiment_name, merge, nearest, nearest_of};
use crate::ZooError;

const STATE: &str = "state";

/// A file of a group, with those it extends below it.
struct Layers {
    /// name and settings, lowest first
    layers: Vec<(String, Table)>,
}

impl Layers {
    fn top(&self, key: &str) -> Option<&Value> {
        self.layers.iter().rev().find_map(|(_, table)| table.get(key))
    }

    fn title(&self) -> &str {
        self.top("title").and_then(Value::as_str).unwrap_or(self.name())
    }

    /// Of the file itself.
    fn name(&self) -> &str {
        self.layers.last().map_or("", |(name, _)| name)
    }

    fn inputs(&self) -> Option<Vec<&str>> {
        Some(self.top("inputs")?.as_array()?.iter().filter_map(Value::as_str).collect())
    }

    fn settings(&self) -> impl Iterator<Item = Table> + '_ {
        self.layers.iter().map(|(_, table)| {
            let special = |key: &str| matches!(key, "extends" | "title" | "inputs" | "for");
            table.iter().filter(|(key, _)| !special(key)).map(|(key, value)| (key.clone(), value.clone())).collect()
        })
    }

    /// The settings of one combination.
    fn only(&self, key: &str) -> impl Iterator<Item = &Table> {
        self.layers.iter().filter_map(move |(_, table)| table.get("for")?.get(key)?.as_table())
    }
}

/// The parts that the name of an experiment says.
struct Parts {
    policy: String,
    task: String,
    inputs: String,
}

impl Parts {
    /// `stack`, `stack_image`
    fn combination(&self) -> String {
        match self.inputs.as_str() {
            STATE => self.task.clone(),
            inputs => format!("{}_{inputs}", self.task),
        }
    }
}

/// `bc_rnn` and `lift_image` -> `lift-bc-rnn-image`
fn entry_name(policy: &str, combination: &str) -> String {
    let (task, rest) = combination.split_once('_').map_or((combination, None), |(task, rest)| (task, Some(rest)));
    [Some(task), Some(policy), rest].into_iter().flatten().collect::<Vec<_>>().join("-").replace('_', "-")
}

impl Library {
    /// Names of every experiment that can be trained, sorted.
    ///
    /// # Errors
    /// When a folder or a file cannot be read.
    pub fn names(&self) -> Result<Vec<String>, ZooError> {
        let (mut names, tasks) = (self.group("recipe")?, self.group("task")?);
        let own = self.group("")?;
        names.extend(own.into_iter().filter(|name| name != "base"));
        let tasks =
            tasks.iter().map(|task| Ok((task, self.layers("task", task)?))).collect::<Result<Vec<_>, ZooError>>()?;
        for policy in self.group("policy")? {
            let layers = self.layers("policy", &policy)?;
            for (task, of_task) in &tasks {
                let reads = |inputs: &&str| layers.inputs().is_none_or(|reads| reads.contains(inputs));
                for inputs in of_task.inputs().unwrap_or_else(|| vec![STATE]).into_iter().filter(reads) {
                    let parts = Parts { policy: String::new(), task: (*task).clone(), inputs: inputs.to_owned() };
                    names.push(format!("{policy}_{}", parts.combination()));
                }
            }
        }
        for puzzle in self.group("puzzle")? {
            let table = self.file(&format!("puzzle/{puzzle}"))?.unwrap_or_default();
            let models = table.get("for").and_then(Value::as_table).into_iter().flat_map(|models| models.keys());
            names.extend(models.map(|model| format!("{model}_{puzzle}")));
        }
        names.sort();
        names.dedup();
        Ok(names)
    }

    /// The experiment that a command line names, and its other overrides: by its name, by `policy=`, `task=` and `inputs=`, or by a name
    /// of which these change a part.
    ///
    /// # Errors
    /// When the policy or the task is missing or unknown.
    pub fn choose(&self, words: &[String]) -> Result<(String, Vec<String>), ZooError> {
        let (mut name, mut chosen, mut rest) = (None, [None, None, None], Vec::new());
        for (n, word) in words.iter().enumerate() {
            let part = word.split_once('=').and_then(|(key, value)| {
                Some((["policy", "task", "inputs"].iter().position(|part| *part == key)?, value))
            });
            match part {
                Some((part, value)) => chosen[part] = Some(value.to_owned()),
                None if n == 0 && !word.contains('=') => name = Some(word.clone()),
                None => rest.push(word.clone()),
            }
        }
        if let (Some(name), [None, None, None]) = (&name, &chosen) {
            return Ok((name.clone(), rest));
        }
        let of_name = match &name {
            Some(name) => Some(self.changeable_parts(name, words)?),
            None => None,
        };
        let missing = |key: &str| ZooError::InvalidValue {
            key: key.to_owned(),
            expected: format!("the {key} as well: an experiment is policy=... task=... [inputs=...]"),
            found: "none".to_owned(),
        };
        let [policy, task, inputs] = chosen;
        let parts = Parts {
            policy: policy.or(of_name.as_ref().map(|p| p.policy.clone())).ok_or_else(|| missing("policy"))?,
            task: task.or(of_name.as_ref().map(|p| p.task.clone())).ok_or_else(|| missing("task"))?,
            inputs: inputs.or(of_name.map(|p| p.inputs)).unwrap_or_else(|| STATE.to_owned()),
        };
        let name = format!("{}_{}", parts.policy, parts.combination());
        for (key, part) in [("policy", &parts.policy), ("task", &parts.task)] {
            let known = self.group(key)?;
            // a puzzle is no task, and what learns it no policy
            if !known.contains(part) && !self.names()?.contains(&name) {
                let hint = nearest(part, &known).map_or(String::new(), |near| format!(" (did you mean `{near}`?)"));
                return Err(ZooError::InvalidValue {
                    key: key.to_owned(),
                    expected: format!("one of {}", known.join(", ")),
                    found: format!("`{part}`{hint}"),
                });
            }
        }
        Ok((name, rest))
    }

    /// The parts of experiment `name`, of which `words` change some.
    ///
    /// # Errors
    /// An unknown experiment; one of a file of its own, whose settings another combination would not have.
    fn changeable_parts(&self, name: &str, words: &[String]) -> Result<Parts, ZooError> {
        let parts = self.parts(name)?;
        let is_own = self.folder.is_some() && self.file(name)?.is_some();
        let is_recipe = parts.is_none() && self.file(&format!("recipe/{name}"))?.is_some();
        let change =
            words.iter().find(|word| ["policy=", "task=", "inputs="].iter().any(|part| word.starts_with(part)));
        match (parts, change) {
            (_, Some(change)) if is_own || is_recipe => Err(ZooError::InvalidValue {
                key: change.split('=').next().unwrap_or_default().to_owned(),
                expected: format!("no change to {name}, whose file has settings for its own policy, task and inputs"),
                found: change.clone(),
            }),
            (parts, _) => parts.ok_or_else(|| self.unknown(name)),
        }
    }

    /// Names of the policies that experiments are made of, sorted.
    ///
    /// # Errors
    /// When a folder cannot be read.
    pub fn policies(&self) -> Result<Vec<String>, ZooError> {
        self.group("policy")
    }

    /// The settings of experiment `name`.
    ///
    /// # Errors
    /// When a part is unknown, not TOML, or extends itself; when the task or the policy does not have these inputs.
    pub fn resolve(&self, name: &str) -> Result<Table, ZooError> {
        self.resolve_below(name, &mut Vec::new())
    }

    /// The same for an experiment that those of `chain` extend.
    fn resolve_below(&self, name: &str, chain: &mut Vec<String>) -> Result<Table, ZooError> {
        check_experiment_name(name)?;
        enter(chain, name.to_owned())?;
        let own = self.folder.is_some().then(|| self.file(name)).transpose()?.flatten().filter(|_| name != "base");
        let is_own = own.is_some();
        let mut table = match own.map_or_else(|| self.file(&format!("recipe/{name}")), |own| Ok(Some(own)))? {
            Some(mut table) => {
                let below = names_in(&mut table, "extends")?;
                let mut merged = match below.is_empty() && !is_own {
                    true => self.compose(&self.parts(name)?.ok_or_else(|| self.unknown(name))?)?,
                    false => Table::new(),
                };
                for below in &below {
                    merge(&mut merged, self.resolve_below(below, chain)?);
                }
                if !is_own {
                    merged.remove("entry");
                }
                merge(&mut merged, table);
                merged
            }
            None => match self.parts(name)? {
                Some(parts) => self.compose(&parts)?,
                None => self.puzzle(name)?.ok_or_else(|| self.unknown(name))?,
            },
        };
        if !table.contains_key("entry") && !name.starts_with('_') {
            let policies = self.group("policy")?;
            let entry = match longest(&policies, name) {
                Some((policy, rest)) => entry_name(policy, rest),
                None => name.replace('_', "-"),
            };
            table.insert("entry".to_owned(), Value::String(entry));
        }
        chain.pop();
        Ok(table)
    }

    fn unknown(&self, name: &str) -> ZooError {
        match self.names() {
            Ok(available) => {
                ZooError::UnknownExperiment { name: name.to_owned(), nearest: nearest_of(name, &available, 3) }
            }
            Err(error) => error,
        }
    }

    /// Policy, task and inputs of a name that says them.
    fn parts(&self, name: &str) -> Result<Option<Parts>, ZooError> {
        let (policies, tasks) = (self.group("policy")?, self.group("task")?);
        let Some((policy, combination)) = longest(&policies, name) else { return Ok(None) };
        let known = |task: &str| tasks.iter().any(|known| known == task);
        let (task, inputs) = match known(combination) {
            true => (combination, STATE),
            false => match longest(&tasks, combination) {
                Some((task, inputs)) if self.file(&format!("inputs/{inputs}"))?.is_some() => (task, inputs),
                _ => return Ok(None),
            },
        };
        Ok(Some(Parts { policy: policy.to_owned(), task: task.to_owned(), inputs: inputs.to_owned() }))
    }

    fn layers(&self, group: &str, name: &str) -> Result<Layers, ZooError> {
        let mut layers = Layers { layers: Vec::new() };
        self.layers_below(group, name, &mut Vec::new(), &mut layers.layers)?;
        Ok(layers)
    }

    fn layers_below(
        &self,
        group: &str,
        name: &str,
        chain: &mut Vec<String>,
        into: &mut Vec<(String, Table)>,
    ) -> Result<(), ZooError> {
        check_experiment_name(name)?;
        let path = format!("{group}/{name}");
        enter(chain, path.clone())?;
        let mut table = self.file(&path)?.ok_or_else(|| self.unknown(&path))?;
        for below in names_in(&mut table, "extends")? {
            self.layers_below(group, &below, chain, into)?;
        }
        // a puzzle's name models
        if group != "puzzle" {
            self.check_combinations(group, &path, &table)?;
        }
        into.push((name.to_owned(), table));
        chain.pop();
        Ok(())
    }

    /// Checks that every `[for.KEY]` of a file names what it can change: in a task's file inputs, in a policy's inputs, a task
    /// or both, in a file of inputs nothing.
    fn check_combinations(&self, group: &str, path: &str, table: &Table) -> Result<(), ZooError> {
        let Some(all) = table.get("for").and_then(Value::as_table) else { return Ok(()) };
        let of_policy = group == "policy";
        let mut known = if group == "inputs" { Vec::new() } else { self.group("inputs")? };
        let tasks = if of_policy { self.group("task")? } else { Vec::new() };
        for key in all.keys() {
            let combined = longest(&tasks, key).is_some_and(|(_, rest)| known.iter().any(|inputs| inputs == rest));
            let names = combined || known.contains(key) || tasks.contains(key) || (key == STATE && group != "inputs");
            if !names {
                known.extend(tasks);
                let hint = nearest(key, &known).map_or(String::new(), |near| format!(" (did you mean `{near}`?)"));
                let expected = match group {
                    "inputs" => "no `for` in a file of inputs",
                    "policy" => "inputs, a task, or a task and inputs such as stack_image",
                    _ => "inputs, such as image",
                };
                return Err(ZooError::InvalidValue {
                    key: format!("{path}: for.{key}"),
                    expected: expected.to_owned(),
                    found: format!("`{key}`{hint}"),
                });
            }
        }
        Ok(())
    }

    fn compose(&self, parts: &Parts) -> Result<Table, ZooError> {
        let policy = self.layers("policy", &parts.policy)?;
        let task = self.layers("task", &parts.task)?;
        let inputs = self.layers("inputs", &parts.inputs)?;
        let of_task = task.inputs().unwrap_or_else(|| vec![STATE]);
        for (what, name, has) in [("task", &parts.task, Some(of_task)), ("policy", &parts.policy, policy.inputs())] {
            if let Some(has) = has.filter(|has| !has.contains(&parts.inputs.as_str())) {
                return Err(ZooError::InvalidValue {
                    key: "inputs".to_owned(),
                    expected: format!("one of those that {what} `{name}` has ({})", has.join(", ")),
                    found: format!("`{}`", parts.inputs),
                });
            }
        }
        let mut table = self.file("base")?.unwrap_or_default();
        for settings in policy.settings().chain(task.settings()).chain(inputs.settings()) {
            merge(&mut table, settings);
        }
        for (name, _) in &inputs.layers {
            task.only(name).for_each(|settings| merge(&mut table, settings.clone()));
        }
        let combination = parts.combination();
        for key in inputs.layers.iter().map(|(name, _)| name).chain([&combination]) {
            policy.only(key).for_each(|settings| merge(&mut table, settings.clone()));
        }
        let text = |table: &mut Table, key: &str, value: String| {
            table.insert(key.to_owned(), Value::String(value));
        };
        text(&mut table, "entry", entry_name(&parts.policy, &combination));
        let description = format!("{} on {}, {}.", policy.title(), task.title(), inputs.title());
        text(&mut table, "description", description);
        Ok(table)
    }

    /// `trm_sudoku9`: `[for.trm]` of `puzzle/sudoku9.toml`.
    fn puzzle(&self, name: &str) -> Result<Option<Table>, ZooError> {
        let Some((model, puzzle)) = name.rsplit_once('_') else { return Ok(None) };
        let path = format!("puzzle/{puzzle}");
        if puzzle.is_empty() || self.file(&path)?.is_none() {
            return Ok(None);
        }
        let file = self.layers("puzzle", puzzle)?;
        let mut table = Table::new();
        file.settings().for_each(|settings| merge(&mut table, settings));
        if !self.lay_model(&file, model, &mut vec![path], &mut table)? {
            return Ok(None);
        }
        table.insert("entry".to_owned(), Value::String(name.replace('_', "-")));
        Ok(Some(table))
    }

    /// Lays a model of a puzzle's file, with what it extends below it: models of the same file, or parts of the group.
    fn lay_model(
        &self,
        file: &Layers,
        model: &str,
        chain: &mut Vec<String>,
        into: &mut Table,
    ) -> Result<bool, ZooError> {
        enter(chain, model.to_owned())?;
        let Some(mut settings) = file.only(model).next().cloned() else { return Ok(false) };
        for below in names_in(&mut settings, "extends")? {
            if !self.lay_model(file, &below, chain, into)? {
                chain.pop();
                self.layers("puzzle", &below)?.settings().for_each(|settings| merge(into, settings));
            }
        }
        merge(into, settings);
        chain.pop();
        Ok(true)
    }
}

/// Adds to the files that are being read, unless it is one of them.
fn enter(chain: &mut Vec<String>, name: String) -> Result<(), ZooError> {
    let cycle = chain.contains(&name);
    chain.push(name);
    match cycle {
        true => Err(ZooError::ExtendsCycle { chain: chain.clone() }),
        false => Ok(()),
    }
}

/// The longest of `names` that `text` begins with, before a `_`, and what follows.
fn longest<'a>(names: &'a [String], text: &'a str) -> Option<(&'a str, &'a str)> {
    let begins = |name: &'a String| Some((name.as_str(), text.strip_prefix(name.as_str())?.strip_prefix('_')?));
    names.iter().filter_map(begins).max_by_key(|(name, _)| name.len())
}

/// Takes a name or a list of names out of a table.
fn names_in(table: &mut Table, key: &str) -> Result<Vec<String>, ZooError> {
    let values = match table.remove(key) {
        None => return Ok(Vec::new()),
        Some(Value::Array(values)) => values,
        Some(value) => vec![value],
    };
    let name = |value: Value| match value {
        Value::String(name) => Ok(name),
        other => Err(ZooError::InvalidValue {
            key: key.to_owned(),
            expected: "the name of an experiment, or a list of names".to_owned(),
            found: other.to_string(),
        }),
    };
    values.into_iter().map(name).collect()
}
