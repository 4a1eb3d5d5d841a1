//! ALOHA and ACT: one file per episode (`episode_<i>.hdf5`) with `/action` and `/observations/{qpos,qvel,images}`;
//! a folder of them is one data set, a single one is a data set of one demo.

use std::collections::{BTreeMap, BTreeSet};

use super::{DemoDraft, Draft, Layout, Survey, key_plan, list, number_of};
use crate::error::InputError;
use crate::plan::{DemoPlan, Dialect, Problem};
use crate::source::walk::Walked;

pub(super) struct Aloha;

fn is_episode(file: &Walked) -> bool {
    file.datasets.contains_key("action") && file.datasets.contains_key("observations/qpos")
}

impl Layout for Aloha {
    fn expected(&self) -> &'static str {
        "action and observations/qpos, in one file or in every file of a folder (ALOHA, ACT)"
    }

    fn recognises(&self, survey: &Survey) -> bool {
        survey.files.iter().any(is_episode)
    }

    fn draft(&self, survey: &Survey, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
        let mut out = Draft {
            dialect: Dialect::Aloha,
            demos: Vec::new(),
            env_args: None,
            env_name: None,
            env_version: None,
            masks: BTreeMap::new(),
            texts: BTreeMap::new(),
            notes: Vec::new(),
            problems: Vec::new(),
        };
        for (index, file) in survey.files.iter().enumerate() {
            if is_episode(file) {
                episode(index, file, &mut out)?;
            } else {
                let unknown = || InputError::UnknownLayout {
                    path: file.path.clone(),
                    expected: "action and observations/qpos as in the other files".to_owned(),
                    found: list(file.datasets.keys().map(String::as_str)),
                };
                let error = file.broken.values().next().cloned().unwrap_or_else(unknown);
                let id = format!("demo_{}", number_of(&file.path, index));
                out.problems.push(Problem::new(Some(&id), None, true, error));
            }
            beat();
        }
        Ok(out)
    }
}

/// robomimic's names for ALOHA's datasets.
fn name_of(path: &str) -> String {
    match path.strip_prefix("observations/") {
        Some(rest) => format!("obs/{rest}"),
        None if path == "action" => "actions".to_owned(),
        None => path.to_owned(),
    }
}

fn episode(index: usize, file: &Walked, out: &mut Draft) -> Result<(), InputError> {
    let (attr_names, _) = file.some_attrs("/", &[])?;
    let mut keys = BTreeMap::new();
    let mut inner = Vec::new();
    let number = number_of(&file.path, index);
    let mut id = format!("demo_{number}");
    if out.demos.iter().any(|d| d.plan.id == id) {
        id = format!("demo_{number}_{index}");
    }
    let length = file.datasets["action"].shape.first().copied().unwrap_or(0);
    let mut add = |key: &str, error: InputError| out.problems.push(Problem::new(Some(&id), Some(key), true, error));
    for (path, error) in &file.broken {
        add(&name_of(path), error.clone());
    }
    for (path, node) in &file.datasets {
        let key = name_of(path);
        if let Some(fault) = &node.fault {
            add(&key, fault.clone());
        } else if (key.starts_with("obs/") || key == "actions") && node.shape.first() != Some(&length) {
            let error = InputError::WrongLength {
                path: file.path.clone(),
                demo: id.clone(),
                key: key.clone(),
                expected: format!("{length} (action)"),
                found: format!("shape {:?}", node.shape),
            };
            add(&key, error);
        }
        if node.attrs > 0 {
            inner.push((key.clone(), index, path.clone()));
        }
        if let Some(plan) = key_plan(index, file, path) {
            keys.insert(key, plan);
        }
    }
    let mut groups = BTreeSet::new();
    for (path, node) in file.groups.iter().filter(|(path, _)| !path.is_empty()) {
        let key = name_of(path);
        if node.attrs > 0 {
            inner.push((key.clone(), index, path.clone()));
        }
        if node.empty {
            groups.insert(key);
        }
    }
    let plan = DemoPlan { id, number, length, keys, attr_names, task: None };
    out.demos.push(DemoDraft { plan, home: Some((index, String::new())), groups, inner });
    Ok(())
}
