//! Every check that a data set can be given.

use super::check::TIME_TOLERANCE;
use super::depth;
use super::encode::PictureSummary;
use super::export::{Rows, picture_pixels};
use super::fingerprint::Fingerprint;
use super::info::Info;
use super::open::{Dataset, parse_info, read_json};
use super::pictures::{Film, places};
use super::schema;
use super::side::{MANIFEST_FILE, Manifest};
use super::tables::{Area, Tables, listed};
use crate::error::{DatasetError, Result};
use crate::source::{self, Source};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// sha256 of a file in hexadecimal.
pub(crate) fn hash_file(path: &Path) -> Result<String> {
    hash_file_unless(path, &AtomicBool::new(false))
}

/// [`hash_file`], unless it is stopped meanwhile.
pub(crate) fn hash_file_unless(path: &Path, stop: &AtomicBool) -> Result<String> {
    let failed = |source| DatasetError::Io { path: path.to_path_buf(), operation: "read it", source };
    let mut file = File::open(path).map_err(failed)?;
    let mut hash = Sha256::new();
    let mut buffer = vec![0; 1 << 18];
    loop {
        if stop.load(Ordering::Relaxed) {
            return Err(DatasetError::Stopped { path: path.to_path_buf() });
        }
        match file.read(&mut buffer).map_err(failed)? {
            0 => return Ok(schema::hex(&hash.finalize())),
            n => hash.update(&buffer[..n]),
        }
    }
}

/// sha256 of a source file; of several, of the lines `<sha256>  <name>`.
pub(crate) fn hash_files(files: &[(PathBuf, u64)]) -> Result<String> {
    hash_files_unless(files, &AtomicBool::new(false))
}

/// [`hash_files`], unless it is stopped meanwhile.
pub(crate) fn hash_files_unless(files: &[(PathBuf, u64)], stop: &AtomicBool) -> Result<String> {
    let name = |file: &Path| file.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let each = files.iter().map(|(file, _)| Ok((name(file), hash_file_unless(file, stop)?)));
    Ok(joint_hash(&each.collect::<Result<Vec<_>>>()?))
}

/// [`hash_files`] of files of these names and hashes.
pub(crate) fn joint_hash(files: &[(String, String)]) -> String {
    if let [(_, single)] = files {
        return single.clone();
    }
    let lines: String = files.iter().map(|(name, sha256)| format!("{sha256}  {name}\n")).collect();
    schema::hex(&Sha256::digest(lines))
}

/// [`hash_files`] of a file, of a folder, and of the files that links in them lead to.
pub fn source_hash(path: &Path) -> Result<String> {
    match Source::open_guarded(path) {
        Ok(source) => hash_files(&source.plan().files),
        // what cannot be opened any more has another hash
        Err(_) => hash_files(&source::files(path)?.into_iter().map(|file| (file, 0)).collect::<Vec<_>>()),
    }
}

/// What a check found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Check {
    /// What was checked.
    pub name: &'static str,
    /// `None` when all is well, what is wrong otherwise, a line each.
    pub problem: Option<String>,
    /// What is not as it should be and was read as LeRobot reads it.
    pub notes: Vec<String>,
}

const FILES_CHECK: &str = "files have the hashes recorded";

/// Compares a file or folder of demonstrations with the hash that was recorded when the data set at `root` was made
/// of it: a change that every reader accepts silently is found here.
pub fn verify_source(root: &Path, source: &Path) -> Result<Check> {
    let (info, _) = parse_info(root)?;
    let Some(provenance) = info.actrm else {
        return Err(DatasetError::NotInDataset {
            path: root.to_path_buf(),
            wanted: "hash of a source".to_owned(),
            found: "a data set that was not converted from demonstrations".to_owned(),
        });
    };
    let found = source_hash(source)?;
    let problem = (found != provenance.source_sha256).then(|| {
        let name = source.display();
        format!("{name}: expected sha256 {} as at the conversion, found {found}", provenance.source_sha256)
    });
    Ok(Check { name: "the source is what was converted", problem, notes: Vec::new() })
}

/// Runs every check on the data set at `root`: that it opens, that its tables agree with its frames, that its columns are
/// finite, that its statistics follow from its frames, that its content has the recorded fingerprint and its files the
/// recorded hashes. An error means that a check could not be made.
pub fn verify(root: &Path, progress: &mut dyn FnMut(u64, u64)) -> Result<Vec<Check>> {
    verify_within(root, TIME_TOLERANCE, progress)
}

/// [`verify`] with so many seconds that timestamps may be off.
pub fn verify_within(root: &Path, tolerance: f64, progress: &mut dyn FnMut(u64, u64)) -> Result<Vec<Check>> {
    const OPENS: &str = "it opens: columns, episodes and tasks agree";
    let mut checks = Vec::new();
    let mut note = |name, problem| checks.push(Check { name, problem, notes: Vec::new() });
    let manifest = root.join(MANIFEST_FILE).exists();
    if manifest {
        note(FILES_CHECK, manifest_problem(root)?);
    }
    let opened = Dataset::open(root);
    let tables = Tables::read(root);
    let problem = opened.as_ref().err().or(tables.as_ref().err()).map(|e| in_full(e));
    note(OPENS, problem);
    let mut set = opened.ok();
    let sound = set.is_some();
    if let Ok(tables) = &tables {
        let mut faults = tables.faults(tolerance);
        if set.is_none() {
            set = tables.derived().ok();
        }
        if let Some(set) = &set {
            faults.extend(tables.statistics_faults(set)?);
        }
        for (area, name) in Area::ALL {
            let mine: Vec<_> = faults.iter().filter(|fault| fault.area == area).collect();
            // what was not looked at is not said to be right
            if area != Area::Statistics || set.is_some() {
                note(name, listed(&mine));
            }
        }
    }
    if let Some(set) = &set {
        note("every number is finite", not_finite(set));
    }
    if let Some(set) = set.filter(|_| sound) {
        if !manifest && set.provenance().is_some_and(|p| p.lossless) {
            note(FILES_CHECK, Some(format!("{MANIFEST_FILE} is missing")));
        }
        note("splits name episodes", split_problem(&set));
        if set.has_pictures() {
            let tell = &mut |done, total| {
                progress(done, total);
                Ok(())
            };
            note("images decode and have the content recorded", picture_problem(&set, true, tell)?);
        } else if set.provenance().is_some() {
            // opening compared it
            note("content has the fingerprint recorded", None);
        }
        if let Some(check) = checks.iter_mut().find(|check| check.name == OPENS) {
            check.notes = set.notes().to_vec();
        }
    }
    Ok(checks)
}

fn manifest_problem(root: &Path) -> Result<Option<String>> {
    let manifest: Manifest = match read_json(&root.join(MANIFEST_FILE)) {
        Ok(manifest) => manifest,
        Err(e) => return Ok(Some(in_full(&e))),
    };
    let problem = |(name, expected): (&String, &String)| match hash_file(&root.join(name)) {
        Ok(found) if found == *expected => None,
        Ok(found) => Some(format!("{name}: expected sha256 {expected}, found {found}")),
        Err(e) => Some(in_full(&e)),
    };
    Ok(listed(&manifest.files.iter().filter_map(problem).collect::<Vec<_>>()))
}

/// An error with what caused it, in a line.
pub(super) fn in_full(error: &dyn std::error::Error) -> String {
    let causes = std::iter::successors(error.source(), |e| e.source());
    causes.fold(error.to_string(), |text, cause| format!("{text}: {cause}"))
}

/// Numbers that are NaN or infinite, in every column.
pub(super) fn not_finite(dataset: &Dataset) -> Option<String> {
    let all: Vec<usize> = (0..dataset.episodes().len()).collect();
    listed(&dataset.column_names().flat_map(|name| dataset.not_finite(name, &all)).collect::<Vec<_>>())
}

fn split_problem(dataset: &Dataset) -> Option<String> {
    let count = dataset.episodes().len();
    for name in dataset.split_names() {
        let Some(episodes) = dataset.split(name) else {
            return Some(format!("{name}: not a range of episodes"));
        };
        if let Some(bad) = episodes.iter().find(|&&e| e >= count) {
            return Some(format!("{name}: names episode {bad} of {count}"));
        }
    }
    None
}

/// Decodes every picture and compares the whole content with the fingerprint; where it is to be `finite`, depth too.
pub(super) fn picture_problem(
    dataset: &Dataset,
    finite: bool,
    tell: &mut dyn FnMut(u64, u64) -> Result<()>,
) -> Result<Option<String>> {
    let info: &Info = dataset.info();
    let root = dataset.root();
    let mut cursors = BTreeMap::new();
    for (name, feature) in info.features.0.iter().filter(|(_, f)| f.dtype == "image" && !f.is_depth()) {
        let Some((height, width)) = feature.picture_size() else {
            return Ok(Some(format!("{name}: images of shape {:?} are not read", feature.shape)));
        };
        cursors.insert(name.as_str(), (Rows::open(root, "data", Some(name), 32)?, height, width));
    }
    let mut depths = BTreeMap::new();
    for name in dataset.depth_names() {
        let (_, width) = match dataset.depth_size(name) {
            Ok(size) => size,
            Err(e) => return Ok(Some(in_full(&e))),
        };
        depths.insert(name, (Rows::open(root, "data", Some(name), 32)?, width));
    }
    let mut films = Vec::new();
    for (name, _) in info.features.0.iter().filter(|(_, f)| f.dtype == "video" && !f.is_depth()) {
        match dataset.camera(name).and_then(|(_, height, width)| Ok(((height, width), places(dataset, name)?))) {
            Ok((size, places)) => films.push((name.as_str(), places, Film::new(info.fps, size))),
            Err(e) => return Ok(Some(in_full(&e))),
        }
    }
    let mut fingerprint = Fingerprint::new(&info.features, info.fps);
    let mut pixels = Vec::new();
    for episode in dataset.episodes() {
        fingerprint.episode(episode.length, episode.tasks.first().map_or("", String::as_str));
        for (name, digest) in dataset.episode_digests(episode) {
            fingerprint.column(&name, digest);
        }
        for (name, (rows, height, width)) in &mut cursors {
            let mut summary = PictureSummary::default();
            for batch in rows.take(episode.length)? {
                pixels.clear();
                if let Err(e) = picture_pixels(root, name, batch.column(0), *height, *width, &mut pixels) {
                    return Ok(Some(format!("episode {}: {e}", episode.index)));
                }
                let frames = pixels.chunks_exact(*height * *width * 3);
                summary.digests.extend(frames.map(|p| <[u8; 32]>::from(Sha256::digest(p))));
            }
            fingerprint.column(name, summary.digest());
        }
        for (name, (rows, width)) in &mut depths {
            let (mut summary, mut bad) = (PictureSummary::default(), None);
            let looked = dataset.each_depth(rows, name, episode.index, &mut |frame, kind, pixels| {
                let found = depth::not_finite(kind, *width, pixels).filter(|_| finite);
                bad = bad.take().or(found.map(|found| format!("frame {frame} of episode {}: {found}", episode.index)));
                summary.digests.push(Sha256::digest(pixels).into());
                Ok(())
            });
            if let Some(found) = looked.err().map(|e| in_full(&e)).or(bad.map(|found| format!("{name}: {found}"))) {
                return Ok(Some(found));
            }
            fingerprint.column(name, summary.digest());
        }
        for (name, places, film) in &mut films {
            let mut digests = Vec::with_capacity(episode.length);
            let looked = film.each(episode, &places[episode.index], &mut |picture| {
                digests.push(Sha256::digest(picture).into());
            });
            if let Err(e) = looked {
                return Ok(Some(format!("{name}: episode {}: {}", episode.index, in_full(&e))));
            }
            fingerprint.column(name, PictureSummary { digests, ..PictureSummary::default() }.digest());
        }
        tell(episode.to as u64, dataset.frames() as u64)?;
    }
    let computed = fingerprint.finish();
    Ok(match dataset.provenance() {
        Some(p) if p.fingerprint != computed => {
            Some(format!("expected fingerprint {}, found {computed}", p.fingerprint))
        }
        _ => None,
    })
}
