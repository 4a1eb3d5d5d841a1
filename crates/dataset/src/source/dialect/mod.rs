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
use std::path::PathBuf;

use super::walk::Walked;
use crate::error::InputError;
use crate::plan::{DemoPlan, Dialect, KeyPlan, Place, Problem};

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
    match LAYOUTS.iter().find(|layout| layout.recognises(survey)) {
        Some(layout) => layout.draft(survey, beat),
        None => {
            let expected: Vec<_> = LAYOUTS.iter().map(|layout| layout.expected()).collect();
            Err(InputError::UnknownLayout {
                path: survey.path.clone(),
                expected: expected.join(", or "),
                found: survey.contents(),
            })
        }
    }
}

/// A dataset as a demo's key: all of it.
fn key_plan(file: usize, walked: &Walked, path: &str) -> Option<KeyPlan> {
    let node = walked.datasets.get(path)?;
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

/// Names in a line; at most twenty of them.
pub(super) fn list<'a>(names: impl Iterator<Item = &'a str>) -> String {
    let all: Vec<&str> = names.collect();
    match all.len() {
        0 => "nothing".to_owned(),
        1..=20 => all.join(", "),
        n => format!("{}, ... ({n} in all)", all[..20].join(", ")),
    }
}
