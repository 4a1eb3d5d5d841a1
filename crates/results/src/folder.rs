//! One evaluation's folder: its life from the first episode to the last.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::record::{EntryIdentity, EpisodeRecord, EpisodeTiming, EvaluationRecord, Seeds, Shard, differing};
use super::seal::{SEAL_FILE, Seal, seal_of};
use super::tables;
use crate::ResultsError;
use crate::files::{MOST_TEXT, read_file, sweep, sync_folder, write_atomic};

/// What an evaluation is of.
pub const RECORD: &str = "evaluation.json";
/// The outcome of every episode.
pub const OUTCOMES: &str = "outcomes.parquet";
const TIMINGS: &str = "timings.parquet";
/// What a seal covers.
const SEALED: [&str; 3] = [RECORD, OUTCOMES, TIMINGS];
const JOURNAL: &str = "journal.jsonl";
const LOCK: &str = "lock";

/// A finished evaluation, read back.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredEvaluation {
    /// Its folder.
    pub folder: PathBuf,
    /// What it depends on.
    pub record: EvaluationRecord,
    /// Outcomes, by seed.
    pub episodes: Vec<EpisodeRecord>,
    /// Timings, by seed.
    pub timings: Vec<EpisodeTiming>,
    /// Whether the folder has a seal, which then was found whole. Evaluations made before there were seals have none.
    pub sealed: bool,
}

impl StoredEvaluation {
    /// Reads a finished evaluation; `None` if it is still under way.
    ///
    /// # Errors
    /// Files that are missing, damaged, not as they were sealed, or do not belong together.
    pub fn read(folder: &Path) -> Result<Option<Self>, ResultsError> {
        let record = read_record(folder)?;
        let outcomes = folder.join(OUTCOMES);
        let sealed = folder.join(SEAL_FILE).exists();
        // a journal beside tables without a seal: killed while they were written, and written again from it
        if !is_finished(folder) {
            return Ok(None);
        }
        // before anything is read from the tables
        if sealed {
            seal_of(folder, &record, &SEALED)?.check(folder)?;
        }
        let episodes = tables::read_episodes(&outcomes)?;
        let timings = tables::read_timings(&folder.join(TIMINGS))?;
        let expected = record.own_seeds();
        for (path, found) in [
            (outcomes, episodes.iter().map(|e| e.seed).collect::<Vec<_>>()),
            (folder.join(TIMINGS), timings.iter().map(|t| t.seed).collect()),
        ] {
            if found != expected {
                let (n, seeds, rows) = (expected.len(), record.seeds, found.len());
                let reason =
                    format!("expected {n} rows for the seeds of {seeds} in order, found {rows} rows or other seeds");
                return Err(ResultsError::Malformed { path, reason });
            }
        }
        check_outcomes(&folder.join(OUTCOMES), &record, &episodes)?;
        Ok(Some(Self { folder: folder.to_owned(), record, episodes, timings, sealed }))
    }

    /// As [`StoredEvaluation::read`]; `None` also where there is no such folder.
    ///
    /// # Errors
    /// As [`StoredEvaluation::read`].
    pub fn read_if_there(folder: &Path) -> Result<Option<Self>, ResultsError> {
        if folder.join(RECORD).exists() { Self::read(folder) } else { Ok(None) }
    }

    /// Seals what was made before there were seals. For whoever has run every episode again and found each the same.
    ///
    /// # Errors
    /// Files that cannot be read or written.
    pub fn seal(&self) -> Result<(), ResultsError> {
        seal_of(&self.folder, &self.record, &SEALED)?.write(&self.folder)
    }

    /// How many episodes succeeded.
    pub fn successes(&self) -> u64 {
        self.episodes.iter().filter(|episode| episode.success).count() as u64
    }
}

/// An evaluation that has not ended, or a part of one that has and waits for the others.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct UnderWay {
    /// Its folder.
    pub folder: PathBuf,
    /// Episodes that it has.
    pub done: u64,
    /// Episodes that it is to have.
    pub total: u64,
    /// Whether a table of outcomes is there all the same, without a seal.
    pub unsealed: bool,
    /// The part that this is, where it has ended.
    pub ended: Option<Shard>,
}

impl UnderWay {
    /// How far the evaluation in `folder` is.
    ///
    /// # Errors
    /// A record or a journal that cannot be read.
    pub fn read(folder: &Path) -> Result<Self, ResultsError> {
        let record = read_record(folder)?;
        let done = read_journal(&folder.join(JOURNAL), &record, false)?.len() as u64;
        let (total, unsealed) = (record.own_seeds().len() as u64, folder.join(OUTCOMES).exists());
        Ok(Self { folder: folder.to_owned(), done, total, unsealed, ended: None })
    }
}

impl std::fmt::Display for UnderWay {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { done, total, unsealed, ended, .. } = self;
        if let Some(part) = ended {
            return write!(f, "part {part}, not shown until `actrm-zoo merge` joins it with the others");
        }
        let table = if *unsealed { format!("; {OUTCOMES} is there without a seal") } else { String::new() };
        write!(f, "not finished: {done} of {total} episodes{table}")
    }
}

/// The entries that the record and the seal in `folder` say its result is of, as far as they can be read.
pub fn entries_named(folder: &Path) -> Vec<EntryIdentity> {
    let record = read_record(folder).ok().map(|record| record.entry);
    record.into_iter().chain(Seal::read(folder).ok().map(|seal| seal.entry)).collect()
}

/// Every finished evaluation under `results`, by folder name. A folder that does not exist holds none.
///
/// # Errors
/// The first evaluation that cannot be read.
pub fn list_evaluations(results: &Path) -> Result<Vec<StoredEvaluation>, ResultsError> {
    let mut all = Vec::new();
    for folder in evaluation_folders(results)? {
        all.extend(StoredEvaluation::read(&folder)?);
    }
    Ok(all)
}

/// Folders of evaluations under `results`, finished or not, by name.
pub fn evaluation_folders(results: &Path) -> Result<Vec<PathBuf>, ResultsError> {
    let mut folders = result_folders(results)?;
    folders.retain(|folder| folder.join(RECORD).is_file());
    Ok(folders)
}

/// Whatever folders are under `results`, by name.
pub fn result_folders(results: &Path) -> Result<Vec<PathBuf>, ResultsError> {
    let entries = match fs::read_dir(results) {
        Ok(entries) => entries,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(ResultsError::io("read folder", results)(error)),
    };
    let mut folders = Vec::new();
    for entry in entries {
        let path = entry.map_err(ResultsError::io("read folder", results))?.path();
        if path.is_dir() {
            folders.push(path);
        }
    }
    folders.sort();
    Ok(folders)
}

/// Refuses outcomes that no episode can have.
fn check_outcomes(path: &Path, record: &EvaluationRecord, episodes: &[EpisodeRecord]) -> Result<(), ResultsError> {
    let most = record.protocol.max_steps;
    // what a simulator of the user's says of progress and failures is its own
    let is_ours = record.protocol.env_module.is_none();
    let is_hash = |text: &str| text.len() == 64 && text.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'));
    for episode in episodes {
        let EpisodeRecord { seed, success, steps, total_reward, fingerprint, failure, progress, .. } = episode;
        let (key, expected, found) = if *steps == 0 || *steps as usize > most {
            ("steps", format!("1 to {most}"), steps.to_string())
        } else if !total_reward.is_finite() {
            ("return", "a finite number".to_owned(), total_reward.to_string())
        } else if let Some(progress) = progress.filter(|progress| !(0.0..=1.0).contains(progress)) {
            ("progress", "0 to 1".to_owned(), progress.to_string())
        } else if let Some(progress) = progress.filter(|progress| is_ours && (*progress == 1.0) != *success) {
            let expected = if *success { "1 of a success" } else { "less than 1 of a failure" };
            ("progress", expected.to_owned(), progress.to_string())
        } else if let Some(failure) = failure.as_ref().filter(|_| is_ours && *success) {
            ("failure", "none of a success".to_owned(), failure.clone())
        } else if !is_hash(fingerprint) {
            ("fingerprint", "64 hexadecimal digits".to_owned(), format!("{fingerprint:?}"))
        } else {
            continue;
        };
        let reason = format!("seed {seed}: {key}: expected {expected}, found {found}");
        return Err(ResultsError::Malformed { path: path.to_owned(), reason });
    }
    Ok(())
}

/// Whether every episode is done and sealed. Evaluations from before there were seals have tables and no journal.
pub(super) fn is_finished(folder: &Path) -> bool {
    folder.join(SEAL_FILE).exists() || (folder.join(OUTCOMES).exists() && !folder.join(JOURNAL).exists())
}

/// What an evaluation in `folder` is of, finished or not.
pub fn read_record(folder: &Path) -> Result<EvaluationRecord, ResultsError> {
    let path = folder.join(RECORD);
    let text = read_file(&path, MOST_TEXT).map_err(ResultsError::io("read", &path))?;
    let malformed = |reason: String| ResultsError::Malformed { path: path.clone(), reason };
    let record: EvaluationRecord =
        serde_json::from_slice(&text).map_err(|e| malformed(format!("not an evaluation: {e}")))?;
    if record.format != EvaluationRecord::FORMAT {
        let (expected, found) = (EvaluationRecord::FORMAT, record.format);
        return Err(malformed(format!("format: expected {expected}, found {found}")));
    }
    if let Some(shard) = record.shard.filter(|shard| !(1..=shard.count).contains(&shard.index)) {
        return Err(malformed(format!("shard: expected I/N with 1 <= I <= N, found {shard}")));
    }
    let Seeds { start, count } = record.seeds;
    if !(1..=MOST_EPISODES).contains(&count) || start.checked_add(count).is_none() {
        return Err(malformed(format!(
            "seeds: expected 1 to {MOST_EPISODES} below 2^64, found {count} from {start} on"
        )));
    }
    Ok(record)
}

/// More episodes than any evaluation has.
const MOST_EPISODES: u64 = 1_000_000;

#[derive(Serialize, Deserialize)]
struct JournalLine {
    episode: EpisodeRecord,
    timing: EpisodeTiming,
}

/// An evaluation that differs from another in nothing but the simulator.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OtherSimulator {
    /// Its folder.
    pub folder: PathBuf,
    /// Episodes that it has.
    pub done: u64,
    /// In what its simulator is another: name, there and here.
    pub differing: Vec<(String, String, String)>,
}

impl std::fmt::Display for OtherSimulator {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { folder, done, differing } = self;
        let each: Vec<String> =
            differing.iter().map(|(name, there, here)| format!("{name}: there {there}, here {here}")).collect();
        let how = if each.is_empty() { "whose sources were not written down".to_owned() } else { each.join("; ") };
        write!(f, "{done} episodes of another simulator ({how}) stay apart, in {}", folder.display())
    }
}

/// An evaluation under way. Holds the folder's lock.
pub struct ResultsFolder {
    folder: PathBuf,
    record: EvaluationRecord,
    journal: Option<File>,
    done: BTreeMap<u64, (EpisodeRecord, EpisodeTiming)>,
    /// Whether a line could not be written: what is left of it is the journal's last, and nothing may come after it.
    torn: bool,
    _lock: File,
}

impl ResultsFolder {
    /// Opens the folder of `record` under `results`, new or with the episodes that are done.
    ///
    /// # Errors
    /// [`ResultsError::Busy`] while another process works there; damaged files.
    pub fn open(results: &Path, record: &EvaluationRecord) -> Result<Self, ResultsError> {
        let folder = record.folder_in(results);
        fs::create_dir_all(&folder).map_err(ResultsError::io("create folder", &folder))?;
        let path = folder.join(LOCK);
        let lock = File::create(&path).map_err(ResultsError::io("create", &path))?;
        if !rollout::try_lock(&lock, &folder).map_err(ResultsError::io("lock", &path))? {
            return Err(ResultsError::Busy { folder });
        }
        sweep(&folder)?;
        let mut own = record.clone();
        if folder.join(RECORD).exists() {
            let found = read_record(&folder)?;
            // the folder's name pins what decides outcomes; the rest is the entry's story, which may
            // not change for one entry hash either
            if !found.is_same(record) {
                let (key, expected, found) = found.difference(record).unwrap_or_default();
                return Err(ResultsError::Differ { folder, what: format!("{RECORD}: {key}"), expected, found });
            }
            own = found;
        } else {
            let mut text = serde_json::to_vec_pretty(record).expect("plain fields are always JSON");
            text.push(b'\n');
            write_atomic(&folder.join(RECORD), &text)?;
        }
        let path = folder.join(JOURNAL);
        let (done, journal) = match StoredEvaluation::read(&folder)? {
            Some(stored) => {
                if path.exists() {
                    // a writer that was killed between its last two steps leaves it behind
                    fs::remove_file(&path).map_err(ResultsError::io("remove", &path))?;
                }
                let rows = stored.episodes.into_iter().zip(stored.timings);
                (rows.map(|(e, t)| (e.seed, (e, t))).collect(), None)
            }
            None => {
                let done = read_journal(&path, record, true)?;
                let journal = OpenOptions::new().create(true).append(true).open(&path);
                (done, Some(journal.map_err(ResultsError::io("open", &path))?))
            }
        };
        Ok(Self { folder, record: own, journal, done, torn: false, _lock: lock })
    }

    /// Evaluations under `results` that are the same but for the simulator, with how many episodes each has: they are kept
    /// apart from this one.
    pub fn others(&self, results: &Path) -> Vec<OtherSimulator> {
        let record = &self.record;
        let of = |folder: PathBuf| {
            let other = read_record(&folder).ok().filter(|other| !other.joins(record))?;
            let alike = |of: &EvaluationRecord| EvaluationRecord {
                versions: BTreeMap::new(),
                sources: BTreeMap::new(),
                ..of.clone()
            };
            if !alike(&other).is_same(&alike(record)) {
                return None;
            }
            let done = match StoredEvaluation::read(&folder) {
                Ok(Some(stored)) => stored.episodes.len(),
                Ok(None) => read_journal(&folder.join(JOURNAL), &other, false).map_or(0, |done| done.len()),
                Err(_) => return None,
            };
            let differing = differing(&other, record);
            (done > 0).then_some(OtherSimulator { folder, done: done as u64, differing })
        };
        evaluation_folders(results).unwrap_or_default().into_iter().filter_map(of).collect()
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.folder
    }

    /// Whether every episode is done and the tables are written.
    pub fn is_finished(&self) -> bool {
        self.journal.is_none()
    }

    /// Outcome and timing of the episodes that are done, by seed.
    pub fn done(&self) -> &BTreeMap<u64, (EpisodeRecord, EpisodeTiming)> {
        &self.done
    }

    /// The seeds that have no outcome yet, ascending.
    pub fn missing(&self) -> Vec<u64> {
        self.record.own_seeds().into_iter().filter(|seed| !self.done.contains_key(seed)).collect()
    }

    /// Takes over outcomes of finished evaluations under `results` that differ in nothing but their seeds: an outcome
    /// depends on the episode's own seed alone. Evaluations that cannot be read are passed over; whoever lists them
    /// names them.
    ///
    /// # Errors
    /// A journal that cannot be written.
    pub fn adopt(&mut self, results: &Path) -> Result<(), ResultsError> {
        if self.is_finished() || self.missing().is_empty() {
            return Ok(());
        }
        for folder in evaluation_folders(results)? {
            let same = |other: &EvaluationRecord| {
                let seeds = |record: &EvaluationRecord| EvaluationRecord {
                    seeds: self.record.seeds,
                    shard: self.record.shard,
                    ..record.clone()
                };
                seeds(other).joins(&self.record)
            };
            if !read_record(&folder).is_ok_and(|other| same(&other)) {
                continue;
            }
            let Ok(Some(stored)) = StoredEvaluation::read(&folder) else { continue };
            if !stored.sealed {
                continue;
            }
            let missing: BTreeSet<u64> = self.missing().into_iter().collect();
            let rows = stored.episodes.into_iter().zip(stored.timings);
            for (episode, timing) in rows.filter(|(episode, _)| missing.contains(&episode.seed)) {
                self.add(episode, timing)?;
            }
        }
        Ok(())
    }

    /// Puts a finished episode on disk.
    ///
    /// # Errors
    /// [`ResultsError::Differ`] if the seed has another outcome already; a journal that cannot be
    /// written.
    pub fn add(&mut self, episode: EpisodeRecord, timing: EpisodeTiming) -> Result<(), ResultsError> {
        let seed = episode.seed;
        if let Some((stored, _)) = self.done.get(&seed) {
            if stored.is_same(&episode) {
                return Ok(());
            }
            return Err(ResultsError::Differ {
                folder: self.folder.clone(),
                what: format!("outcome of seed {seed}"),
                expected: json(stored),
                found: json(&episode),
            });
        }
        let unwritten = ResultsError::io("write", self.folder.join(JOURNAL));
        if self.torn {
            return Err(unwritten(std::io::Error::other("an episode before this one could not be written")));
        }
        let line = JournalLine { episode, timing };
        let mut text = serde_json::to_vec(&line).expect("plain fields are always JSON");
        text.push(b'\n');
        let journal = self.journal.as_mut().expect("a finished evaluation holds every seed");
        let written = journal.write_all(&text).and_then(|()| journal.sync_data());
        self.torn = written.is_err();
        written.map_err(unwritten)?;
        self.done.insert(seed, (line.episode, line.timing));
        Ok(())
    }

    /// Writes the tables of a finished evaluation anew, with outcomes that were found to be the same and say more. Killed at
    /// any moment it is what it was, or goes on from the journal of all its episodes.
    ///
    /// # Errors
    /// [`ResultsError::Differ`] for another outcome of a seed; files that cannot be written.
    pub fn rewrite(mut self, episodes: Vec<EpisodeRecord>) -> Result<StoredEvaluation, ResultsError> {
        let mut text = Vec::new();
        for episode in episodes {
            let seed = episode.seed;
            let Some((stored, timing)) = self.done.get(&seed) else { continue };
            if !stored.is_same(&episode) {
                return Err(ResultsError::Differ {
                    folder: self.folder.clone(),
                    what: format!("outcome of seed {seed}"),
                    expected: json(stored),
                    found: json(&episode),
                });
            }
            let line = JournalLine { episode, timing: timing.clone() };
            text.extend(serde_json::to_vec(&line).expect("plain fields are always JSON"));
            text.push(b'\n');
            self.done.insert(seed, (line.episode, line.timing));
        }
        let path = self.folder.join(JOURNAL);
        write_atomic(&path, &text)?;
        // without its seal it is an evaluation under way, whose journal holds every episode
        let seal = self.folder.join(SEAL_FILE);
        fs::remove_file(&seal).map_err(ResultsError::io("remove", &seal))?;
        sync_folder(&self.folder)?;
        let journal = OpenOptions::new().append(true).open(&path).map_err(ResultsError::io("open", &path))?;
        self.journal = Some(journal);
        self.finish()
    }

    /// Writes the tables, if every episode is done, and reads them back.
    ///
    /// # Errors
    /// [`ResultsError::Malformed`] if episodes are missing; files that cannot be written.
    pub fn finish(self) -> Result<StoredEvaluation, ResultsError> {
        if !self.is_finished() {
            let missing = self.missing();
            if let Some(first) = missing.first() {
                let reason = format!("{} episodes have no outcome, the first is {first}", missing.len());
                return Err(ResultsError::Malformed { path: self.folder, reason });
            }
            let (episodes, timings): (Vec<_>, Vec<_>) = self.done.values().cloned().unzip();
            tables::write_timings(&self.folder.join(TIMINGS), &timings)?;
            tables::write_episodes(&self.folder.join(OUTCOMES), &episodes)?;
            // the last one: its presence says that the evaluation is whole
            seal_of(&self.folder, &self.record, &SEALED)?.write(&self.folder)?;
            let journal = self.folder.join(JOURNAL);
            fs::remove_file(&journal).map_err(ResultsError::io("remove", &journal))?;
            sync_folder(&self.folder)?;
        }
        let stored = StoredEvaluation::read(&self.folder)?;
        Ok(stored.expect("its tables were just written"))
    }
}

fn json<T: Serialize>(value: &T) -> String {
    serde_json::to_string(value).unwrap_or_default()
}

/// The episodes in a journal. A last line that was cut off is no episode; it is cut away.
fn read_journal(
    path: &Path,
    record: &EvaluationRecord,
    repair: bool,
) -> Result<BTreeMap<u64, (EpisodeRecord, EpisodeTiming)>, ResultsError> {
    let text = match read_file(path, u64::MAX) {
        Ok(text) => text,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(BTreeMap::new()),
        Err(error) => return Err(ResultsError::io("read", path)(error)),
    };
    let whole = text.iter().rposition(|&byte| byte == b'\n').map_or(0, |at| at + 1);
    if repair && whole < text.len() {
        let cut = OpenOptions::new().write(true).open(path).and_then(|f| f.set_len(whole as u64));
        cut.map_err(ResultsError::io("cut the unfinished last line of", path))?;
    }
    let own = record.own_seeds();
    let mut done = BTreeMap::new();
    for (index, line) in text[..whole].split_inclusive(|&byte| byte == b'\n').enumerate() {
        let malformed = |reason: String| ResultsError::Malformed {
            path: path.to_owned(),
            reason: format!("line {}: {reason}", index + 1),
        };
        let JournalLine { episode, timing } =
            serde_json::from_slice(line).map_err(|e| malformed(format!("not an episode: {e}")))?;
        let seed = episode.seed;
        if own.binary_search(&seed).is_err() {
            return Err(malformed(format!("seed {seed} is none of {}", record.seeds)));
        }
        if done.insert(seed, (episode, timing)).is_some() {
            return Err(malformed(format!("seed {seed} is there twice")));
        }
    }
    Ok(done)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::testing::{episode, finished, sample};

    #[test]
    fn an_interrupted_evaluation_goes_on_and_ends_in_the_same_bytes() {
        let dir = tempfile::tempdir().unwrap();
        let record = sample("a", 1, 6);
        let straight = finished(&dir.path().join("straight"), &record);
        let results = dir.path().join("interrupted");
        for seed in [10_003, 10_001] {
            let mut folder = ResultsFolder::open(&results, &record).unwrap();
            assert!(folder.missing().contains(&seed));
            let (e, t) = episode(seed);
            folder.add(e, t).unwrap();
            // killed in the middle of the next line
            let journal = folder.path().join(JOURNAL);
            let mut file = OpenOptions::new().append(true).open(journal).unwrap();
            file.write_all(b"{\"episode\":{\"seed\":10002,").unwrap();
        }
        let folder = ResultsFolder::open(&results, &record).unwrap();
        assert_eq!(folder.missing(), [10_000, 10_002, 10_004, 10_005]);
        drop(folder);
        assert!(list_evaluations(&results).unwrap().is_empty(), "half an evaluation is none");
        let resumed = finished(&results, &record);
        for name in [RECORD, OUTCOMES] {
            let read = |folder: &Path| fs::read(folder.join(name)).unwrap();
            assert_eq!(read(&straight.folder), read(&resumed.folder), "{name}");
        }
        assert_eq!(list_evaluations(&results).unwrap(), std::slice::from_ref(&resumed));
        let mut again = ResultsFolder::open(&results, &record).unwrap();
        assert!(again.is_finished() && again.missing().is_empty());
        let (mut other, timing) = episode(10_001);
        again.add(other.clone(), timing.clone()).unwrap();
        other.steps += 1;
        let error = again.add(other, timing).unwrap_err().to_string();
        assert!(error.contains("outcome of seed 10001 differs"), "{error}");
    }

    #[test]
    fn an_evaluation_takes_over_what_a_smaller_one_has_and_ends_in_the_same_bytes() {
        let dir = tempfile::tempdir().unwrap();
        let (grown, straight) = (dir.path().join("grown"), dir.path().join("straight"));
        finished(&grown, &sample("a", 1, 10));
        let mut shard = sample("a", 1, 30);
        shard.shard = Some(crate::Shard { index: 2, count: 2 });
        finished(&grown, &shard);
        let mut other = sample("a", 1, 12);
        other.protocol.max_steps += 1;
        finished(&grown, &other);
        finished(&grown, &sample("b", 1, 12));
        let mut folder = ResultsFolder::open(&grown, &sample("a", 1, 14)).unwrap();
        folder.adopt(&grown).unwrap();
        // ten of the first, the odd ones of the second
        assert_eq!(folder.missing(), [10_010, 10_012]);
        drop(folder);
        let (grown, straight) = (finished(&grown, &sample("a", 1, 14)), finished(&straight, &sample("a", 1, 14)));
        let read = |stored: &StoredEvaluation| fs::read(stored.folder.join(OUTCOMES)).unwrap();
        assert_eq!(read(&grown), read(&straight));
    }

    #[test]
    fn a_finished_evaluation_takes_in_progress_and_goes_on_when_killed_in_between() {
        let dir = tempfile::tempdir().unwrap();
        let record = sample("a", 1, 6);
        let before = finished(dir.path(), &record);
        let further: Vec<EpisodeRecord> = before
            .episodes
            .iter()
            .map(|episode| EpisodeRecord {
                progress: Some(if episode.success { 1.0 } else { 1.0 / 3.0 }),
                ..episode.clone()
            })
            .collect();
        let open = || ResultsFolder::open(dir.path(), &record).unwrap();
        let mut other = further.clone();
        other[2].steps += 1;
        let error = open().rewrite(other).unwrap_err().to_string();
        assert!(error.contains("outcome of seed 10002 differs"), "{error}");
        assert_eq!(StoredEvaluation::read(&before.folder).unwrap().as_ref(), Some(&before), "nothing was touched");
        let after = open().rewrite(further.clone()).unwrap();
        assert_eq!((after.episodes, after.timings, after.sealed), (further.clone(), before.timings, true));
        assert!(!before.folder.join(JOURNAL).exists());
        // killed after the journal was written: the seal stands, and what it seals
        let text = |episodes: &[EpisodeRecord]| -> String {
            let lines =
                episodes.iter().cloned().map(|episode| JournalLine { timing: self::episode(episode.seed).1, episode });
            lines.map(|line| serde_json::to_string(&line).unwrap() + "\n").collect()
        };
        fs::write(before.folder.join(JOURNAL), text(&before.episodes)).unwrap();
        assert!(open().is_finished());
        // killed after the seal was removed: every episode is in the journal
        fs::write(before.folder.join(JOURNAL), text(&further)).unwrap();
        fs::remove_file(before.folder.join(SEAL_FILE)).unwrap();
        assert_eq!(StoredEvaluation::read(&before.folder).unwrap(), None, "under way");
        let folder = open();
        assert!(!folder.is_finished() && folder.missing().is_empty());
        assert_eq!(folder.finish().unwrap().episodes, further);
    }

    #[test]
    fn two_processes_cannot_work_in_one_folder() {
        let dir = tempfile::tempdir().unwrap();
        let record = sample("a", 1, 2);
        let first = ResultsFolder::open(dir.path(), &record).unwrap();
        let error = ResultsFolder::open(dir.path(), &record).err().unwrap().to_string();
        assert!(error.contains("another evaluation"), "{error}");
        drop(first);
        ResultsFolder::open(dir.path(), &record).unwrap();
    }

    #[test]
    fn damage_inside_the_journal_is_an_error_and_not_a_shorter_journal() {
        let dir = tempfile::tempdir().unwrap();
        let record = sample("a", 1, 3);
        let mut folder = ResultsFolder::open(dir.path(), &record).unwrap();
        for seed in [10_000, 10_001] {
            let (e, t) = episode(seed);
            folder.add(e, t).unwrap();
        }
        let journal = folder.path().join(JOURNAL);
        drop(folder);
        let text = fs::read_to_string(&journal).unwrap();
        for (damaged, word) in [
            (text.replacen("10000", "1x000", 1), "line 1"),
            (text.replacen("10000", "99999", 1), "99999"),
            (text.replacen("10001", "10000", 1), "there twice"),
        ] {
            fs::write(&journal, damaged).unwrap();
            let error = ResultsFolder::open(dir.path(), &record).err().unwrap().to_string();
            assert!(error.contains(word), "{error}");
        }
    }

    #[test]
    fn outcomes_that_no_episode_can_have_are_refused_though_they_are_sealed() {
        let dir = tempfile::tempdir().unwrap();
        let record = sample("a", 1, 3);
        let stored = finished(dir.path(), &record);
        #[allow(clippy::type_complexity)]
        let changes: [(&str, fn(&mut EpisodeRecord)); 9] = [
            ("steps: expected 1 to 400, found 0", |e| e.steps = 0),
            ("steps: expected 1 to 400, found 401", |e| e.steps = 401),
            ("return: expected a finite number, found NaN", |e| e.total_reward = f64::NAN),
            ("return: expected a finite number, found inf", |e| e.total_reward = f64::INFINITY),
            ("progress: expected 0 to 1, found 1.5", |e| e.progress = Some(1.5)),
            ("progress: expected 0 to 1, found NaN", |e| e.progress = Some(f64::NAN)),
            ("progress: expected 1 of a success, found 0.5", |e| e.progress = Some(0.5)),
            ("failure: expected none of a success, found dropped", |e| e.failure = Some("dropped".into())),
            ("fingerprint: expected 64 hexadecimal digits, found \"x\"", |e| e.fingerprint = "x".into()),
        ];
        for (word, change) in changes {
            let mut episodes = stored.episodes.clone();
            change(&mut episodes[1]);
            tables::write_episodes(&stored.folder.join(OUTCOMES), &episodes).unwrap();
            stored.seal().unwrap();
            let error = StoredEvaluation::read(&stored.folder).unwrap_err().to_string();
            let whole = format!("{}: seed 10001: {word}", stored.folder.join(OUTCOMES).display());
            assert_eq!(error, whole);
        }
        for (start, count) in [(10_000, 0), (u64::MAX, 1)] {
            let none = EvaluationRecord { seeds: Seeds { start, count }, ..record.clone() };
            fs::write(stored.folder.join(RECORD), serde_json::to_vec(&none).unwrap()).unwrap();
            let error = read_record(&stored.folder).unwrap_err().to_string();
            let expected = format!("seeds: expected 1 to 1000000 below 2^64, found {count} from {start} on");
            assert!(error.ends_with(&expected), "{error}");
        }
    }

    #[test]
    fn a_changed_story_for_the_same_entry_hash_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let mut record = sample("a", 1, 2);
        drop(ResultsFolder::open(dir.path(), &record).unwrap());
        record.training.demos = 51;
        let error = ResultsFolder::open(dir.path(), &record).err().unwrap().to_string();
        assert!(error.contains("evaluation.json: training differs: stored {"), "{error}");
    }
}
