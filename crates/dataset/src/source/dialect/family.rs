//! What robomimic's layout and everything derived from it share: `/data/demo_<k>` and `/mask`.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

use serde_json::Value;

use super::{DemoDraft, Draft, Survey, behavior, contents, list, number_after, wrong_lengths};
use crate::error::InputError;
use crate::lerobot::{mask_note, shared_notes};
use crate::plan::{DemoPlan, Dialect, ENV_KWARGS, KeyPlan, Problem};
use crate::source::value::one_line;
use crate::source::walk::Walked;
use crate::tree::{Array, Attrs, Dtype};

/// Names of the members of `data` that are demos.
pub(super) fn demo_ids(file: &Walked) -> Vec<(u64, String)> {
    let mut ids: Vec<(u64, String)> = file
        .groups
        .range("data/".to_owned()..)
        .take_while(|(path, _)| path.starts_with("data/"))
        .filter_map(|(path, _)| {
            let name = path.strip_prefix("data/")?;
            Some((number_after(name, "demo_")?, name.to_owned()))
        })
        .collect();
    ids.sort();
    ids
}

/// Whether any demo has something below this relative path.
pub(super) fn any_demo_has(file: &Walked, below: &str) -> bool {
    demo_ids(file).iter().any(|(_, id)| {
        let path = format!("data/{id}/{below}");
        file.groups.contains_key(&path) || file.datasets.contains_key(&path)
    })
}

/// Names of the attributes of `data`.
pub(super) fn data_attr_names(file: &Walked) -> Vec<String> {
    file.some_attrs("data", &[]).map(|(names, _)| names).unwrap_or_default()
}

/// Text of an attribute of `data`.
pub(super) fn data_attr(file: &Walked, name: &str) -> Option<String> {
    let (_, attrs) = file.some_attrs("data", &[name]).ok()?;
    attrs.get(name)?.to_text()
}

/// `ep_meta` of the first demo, if it is JSON.
pub(super) fn first_ep_meta(file: &Walked) -> Option<Value> {
    let (_, id) = demo_ids(file).into_iter().next()?;
    let (_, attrs) = file.some_attrs(&format!("data/{id}"), &["ep_meta"]).ok()?;
    serde_json::from_str(&attrs.get("ep_meta")?.to_text()?).ok()
}

/// Finds demos, masks and the environment of a file in robomimic's layout, or of a folder of such files: their demos are
/// numbered through in the order of the files.
pub(super) fn draft(survey: &Survey, dialect: Dialect, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
    if let Some(file) = survey.single() {
        let mut out = draft_file((0, file), None, dialect, beat)?;
        out.notes.extend(shared_notes(&out.masks));
        return Ok(out);
    }
    let mut out = Draft::new(dialect);
    let mut first: Option<(String, Decided)> = None;
    let mut parts = Vec::new();
    for (index, file) in survey.files.iter().enumerate() {
        let name = file_name(file);
        let mut one = match draft_file((index, file), Some(out.demos.len() as u64), dialect, beat) {
            Ok(one) => one,
            Err(error) => {
                out.problems.push(Problem::new(Some(&name), None, true, error));
                continue;
            }
        };
        if let (Some(from), Some(to)) = (one.demos.first(), one.demos.last()) {
            out.notes.push(format!("{} to {} are the demos of {name}", from.plan.id, to.plan.id));
        }
        let demos = out.demos.len()..out.demos.len() + one.demos.len();
        let masks = one.masks.keys().cloned().collect();
        parts.push(Part { name: name.clone(), masks, env_name: one.env_name.clone(), demos });
        // what all files say is said of the whole
        let said = DECISIVE.map(|argument| decisive(one.env_args.as_ref(), argument));
        if let Some((first, of_first)) = &first {
            one.problems.extend(at_odds(survey, &out, (first, of_first), (&name, &said)));
            out.env_args = out.env_args.zip(one.env_args).and_then(|(a, b)| common(a, &b));
            out.env_name = out.env_name.filter(|mine| one.env_name.as_ref() == Some(mine));
            out.env_version = out.env_version.filter(|mine| one.env_version.as_ref() == Some(mine));
            out.texts.retain(|name, text| one.texts.get(name) == Some(text));
        } else {
            (out.env_args, out.env_name, out.env_version) = (one.env_args, one.env_name, one.env_version);
            out.texts = one.texts;
            first = Some((name, said));
        }
        for (name, ids) in one.masks {
            out.masks.entry(name).or_default().extend(ids);
        }
        out.demos.extend(one.demos);
        out.notes.extend(one.notes);
        out.problems.extend(one.problems);
    }
    for Part { name, masks, env_name, demos } in parts {
        let lacking: Vec<String> =
            out.masks.keys().filter(|mask| !masks.contains(*mask)).map(|mask| format!("mask/{mask}")).collect();
        if !lacking.is_empty() {
            out.notes.push(format!("the demos of {name} are in none of the other files' {}", lacking.join(", ")));
        }
        // where no name is the whole's each demo keeps its own; LIBERO's have instructions
        if out.env_name.is_none() && dialect != Dialect::Libero {
            out.demos[demos].iter_mut().for_each(|demo| demo.plan.task = demo.plan.task.take().or(env_name.clone()));
        }
    }
    out.notes.extend(shared_notes(&out.masks));
    match out.problems.first() {
        Some(problem) if out.demos.is_empty() => Err(problem.error.clone()),
        _ => Ok(out),
    }
}

/// What a file of a folder is to the whole.
struct Part {
    name: String,
    masks: BTreeSet<String>,
    env_name: Option<String>,
    /// Its demos among all.
    demos: Range<usize>,
}

/// What the arguments [`DECISIVE`] are in a file.
type Decided = [Option<Value>; 2];

fn file_name(file: &Walked) -> String {
    file.path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Arguments of the environment by which columns are made: files that are joined have to agree in them.
const DECISIVE: [&str; 2] = ["control_freq", "reward_shaping"];

/// What `env_args` say of such an argument; robosuite's rewards are sparse unless it is told otherwise.
fn decisive(env_args: Option<&Value>, argument: &str) -> Option<Value> {
    let said = env_args.and_then(|args| args.get("env_kwargs")?.get(argument)).filter(|value| !value.is_null());
    said.cloned().or((argument == "reward_shaping").then_some(Value::Bool(false)))
}

/// The arguments in which a file differs from the first one, unless another did already.
fn at_odds(
    survey: &Survey,
    out: &Draft,
    (first, of_first): (&str, &Decided),
    (name, said): (&str, &Decided),
) -> Vec<Problem> {
    let words = |value: &Option<Value>| value.as_ref().map_or_else(|| "nothing".to_owned(), Value::to_string);
    let mut problems = Vec::new();
    for (argument, (a, b)) in DECISIVE.iter().zip(of_first.iter().zip(said)) {
        let agree =
            a.is_none() && b.is_none() || a.clone().zip(b.as_ref()).is_some_and(|(a, b)| common(a, b).is_some());
        if agree || crate::plan::at_odds(&out.problems, argument).is_some() {
            continue;
        }
        let or = if *argument == "control_freq" { ", or --fps decides" } else { "" };
        let error = InputError::BadAttribute {
            path: survey.path.clone(),
            object: "data".to_owned(),
            attribute: format!("{ENV_KWARGS}{argument}"),
            expected: format!("the same in all files (convert them separately{or})"),
            found: format!("{} in {first}, {} in {name}", words(a), words(b)),
        };
        problems.push(Problem::new(None, None, false, error));
    }
    problems
}

/// What two JSON values agree in.
fn common(a: Value, b: &Value) -> Option<Value> {
    match (a, b) {
        (Value::Number(a), Value::Number(b)) => (a.as_f64() == b.as_f64()).then_some(Value::Number(a)),
        (Value::Object(a), Value::Object(b)) => {
            let both = a.into_iter().filter_map(|(key, value)| Some((key.clone(), common(value, b.get(&key)?)?)));
            Some(Value::Object(both.collect()))
        }
        (a, b) => (a == *b).then_some(a),
    }
}

/// [`draft`] of one file; where the demos are numbered through, `base` is the number of the first.
fn draft_file(
    (index, file): (usize, &Walked),
    base: Option<u64>,
    dialect: Dialect,
    beat: &mut dyn FnMut(),
) -> Result<Draft, InputError> {
    let found = demo_ids(file);
    let ids: Vec<(u64, String, String)> = match base {
        None => found.into_iter().map(|(number, name)| (number, name.clone(), name)).collect(),
        Some(base) => (base..).zip(found).map(|(number, (_, name))| (number, format!("demo_{number}"), name)).collect(),
    };
    if ids.is_empty() {
        if let Some(error) = file.broken.values().next() {
            return Err(error.clone());
        }
        let members = file
            .groups
            .keys()
            .map(String::as_str)
            .chain(file.datasets.keys())
            .filter_map(|p| p.strip_prefix("data/"))
            .filter(|p| !p.contains('/'));
        return Err(InputError::NoDemos { path: file.path.clone(), found: list(members) });
    }
    let mut out = Draft::new(dialect);
    for (path, error) in &file.broken {
        let name = path.strip_prefix("data/").unwrap_or_default();
        // what is broken inside a demo is found with its contents
        if ids.iter().any(|(.., home)| name.split_once('/').is_some_and(|(first, _)| first == home)) {
            continue;
        }
        let of_demo = number_after(name, "demo_").is_some();
        let id = match base {
            None => name.to_owned(),
            Some(_) => format!("{} {name}", file_name(file)),
        };
        out.problems.push(Problem::new(of_demo.then_some(&id), None, of_demo, error.clone()));
    }
    let data_attrs = file.attrs("data")?;
    for (place, attrs) in [("", file.attrs("")?), ("data/", data_attrs.clone())] {
        for (name, value) in attrs {
            if let Some(text) = value.to_text() {
                out.texts.insert(format!("{place}{name}"), text);
            }
        }
    }
    out.notes.extend(no_demos(file, &ids).map(|note| match base {
        None => note,
        Some(_) => format!("{}: {note}", file_name(file)),
    }));
    environment(file, &data_attrs, &mut out);
    let language = file_language(&out);
    for (number, id, name) in &ids {
        demo((index, file), (*number, id, &format!("data/{name}")), language.as_deref(), &mut out)?;
        beat();
    }
    if !file.foreign.is_empty() {
        out.notes.push(format!(
            "numbers in another byte order or precision: the values are kept, their type becomes the machine's: {}",
            list(file.foreign.iter().map(String::as_str))
        ));
    }
    total(file, &data_attrs, &mut out);
    masks(file, &ids, base.is_some(), &mut out)?;
    Ok(out)
}

/// A note on the members of `data` that look like demos and are called otherwise.
fn no_demos(file: &Walked, ids: &[(u64, String, String)]) -> Option<String> {
    let parts = ["actions", "obs"].map(|part| format!("/{part}"));
    let paths = file.groups.keys().map(String::as_str).chain(file.datasets.keys());
    let alike = |path: &str| {
        let name = path.strip_prefix("data/")?;
        let group = parts.iter().find_map(|part| name.strip_suffix(part.as_str()));
        let dataset = (name.starts_with("demo_") && file.datasets.contains_key(path)).then_some(name);
        group.or(dataset).filter(|name| !name.contains('/')).map(str::to_owned)
    };
    let mut names: BTreeSet<String> = paths.filter_map(alike).collect();
    for (.., name) in ids {
        names.remove(name);
    }
    let some: Vec<&str> = names.iter().take(5).map(String::as_str).collect();
    let more = if names.len() > some.len() { format!(", ... ({} in all)", names.len()) } else { String::new() };
    let expected = "a demo is a group named demo_ and a whole number below 2^64";
    (!some.is_empty()).then(|| format!("not read as demos ({expected}): data/{}{more}", some.join(", data/")))
}

fn environment(file: &Walked, attrs: &Attrs, out: &mut Draft) {
    let Some(value) = attrs.get("env_args") else { return };
    let parsed = value
        .to_text()
        .ok_or_else(|| "no text".to_owned())
        .and_then(|t| serde_json::from_str::<Value>(&t).map_err(|e| e.to_string()));
    match parsed {
        Ok(json) => {
            let text = |key: &str| json.get(key).and_then(|v| v.as_str()).map(str::to_owned);
            // a file that was made of a data set without an environment has arguments only because robomimic wants some
            if stated_elsewhere(out) {
                return;
            }
            out.env_name = text("env_name");
            out.env_version = text("env_version");
            out.env_args = Some(json);
        }
        Err(found) => out.problems.push(Problem::new(
            None,
            None,
            false,
            InputError::BadAttribute {
                path: file.path.clone(),
                object: "data".to_owned(),
                attribute: "env_args".to_owned(),
                expected: "JSON".to_owned(),
                found,
            },
        )),
    }
}

/// Whether the file says that its `env_args` are made up.
fn stated_elsewhere(out: &Draft) -> bool {
    let stated = out.texts.get("data/lerobot").and_then(|text| serde_json::from_str::<Value>(text).ok());
    stated.is_some_and(|stated| stated["environment"] == Value::Bool(false))
}

/// An instruction that holds for the whole file.
fn file_language(out: &Draft) -> Option<String> {
    let env = out.env_args.as_ref()?;
    let text = |v: Option<&Value>| v.and_then(|v| v.as_str()).map(str::to_owned);
    text(env.get("lang"))
        .or_else(|| text(env.get("env_kwargs").and_then(|k| k.get("env_lang"))))
        .filter(|t| !t.is_empty())
}

fn demo(
    (index, file): (usize, &Walked),
    (number, id, home): (u64, &str, &str),
    language: Option<&str>,
    out: &mut Draft,
) -> Result<(), InputError> {
    let (attr_names, attrs) = file.some_attrs(home, &["num_samples", "ep_meta"])?;
    let behavior = out.dialect == Dialect::Behavior;
    let named = |path: &str| if behavior { behavior::name_of(path).to_owned() } else { path.to_owned() };
    let found = contents((index, file), home, id, &named, &mut out.problems);
    let (length, of) = length(file, (id, home), &attrs, &found.keys, out);
    let task = attrs
        .get("ep_meta")
        .and_then(Array::to_text)
        .and_then(|t| serde_json::from_str::<Value>(&t).ok())
        .and_then(|meta| meta.get("lang")?.as_str().map(str::to_owned))
        .filter(|t| !t.is_empty())
        .or_else(|| language.map(str::to_owned));
    let mut plan = DemoPlan { id: id.to_owned(), number, length, keys: found.keys.into(), attr_names, task };
    check(file, &plan, of, out);
    if let Some(before) = out.demos.last() {
        plan.keys.share_names(&before.plan.keys);
    }
    let home = Some((index, home.to_owned()));
    out.demos.push(DemoDraft { plan, home, groups: found.groups, inner: found.inner });
    Ok(())
}

/// Steps of a demo: `num_samples` where it is there, else the length of its actions; and who says so, where the actions
/// say otherwise.
fn length(
    file: &Walked,
    (id, home): (&str, &str),
    attrs: &Attrs,
    keys: &BTreeMap<String, KeyPlan>,
    out: &mut Draft,
) -> (usize, &'static str) {
    let rows = keys.get("actions").and_then(|k| k.shape.first().copied()).unwrap_or(0);
    let stated = attrs.get("num_samples");
    match stated.and_then(Array::to_i64).and_then(|n| usize::try_from(n).ok()) {
        Some(n) => (n, if n == rows { "" } else { "num_samples" }),
        None => {
            if out.dialect != Dialect::RobosuiteRaw {
                let error = InputError::BadAttribute {
                    path: file.path.clone(),
                    object: home.to_owned(),
                    attribute: "num_samples".to_owned(),
                    expected: "the number of steps".to_owned(),
                    found: match stated {
                        None => "no such attribute".to_owned(),
                        Some(value) => format!("{} of shape {:?}", value.dtype, value.shape),
                    },
                };
                out.problems.push(Problem::new(Some(id), None, stated.is_some(), error));
            }
            (rows, "")
        }
    }
}

fn check(file: &Walked, plan: &DemoPlan, of: &str, out: &mut Draft) {
    let id = plan.id.as_str();
    let path = || file.path.clone();
    let found = || list(plan.keys.keys());
    let missing =
        |key: &str| InputError::MissingKey { path: path(), demo: id.to_owned(), key: key.to_owned(), found: found() };
    if plan.length == 0 {
        return out.problems.push(Problem::empty(&file.path, id, "actions"));
    }
    let known: Vec<String> =
        out.problems.iter().filter(|p| p.demo.as_deref() == Some(id)).filter_map(|p| p.key.clone()).collect();
    let mut add = |key: &str, fatal: bool, error: InputError| {
        if !known.iter().any(|known| known == key || key == "obs" && known.starts_with("obs/")) {
            out.problems.push(Problem::new(Some(id), Some(key), fatal, error));
        }
    };
    match plan.keys.get("actions") {
        None => add("actions", true, missing("actions")),
        Some(actions) => {
            let numbers = matches!(actions.dtype, Dtype::F32 | Dtype::F64);
            if !numbers || actions.shape.len() != 2 || actions.shape[1] == 0 {
                let error = InputError::WrongShape {
                    path: path(),
                    demo: id.to_owned(),
                    key: "actions".to_owned(),
                    expected: "float32 or float64 of shape (steps, dimensions)".to_owned(),
                    found: format!("{} of shape {:?}", actions.dtype, actions.shape),
                };
                add("actions", true, error);
            }
        }
    }
    // what a recording has instead of observations
    let instead = match out.dialect {
        Dialect::RobosuiteRaw | Dialect::Behavior => "",
        Dialect::IsaacLab => "states/",
        _ => "obs/",
    };
    if !plan.keys.keys().any(|key| key.starts_with("obs/") || key.starts_with(instead)) {
        add("obs", true, missing("obs"));
    }
    if out.dialect != Dialect::RobosuiteRaw && !out.dialect.is_a_recording() {
        for key in ["rewards", "dones"] {
            if !plan.keys.contains_key(key) {
                add(key, false, missing(key));
            }
        }
    }
    let wrong = wrong_lengths(file, id, (plan.length, of), &plan.keys);
    // nothing of the demo has the length that is stated, which may be any number
    if let (false, Some(first)) = (of.is_empty(), wrong.first()) {
        return out.problems.push(Problem { key: None, ..first.clone() });
    }
    out.problems.extend(wrong.into_iter().filter(|p| !known.iter().any(|known| p.key.as_ref() == Some(known))));
}

fn total(file: &Walked, attrs: &Attrs, out: &mut Draft) {
    let Some(stated) = attrs.get("total") else { return };
    let steps = out.demos.iter().fold(0_usize, |steps, demo| steps.saturating_add(demo.plan.length));
    if stated.to_i64().and_then(|n| usize::try_from(n).ok()) != Some(steps) {
        let error = InputError::BadAttribute {
            path: file.path.clone(),
            object: "data".to_owned(),
            attribute: "total".to_owned(),
            expected: format!("{steps}, the steps of all demos"),
            found: stated.to_i64().map_or_else(|| "no integer".to_owned(), |n| n.to_string()),
        };
        out.problems.push(Problem::new(None, None, false, error));
    }
}

fn masks(file: &Walked, demos: &[(u64, String, String)], renumbered: bool, out: &mut Draft) -> Result<(), InputError> {
    let known: BTreeMap<&str, &str> = demos.iter().map(|(_, id, name)| (name.as_str(), id.as_str())).collect();
    let paths: Vec<&str> =
        file.datasets.starting_at("mask/").map(|(path, _)| path).take_while(|path| path.starts_with("mask/")).collect();
    for path in paths {
        let name = path["mask/".len()..].to_owned();
        let array = file.read(path, None)?;
        let Some(ids) = array.to_strings().filter(|_| array.shape.len() == 1) else {
            let error = InputError::BadAttribute {
                path: file.path.clone(),
                object: "mask".to_owned(),
                attribute: name,
                expected: "a list of demo ids".to_owned(),
                found: format!("{} of shape {:?}", array.dtype, array.shape),
            };
            out.problems.push(Problem::new(None, None, false, error));
            continue;
        };
        // robomimic's own `dataset_states_to_obs --n 3` copies the masks of the whole file; what is absent is no demo that
        // another file has under this name
        let mut absent = Vec::new();
        let here = ids.iter().map(|id| match known.get(id.as_str()) {
            Some(&id) => id.to_owned(),
            None => {
                let id = if renumbered { format!("{} {id}", file_name(file)) } else { id.clone() };
                absent.push(one_line(&id));
                id
            }
        });
        let here: Vec<String> = here.collect();
        if !absent.is_empty() {
            out.notes.push(mask_note(&name, ids.len(), &absent));
        }
        out.masks.insert(name, here);
    }
    Ok(())
}
