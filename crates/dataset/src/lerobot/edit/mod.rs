//! Other data sets made of data sets: some of the episodes, several sets together, columns under other names.
//!
//! Frames, pictures and videos are carried over as they are stored; what follows from which episodes there are (numbers,
//! tasks, masks, statistics, fingerprint, the side folder) is made anew, by the code that conversion has. Results appear
//! whole or not at all, and no source is touched.

mod agree;
mod films;
mod frames;
mod groups;
mod origin;
mod other_columns;
mod repair;
mod select;
mod side;
mod splits;

pub(in crate::lerobot) use frames::is_looked_at;
pub(crate) use frames::statistics_in;
pub(in crate::lerobot) use other_columns::is_own;
pub use repair::{Repair, RepairReport, repair};
pub use select::{Parts, Selection};
pub(in crate::lerobot) use side::texts_like;

use super::check;
use super::export::side_folder;
use super::info::{self, Feature, Features, Info};
use super::meta;
use super::open::{ACTION, Dataset};
use super::other_files::other_files;
use super::side::{Layout, write_manifest};
use super::staging::Staging;
use super::verify::picture_problem;
use super::videos::VIDEO_PATH;
use crate::error::{DatasetError, Result};
use crate::source::list;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// Where an edited data set goes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Destination {
    /// A directory that does not exist.
    New(PathBuf),
    /// The place of the set that is edited: written beside it and exchanged with it at once, so that a kill at any time
    /// leaves one of the two there, whole.
    InPlace,
}

/// What an edit made.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EditReport {
    /// Episodes written.
    pub episodes: usize,
    /// Frames written.
    pub frames: usize,
    /// Task texts.
    pub tasks: Vec<String>,
    /// Files written.
    pub files: usize,
    /// Bytes written.
    pub bytes: u64,
    /// sha256 of the content.
    pub fingerprint: String,
    /// What could not be kept, and what was numbered otherwise.
    pub notes: Vec<String>,
}

/// New names of features by their old ones.
pub type Renames = BTreeMap<String, String>;

/// Told frames done and frames in all; says whether to go on.
type Progress<'p> = dyn FnMut(u64, u64) -> ControlFlow<()> + 'p;
/// Told frames more.
type Advance<'p> = dyn FnMut(u64) -> Result<()> + 'p;

/// Tells how much is done of the work on `set`.
fn tell(progress: &mut Progress<'_>, done: u64, total: u64, set: &Path) -> Result<()> {
    match progress(done, total) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(DatasetError::Stopped { path: set.to_path_buf() }),
    }
}

/// A data set that episodes are taken from.
struct Input {
    set: Dataset,
    /// Of its side folder, whose files have the hashes recorded.
    layout: Option<Layout>,
    /// Whether its videos, a file an episode, become files of many episodes.
    joins: bool,
}

impl Input {
    /// Opens a set and makes sure that it is what was written: what is damaged must not get a new fingerprint. The files of
    /// a set with a side folder have hashes; of one without, pictures are held against the fingerprint.
    fn open(root: &Path, progress: &mut Progress<'_>) -> Result<Self> {
        // pictures are held against the fingerprint together with the numbers
        let set = match Dataset::open_scanned(root)? {
            set if set.has_pictures() && set.provenance().is_some_and(|p| !p.lossless) => Dataset::open(root)?,
            set => set,
        };
        // depth that could not be looked at is told of before anything is copied
        set.depth_names().try_for_each(|name| set.depth_size(name).map(drop))?;
        let layout = match set.provenance() {
            Some(provenance) if provenance.lossless => Some(side_folder(root, set.info())?),
            Some(_) if set.has_pictures() => {
                let tell = &mut |done, total| tell(progress, done, total, root);
                match picture_problem(&set, false, tell)? {
                    None => None,
                    Some(found) => {
                        return Err(DatasetError::BadDataset {
                            path: root.to_path_buf(),
                            object: "images".to_owned(),
                            expected: "the content that was recorded when it was made".to_owned(),
                            found,
                        });
                    }
                }
            }
            _ => None,
        };
        Ok(Self { set, layout, joins: false })
    }
}

/// One result that is being put together.
struct Edit<'a> {
    inputs: &'a [Input],
    /// Episodes of each input, ascending.
    taken: Vec<Vec<usize>>,
    /// The columns of the result.
    features: Features,
    renames: &'a Renames,
    /// Whether the tables are made anew from the frames.
    repair: Option<Repair>,
    /// Where it is written.
    root: &'a Path,
    /// Whether the work was given up.
    ended: AtomicBool,
}

/// The episodes of `set` that are `chosen`, as a data set of its own.
///
/// # Errors
/// An episode that is not there, a destination that is, videos that cannot be cut ([`video::VideoError::Cut`]).
pub fn keep(set: &Path, to: &Destination, chosen: &Selection, progress: &mut Progress<'_>) -> Result<EditReport> {
    let input = Input::open(set, progress)?;
    let episodes = chosen.resolve(&input.set)?.into_iter().collect();
    one(input, to, episodes, &Renames::new(), None, progress)
}

/// `set` without the episodes that are `chosen`.
///
/// # Errors
/// As [`keep`], and when no episode would be left.
pub fn without(set: &Path, to: &Destination, chosen: &Selection, progress: &mut Progress<'_>) -> Result<EditReport> {
    let input = Input::open(set, progress)?;
    let gone = chosen.resolve(&input.set)?;
    let left: Vec<usize> = (0..input.set.episodes().len()).filter(|episode| !gone.contains(episode)).collect();
    if left.is_empty() {
        return Err(DatasetError::NotInDataset {
            path: set.to_path_buf(),
            wanted: "episode that would be left".to_owned(),
            found: format!("{}, each to be dropped", gone.len()),
        });
    }
    one(input, to, left, &Renames::new(), None, progress)
}

/// `set` with features under other names. The five index columns keep theirs, and so does `action` where its origin is
/// recorded.
///
/// # Errors
/// A feature that is not there, a name that is taken or that LeRobot does not allow.
pub fn rename(set: &Path, to: &Destination, renames: &Renames, progress: &mut Progress<'_>) -> Result<EditReport> {
    let input = Input::open(set, progress)?;
    check_names(&input.set, renames)?;
    let all = (0..input.set.episodes().len()).collect();
    one(input, to, all, renames, None, progress)
}

/// Several data sets of some of the episodes of `set`, each in a folder of its name in the new directory `out`, which
/// appears with all of them. With a `seed` episodes are drawn, otherwise taken in order.
///
/// # Errors
/// Parts that overlap, are empty or more than the whole; as [`keep`].
pub fn split(
    set: &Path,
    out: &Path,
    parts: &Parts,
    seed: Option<u64>,
    progress: &mut Progress<'_>,
) -> Result<Vec<(String, EditReport)>> {
    let inputs = [Input::open(set, progress)?];
    refuse_inside(roots(&inputs), out)?;
    let parts = parts.resolve(&inputs[0].set, seed)?;
    let staging = Staging::create(out)?;
    let total: u64 = parts.iter().map(|(_, taken)| work_of(&inputs[0].set, taken)).sum();
    let mut done = 0;
    let mut advance = |frames| {
        done += frames;
        tell(progress, done, total, set)
    };
    let mut made = Vec::with_capacity(parts.len());
    for (name, taken) in parts {
        let root = staging.path().join(&name);
        std::fs::create_dir(&root).map_err(|source| DatasetError::Io {
            path: out.join(&name),
            operation: "create the folder",
            source,
        })?;
        let mut report = compose(&inputs, vec![taken], &Renames::new(), None, &root, &mut advance)?;
        report.notes.extend(left_behind(roots(&inputs))?);
        made.push((name, report));
    }
    staging.publish()?;
    Ok(made)
}

/// All episodes of several data sets, one set after the other, in the new directory `out`. They must have the same
/// features at the same rate, of the same robot and environment; tasks become one table.
///
/// # Errors
/// Sets that differ, with the first difference; as [`keep`].
pub fn merge(sets: &[PathBuf], out: &Path, progress: &mut Progress<'_>) -> Result<EditReport> {
    let inputs = sets.iter().map(|set| Input::open(set, progress)).collect::<Result<Vec<_>>>()?;
    let taken: Vec<Vec<usize>> = inputs.iter().map(|input| (0..input.set.episodes().len()).collect()).collect();
    refuse_inside(roots(&inputs), out)?;
    let staging = Staging::create(out)?;
    let mut report = told(&inputs, taken, &Renames::new(), None, staging.path(), progress)?;
    report.notes.extend(left_behind(roots(&inputs))?);
    staging.publish()?;
    Ok(report)
}

/// All of `set`, which shows the folder `root` with a file an episode, in the new directory `out`.
pub(super) fn gather(set: Dataset, root: &Path, out: &Path, progress: &mut Progress<'_>) -> Result<EditReport> {
    refuse_inside([root], out)?;
    let staging = Staging::create(out)?;
    let all = (0..set.episodes().len()).collect();
    let input = Input { set, layout: None, joins: true };
    let mut report = told(&[input], vec![all], &Renames::new(), None, staging.path(), progress)?;
    report.notes.extend(left_behind([root])?);
    staging.publish()?;
    Ok(report)
}

/// An edit of one data set.
fn one(
    input: Input,
    to: &Destination,
    taken: Vec<usize>,
    renames: &Renames,
    repair: Option<Repair>,
    progress: &mut Progress<'_>,
) -> Result<EditReport> {
    let inputs = [input];
    let staging = match to {
        Destination::New(out) => {
            refuse_inside(roots(&inputs), out)?;
            Staging::create(out)?
        }
        Destination::InPlace => Staging::replacing(inputs[0].set.root())?,
    };
    let mut report = told(&inputs, vec![taken], renames, repair, staging.path(), progress)?;
    report.notes.extend(match to {
        Destination::New(_) => left_behind(roots(&inputs))?,
        Destination::InPlace => kept_beside(inputs[0].set.root())?,
    });
    staging.publish()?;
    Ok(report)
}

/// Where the sets lie.
fn roots(inputs: &[Input]) -> impl Iterator<Item = &Path> {
    inputs.iter().map(|input| input.set.root())
}

/// Refuses a result inside a set that it is made of: it would be lost with the set.
fn refuse_inside<'a>(sets: impl IntoIterator<Item = &'a Path>, out: &Path) -> Result<()> {
    let parent = out.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    // whoever creates it says what is wrong with the path
    let Ok(parent) = std::fs::canonicalize(parent) else { return Ok(()) };
    let inside = |set: &&Path| std::fs::canonicalize(set).is_ok_and(|root| parent.starts_with(root));
    match sets.into_iter().find(inside) {
        None => Ok(()),
        Some(set) => Err(DatasetError::BadDataset {
            path: out.to_path_buf(),
            object: "output".to_owned(),
            expected: format!("a place outside of {}", set.display()),
            found: "one inside".to_owned(),
        }),
    }
}

/// What lies beside the sets and is not carried over.
fn left_behind<'a>(sets: impl IntoIterator<Item = &'a Path>) -> Result<Option<String>> {
    let mut names = BTreeSet::new();
    for set in sets {
        let others = other_files(set)?;
        names.extend(others.iter().filter(|path| !path.starts_with("images")).map(|path| path.display().to_string()));
    }
    Ok((!names.is_empty()).then(|| format!("not copied: {}", list(names.iter().map(String::as_str)))))
}

/// The tables of other programs that stay as they are.
fn kept_beside(set: &Path) -> Result<Option<String>> {
    let all = other_files(set)?;
    let tables = all.iter().filter(|path| path.starts_with("meta")).map(|path| path.display().to_string());
    let tables: Vec<String> = tables.collect();
    let names = || list(tables.iter().map(String::as_str));
    Ok((!tables.is_empty()).then(|| format!("kept as it was, not adapted to the edit: {}", names())))
}

/// [`compose`], with a total.
fn told(
    inputs: &[Input],
    taken: Vec<Vec<usize>>,
    renames: &Renames,
    repair: Option<Repair>,
    root: &Path,
    progress: &mut Progress<'_>,
) -> Result<EditReport> {
    let total = inputs.iter().zip(&taken).map(|(input, taken)| work_of(&input.set, taken)).sum();
    let mut done = 0;
    let set = inputs[0].set.root();
    tell(progress, 0, total, set)?;
    compose(inputs, taken, renames, repair, root, &mut |frames| {
        done += frames;
        tell(progress, done, total, set)
    })
}

/// Refuses a result without a frame, which nothing reads.
fn refuse_nothing(inputs: &[Input], taken: &[Vec<usize>]) -> Result<()> {
    let frames = |(input, taken): (&Input, &Vec<usize>)| {
        taken.iter().map(|&episode| input.set.episodes()[episode].length).sum::<usize>()
    };
    if inputs.iter().zip(taken).map(frames).sum::<usize>() > 0 {
        return Ok(());
    }
    Err(DatasetError::NotInDataset {
        path: inputs[0].set.root().to_path_buf(),
        wanted: "frame in the episodes that were chosen".to_owned(),
        found: "none".to_owned(),
    })
}

/// Frames to be gone through: those of the data files, and those of each camera's videos.
fn work_of(set: &Dataset, taken: &[usize]) -> u64 {
    let films = set.info().features.0.iter().filter(|(_, f)| f.dtype == "video").count();
    let frames: usize = taken.iter().map(|&episode| set.episodes()[episode].length).sum();
    (frames * (1 + films)) as u64
}

/// Writes the episodes `taken` of each of `inputs`, one input after the other, as a data set into the empty folder `root`.
fn compose(
    inputs: &[Input],
    taken: Vec<Vec<usize>>,
    renames: &Renames,
    repair: Option<Repair>,
    root: &Path,
    advance: &mut Advance<'_>,
) -> Result<EditReport> {
    refuse_nothing(inputs, &taken)?;
    let mut notes: Vec<String> = inputs.iter().flat_map(|input| input.set.notes()).cloned().collect();
    let mut features = renamed(agree::features(inputs)?, renames);
    frames::state_index_columns(&mut features, &inputs[0].set)?;
    let edit = Edit { inputs, taken, features, renames, repair, root, ended: AtomicBool::new(false) };
    let first = inputs[0].set.info();
    let (mut films, mut files) = (Vec::new(), Vec::new());
    for (index, (name, _)) in edit.features.0.iter().enumerate().filter(|(_, (_, f))| f.dtype == "video") {
        let mut film = films::copy(&edit, name, advance)?;
        files.append(&mut film.files);
        films.push((index, film));
    }
    let filmed = !films.is_empty();
    let mut origin = origin::of(&edit, &mut notes)?;
    let lossless = origin.as_ref().filter(|provenance| provenance.lossless);
    let (copied, side) = std::thread::scope(|scope| {
        let side = lossless.map(|origin| scope.spawn(|| side::copy(&edit, origin)));
        let copied = frames::copy(&edit, films, advance);
        edit.ended.store(copied.is_err(), Ordering::Relaxed);
        (copied, side.map(|side| side.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))))
    });
    let mut copied = copied?;
    files.append(&mut copied.files);
    let lossless = side.is_some();
    if let Some(side) = side {
        let (of_side, of_rest) = side?;
        files.extend(of_side);
        notes.extend(of_rest);
    }
    let mut told = copied.told;
    if let Some(origin) = &mut origin {
        origin.fingerprint.clone_from(&told.fingerprint);
    }
    edit.keep_stored_totals(&mut told.stats);
    notes.extend(edit.lost_statistics(&told.stats));
    // texts and the like have none
    let statistical: Vec<(String, bool)> = edit
        .features
        .0
        .iter()
        .filter(|(name, _)| told.stats.contains_key(name))
        .map(|(name, feature)| (name.clone(), feature.is_visual()))
        .collect();
    let others = other_columns::columns(&edit, &mut notes)?;
    files.push(meta::write_tasks(root, &copied.tasks)?);
    files.push(meta::write_episodes(root, &copied.tasks, &statistical, &told.rows, &told.each, &others)?);
    files.push(meta::write_stats(root, &statistical, &told.stats)?);
    let info = Info {
        total_episodes: told.rows.len(),
        total_frames: told.rows.iter().map(|row| row.length).sum(),
        total_tasks: copied.tasks.len(),
        chunks_size: info::FILES_PER_FOLDER,
        splits: edit.splits(&mut notes),
        data_path: info::DATA_PATH.to_owned(),
        video_path: filmed.then(|| VIDEO_PATH.to_owned()),
        features: edit.features.clone(),
        actrm: origin,
        other: agree::others(inputs, &mut notes),
        ..first.clone()
    };
    files.extend(meta::write_info(root, &check::sealed(info, root)?)?);
    if lossless {
        files.push(write_manifest(root, &files)?);
    }
    // what was just written opens, or it is not published; rows of sets with a fingerprint were held against it as they came
    let set = match edit.digests() && edit.repair.is_none() {
        true => Dataset::open_written(root, &told.fingerprint)?,
        false => Dataset::open_scanned(root)?,
    };
    Ok(EditReport {
        episodes: set.episodes().len(),
        frames: set.frames(),
        tasks: copied.tasks,
        files: files.len(),
        bytes: files.iter().map(|f| f.bytes).sum(),
        fingerprint: set.fingerprint().to_owned(),
        notes,
    })
}

impl Edit<'_> {
    /// The name that a feature of the result has in the inputs.
    fn before<'n>(&'n self, name: &'n str) -> &'n str {
        self.renames.iter().find(|(_, new)| *new == name).map_or(name, |(old, _)| old)
    }

    /// Task texts that the result has whichever of them its frames do.
    fn tasks(&self) -> Vec<String> {
        let whole = self.inputs.iter().filter(|input| self.repair.is_some() || input.joins);
        let mut known = BTreeSet::new();
        whole.flat_map(|input| input.set.tasks()).filter(|text| known.insert(*text)).cloned().collect()
    }

    /// Whether content is hashed: of sets that LeRobot wrote, pictures are no part of the fingerprint.
    fn digests(&self) -> bool {
        self.inputs.iter().all(|input| input.set.provenance().is_some())
    }

    /// The number of each episode taken in the result, by input.
    fn numbers(&self) -> Vec<BTreeMap<usize, usize>> {
        let mut next = 0..;
        self.taken.iter().map(|taken| taken.iter().copied().zip(&mut next).collect()).collect()
    }

    /// Where every episode of one set is taken, statistics that cannot be computed again are those that it has.
    fn keep_stored_totals(&self, stats: &mut BTreeMap<String, crate::stats::FeatureStats>) {
        let [input] = self.inputs else { return };
        if self.taken[0].len() < input.set.episodes().len() {
            return;
        }
        for (name, feature) in self.features.0.iter().filter(|(_, f)| f.is_visual()) {
            let stored = input.set.stats().get(self.before(name));
            if let (false, Some(stored)) = (frames::is_looked_at(feature), stored.filter(|s| meta::are_finite(s))) {
                stats.insert(name.clone(), stored.clone());
            }
        }
    }

    /// A note of the images and videos whose statistics an input has and the result has not.
    fn lost_statistics(&self, stats: &BTreeMap<String, crate::stats::FeatureStats>) -> Option<String> {
        let had = |name: &str| self.inputs.iter().any(|i| i.set.stats().contains_key(self.before(name)));
        let lost = self.features.names().filter(|name| !stats.contains_key(*name) && had(name));
        let names: Vec<&str> = lost.collect();
        (!names.is_empty())
            .then(|| format!("statistics of {} are left out: meta/episodes has none of its episodes", names.join(", ")))
    }
}

fn renamed(features: Features, renames: &Renames) -> Features {
    let new = |(name, feature): (String, Feature)| (renames.get(&name).cloned().unwrap_or(name), feature);
    Features(features.0.into_iter().map(new).collect())
}

fn check_names(set: &Dataset, renames: &Renames) -> Result<()> {
    let features = &set.info().features;
    let bad = |object: String, expected: &str, found: &str| DatasetError::BadDataset {
        path: set.root().to_path_buf(),
        object,
        expected: expected.to_owned(),
        found: found.to_owned(),
    };
    for (old, new) in renames {
        if features.get(old).is_none() {
            return Err(DatasetError::NotInDataset {
                path: set.root().to_path_buf(),
                wanted: format!("feature {old}"),
                found: features.names().collect::<Vec<_>>().join(", "),
            });
        }
        let object = format!("new name of {old}");
        let fixed = |name: &str| super::fingerprint::INDEX_COLUMNS.contains(&name);
        if fixed(old) || (old == ACTION && set.provenance().is_some()) {
            return Err(bad(object, &format!("{old}, which keeps its name"), new));
        }
        // LeRobot makes paths of names, and columns that are separated by slashes
        let plain = |c: char| !c.is_control() && !matches!(c, '/' | '\\' | '{' | '}');
        if new.is_empty() || new.starts_with('.') || !new.chars().all(plain) || fixed(new) {
            return Err(bad(
                object,
                "a name without slashes and braces that is not an index column's",
                &format!("{new:?}"),
            ));
        }
        let stays = features.get(new).is_some() && !renames.contains_key(new);
        if stays || renames.iter().any(|(other, name)| other != old && name == new) {
            return Err(bad(object, "a name that no feature has", &format!("{new}, which is taken")));
        }
    }
    Ok(())
}
