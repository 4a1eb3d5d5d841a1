//! The layouts that files of demonstrations come in: each recognised by content, each in a file of its own.

mod aloha;
mod d4rl;
mod family;
mod libero;
mod mimicgen;
mod robocasa;
mod robomimic;
mod robosuite_raw;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::walk::Walked;
use crate::error::InputError;
use crate::plan::{DemoPlan, Dialect, KeyPlan, Place, Problem};
use crate::tree::Dtype;

/// A source as walked: one file, or every file of a folder in numeric order of their names.
pub(super) struct Survey {
    pub path: PathBuf,
    pub files: Vec<Walked>,
}

impl Survey {
    /// The file, where the source is one.
    pub fn single(&self) -> Option<&Walked> {
        if self.files.len() == 1 { self.files.first() } else { None }
    }

    /// What is at the top of the source, in a line.
    pub fn contents(&self) -> String {
        match self.files.as_slice() {
            [] => "nothing".to_owned(),
            [file] => {
                let names: BTreeSet<String> = file
                    .groups
                    .keys()
                    .filter(|p| !p.is_empty() && p.matches('/').count() < 2)
                    .map(|p| format!("{p}/"))
                    .chain(file.datasets.keys().filter(|p| !p.contains('/')).cloned())
                    .collect();
                list(names.iter().map(String::as_str))
            }
            [first, ..] => format!(
                "{} files, the first with {}",
                self.files.len(),
                list(first.groups.keys().chain(first.datasets.keys()).map(String::as_str))
            ),
        }
    }
}

/// A plan in the making.
pub(super) struct Draft {
    pub dialect: Dialect,
    pub demos: Vec<DemoDraft>,
    pub env_args: Option<serde_json::Value>,
    pub env_name: Option<String>,
    pub env_version: Option<String>,
    pub masks: BTreeMap<String, Vec<String>>,
    pub texts: BTreeMap<String, String>,
    pub notes: Vec<String>,
    pub problems: Vec<Problem>,
}

/// A demo, and where the parts of it lie that are no dataset.
pub(super) struct DemoDraft {
    pub plan: DemoPlan,
    /// Where the demo's own attributes are: file and path of the group, if it has a group of its own.
    pub home: Option<(usize, String)>,
    /// Groups without members, by path below the demo.
    pub groups: BTreeSet<String>,
    /// Objects below the demo that have attributes: path below the demo, file, path in the file.
    pub inner: Vec<(String, usize, String)>,
}

/// One way to lay out demonstrations.
trait Layout {
    /// What a source of this layout has, for the message about an unknown one.
    fn expected(&self) -> &'static str;
    /// Whether the source is laid out this way.
    fn recognises(&self, survey: &Survey) -> bool;
    /// Finds the demos; `beat` is called as the work goes on.
    fn draft(&self, survey: &Survey, beat: &mut dyn FnMut()) -> Result<Draft, InputError>;
}

/// The special ones first: most are robomimic's layout with something more.
const LAYOUTS: [&dyn Layout; 7] = [
    &libero::Libero,
    &robocasa::Robocasa,
    &mimicgen::Mimicgen,
    &robosuite_raw::RobosuiteRaw,
    &robomimic::Robomimic,
    &d4rl::D4rl,
    &aloha::Aloha,
];

/// Recognises the layout and finds the demos.
pub(super) fn draft(survey: &Survey, beat: &mut dyn FnMut()) -> Result<Draft, InputError> {
    let Some(layout) = LAYOUTS.iter().find(|layout| layout.recognises(survey)) else {
        // a link that is not followed may be what is missed
        if let Some(error) = survey.files.iter().find_map(|file| file.broken.values().next()) {
            return Err(error.clone());
        }
        let expected: Vec<_> = LAYOUTS.iter().map(|layout| layout.expected()).collect();
        return Err(InputError::UnknownLayout {
            path: survey.path.clone(),
            expected: expected.join(", or "),
            found: survey.contents(),
        });
    };
    let mut draft = layout.draft(survey, beat)?;
    let faults = survey.files.iter().flat_map(|file| &file.faults);
    draft.problems.splice(0..0, faults.map(|fault| Problem::new(None, None, false, fault.clone())));
    ragged(survey, &mut draft);
    Ok(draft)
}

/// Datasets that have one row per step wherever they occur.
fn per_step(key: &str) -> bool {
    matches!(key, "actions" | "actions_abs" | "rewards" | "dones" | "mistakes" | "states")
        || ["obs/", "next_obs/", "action_dict/"].iter().any(|p| key.starts_with(p))
}

/// Keys that some demos have and others lack, and keys whose elements differ in shape or type.
fn ragged(survey: &Survey, out: &mut Draft) {
    let hopeless = |id: &str| out.problems.iter().any(|p| p.fatal && p.key.is_none() && p.demo.as_deref() == Some(id));
    let demos: Vec<&DemoPlan> = out.demos.iter().map(|demo| &demo.plan).filter(|plan| !hopeless(&plan.id)).collect();
    let mut all: BTreeMap<&str, (&str, &Dtype, &[usize])> = BTreeMap::new();
    let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
    let mut problems = Vec::new();
    for plan in &demos {
        for (key, k) in &plan.keys {
            let step = k.shape.get(1..).unwrap_or_default();
            *counts.entry(key).or_default() += 1;
            let (first, dtype, shape) = all.entry(key).or_insert((&plan.id, &k.dtype, step));
            if per_step(key) && (*dtype, *shape) != (&k.dtype, step) {
                let error = InputError::WrongShape {
                    path: survey.path.clone(),
                    demo: plan.id.clone(),
                    key: key.clone(),
                    expected: format!("{dtype} {shape:?} per step as in {first}"),
                    found: format!("{} {step:?} per step", k.dtype),
                };
                problems.push(Problem::new(Some(&plan.id), Some(key), false, error));
            }
        }
    }
    // actions, rewards and dones have been asked for already
    let asked = |key: &str| out.dialect != Dialect::Aloha && matches!(key, "actions" | "rewards" | "dones");
    let some = counts.into_iter().filter(|&(key, count)| count < demos.len() && !asked(key));
    let (mut notes, mut missing) = (Vec::new(), Vec::new());
    for (key, count) in some {
        let lacking = || demos.iter().enumerate().filter(|(_, plan)| !plan.keys.contains_key(key));
        if !per_step(key) {
            let without = list(lacking().map(|(_, plan)| plan.id.as_str()));
            notes.push(format!("{key} is in {count} of {} demos, not in {without}", demos.len()));
            continue;
        }
        for (position, plan) in lacking() {
            let known = |p: &Problem| p.demo.as_deref() == Some(&plan.id) && p.key.as_deref() == Some(key);
            if out.problems.iter().any(known) {
                continue;
            }
            let error = InputError::MissingKey {
                path: survey.path.clone(),
                demo: plan.id.clone(),
                key: key.to_owned(),
                found: format!("it in {}; here {}", all[key].0, list(plan.keys.keys().map(String::as_str))),
            };
            missing.push((position, Problem::new(Some(&plan.id), Some(key), false, error)));
        }
    }
    missing.sort_by_key(|(position, _)| *position);
    problems.extend(missing.into_iter().map(|(_, problem)| problem));
    out.notes.append(&mut notes);
    out.problems.append(&mut problems);
}

/// A dataset as a demo's key: all of it; `None` where it cannot be read.
fn key_plan(file: usize, walked: &Walked, path: &str) -> Option<KeyPlan> {
    let node = walked.datasets.get(path).filter(|node| node.fault.is_none())?;
    Some(KeyPlan {
        dtype: node.dtype.clone(),
        shape: node.shape.clone(),
        block_rows: node.block_rows,
        place: Place { file, path: path.to_owned(), first_row: 0, offset: node.offset },
    })
}

/// The number at the end of a name such as `demo_12` or `episode_3`.
fn number_after(name: &str, prefix: &str) -> Option<u64> {
    let digits = name.strip_prefix(prefix)?;
    if digits.is_empty() || !digits.bytes().all(|b| b.is_ascii_digit()) {
        return None;
    }
    digits.parse().ok()
}

/// The number at the end of a file's name; its position in the folder if there is none.
pub(super) fn number_of(file: &Path, index: usize) -> u64 {
    let stem = file.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    let digits = stem.len() - stem.bytes().rev().take_while(u8::is_ascii_digit).count();
    stem[digits..].parse().unwrap_or(index as u64)
}

/// Names in a line; at most twenty of them.
pub(crate) fn list<'a>(names: impl Iterator<Item = &'a str>) -> String {
    let all: Vec<&str> = names.collect();
    match all.len() {
        0 => "nothing".to_owned(),
        1..=20 => all.join(", "),
        n => format!("{}, ... ({n} in all)", all[..20].join(", ")),
    }
}
