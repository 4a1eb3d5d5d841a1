//! Reading with libhdf5 in this process: what the reading process does, and what [`super::Source::open`] does
//! for files that are trusted.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use super::dialect::{self, DemoDraft, Draft, Survey};
use super::walk::{Walked, check_signature};
use crate::error::InputError;
use crate::plan::{Plan, Problem};
use crate::tree::{Array, Demo};

/// What a source can be asked for, in this process or in another.
pub(super) trait Backend: Send + Sync {
    /// Everything that belongs to no demo.
    fn root(&self) -> Result<Demo, InputError>;
    /// Attributes and groups of a demo, and the datasets that are named.
    fn demo(&self, index: usize, keys: &[String]) -> Result<Demo, InputError>;
    /// Rows of one dataset of a demo.
    fn rows(&self, index: usize, key: &str, first: usize, count: usize) -> Result<Array, InputError>;
}

/// An opened source.
pub(super) struct Local {
    survey: Survey,
    plan: Plan,
    drafts: Vec<DemoDraft>,
}

/// Files of a folder beyond this many are opened one at a time.
const KEEP_OPEN: usize = 64;

impl Local {
    /// Opens a file, or a folder of files, and plans it; `beat` is called as the work goes on.
    pub fn open(path: &Path, beat: &mut dyn FnMut()) -> Result<(Self, Plan), InputError> {
        let paths = files(path)?;
        let keep = paths.len() <= KEEP_OPEN;
        let (mut files, mut lost) = (Vec::new(), Vec::new());
        for (index, file) in paths.iter().enumerate() {
            match Walked::open(file, keep, beat) {
                Ok(walked) => files.push(walked),
                Err(error) if path.is_dir() => {
                    let id = format!("demo_{}", dialect::number_of(file, index));
                    lost.push(Problem::new(Some(&id), None, true, error));
                }
                Err(error) => return Err(error),
            }
        }
        if let (true, Some(problem)) = (files.is_empty(), lost.first()) {
            return Err(problem.error.clone());
        }
        let survey = Survey { path: path.to_owned(), files };
        let Draft { dialect, demos, env_args, env_name, env_version, masks, texts, notes, problems } =
            dialect::draft(&survey, beat)?;
        let problems = lost.into_iter().chain(problems).collect();
        let mut linked: Vec<(PathBuf, u64)> = Vec::new();
        for file in survey.files.iter().flat_map(|f| &f.linked) {
            if !linked.contains(file) && !survey.files.iter().any(|f| f.path == file.0) {
                linked.push(file.clone());
            }
        }
        let mut drafts = demos;
        drafts.sort_by(|a, b| (a.plan.number, &a.plan.id).cmp(&(b.plan.number, &b.plan.id)));
        let plan = Plan {
            path: path.to_owned(),
            files: survey.files.iter().map(|f| (f.path.clone(), f.bytes)).chain(linked).collect(),
            dialect,
            demos: drafts.iter().map(|d| d.plan.clone()).collect(),
            env_args,
            env_name,
            env_version,
            masks,
            texts,
            notes,
            problems,
        };
        let local = Self { survey, plan: plan.clone(), drafts };
        Ok((local, plan))
    }

    fn draft(&self, index: usize) -> Result<&DemoDraft, InputError> {
        self.drafts.get(index).ok_or_else(|| InputError::NoSuch {
            path: self.survey.path.clone(),
            wanted: format!("demo at position {index}"),
            found: format!("{} demos", self.drafts.len()),
        })
    }
}

/// The files of a source: itself, or those of a folder.
pub(crate) fn files(path: &Path) -> Result<Vec<PathBuf>, InputError> {
    if path.is_dir() { files_of(path) } else { Ok(vec![path.to_owned()]) }
}

/// What HDF5 files are called.
const EXTENSIONS: [&str; 4] = ["hdf5", "h5", "hdf", "he5"];

/// The HDF5 files of a folder, by the number in their names and then by name, with those that are only called so: an
/// episode may have been cut off, or be a pointer of git-lfs. Hidden ones are somebody's work in progress.
fn files_of(folder: &Path) -> Result<Vec<PathBuf>, InputError> {
    let unreadable = |e: std::io::Error| InputError::Unreadable { path: folder.to_owned(), reason: e.to_string() };
    let mut found = Vec::new();
    let mut others = BTreeSet::new();
    for entry in std::fs::read_dir(folder).map_err(unreadable)? {
        let path = entry.map_err(unreadable)?.path();
        let hidden = path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"."));
        let named = path.extension().is_some_and(|e| EXTENSIONS.iter().any(|known| e.eq_ignore_ascii_case(known)));
        if !hidden && path.is_file() && (named || check_signature(&path).is_ok()) {
            found.push(path);
        } else if let Some(name) = path.file_name() {
            others.insert(name.to_string_lossy().into_owned());
        }
    }
    if found.is_empty() {
        return Err(InputError::UnknownLayout {
            path: folder.to_owned(),
            expected: "a file, or a folder of HDF5 files with one episode each".to_owned(),
            found: dialect::list(others.iter().map(String::as_str)),
        });
    }
    let number = |path: &Path| {
        let stem = path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        let digits = stem.bytes().rev().take_while(u8::is_ascii_digit).count();
        stem[stem.len() - digits..].parse::<u64>().unwrap_or(u64::MAX)
    };
    found.sort_by_cached_key(|path| (number(path), path.clone()));
    Ok(found)
}

impl Backend for Local {
    fn root(&self) -> Result<Demo, InputError> {
        let mut root = Demo::default();
        let Some(file) = self.survey.single() else { return Ok(root) };
        if self.drafts.iter().any(|d| d.home.as_ref().is_some_and(|(_, path)| path.is_empty())) {
            // the file is the demo
            return Ok(root);
        }
        root.attrs = file.attrs("")?;
        let homes: Vec<String> = self.drafts.iter().filter_map(|d| Some(format!("{}/", d.home.as_ref()?.1))).collect();
        let homes: BTreeSet<&str> = homes.iter().map(String::as_str).collect();
        // a home is `data/demo_3/`: two levels, so the first two levels of a path decide
        let in_demo = |path: &str| {
            let end = path.match_indices('/').nth(1).map_or(path.len(), |(at, _)| at);
            homes.contains(format!("{}/", &path[..end]).as_str())
        };
        let used: BTreeSet<&str> =
            self.plan.demos.iter().flat_map(|d| d.keys.values().map(|k| k.place.path.as_str())).collect();
        for (path, node) in &file.groups {
            if path.is_empty() || in_demo(path) {
                continue;
            }
            if node.empty {
                root.groups.insert(path.clone());
            }
            if node.attrs > 0 {
                root.inner_attrs.insert(path.clone(), file.attrs(path)?);
            }
        }
        for (path, node) in &file.datasets {
            if in_demo(path) || used.contains(path.as_str()) {
                continue;
            }
            root.datasets.insert(path.clone(), file.read(path, None)?);
            if node.attrs > 0 {
                root.inner_attrs.insert(path.clone(), file.attrs(path)?);
            }
        }
        Ok(root)
    }

    fn demo(&self, index: usize, keys: &[String]) -> Result<Demo, InputError> {
        let draft = self.draft(index)?;
        let mut demo = Demo { id: draft.plan.id.clone(), ..Demo::default() };
        if let Some((file, path)) = &draft.home {
            demo.attrs = self.survey.files[*file].attrs(path)?;
        }
        demo.groups = draft.groups.clone();
        for (below, file, path) in &draft.inner {
            demo.inner_attrs.insert(below.clone(), self.survey.files[*file].attrs(path)?);
        }
        for key in keys {
            let rows = draft.plan.keys.get(key).and_then(|k| k.shape.first().copied());
            let array = match rows {
                Some(rows) => self.rows(index, key, 0, rows)?,
                None => self.scalar(index, key)?,
            };
            demo.datasets.insert(key.clone(), array);
        }
        Ok(demo)
    }

    fn rows(&self, index: usize, key: &str, first: usize, count: usize) -> Result<Array, InputError> {
        let place = self.place(index, key)?;
        self.survey.files[place.file].read(&place.path, Some((place.first_row + first, count)))
    }
}

impl Local {
    fn place(&self, index: usize, key: &str) -> Result<&crate::plan::Place, InputError> {
        let draft = self.draft(index)?;
        draft.plan.keys.get(key).map(|k| &k.place).ok_or_else(|| InputError::MissingKey {
            path: self.survey.path.clone(),
            demo: draft.plan.id.clone(),
            key: key.to_owned(),
            found: dialect::list(draft.plan.keys.keys().map(String::as_str)),
        })
    }

    fn scalar(&self, index: usize, key: &str) -> Result<Array, InputError> {
        let place = self.place(index, key)?;
        self.survey.files[place.file].read(&place.path, None)
    }
}
