//! Which results stand: sealed, in the folder that their record belongs in, and of an entry of the zoo that says the same.
//!
//! One bad file stops nothing: what does not stand is left out and named, with the reason.

pub mod rerun;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use results::{
    EntryIdentity, EvaluationRecord, OUTCOMES, Protocol, RECORD, ResultsError, SEAL_FILE, StoredEvaluation,
    TrainingFacts, UnderWay, entries_named, result_folders,
};
use zoo::ZooError;
use zoo::entry::{Entry, EntryId, EntryMeta, Families, MODEL_FILE, family_of, training_facts};
use zoo::registry::Registry;

/// A result that does not stand.
#[derive(Debug)]
pub struct LeftOut {
    /// Its folder.
    pub folder: PathBuf,
    /// Why it does not.
    pub reason: ZooError,
}

/// Results that stand, and the others.
#[derive(Debug)]
pub struct Audit<E> {
    /// Those that stand, by folder name.
    pub standing: Vec<E>,
    /// Those that do not.
    pub left_out: Vec<LeftOut>,
    /// Those that have not ended.
    pub under_way: Vec<UnderWay>,
    /// Those that stand and of which something is to be said: their folders, and what.
    pub doubts: Vec<(PathBuf, String)>,
}

impl<E> Default for Audit<E> {
    fn default() -> Self {
        Self { standing: Vec::new(), left_out: Vec::new(), under_way: Vec::new(), doubts: Vec::new() }
    }
}

impl<E> Audit<E> {
    /// Takes in what a folder holds; one still under way is neither.
    pub fn add(&mut self, folder: &Path, found: Result<Option<E>, ZooError>) {
        match found {
            Ok(found) => self.standing.extend(found),
            Err(reason) => self.left_out.push(LeftOut { folder: folder.to_owned(), reason }),
        }
    }
}

/// Entries of several names with the same weights.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SameWeights {
    /// Those entries.
    pub entries: Vec<EntryId>,
    /// Whether two of them are of one family and say other seeds: other seeds give other weights.
    pub impossible: bool,
}

/// The entries of a zoo, each with every file's hash checked.
#[derive(Debug)]
pub struct KnownEntries {
    zoo: PathBuf,
    opened: BTreeMap<EntryId, Result<Entry, ZooError>>,
}

impl KnownEntries {
    /// Opens every entry of `registry`.
    ///
    /// # Errors
    /// A zoo that cannot be listed. Bad entries are [`KnownEntries::bad`].
    pub fn open(registry: &Registry) -> Result<Self, ZooError> {
        Ok(Self::only(registry, registry.ids()?))
    }

    /// Opens these entries of `registry` and no other.
    pub fn only(registry: &Registry, ids: impl IntoIterator<Item = EntryId>) -> Self {
        let zoo = registry.folder().to_owned();
        let opened = ids.into_iter().map(|id| {
            let entry = Entry::open(&zoo, &id);
            (id, entry)
        });
        let opened = opened.collect();
        Self { zoo, opened }
    }

    /// Those that are what was written, by name and version.
    pub fn good(&self) -> impl Iterator<Item = &Entry> {
        self.opened.values().filter_map(|entry| entry.as_ref().ok())
    }

    /// Entries of several names, or of several seeds of one family, with the same weights; those without weights, such as
    /// baselines, are left out.
    pub fn same_weights(&self) -> Vec<SameWeights> {
        let mut by_hash: BTreeMap<&str, Vec<&Entry>> = BTreeMap::new();
        let has_weights = |entry: &&Entry| entry.meta().parameters > 0 && !entry.meta().is_external();
        for entry in self.good().filter(has_weights) {
            if let Some(file) = entry.meta().files.get(MODEL_FILE) {
                by_hash.entry(&file.sha256).or_default().push(entry);
            }
        }
        let seed = |entry: &Entry| Some((family_of(entry)?, entry.meta().training.as_ref()?.seed));
        let of = |found: Vec<&Entry>| {
            let seeds: Vec<(String, u64)> = found.iter().filter_map(|entry| seed(entry)).collect();
            let twice = |(family, seed): &(String, u64)| seeds.iter().any(|(of, other)| of == family && other != seed);
            let impossible = seeds.iter().any(twice);
            // versions of one entry may be the same training, run again
            let told = impossible || found.iter().any(|entry| entry.meta().name != found[0].meta().name);
            told.then(|| SameWeights { impossible, entries: found.iter().map(|entry| entry.id()).collect() })
        };
        by_hash.into_values().filter_map(of).collect()
    }

    /// The families among those.
    pub fn families(&self) -> Families {
        Families::of(self.good())
    }

    /// Those that are not, with the reason.
    pub fn bad(&self) -> impl Iterator<Item = (&EntryId, &ZooError)> {
        self.opened.iter().filter_map(|(id, entry)| Some((id, entry.as_ref().err()?)))
    }

    /// The entry of that name and version, if it is there and whole.
    pub fn get(&self, id: &EntryId) -> Option<&Entry> {
        self.opened.get(id)?.as_ref().ok()
    }

    /// Compares what a result in `folder` says of its entry with the entry.
    ///
    /// # Errors
    /// [`ResultsError::Unfit`]: an entry that is not in the zoo or damaged, another hash, other facts of its training.
    pub fn check(&self, folder: &Path, claimed: &EntryIdentity, training: &TrainingFacts) -> Result<(), ZooError> {
        let unfit = |what: &str, expected: String, found: String| {
            Err(ZooError::from(ResultsError::Unfit {
                folder: folder.to_owned(),
                what: what.to_owned(),
                expected,
                found,
            }))
        };
        let id = EntryId { name: claimed.name.clone(), version: claimed.version };
        let entry = match self.opened.get(&id) {
            Some(Ok(entry)) => entry,
            Some(Err(error)) => return unfit("entry", format!("{id} as it was written"), error.to_string()),
            None => return unfit("entry", format!("one of the zoo {}", self.zoo.display()), id.to_string()),
        };
        let hash = entry.meta().content_sha256();
        if hash != claimed.hash {
            return unfit("hash of the entry", hash, claimed.hash.clone());
        }
        match difference(entry.meta(), training) {
            Some((what, expected, found)) => unfit(what, expected, found),
            None => Ok(()),
        }
    }
}

/// The first fact of the training that the entry states otherwise.
fn difference(meta: &EntryMeta, found: &TrainingFacts) -> Option<(&'static str, String, String)> {
    let expected = training_facts(meta);
    let minutes = expected.is_as_long(found);
    let text = |value: &Option<String>| value.clone().unwrap_or_else(|| "none".to_owned());
    let data_set = meta.data_set_of(&expected, found).to_owned();
    let facts = [
        ("policy", expected.policy, found.policy.clone()),
        ("parameters", expected.parameters.to_string(), found.parameters.to_string()),
        ("training steps", expected.steps.to_string(), found.steps.to_string()),
        ("training seed", expected.seed.to_string(), found.seed.to_string()),
        ("data set", expected.data_set, data_set),
        ("fingerprint of the data", expected.data_fingerprint, found.data_fingerprint.clone()),
        ("simulator of the data", text(&expected.data_simulator), text(&found.data_simulator)),
        ("demos", expected.demos.to_string(), found.demos.to_string()),
    ];
    let other = facts.into_iter().find(|(_, expected, found)| expected != found);
    let minutes = (!minutes).then(|| ("minutes", expected.minutes.to_string(), found.minutes.to_string()));
    other.or(minutes)
}

/// Refuses a folder that is not called what its record says: a copy, or one that was renamed.
///
/// # Errors
/// [`ResultsError::Unfit`].
pub fn check_folder_name(folder: &Path, expected: &str) -> Result<(), ZooError> {
    let found = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
    if found == expected {
        return Ok(());
    }
    let (what, expected) = ("name of the folder".to_owned(), expected.to_owned());
    Err(ResultsError::Unfit { folder: folder.to_owned(), what, expected, found }.into())
}

/// Every finished evaluation of a robot policy under `results` that stands, and what does not.
///
/// # Errors
/// A folder of results that cannot be listed.
pub fn audit(results: &Path, entries: &KnownEntries) -> Result<Audit<StoredEvaluation>, ZooError> {
    let mut audit = Audit::default();
    for folder in result_folders(results)? {
        // whatever it is: a pipe in its place is an error, too
        if folder.join(RECORD).symlink_metadata().is_ok() {
            match standing(&folder, entries) {
                Ok(None) => match UnderWay::read(&folder) {
                    Ok(found) => audit.under_way.push(found),
                    Err(error) => audit.add(&folder, Err(error.into())),
                },
                found => audit.add(&folder, found),
            }
        } else if let Some(sole) = unexplained(&folder) {
            let path = folder.join(sole);
            let reason = format!("a result without {RECORD}, which says what it is of");
            audit.add(&folder, Err(ZooError::Malformed { path, reason }));
        }
    }
    audit.other_beginnings();
    audit.parts();
    Ok(audit)
}

impl Audit<StoredEvaluation> {
    /// Names results in which an episode begins otherwise than in most results of the same simulator and seed: an initial state
    /// depends on nothing else, but for the last bits of another kind of processor. A simulator of the user's may be less exact.
    fn other_beginnings(&mut self) {
        let mut beginnings: BTreeMap<(String, u64), BTreeMap<&str, Vec<&Path>>> = BTreeMap::new();
        let ours = self.standing.iter().filter(|stored| stored.record.protocol.env_module.is_none());
        for StoredEvaluation { folder, record, episodes, .. } in ours {
            let rules = Protocol { max_steps: 0, ..record.protocol.clone() };
            let simulator = format!("{rules:?} {:?} {:?} {:?}", record.versions, record.sources, record.kernels);
            for episode in episodes {
                let of_seed = beginnings.entry((simulator.clone(), episode.seed)).or_default();
                of_seed.entry(&episode.fingerprint).or_default().push(folder);
            }
        }
        let mut doubts = BTreeMap::new();
        for ((_, seed), found) in &beginnings {
            let most = found.values().map(Vec::len).max().unwrap_or(0);
            let usual: Vec<&str> = found.iter().filter(|(_, of)| of.len() == most).map(|(print, _)| *print).collect();
            for (print, folders) in found.iter().filter(|(print, _)| usual != [**print]) {
                let other =
                    found.iter().find(|(other, _)| other != &print).map(|(_, of)| of[0]).unwrap_or(Path::new(""));
                for &folder in folders {
                    let text = format!(
                        "the initial state of seed {seed} is not that in {}: it was computed on another kind of processor, or \
                         the result was edited; `eval --again` checks it",
                        other.display()
                    );
                    doubts.entry(folder.to_owned()).or_insert(text);
                }
            }
        }
        self.doubts.extend(doubts);
    }

    /// Names parts of evaluations that nobody has joined.
    fn parts(&mut self) {
        let whole = |record: &EvaluationRecord| EvaluationRecord { shard: None, ..record.clone() };
        let parts = self.standing.iter().filter_map(|stored| Some((stored, stored.record.shard?)));
        let parts = parts.filter(|(part, _)| {
            let joined = whole(&part.record);
            !self.standing.iter().any(|other| other.record.shard.is_none() && other.record.is_same(&joined))
        });
        let waiting: Vec<UnderWay> = parts
            .map(|(StoredEvaluation { folder, episodes, .. }, shard)| {
                let done = episodes.len() as u64;
                UnderWay { folder: folder.clone(), done, total: done, unsealed: false, ended: Some(shard) }
            })
            .collect();
        self.under_way.extend(waiting);
    }
}

/// Whether a result's folder, its record or its seal says that it is of this entry.
pub fn is_of(folder: &Path, id: &EntryId) -> bool {
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    let is = |entry: EntryIdentity| entry.name == id.name && entry.version == id.version;
    name.starts_with(&format!("{id}_")) || entries_named(folder).into_iter().any(is)
}

/// The record of an evaluation on puzzles.
const PUZZLES: &str = "puzzles.json";

/// A file that only a result has, in a folder without any record.
fn unexplained(folder: &Path) -> Option<&'static str> {
    let names = folder.read_dir().ok()?.flatten().filter_map(|item| item.file_name().into_string().ok());
    let names: Vec<String> = names.collect();
    let tables = [OUTCOMES, SEAL_FILE].into_iter().find(|name| names.iter().any(|found| found == name));
    // evaluations on puzzles have a record of another name, which is read elsewhere
    tables.filter(|_| !folder.join(PUZZLES).is_file())
}

/// The finished evaluation in `folder`; nothing if it is still under way.
///
/// # Errors
/// Why it does not stand.
pub fn standing(folder: &Path, entries: &KnownEntries) -> Result<Option<StoredEvaluation>, ZooError> {
    let Some(stored) = StoredEvaluation::read(folder)? else { return Ok(None) };
    check_folder_name(folder, &stored.record.folder_name())?;
    if !stored.sealed {
        return Err(ResultsError::Unsealed { folder: folder.to_owned() }.into());
    }
    entries.check(folder, &stored.record.entry, &stored.record.training)?;
    Ok(Some(stored))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::fs;

    use super::*;
    use results::testing::{finished, sample, write_episodes};
    use zoo::entry::testing::draft as test_draft;
    use zoo::results::{Execution, ResultsFolder, Seeds, Shard};

    /// A zoo with `lift-act@1` and a finished evaluation of it.
    fn zoo() -> (tempfile::TempDir, PathBuf, EvaluationRecord) {
        let zoo = tempfile::tempdir().unwrap();
        let id = test_draft("lift-act").seal(zoo.path()).unwrap();
        let record = record_of(&Entry::open(zoo.path(), &id).unwrap(), 20);
        let folder = finished(&zoo.path().join("results"), &record).folder;
        (zoo, folder, record)
    }

    fn record_of(entry: &Entry, episodes: u64) -> EvaluationRecord {
        let mut record = sample("lift-act", 1, episodes);
        record.entry.hash = entry.meta().content_sha256();
        record.training = training_facts(entry.meta());
        record
    }

    fn audited(zoo: &Path) -> Audit<StoredEvaluation> {
        let entries = KnownEntries::open(&Registry::open(zoo)).unwrap();
        audit(&zoo.join("results"), &entries).unwrap()
    }

    /// Why the only result is left out.
    fn reason(zoo: &Path) -> String {
        let audit = audited(zoo);
        assert_eq!((audit.standing.len(), audit.left_out.len()), (0, 1), "{audit:?}");
        audit.left_out[0].reason.to_string()
    }

    #[test]
    fn what_was_measured_stands() {
        let (zoo, folder, record) = zoo();
        let audit = audited(zoo.path());
        assert!(audit.left_out.is_empty(), "{:?}", audit.left_out);
        assert_eq!(audit.standing[0].record, record);
        let seal: serde_json::Value = serde_json::from_slice(&fs::read(folder.join(SEAL_FILE)).unwrap()).unwrap();
        assert_eq!(seal["folder"], record.folder_name());
        assert_eq!(seal["entry"]["hash"], record.entry.hash);
        assert_eq!(seal["protocol"], record.protocol.hash());
        let files: Vec<&String> = seal["files"].as_object().unwrap().keys().collect();
        assert_eq!(files, ["evaluation.json", "outcomes.parquet", "timings.parquet"]);
    }

    /// Sealed, and possible by itself: but other results of the simulator say how these episodes begin.
    #[test]
    fn an_episode_begins_as_in_most_results() {
        let (zoo, folder, record) = zoo();
        let results = zoo.path().join("results");
        for n_action_steps in [1, 2] {
            finished(
                &results,
                &EvaluationRecord { execution: Execution::RecedingHorizon { n_action_steps }, ..record.clone() },
            );
        }
        assert_eq!(audited(zoo.path()).standing.len(), 3);
        let mut stored = StoredEvaluation::read(&folder).unwrap().unwrap();
        stored.episodes[4].fingerprint = "0".repeat(64);
        write_episodes(&folder.join(OUTCOMES), &stored.episodes).unwrap();
        stored.seal().unwrap();
        let Audit { standing, doubts, .. } = audited(zoo.path());
        let [(doubted, text)] = doubts.as_slice() else { panic!("{doubts:?}") };
        assert!(
            standing.len() == 3 && *doubted == folder && text.contains("initial state of seed 10004 is not that in"),
            "{text}"
        );
    }

    #[test]
    fn parts_that_nobody_has_joined_are_named() {
        let (zoo, _, record) = zoo();
        let seeds = Seeds { start: 50_000, count: 20 };
        let part = |index| EvaluationRecord { shard: Some(Shard { index, count: 2 }), seeds, ..record.clone() };
        let results = zoo.path().join("results");
        finished(&results, &part(1));
        let said = audited(zoo.path()).under_way[0].to_string();
        assert!(said.starts_with("part 1/2, not shown until"), "{said}");
        finished(&results, &EvaluationRecord { seeds, ..record.clone() });
        assert_eq!(audited(zoo.path()).under_way, []);
    }

    /// Every bit of every file of a result: headers, payload, Parquet, seal.
    #[test]
    fn a_flipped_bit_anywhere_in_a_result_is_told() {
        let (_zoo, folder, _) = zoo();
        let mut flips = 0;
        for name in [RECORD, OUTCOMES, "timings.parquet", SEAL_FILE] {
            let path = folder.join(name);
            let original = fs::read(&path).unwrap();
            let mut bytes = original.clone();
            // `tests/flips.rs` flips others
            for bit in (0..8 * original.len()).step_by(37) {
                bytes[bit / 8] ^= 1 << (bit % 8);
                fs::write(&path, &bytes).unwrap();
                let read = StoredEvaluation::read(&folder);
                assert!(read.is_err(), "{name}: bit {bit} passed: {read:?}");
                bytes[bit / 8] ^= 1 << (bit % 8);
                flips += 1;
            }
            fs::write(&path, &original).unwrap();
        }
        assert!(StoredEvaluation::read(&folder).unwrap().is_some());
        assert!(flips > 800, "{flips}");
    }

    #[test]
    fn a_flipped_bit_anywhere_in_an_entry_leaves_its_results_out_and_names_it() {
        let (zoo, _, _) = zoo();
        let mut flips = 0;
        for name in ["entry.json", "model.safetensors", "config.toml", "normaliser.safetensors", "README.md"] {
            let path = zoo.path().join("lift-act/1").join(name);
            let original = fs::read(&path).unwrap();
            for bit in (0..8 * original.len()).step_by(23) {
                let mut bytes = original.clone();
                bytes[bit / 8] ^= 1 << (bit % 8);
                fs::write(&path, &bytes).unwrap();
                let entries = KnownEntries::open(&Registry::open(zoo.path())).unwrap();
                assert_eq!(entries.bad().count(), 1, "{name}: bit {bit}");
                assert_eq!(entries.good().count(), 0);
                flips += 1;
            }
            fs::write(&path, original.iter().rev().copied().collect::<Vec<u8>>()).unwrap();
            assert!(reason(zoo.path()).contains("entry: expected lift-act@1 as it was written"));
            fs::write(&path, original).unwrap();
        }
        assert!(flips > 390, "{flips}");
        assert_eq!(audited(zoo.path()).standing.len(), 1);
    }

    #[test]
    fn forged_results_are_left_out_with_the_reason() {
        let (zoo, folder, _) = zoo();
        let results = zoo.path().join("results");
        let path = folder.join(RECORD);
        let original = fs::read_to_string(&path).unwrap();
        // the story edited, one field after the other
        for (from, to) in [
            ("\"demos\": 45", "\"demos\": 5"),
            ("\"minutes\": 1.25", "\"minutes\": 0.25"),
            ("\"count\": 20", "\"count\": 19"),
            ("\"name\": \"lift-act\"", "\"name\": \"lift-actrm\""),
            ("\"max_steps\": 400", "\"max_steps\": 40"),
        ] {
            assert!(original.contains(from), "{from} in {original}");
            fs::write(&path, original.replacen(from, to, 1)).unwrap();
            let reason = reason(zoo.path());
            assert!(reason.contains("evaluation.json: sha256 does not match"), "{from}: {reason}");
        }
        fs::write(&path, "").unwrap();
        assert!(reason(zoo.path()).contains("evaluation.json: not an evaluation"));
        fs::remove_file(&path).unwrap();
        assert!(reason(zoo.path()).contains("a result without evaluation.json"));
        fs::write(&path, &original).unwrap();

        // every success set to true
        let mine = folder.join(OUTCOMES);
        let honest = fs::read(&mine).unwrap();
        let mut forged = StoredEvaluation::read(&folder).unwrap().unwrap().episodes;
        forged.iter_mut().for_each(|episode| episode.success = true);
        write_episodes(&mine, &forged).unwrap();
        assert!(reason(zoo.path()).contains("outcomes.parquet: sha256 does not match"));
        fs::remove_file(&mine).unwrap();
        assert!(reason(zoo.path()).contains("outcomes.parquet"));
        fs::write(&mine, honest).unwrap();

        // its record under another name
        let hidden = folder.join("evaluation.json.bak.json");
        fs::rename(folder.join(RECORD), &hidden).unwrap();
        assert!(reason(zoo.path()).contains("a result without evaluation.json"));
        fs::rename(&hidden, folder.join(RECORD)).unwrap();

        // a seal taken away, or of another folder
        let seal = fs::read(folder.join(SEAL_FILE)).unwrap();
        fs::remove_file(folder.join(SEAL_FILE)).unwrap();
        assert!(reason(zoo.path()).contains("not sealed"));
        fs::write(folder.join(SEAL_FILE), &seal).unwrap();
        assert_eq!(audited(zoo.path()).standing.len(), 1);

        // a copy under another name: the original stands
        let copy = results.join("lift-act@2_Lift_10000-10019_00000000");
        fs::create_dir(&copy).unwrap();
        for file in [RECORD, OUTCOMES, "timings.parquet", SEAL_FILE] {
            fs::copy(folder.join(file), copy.join(file)).unwrap();
        }
        let audit = audited(zoo.path());
        assert_eq!((audit.standing.len(), audit.left_out.len()), (1, 1));
        let reason = audit.left_out[0].reason.to_string();
        assert!(reason.contains("name of the folder: expected lift-act@1_Lift"), "{reason}");
        let id = |name: &str, version| EntryId { name: name.to_owned(), version };
        assert!(is_of(&copy, &id("lift-act", 1)) && is_of(&copy, &id("lift-act", 2)) && !is_of(&copy, &id("lift", 1)));
        fs::remove_file(copy.join(RECORD)).unwrap();
        assert!(is_of(&copy, &id("lift-act", 1)), "its seal says so");
    }

    /// A result without its seal that looks as if it was under way is named, though it is no error.
    #[test]
    fn what_is_not_finished_is_named() {
        let (zoo, folder, _) = zoo();
        fs::remove_file(folder.join(SEAL_FILE)).unwrap();
        fs::write(folder.join("journal.jsonl"), "").unwrap();
        let said = || {
            let audit = audited(zoo.path());
            assert_eq!((audit.standing.len(), audit.left_out.len(), audit.under_way.len()), (0, 0, 1));
            audit.under_way[0].to_string()
        };
        assert_eq!(said(), "not finished: 0 of 20 episodes; outcomes.parquet is there without a seal");
        for file in [OUTCOMES, "timings.parquet", "journal.jsonl"] {
            fs::remove_file(folder.join(file)).unwrap();
        }
        assert_eq!(said(), "not finished: 0 of 20 episodes");
        fs::write(folder.join("journal.jsonl"), "{}\n").unwrap();
        assert!(reason(zoo.path()).contains("journal.jsonl: line 1: not an episode"));
        fs::remove_file(folder.join(RECORD)).unwrap();
        std::os::unix::fs::symlink("/dev/zero", folder.join(RECORD)).unwrap();
        assert!(reason(zoo.path()).contains("evaluation.json"));
    }

    #[test]
    fn the_same_weights_under_two_names_are_told() {
        let zoo = tempfile::tempdir().unwrap();
        let seal = |name: &str, seed: u64, parameters: u64, weights: &str| {
            let mut draft = test_draft(name);
            draft.meta.training.as_mut().unwrap().seed = seed;
            (draft.meta.parameters, draft.model) = (parameters, weights.as_bytes().to_vec());
            draft.config = format!("entry = \"{name}\"\n[train]\nseed = {seed}\n");
            draft.seal(zoo.path()).unwrap()
        };
        let same = || KnownEntries::open(&Registry::open(zoo.path())).unwrap().same_weights();
        for (name, parameters) in [("a-s1", 12), ("a-s1", 12), ("zero", 0), ("random", 0)] {
            seal(name, 1, parameters, if parameters > 0 { "w" } else { "" });
        }
        seal("a-s2", 2, 12, "other");
        assert_eq!(same(), []);
        seal("b", 1, 12, "w");
        let names = |found: &SameWeights| found.entries.iter().map(ToString::to_string).collect::<Vec<_>>();
        let found = same();
        assert_eq!(
            (names(&found[0]), found[0].impossible),
            (["a-s1@1", "a-s1@2", "b@1"].map(String::from).into(), false)
        );
        seal("a-s3", 3, 12, "other");
        let found = same();
        let family = found.iter().find(|found| found.impossible).unwrap();
        assert_eq!((found.len(), names(family)), (2, ["a-s2@1", "a-s3@1"].map(String::from).into()));
        // versions of one name that say other seeds are one family, too
        seal("c-s1", 1, 12, "third");
        seal("c-s1", 2, 12, "third");
        let found = same();
        assert!(found.iter().any(|found| found.impossible && names(found) == ["c-s1@1", "c-s1@2"]), "{found:?}");
    }

    /// Sealed anew after the edit, as only this program's code can: the entry says otherwise.
    #[test]
    fn results_that_say_other_things_than_their_entry_are_left_out() {
        let (zoo, folder, record) = zoo();
        fs::remove_dir_all(folder).unwrap();
        #[allow(clippy::type_complexity)]
        let changes: [(&str, fn(&mut EvaluationRecord)); 6] = [
            ("one of the zoo", |r| r.entry.name = "better-act".into()),
            ("one of the zoo", |r| r.entry.version = 2),
            ("hash of the entry", |r| r.entry.hash = "0".repeat(64)),
            ("parameters: expected", |r| r.training.parameters = 10),
            ("minutes: expected 1.25, found 0.5", |r| r.training.minutes = 0.5),
            ("demos: expected 45, found 1", |r| r.training.demos = 1),
        ];
        for (word, change) in changes {
            let mut forged = record.clone();
            change(&mut forged);
            let folder = finished(&zoo.path().join("results"), &forged).folder;
            let reason = reason(zoo.path());
            assert!(reason.contains(word), "{word}: {reason}");
            fs::remove_dir_all(folder).unwrap();
        }
    }

    #[test]
    fn killed_between_the_tables_and_the_seal_an_evaluation_ends_in_the_same_bytes() {
        let (zoo, folder, record) = zoo();
        let results = zoo.path().join("results");
        let read = || [OUTCOMES, "timings.parquet", SEAL_FILE].map(|name| fs::read(folder.join(name)).unwrap());
        let before = read();
        let stored = StoredEvaluation::read(&folder).unwrap().unwrap();
        fs::remove_dir_all(&folder).unwrap();
        let mut again = ResultsFolder::open(&results, &record).unwrap();
        for (episode, timing) in stored.episodes.iter().zip(&stored.timings) {
            again.add(episode.clone(), timing.clone()).unwrap();
        }
        drop(again);
        fs::write(folder.join(OUTCOMES), &before[0]).unwrap();
        let audit = audited(zoo.path());
        assert!(audit.standing.is_empty() && audit.left_out.is_empty());
        let said = audit.under_way[0].to_string();
        assert_eq!(said, "not finished: 20 of 20 episodes; outcomes.parquet is there without a seal");
        ResultsFolder::open(&results, &record).unwrap().finish().unwrap();
        assert_eq!(read(), before);
        assert_eq!(audited(zoo.path()).standing.len(), 1);
    }
}
