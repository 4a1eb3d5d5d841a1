//! The layouts that files of demonstrations come in: each recognised by content, each in a file of its own.

mod aloha;
mod behavior;
mod d4rl;
mod droid;
mod family;
mod isaac_lab;
mod libero;
mod maniskill;
mod mimicgen;
mod robocasa;
mod robomimic;
mod robosuite_raw;
mod robotwin;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::local::file_number;
use super::value::one_line;
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

    /// Whether any of the files is laid out this way.
    pub fn any(&self, is: impl Fn(&Walked) -> bool) -> bool {
        self.files.iter().any(is)
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
                    .chain(file.datasets.keys().filter(|p| !p.contains('/')).map(str::to_owned))
                    .collect();
                list(names.iter().map(String::as_str))
            }
            [first, ..] => format!(
                "{} files, the first with {}",
                self.files.len(),
                list(first.groups.keys().map(String::as_str).chain(first.datasets.keys()))
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

impl Draft {
    /// Nothing found yet.
    fn new(dialect: Dialect) -> Self {
        Self {
            dialect,
            demos: Vec::new(),
            env_args: None,
            env_name: None,
            env_version: None,
            masks: BTreeMap::new(),
            texts: BTreeMap::new(),
            notes: Vec::new(),
            problems: Vec::new(),
        }
    }
}

/// Begins the names of texts that come from a file beside the source: the root keeps them.
pub(super) const BESIDE: &str = "beside/";

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
const LAYOUTS: [&dyn Layout; 12] = [
    &libero::Libero,
    &robocasa::Robocasa,
    &isaac_lab::IsaacLab,
    &behavior::Behavior,
    &mimicgen::Mimicgen,
    &robosuite_raw::RobosuiteRaw,
    &robomimic::Robomimic,
    &d4rl::D4rl,
    &aloha::Aloha,
    &maniskill::Maniskill,
    &robotwin::Robotwin,
    &droid::Droid,
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
    draft.notes.extend(odd_attrs(survey));
    draft.notes.extend(renumbered(survey, &draft.demos));
    ragged(survey, &mut draft);
    Ok(draft)
}

/// Notes on the attributes that are left out, one for each name.
fn odd_attrs(survey: &Survey) -> Vec<String> {
    let mut all: BTreeMap<&str, (usize, &str, &str)> = BTreeMap::new();
    for ((object, name), what) in survey.files.iter().flat_map(|file| &file.odd_attrs) {
        all.entry(name).or_insert((0, object, what)).0 += 1;
    }
    let note = |(name, (count, object, what)): (&str, (usize, &str, &str))| {
        let object = if object.is_empty() { "the file" } else { object };
        let more = if count > 1 { format!(" and {} more", count - 1) } else { String::new() };
        format!("attribute {} of {object}{more} is left out: the type {what} is not supported", one_line(name))
    };
    all.into_iter().map(note).collect()
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
            // a row of bytes is as long as the longest file of its demo
            let files = **dtype == Dtype::U8 && k.dtype == Dtype::U8 && (shape.len(), step.len()) == (1, 1);
            if per_step(key) && !files && (*dtype, *shape) != (&k.dtype, step) {
                let error = InputError::WrongShape {
                    path: survey.path.clone(),
                    demo: plan.id.clone(),
                    key: key.to_owned(),
                    expected: format!("{dtype} {shape:?} per step as in {first}"),
                    found: format!("{} {step:?} per step", k.dtype),
                };
                problems.push(Problem::new(Some(&plan.id), Some(key), false, error));
            }
        }
    }
    // the files of a suite are of tasks with other things each
    let of_files = |key: &str, has: bool| -> BTreeSet<usize> {
        let demos = out.demos.iter().filter(|demo| demo.plan.keys.contains_key(key) == has);
        demos.filter_map(|demo| Some(demo.home.as_ref()?.0)).collect()
    };
    let of_tasks = |key: &str| out.dialect == Dialect::Libero && of_files(key, true).is_disjoint(&of_files(key, false));
    // actions, rewards and dones have been asked for already
    let family = !out.dialect.is_a_recording();
    let asked = |key: &str| family && matches!(key, "actions" | "rewards" | "dones");
    let some = counts.into_iter().filter(|&(key, count)| count < demos.len() && !asked(key));
    let (mut notes, mut missing) = (Vec::new(), Vec::new());
    for (key, count) in some {
        let lacking = || demos.iter().enumerate().filter(|(_, plan)| !plan.keys.contains_key(key));
        if !per_step(key) || of_tasks(key) {
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
                found: format!("it in {}; here {}", all[key].0, list(plan.keys.keys())),
            };
            missing.push((position, Problem::new(Some(&plan.id), Some(key), false, error)));
        }
    }
    missing.sort_by_key(|(position, _)| *position);
    problems.extend(missing.into_iter().map(|(_, problem)| problem));
    out.notes.append(&mut notes);
    out.problems.append(&mut problems);
}

/// A dataset as a demo's key: all of it; `None` where it cannot be read. Byte strings that hold JPEG files are a row of
/// bytes each.
fn key_plan(file: usize, walked: &Walked, path: &str) -> Option<KeyPlan> {
    let node = walked.datasets.get(path).filter(|node| node.fault.is_none())?;
    let place = Place { file, path: path.into(), first_row: 0, offset: node.offset, join: None };
    let (mut dtype, mut shape) = (node.dtype.clone(), node.shape.clone());
    if let (&Dtype::FixedStr(width), &[rows]) = (&node.dtype, shape.as_slice())
        && rows > 0
        && walked.begins_with(path, node, &JPEG)
    {
        (dtype, shape) = (Dtype::U8, vec![rows, width]);
    }
    Some(KeyPlan { dtype, shape: shape.into(), block_rows: node.block_rows, place })
}

/// What belongs to one demo of a file, by its name here.
struct Contents {
    keys: BTreeMap<String, KeyPlan>,
    groups: BTreeSet<String>,
    inner: Vec<(String, usize, String)>,
}

/// Everything below the group `home` of a file, the whole file where that is empty. `named` gives its name here; what
/// cannot be read is a problem of the demo `id`.
fn contents(
    (index, file): (usize, &Walked),
    home: &str,
    id: &str,
    named: &dyn Fn(&str) -> String,
    problems: &mut Vec<Problem>,
) -> Contents {
    let mut out = Contents { keys: BTreeMap::new(), groups: BTreeSet::new(), inner: Vec::new() };
    let prefix = if home.is_empty() { String::new() } else { format!("{home}/") };
    let inside = |path: &str| path.starts_with(&prefix);
    for (path, error) in file.broken.range(prefix.clone()..).take_while(|(path, _)| inside(path)) {
        problems.push(Problem::new(Some(id), Some(&named(&path[prefix.len()..])), true, error.clone()));
    }
    for (path, node) in file.datasets.starting_at(&prefix).take_while(|(path, _)| inside(path)) {
        let mut key = named(&path[prefix.len()..]);
        if out.keys.contains_key(&key) {
            // two datasets of one name here keep the names that they have there
            key = path[prefix.len()..].to_owned();
        }
        if let Some(fault) = &node.fault {
            problems.push(Problem::new(Some(id), Some(&key), true, (**fault).clone()));
        }
        if node.attrs > 0 {
            out.inner.push((key.clone(), index, path.to_owned()));
        }
        if let Some(plan) = key_plan(index, file, path) {
            out.keys.insert(key, plan);
        }
    }
    let groups = file.groups.range(prefix.clone()..).take_while(|(path, _)| inside(path));
    for (path, node) in groups.filter(|(path, _)| !path.is_empty()) {
        let key = named(&path[prefix.len()..]);
        if node.attrs > 0 {
            out.inner.push((key.clone(), index, path.clone()));
        }
        if node.empty {
            out.groups.insert(key);
        }
    }
    out
}

/// A demo that lacks a dataset without which nothing can be made of it.
fn missing(file: &Walked, id: &str, key: &str, keys: &BTreeMap<String, KeyPlan>) -> Problem {
    let error = InputError::MissingKey {
        path: file.path.clone(),
        demo: id.to_owned(),
        key: key.to_owned(),
        found: list(keys.keys().map(String::as_str)),
    };
    Problem::new(Some(id), None, true, error)
}

/// Problems of the datasets that have not one row a step; `of` says where the length was found, if not in the demo.
fn wrong_lengths<'k>(
    file: &Walked,
    id: &str,
    (length, of): (usize, &str),
    keys: impl IntoIterator<Item = (impl AsRef<str>, &'k KeyPlan)>,
) -> Vec<Problem> {
    let problem = |(key, k): (_, &KeyPlan)| {
        let key = AsRef::<str>::as_ref(&key);
        if !per_step(key) || k.shape.first() == Some(&length) {
            return None;
        }
        let error = InputError::WrongLength {
            path: file.path.clone(),
            demo: id.to_owned(),
            key: key.to_owned(),
            expected: if of.is_empty() { length.to_string() } else { format!("{length} ({of})") },
            found: format!("shape {:?}", k.shape),
        };
        Some(Problem::new(Some(id), Some(key), true, error))
    };
    keys.into_iter().filter_map(problem).collect()
}

/// Takes the rows `first .. first + length` of a dataset that has a row for the state after the last step too, and the rows
/// one step later as `next_obs`.
fn observed(keys: &mut BTreeMap<String, KeyPlan>, length: usize) {
    let later: Vec<(String, KeyPlan)> = keys
        .iter()
        .filter(|(key, k)| key.starts_with("obs/") && k.shape.first() == Some(&(length + 1)))
        .map(|(key, k)| (key.replacen("obs/", "next_obs/", 1), k.clone().part(1, length)))
        .collect();
    for (next, plan) in later {
        if let Some(now) = keys.get_mut(&next.replacen("next_obs/", "obs/", 1)) {
            *now = now.clone().part(0, length);
        }
        keys.insert(next, plan);
    }
}

/// The id of the episode that a file is: the number of its name, or the next free one where another has it.
fn id_of(file: &Path, index: usize, demos: &[DemoDraft]) -> (u64, String) {
    let numbers = || demos.iter().map(|demo| demo.plan.number);
    let mut number = number_of(file, index);
    if numbers().any(|taken| taken == number) {
        number = numbers().max().map_or(0, |last| last.saturating_add(1));
    }
    (number, format!("demo_{number}"))
}

/// A note on the files whose episodes have other numbers than their names.
fn renumbered(survey: &Survey, demos: &[DemoDraft]) -> Option<String> {
    let other = |demo: &DemoDraft| {
        let (index, _) = demo.home.as_ref().filter(|(_, home)| home.is_empty())?;
        let path = &survey.files[*index].path;
        let name = path.strip_prefix(&survey.path).unwrap_or(path).display();
        (number_of(path, *index) != demo.plan.number).then(|| format!("{name} is {}", demo.plan.id))
    };
    let others: Vec<String> = demos.iter().filter_map(other).collect();
    let all = list(others.iter().map(String::as_str));
    (!others.is_empty()).then(|| format!("files of other folders or names have the same numbers, so {all}"))
}

/// A file that is no episode as the others of its folder are.
fn stranger(file: &Walked, expected: &str) -> Problem {
    let unknown = || InputError::UnknownLayout {
        path: file.path.clone(),
        expected: expected.to_owned(),
        found: list(file.datasets.keys()),
    };
    let error = file.broken.values().next().cloned().unwrap_or_else(unknown);
    // an episode may have its number
    let id = file.path.file_name().unwrap_or_default().to_string_lossy();
    Problem::new(Some(&id), None, true, error)
}

/// Text of a small file beside the source; `None` where there is none.
fn beside(path: &Path) -> Option<String> {
    const MOST: u64 = 64 << 20;
    let small = std::fs::metadata(path).is_ok_and(|meta| meta.is_file() && meta.len() <= MOST);
    if small { std::fs::read_to_string(path).ok() } else { None }
}

const JPEG: [u8; 3] = [0xFF, 0xD8, 0xFF];

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
    match file_number(file) {
        u64::MAX => index as u64,
        number => number,
    }
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
