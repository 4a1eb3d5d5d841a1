//! Reading with libhdf5 in this process: what the reading process does, and what [`super::Source::open`] does
//! for files that are trusted.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::dialect::{self, DemoDraft, Draft, Survey};
use super::walk::{DatasetNode, Walked, check_signature};
use crate::error::InputError;
use crate::plan::{DemoPlan, Join, KeyPlan, Plan, Problem};
use crate::tree::{Array, Attrs, Demo, Dtype};

/// What a source can be asked for, in this process or in another.
pub(super) trait Backend: Send + Sync {
    /// Everything that belongs to no demo; its datasets only where they are wanted.
    fn root(&self, datasets: bool) -> Result<Demo, InputError>;
    /// Attributes and groups of a demo, and the datasets that are named.
    fn demo(&self, index: usize, keys: &[String]) -> Result<Demo, InputError>;
    /// Rows of one dataset of a demo.
    fn rows(&self, index: usize, key: &str, first: usize, count: usize) -> Result<Array, InputError>;
}

/// An opened source.
pub(super) struct Local {
    survey: Survey,
    plan: Arc<Plan>,
    /// What is in each demo beside its datasets.
    parts: Vec<Parts>,
}

/// See [`DemoDraft`].
struct Parts {
    home: Option<(usize, String)>,
    groups: BTreeSet<String>,
    inner: Vec<(String, usize, String)>,
}

/// Files of a folder beyond this many are opened one at a time.
const KEEP_OPEN: usize = 64;

impl Local {
    /// Opens a file, or a folder of files, and plans it; `beat` is called as the work goes on.
    pub fn open(path: &Path, beat: &mut dyn FnMut()) -> Result<(Self, Arc<Plan>), InputError> {
        let paths = files(path)?;
        let keep = paths.len() <= KEEP_OPEN;
        let (mut files, mut lost) = (Vec::new(), Vec::new());
        for (index, file) in paths.iter().enumerate() {
            match Walked::open(file, keep, beat) {
                Ok(walked) => files.push(walked),
                Err(error) if path.is_dir() => {
                    lost.push((file, dialect::number_of(file, index), error));
                }
                Err(error) => return Err(error),
            }
        }
        if let (true, Some((.., error))) = (files.is_empty(), lost.first()) {
            return Err(error.clone());
        }
        let survey = Survey { path: path.to_owned(), files };
        let Draft { dialect, demos, env_args, env_name, env_version, masks, texts, notes, problems } =
            dialect::draft(&survey, beat)?;
        let of_file = |(file, number, error): (&PathBuf, u64, InputError)| {
            let mut id = format!("demo_{number}");
            if demos.iter().any(|demo| demo.plan.id == id) {
                // a file of many demos is no demo itself
                id = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
            }
            Problem::new(Some(&id), None, true, error)
        };
        let problems = lost.into_iter().map(of_file).chain(problems).collect();
        let mut linked: Vec<(PathBuf, u64)> = Vec::new();
        for file in survey.files.iter().flat_map(|f| &f.linked) {
            if !linked.contains(file) && !survey.files.iter().any(|f| f.path == file.0) {
                linked.push(file.clone());
            }
        }
        let mut drafts = demos;
        drafts.sort_by(|a, b| (a.plan.number, &a.plan.id).cmp(&(b.plan.number, &b.plan.id)));
        let (demos, parts) = drafts
            .into_iter()
            .map(|DemoDraft { plan, home, groups, inner }| (plan, Parts { home, groups, inner }))
            .unzip();
        let plan = Arc::new(Plan {
            path: path.to_owned(),
            files: survey.files.iter().map(|f| (f.path.clone(), f.bytes)).chain(linked).collect(),
            dialect,
            demos,
            env_args,
            env_name,
            env_version,
            masks,
            texts,
            notes,
            problems,
        });
        Ok((Self { survey, plan: Arc::clone(&plan), parts }, plan))
    }

    fn at(&self, index: usize) -> Result<(&DemoPlan, &Parts), InputError> {
        self.plan.demos.get(index).zip(self.parts.get(index)).ok_or_else(|| InputError::NoSuch {
            path: self.survey.path.clone(),
            wanted: format!("demo at position {index}"),
            found: format!("{} demos", self.parts.len()),
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
/// Where there is none, those of the folders below.
fn files_of(folder: &Path) -> Result<Vec<PathBuf>, InputError> {
    let mut found = Vec::new();
    let mut others = BTreeSet::new();
    let mut folders = Vec::new();
    list_files(folder, true, &mut found, &mut folders, &mut others)?;
    let mut deeper = Vec::new();
    // an episode a folder, a folder of tasks, a folder beside instructions and videos
    for _ in 0..MAX_FOLDERS {
        let above = !found.is_empty();
        let into = if above { &mut deeper } else { &mut found };
        for folder in std::mem::take(&mut folders) {
            let listed = list_files(&folder, !above, into, &mut folders, &mut BTreeSet::new());
            // what is beside the files need not be readable
            listed.or_else(|error| if above { Ok(()) } else { Err(error) })?;
        }
    }
    if found.is_empty() {
        return Err(no_demonstrations(folder, &others));
    }
    if !deeper.is_empty() {
        let expected = "HDF5 files at one depth (name one of the folders, or move the others away)";
        return Err(InputError::UnknownLayout {
            path: folder.to_owned(),
            expected: expected.to_owned(),
            found: format!("{}, and deeper {}", names_in(folder, found), names_in(folder, deeper)),
        });
    }
    found.sort_by_cached_key(|path| (file_number(path), path.clone()));
    Ok(found)
}

/// Paths from a folder on, in a line.
fn names_in(folder: &Path, mut paths: Vec<PathBuf>) -> String {
    paths.sort();
    let names: Vec<_> = paths.iter().map(|path| path.strip_prefix(folder).unwrap_or(path).to_string_lossy()).collect();
    dialect::list(names.iter().map(|name| &**name))
}

/// The number at the end of a file's name, which orders the files of a folder; the largest of all if there is none.
pub(crate) fn file_number(path: &Path) -> u64 {
    let stem = path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    let digits = stem.bytes().rev().take_while(u8::is_ascii_digit).count();
    stem[stem.len() - digits..].parse().unwrap_or(u64::MAX)
}

/// Files by which a folder is known as a data set: of LeRobot, zarr, RLDS.
const MARKS: [&str; 3] = ["meta/info.json", "meta/episode_ends/.zarray", "features.json"];

/// Why a folder without an HDF5 file is refused: it is a LeRobot data set already, its folders are sets, or it is none.
fn no_demonstrations(folder: &Path, names: &BTreeSet<String>) -> InputError {
    let is_set = |name: &&str| MARKS.iter().any(|mark| folder.join(name).join(mark).is_file());
    let sets: Vec<&str> = names.iter().map(String::as_str).filter(is_set).collect();
    let (expected, found) = if folder.join(MARKS[0]).is_file() {
        let ready = "a LeRobot data set, which needs no conversion: `actrm-data edit` changes it, `convert --to robomimic` writes HDF5";
        ("demonstrations to convert", ready.to_owned())
    } else if !sets.is_empty() {
        ("one data set: name one of its folders", dialect::list(sets.into_iter()))
    } else {
        let all = dialect::list(names.iter().map(String::as_str));
        ("a file, or a folder of HDF5 files with one episode each", all)
    };
    InputError::UnknownLayout { path: folder.to_owned(), expected: expected.to_owned(), found }
}

/// Folders in folders are looked through so deep: DROID has four.
pub(super) const MAX_FOLDERS: usize = 5;

/// Sorts what is in a folder into HDF5 files, folders and the names of everything else. Files of other names are opened to
/// see whether they are HDF5 only if `signed`.
fn list_files(
    folder: &Path,
    signed: bool,
    found: &mut Vec<PathBuf>,
    folders: &mut Vec<PathBuf>,
    others: &mut BTreeSet<String>,
) -> Result<(), InputError> {
    let unreadable = |e: std::io::Error| InputError::Unreadable { path: folder.to_owned(), reason: e.to_string() };
    for entry in std::fs::read_dir(folder).map_err(unreadable)? {
        let entry = entry.map_err(unreadable)?;
        let path = entry.path();
        let hidden = path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"."));
        let named = path.extension().is_some_and(|e| EXTENSIONS.iter().any(|known| e.eq_ignore_ascii_case(known)));
        if !hidden && (named || signed) && path.is_file() && (named || check_signature(&path).is_ok()) {
            found.push(path);
            continue;
        }
        if let Some(name) = path.file_name() {
            others.insert(name.to_string_lossy().into_owned());
        }
        // links to folders may lead in a circle
        if !hidden && entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            folders.push(path);
        }
    }
    Ok(())
}

fn datasets_of(file: &Walked) -> impl Iterator<Item = (&Walked, &str, &DatasetNode)> {
    file.datasets.iter().map(move |(path, node)| (file, path, node))
}

/// Bytes of the datasets that belong to no demo, at most: they are read at once.
const MAX_OUTSIDE: u64 = 192 << 20;

/// Refuses datasets that are too large to be read at once, by the name of the largest.
fn fits<'w>(datasets: impl Iterator<Item = (&'w Walked, &'w str, &'w DatasetNode)>) -> Result<(), InputError> {
    let bytes = |node: &DatasetNode| {
        let size = node.dtype.size().unwrap_or(0) as u64;
        node.shape.iter().fold(size, |bytes, &extent| bytes.saturating_mul(extent as u64))
    };
    let (mut all, mut largest) = (0_u64, None);
    for (file, path, node) in datasets {
        all = all.saturating_add(bytes(node));
        largest = largest.max(Some((bytes(node), path, &file.path)));
    }
    match largest.filter(|_| all > MAX_OUTSIDE) {
        Some((_, path, file)) => Err(InputError::TooLarge {
            path: file.clone(),
            object: format!("{path} and what else belongs to no demo (--no-lossless leaves it out)"),
            bytes: all,
            limit: MAX_OUTSIDE,
        }),
        None => Ok(()),
    }
}

impl Backend for Local {
    fn root(&self, datasets: bool) -> Result<Demo, InputError> {
        let mut root = Demo::default();
        for (name, text) in &self.plan.texts {
            if let Some(name) = name.strip_prefix(dialect::BESIDE) {
                root.attrs.insert(name.to_owned(), Array::from_str(text));
            }
        }
        let Some(file) = self.survey.single() else {
            if self.parts.iter().any(|d| d.home.as_ref().is_some_and(|(_, path)| !path.is_empty())) {
                self.roots(&mut root, datasets)?;
            }
            return Ok(root);
        };
        if self.parts.iter().any(|d| d.home.as_ref().is_some_and(|(_, path)| path.is_empty())) {
            // the file is the demo
            return Ok(root);
        }
        root.attrs.extend(file.attrs("")?);
        let homes: Vec<String> = self.parts.iter().filter_map(|d| Some(format!("{}/", d.home.as_ref()?.1))).collect();
        let homes: BTreeSet<&str> = homes.iter().map(String::as_str).collect();
        // a home is `data/demo_3/` or `traj_3/`, so the first two levels of a path decide
        let in_demo = |path: &str| {
            let mut ends = path.match_indices('/').map(|(at, _)| at).chain([path.len()]).take(2);
            ends.any(|end| homes.contains(format!("{}/", &path[..end]).as_str()))
        };
        let used: BTreeSet<&str> =
            self.plan.demos.iter().flat_map(|d| d.keys.values().map(|k| &*k.place.path)).collect();
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
        let outside = |path: &str| !in_demo(path) && !used.contains(path);
        if datasets {
            fits(datasets_of(file).filter(|(_, path, _)| outside(path)))?;
        }
        for (path, node) in file.datasets.iter().filter(|(path, _)| outside(path)) {
            if datasets {
                root.datasets.insert(path.to_owned(), file.read(path, None)?);
            }
            if node.attrs > 0 {
                root.inner_attrs.insert(path.to_owned(), file.attrs(path)?);
            }
        }
        Ok(root)
    }

    fn demo(&self, index: usize, keys: &[String]) -> Result<Demo, InputError> {
        let (plan, parts) = self.at(index)?;
        let mut demo = Demo { id: plan.id.clone(), ..Demo::default() };
        if let Some((file, path)) = &parts.home {
            demo.attrs = self.survey.files[*file].attrs(path)?;
        }
        demo.groups = parts.groups.clone();
        for (below, file, path) in &parts.inner {
            demo.inner_attrs.insert(below.clone(), self.survey.files[*file].attrs(path)?);
        }
        for key in keys {
            let rows = plan.keys.get(key).and_then(|k| k.shape.first().copied());
            let array = match rows {
                Some(rows) => self.rows(index, key, 0, rows)?,
                None => self.scalar(index, key)?,
            };
            demo.datasets.insert(key.clone(), array);
        }
        Ok(demo)
    }

    fn rows(&self, index: usize, key: &str, first: usize, count: usize) -> Result<Array, InputError> {
        let KeyPlan { place, dtype, .. } = self.key(index, key)?;
        let file = &self.survey.files[place.file];
        let from = place.first_row + first;
        let beside = match place.join.as_deref() {
            None => {
                let mut array = file.read(&place.path, Some((from, count)))?;
                // byte strings that hold JPEG files are rows of bytes
                if let (Dtype::U8, &Dtype::FixedStr(width)) = (dtype, &array.dtype) {
                    array.dtype = Dtype::U8;
                    array.shape.push(width);
                }
                return Ok(array);
            }
            Some(Join::Before(path)) => {
                let mut array = file.read(path, Some((0, usize::from(from == 0 && count > 0))))?;
                let rest = file.read(&place.path, Some((from.saturating_sub(1), count - array.shape[0])))?;
                array.shape[0] += rest.shape[0];
                array.bytes.extend_from_slice(&rest.bytes);
                return Ok(array);
            }
            Some(Join::Beside(paths)) => paths,
        };
        let mut parts = vec![file.read(&place.path, Some((from, count)))?];
        for path in beside {
            parts.push(file.read(path, Some((from, count)))?);
        }
        let width = |part: &Array| part.shape.iter().skip(1).product::<usize>();
        let shape = vec![count, parts.iter().map(width).sum()];
        let mut bytes = Vec::new();
        for row in 0..count {
            for part in &parts {
                let size = part.bytes.len() / count;
                bytes.extend_from_slice(&part.bytes[row * size..(row + 1) * size]);
            }
        }
        Ok(Array { dtype: parts[0].dtype.clone(), shape, bytes })
    }
}

impl Local {
    /// What belongs to no demo in several files of many demos each: the attributes that the group `data` needs, and below
    /// `files/<name>` everything else of each.
    fn roots(&self, root: &mut Demo, datasets: bool) -> Result<(), InputError> {
        let mut data = Attrs::from([("total".to_owned(), Array::from_i64(Vec::new(), &[self.plan.frames() as i64]))]);
        if let Some(env_args) = &self.plan.env_args {
            data.insert("env_args".to_owned(), Array::from_str(&env_args.to_string()));
        }
        root.inner_attrs.insert("data".to_owned(), data);
        for (name, demos) in &self.plan.masks {
            root.datasets.insert(format!("mask/{name}"), Array::from_fixed_strings(demos));
        }
        let outside = |path: &str| !path.starts_with("data/") && !path.starts_with("mask/");
        if datasets {
            fits(self.survey.files.iter().flat_map(datasets_of).filter(|(_, path, _)| outside(path)))?;
        }
        for file in &self.survey.files {
            let name = file.path.file_name().unwrap_or_default().to_string_lossy();
            for (path, _) in file.groups.iter().filter(|(path, node)| node.attrs > 0 && outside(path)) {
                let below = if path.is_empty() { String::new() } else { format!("/{path}") };
                root.inner_attrs.insert(format!("files/{name}{below}"), file.attrs(path)?);
            }
            for path in file.datasets.keys().filter(|path| datasets && outside(path)) {
                root.datasets.insert(format!("files/{name}/{path}"), file.read(path, None)?);
            }
        }
        Ok(())
    }

    fn key(&self, index: usize, key: &str) -> Result<&KeyPlan, InputError> {
        let (plan, _) = self.at(index)?;
        plan.keys.get(key).ok_or_else(|| InputError::MissingKey {
            path: self.survey.path.clone(),
            demo: plan.id.clone(),
            key: key.to_owned(),
            found: dialect::list(plan.keys.keys()),
        })
    }

    fn scalar(&self, index: usize, key: &str) -> Result<Array, InputError> {
        let place = &self.key(index, key)?.place;
        self.survey.files[place.file].read(&place.path, None)
    }
}
