//! What robomimic's layout and everything derived from it share: `/data/demo_<k>` and `/mask`.

use std::collections::{BTreeMap, BTreeSet};

use super::{DemoDraft, Draft, Survey, key_plan, list, number_after, per_step};
use crate::error::InputError;
use crate::lerobot::{mask_note, shared_notes};
use crate::plan::{DemoPlan, Dialect, KeyPlan, Problem};
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

/// `ep_meta` of the first demo, if it is JSON.
pub(super) fn first_ep_meta(file: &Walked) -> Option<serde_json::Value> {
    let (_, id) = demo_ids(file).into_iter().next()?;
    let (_, attrs) = file.some_attrs(&format!("data/{id}"), &["ep_meta"]).ok()?;
    serde_json::from_str(&attrs.get("ep_meta")?.to_text()?).ok()
}

/// Finds demos, masks and the environment of a file in robomimic's layout.
pub(super) fn draft(survey: &Survey, dialect: Dialect, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
    let Some(file) = survey.single() else {
        return Err(InputError::UnknownLayout {
            path: survey.path.clone(),
            expected: "one file".to_owned(),
            found: survey.contents(),
        });
    };
    let ids = demo_ids(file);
    if ids.is_empty() {
        if let Some(error) = file.broken.values().next() {
            return Err(error.clone());
        }
        let members = file
            .groups
            .keys()
            .chain(file.datasets.keys())
            .filter_map(|p| p.strip_prefix("data/"))
            .filter(|p| !p.contains('/'));
        return Err(InputError::NoDemos { path: file.path.clone(), found: list(members) });
    }
    let mut out = Draft {
        dialect,
        demos: Vec::new(),
        env_args: None,
        env_name: None,
        env_version: None,
        masks: BTreeMap::new(),
        texts: BTreeMap::new(),
        notes: Vec::new(),
        problems: Vec::new(),
    };
    for (path, error) in &file.broken {
        let below = path.strip_prefix("data/").unwrap_or_default();
        let (id, key) = below.split_once('/').map_or((below, None), |(id, key)| (id, Some(key)));
        let of_demo = number_after(id, "demo_").is_some();
        out.problems.push(Problem::new(of_demo.then_some(id), key.filter(|_| of_demo), of_demo, error.clone()));
    }
    let data_attrs = file.attrs("data")?;
    for (place, attrs) in [("", file.attrs("")?), ("data/", data_attrs.clone())] {
        for (name, value) in attrs {
            if let Some(text) = value.to_text() {
                out.texts.insert(format!("{place}{name}"), text);
            }
        }
    }
    environment(file, &data_attrs, &mut out);
    let language = file_language(&out);
    for (number, id) in ids {
        demo(file, number, &id, language.as_deref(), &mut out)?;
        beat();
    }
    if !file.foreign.is_empty() {
        out.notes.push(format!(
            "numbers in another byte order or precision: the values are kept, their type becomes the machine's: {}",
            list(file.foreign.iter().map(String::as_str))
        ));
    }
    total(file, &data_attrs, &mut out);
    masks(file, &mut out)?;
    Ok(out)
}

fn environment(file: &Walked, attrs: &Attrs, out: &mut Draft) {
    let Some(value) = attrs.get("env_args") else { return };
    let parsed = value
        .to_text()
        .ok_or_else(|| "no text".to_owned())
        .and_then(|t| serde_json::from_str::<serde_json::Value>(&t).map_err(|e| e.to_string()));
    match parsed {
        Ok(json) => {
            let text = |key: &str| json.get(key).and_then(|v| v.as_str()).map(str::to_owned);
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

/// An instruction that holds for the whole file.
fn file_language(out: &Draft) -> Option<String> {
    let env = out.env_args.as_ref()?;
    let text = |v: Option<&serde_json::Value>| v.and_then(|v| v.as_str()).map(str::to_owned);
    text(env.get("lang"))
        .or_else(|| text(env.get("env_kwargs").and_then(|k| k.get("env_lang"))))
        .filter(|t| !t.is_empty())
}

fn demo(file: &Walked, number: u64, id: &str, language: Option<&str>, out: &mut Draft) -> Result<(), InputError> {
    let home = format!("data/{id}");
    let prefix = format!("{home}/");
    let (attr_names, attrs) = file.some_attrs(&home, &["num_samples", "ep_meta"])?;
    let mut keys = BTreeMap::new();
    let mut inner = Vec::new();
    for (path, node) in file.datasets.range(prefix.clone()..).take_while(|(p, _)| p.starts_with(&prefix)) {
        let key = path[prefix.len()..].to_owned();
        if node.attrs > 0 {
            inner.push((key.clone(), 0, path.clone()));
        }
        if let Some(fault) = &node.fault {
            out.problems.push(Problem::new(Some(id), Some(&key), true, fault.clone()));
        }
        if let Some(plan) = key_plan(0, file, path) {
            keys.insert(key, plan);
        }
    }
    let mut groups = BTreeSet::new();
    for (path, node) in file.groups.range(prefix.clone()..).take_while(|(p, _)| p.starts_with(&prefix)) {
        let below = path[prefix.len()..].to_owned();
        if node.attrs > 0 {
            inner.push((below.clone(), 0, path.clone()));
        }
        if node.empty {
            groups.insert(below);
        }
    }
    let length = length(file, id, &attrs, &keys, out);
    let task = attrs
        .get("ep_meta")
        .and_then(Array::to_text)
        .and_then(|t| serde_json::from_str::<serde_json::Value>(&t).ok())
        .and_then(|meta| meta.get("lang")?.as_str().map(str::to_owned))
        .filter(|t| !t.is_empty())
        .or_else(|| language.map(str::to_owned));
    let plan = DemoPlan { id: id.to_owned(), number, length, keys, attr_names, task };
    check(file, &plan, out);
    out.demos.push(DemoDraft { plan, home: Some((0, home)), groups, inner });
    Ok(())
}

/// Steps of a demo: `num_samples` where it is there, else the length of its actions.
fn length(file: &Walked, id: &str, attrs: &Attrs, keys: &BTreeMap<String, KeyPlan>, out: &mut Draft) -> usize {
    let rows = keys.get("actions").and_then(|k| k.shape.first().copied()).unwrap_or(0);
    let stated = attrs.get("num_samples");
    match stated.and_then(Array::to_i64).and_then(|n| usize::try_from(n).ok()) {
        Some(n) => n,
        None => {
            if out.dialect != Dialect::RobosuiteRaw {
                let error = InputError::BadAttribute {
                    path: file.path.clone(),
                    object: format!("data/{id}"),
                    attribute: "num_samples".to_owned(),
                    expected: "the number of steps".to_owned(),
                    found: match stated {
                        None => "no such attribute".to_owned(),
                        Some(value) => format!("{} of shape {:?}", value.dtype, value.shape),
                    },
                };
                out.problems.push(Problem::new(Some(id), None, stated.is_some(), error));
            }
            rows
        }
    }
}

fn check(file: &Walked, plan: &DemoPlan, out: &mut Draft) {
    let id = plan.id.as_str();
    let path = || file.path.clone();
    let found = || list(plan.keys.keys().map(String::as_str));
    let missing =
        |key: &str| InputError::MissingKey { path: path(), demo: id.to_owned(), key: key.to_owned(), found: found() };
    if plan.length == 0 {
        let error = InputError::WrongLength {
            path: path(),
            demo: id.to_owned(),
            key: "actions".to_owned(),
            expected: "at least 1".to_owned(),
            found: "0: the demo is empty".to_owned(),
        };
        return out.problems.push(Problem::new(Some(id), None, true, error));
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
    if out.dialect != Dialect::RobosuiteRaw {
        if !plan.keys.keys().any(|k| k.starts_with("obs/")) {
            add("obs", true, missing("obs"));
        }
        for key in ["rewards", "dones"] {
            if !plan.keys.contains_key(key) {
                add(key, false, missing(key));
            }
        }
    }
    for (key, plan_of_key) in plan.keys.iter().filter(|(key, _)| per_step(key)) {
        if plan_of_key.shape.first() != Some(&plan.length) {
            let error = InputError::WrongLength {
                path: path(),
                demo: id.to_owned(),
                key: key.clone(),
                expected: plan.length.to_string(),
                found: format!("shape {:?}", plan_of_key.shape),
            };
            add(key, true, error);
        }
    }
}

fn total(file: &Walked, attrs: &Attrs, out: &mut Draft) {
    let Some(stated) = attrs.get("total") else { return };
    let steps: usize = out.demos.iter().map(|d| d.plan.length).sum();
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

fn masks(file: &Walked, out: &mut Draft) -> Result<(), InputError> {
    let known: BTreeSet<String> = out.demos.iter().map(|d| d.plan.id.clone()).collect();
    let paths: Vec<&String> = file
        .datasets
        .range("mask/".to_owned()..)
        .map(|(path, _)| path)
        .take_while(|path| path.starts_with("mask/"))
        .collect();
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
        // robomimic's own `dataset_states_to_obs --n 3` copies the masks of the whole file
        let absent: Vec<String> = ids.iter().filter(|id| !known.contains(*id)).map(|id| one_line(id)).collect();
        if !absent.is_empty() {
            out.notes.push(mask_note(&name, ids.len(), &absent));
        }
        out.masks.insert(name, ids);
    }
    out.notes.extend(shared_notes(&out.masks));
    Ok(())
}
