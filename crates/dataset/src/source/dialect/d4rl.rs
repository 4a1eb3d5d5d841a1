//! D4RL: no `/data`; one run of steps in root arrays, cut into episodes after terminals and timeouts. Steps
//! after the last cut are an unfinished episode and left out, as robomimic's converter does.

use std::collections::{BTreeMap, BTreeSet};

use super::{DemoDraft, Draft, Layout, Survey, key_plan};
use crate::error::InputError;
use crate::plan::{DemoPlan, Dialect, KeyPlan, Problem};
use crate::source::walk::{DatasetNode, Walked};
use crate::tree::Dtype;

pub(super) struct D4rl;

impl Layout for D4rl {
    fn expected(&self) -> &'static str {
        "root arrays observations, actions, rewards, terminals (D4RL)"
    }

    fn recognises(&self, survey: &Survey) -> bool {
        survey.single().is_some_and(|file| {
            ["observations", "actions", "rewards", "terminals"].iter().all(|key| file.datasets.contains_key(key))
        })
    }

    fn draft(&self, survey: &Survey, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
        let file = survey.single().expect("recognised as one file");
        let steps = file.datasets["actions"].shape.first().copied().unwrap_or(0);
        let mut ends = flags(file, "terminals", steps)?;
        if file.datasets.contains_key("timeouts") {
            let timeouts = flags(file, "timeouts", steps)?;
            ends.iter_mut().zip(timeouts).for_each(|(end, timeout)| *end |= timeout);
        }
        let mut notes = Vec::new();
        for (path, node) in &file.datasets {
            match node.shape.first() {
                Some(&rows) if rows != steps && path == "observations" => {
                    return Err(wrong_length(file, path, steps, format!("shape {:?}", node.shape)));
                }
                // what was trained with the run has lengths of its own
                Some(&rows) if rows != steps && !path.starts_with("metadata/") => notes.push(format!(
                    "{path} has {rows} rows where actions has {steps}: it is kept with the file and is in no episode"
                )),
                _ => {}
            }
        }
        let mut demos: Vec<DemoDraft> = Vec::new();
        let mut first = 0;
        for (step, _) in ends.iter().enumerate().filter(|(_, end)| **end) {
            demos.push(demo(file, demos.len(), first, step + 1 - first, steps));
            first = step + 1;
            beat();
        }
        if first < steps {
            notes.push(format!(
                "the last {} steps belong to an episode that does not end and are left out",
                steps - first
            ));
        }
        // the attributes of what is cut belong to the run: the first episode keeps them
        if let Some(first) = demos.first_mut() {
            let cut = |path: &str| first.plan.keys.get(&name_of(path)).is_some_and(|key| *key.place.path == *path);
            let of = |(path, node): (&str, &DatasetNode)| (node.attrs > 0 && cut(path)).then(|| path.to_owned());
            let inner: Vec<String> = file.datasets.iter().filter_map(of).collect();
            first.inner.extend(inner.into_iter().map(|path| (name_of(&path), 0, path)));
        }
        let attrs = file.attrs("")?;
        let texts = attrs.iter().filter_map(|(k, v)| Some((k.clone(), v.to_text()?))).collect();
        let mut problems = Vec::new();
        for (path, node) in &file.datasets {
            if let Some(error) = &node.fault {
                problems.push(Problem::new(None, Some(&name_of(path)), true, (**error).clone()));
            }
        }
        for (path, error) in &file.broken {
            problems.push(Problem::new(None, Some(&name_of(path)), true, error.clone()));
        }
        if demos.is_empty() {
            return Err(InputError::NoDemos {
                path: file.path.clone(),
                found: format!("{steps} steps and neither terminal nor timeout"),
            });
        }
        Ok(Draft { demos, texts, notes, problems, ..Draft::new(Dialect::D4rl) })
    }
}

/// Which steps are marked, of a dataset of one truth value or number per step.
fn flags(file: &Walked, key: &str, steps: usize) -> Result<Vec<bool>, InputError> {
    let array = file.read(key, None)?;
    match array.to_f64().filter(|v| v.len() == steps) {
        Some(values) => Ok(values.iter().map(|&v| v != 0.0).collect()),
        None => Err(wrong_length(file, key, steps, format!("{} of shape {:?}", array.dtype, array.shape))),
    }
}

/// No demo is at fault, so that none can be left out.
fn wrong_length(file: &Walked, key: &str, steps: usize, found: String) -> InputError {
    InputError::Damaged {
        path: file.path.clone(),
        object: key.to_owned(),
        operation: "cut the run by".to_owned(),
        reason: format!("expected {steps} steps, as actions has, found {found}"),
    }
}

/// robomimic's names for D4RL's arrays.
fn name_of(path: &str) -> String {
    match path {
        "observations" => "obs/flat".to_owned(),
        "next_observations" => "next_obs/flat".to_owned(),
        "terminals" => "dones".to_owned(),
        other => other.to_owned(),
    }
}

fn demo(file: &Walked, number: usize, first: usize, length: usize, steps: usize) -> DemoDraft {
    let mut keys: BTreeMap<String, KeyPlan> = BTreeMap::new();
    for (path, node) in &file.datasets {
        // arrays of another length (policy weights in metadata/) belong to no episode
        if node.shape.first() != Some(&steps) || node.dtype == Dtype::VarStr {
            continue;
        }
        if let Some(plan) = key_plan(0, file, path) {
            keys.insert(name_of(path), plan.part(first, length));
        }
    }
    let plan = DemoPlan {
        id: format!("demo_{number}"),
        number: number as u64,
        length,
        keys: keys.into(),
        attr_names: Vec::new(),
        task: None,
    };
    DemoDraft { plan, home: None, groups: BTreeSet::new(), inner: Vec::new() }
}
