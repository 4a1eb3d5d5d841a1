//! A conversion in shards: each reads and encodes the row groups of some of the episodes, on a machine of its own, and a merge
//! puts them together to the bytes of a conversion in one run.
//!
//! Every shard plans the whole source, so that all of them cut it into the same row groups. A shard is a folder:
//!
//! - `shard.json`: which shard of which conversion it is, what the data set says of itself, and the hashes of its files;
//! - `rows/`, `side/`: the encoded row groups of the data files and of the side folder;
//! - `episodes.bin`: what the episodes say of themselves, a record a row group;
//! - `rest.bin`: what the side folder keeps of no demo.
//!
//! Row groups are spliced, not encoded again, and statistics are made of the values as in one run.

mod merge;
mod record;

pub use merge::merge_shards;

use super::assembly::{Encoders, Head};
use super::convert::{Opened, StopWhenDropped};
use super::doubts::Doubts;
use super::features::ConvertOptions;
use super::info::{Feature, Features, Info};
use super::open::read_json;
use super::schema::{CREATED_BY, hex};
use super::shards::{HashingFile, ShardWriter, WrittenFile};
use super::side::Layout;
use super::staging::Staging;
use super::v2::version as old_version;
use super::verify::hash_file_unless;
use super::work::Part;
use crate::error::{DatasetError, InputError, Result};
use crate::plan::{Dialect, Plan};
use crate::source::codec::put_demo;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::Write;
use std::ops::ControlFlow;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

/// What a shard says of itself.
const STATE_FILE: &str = "shard.json";
const RECORDS_FILE: &str = "episodes.bin";
const REST_FILE: &str = "rest.bin";
const ROWS: &str = "rows";
const SIDE: &str = "side";
/// Version of all that.
const FORMAT: u32 = 1;

/// One of several shards.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Shard {
    /// Which one, from 1.
    pub index: usize,
    /// How many there are.
    pub of: usize,
}

/// More than anyone makes: of so many, those that are missing can be counted.
const MOST_SHARDS: usize = 100_000;

impl Shard {
    fn is_one(&self) -> bool {
        self.of <= MOST_SHARDS && (1..=self.of).contains(&self.index)
    }
}

impl std::str::FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('/').and_then(|(index, of)| Some((index.parse().ok()?, of.parse().ok()?)));
        let shard = parts.map(|(index, of)| Self { index, of }).filter(Self::is_one);
        shard.ok_or_else(|| format!("expected I/N, from 1/N to N/N, of {MOST_SHARDS} at most"))
    }
}

impl std::fmt::Display for Shard {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}/{}", self.index, self.of)
    }
}

/// What a conversion of a shard did.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ShardReport {
    /// Episodes of the shard.
    pub episodes: usize,
    /// Its frames.
    pub frames: usize,
    /// Episodes of all shards.
    pub total_episodes: usize,
    /// Bytes of its files.
    pub bytes: u64,
    /// Whether it was there already, complete.
    pub resumed: bool,
    /// Facts and faults of the source that did not prevent the conversion.
    pub notes: Vec<String>,
}

/// `shard.json`.
#[derive(Serialize, Deserialize)]
struct State {
    format: u32,
    writer: String,
    shard: Shard,
    /// Name of the source.
    source: String,
    /// sha256 over the plan of the source, the options and a sample of the content: the same in all shards of a conversion.
    conversion: String,
    /// Row groups in it.
    groups: usize,
    episodes: usize,
    frames: usize,
    /// Name of each file of the source, and its sha256 where this shard is the one that states it.
    source_files: Vec<(String, Option<String>)>,
    head: StoredHead,
    #[serde(default)]
    doubts: Doubts,
    /// sha256 of each file of the shard.
    files: BTreeMap<String, String>,
}

/// [`Head`] as JSON that keeps every bit of its numbers, and the order of columns.
#[derive(Default, Serialize, Deserialize)]
struct StoredHead {
    dialect: Option<Dialect>,
    info: Value,
    provenance: Value,
    features: Vec<(String, Feature)>,
    tasks: Vec<String>,
    task_of: Vec<usize>,
    layout: Option<Layout>,
    notes: Vec<String>,
    last_notes: Vec<String>,
}

impl StoredHead {
    fn of(head: &Head) -> serde_json::Result<Self> {
        let info = Info { features: Features::default(), ..head.info.clone() };
        Ok(Self {
            dialect: Some(head.dialect),
            info: exact(serde_json::to_value(&info)?),
            provenance: exact(serde_json::to_value(&head.info.actrm)?),
            features: head.info.features.0.clone(),
            tasks: head.tasks.clone(),
            task_of: head.task_of.clone(),
            layout: head.layout.clone(),
            notes: head.notes.clone(),
            last_notes: head.last_notes.clone(),
        })
    }

    fn head(self) -> serde_json::Result<Head> {
        let mut info: Info = serde_json::from_value(inexact(self.info))?;
        info.features = Features(self.features);
        info.actrm = serde_json::from_value(inexact(self.provenance))?;
        let Self { dialect, tasks, task_of, layout, notes, last_notes, .. } = self;
        let dialect = dialect.ok_or_else(|| serde::de::Error::custom("no layout of the source"))?;
        Ok(Head { dialect, info, tasks, task_of, layout, notes, last_notes })
    }
}

/// What begins a text that stands for the bits of a number with a fraction: as text such a number could come back as its
/// neighbour.
const BITS: &str = "\u{0}bits ";

fn exact(value: Value) -> Value {
    match value {
        Value::Number(number) if number.is_f64() => {
            Value::from(format!("{BITS}{}", number.as_f64().unwrap_or_default().to_bits()))
        }
        Value::Array(items) => items.into_iter().map(exact).collect(),
        Value::Object(items) => items.into_iter().map(|(key, value)| (key, exact(value))).collect(),
        other => other,
    }
}

fn inexact(value: Value) -> Value {
    let number = |text: &str| text.strip_prefix(BITS)?.parse().ok().map(f64::from_bits);
    match value {
        Value::String(text) => number(&text).map_or(Value::String(text), Value::from),
        Value::Array(items) => items.into_iter().map(inexact).collect(),
        Value::Object(items) => items.into_iter().map(|(key, value)| (key, inexact(value))).collect(),
        other => other,
    }
}

/// Says of a folder that is a shard that it is no data set.
pub(crate) fn refuse(path: &Path) -> Result<(), InputError> {
    let file = path.join(STATE_FILE);
    let Ok(text) = std::fs::read(&file) else { return Ok(()) };
    let shard = serde_json::from_slice::<Value>(&text)
        .ok()
        .filter(|state| state.get("conversion").is_some())
        .and_then(|state| serde_json::from_value::<Shard>(state.get("shard")?.clone()).ok());
    let Some(shard) = shard else { return Ok(()) };
    Err(InputError::Unavailable {
        path: path.to_owned(),
        object: format!("shard {shard} of a conversion"),
        reason: "it is no data set yet; `actrm-data merge` makes one of all shards".to_owned(),
    })
}

/// A conversion of which one shard is wanted.
struct Job<'a> {
    source: &'a Path,
    options: &'a ConvertOptions,
    shard: Shard,
    opened: Opened,
    /// Of the shard.
    groups: Vec<Vec<Part>>,
    /// The shard that states the hash of each file of the source.
    owners: Vec<usize>,
}

impl<'a> Job<'a> {
    fn new(source: &'a Path, options: &'a ConvertOptions, shard: Shard) -> Result<Self> {
        let refused = |reason: &str| {
            let object = format!("shard {shard} of it");
            DatasetError::from(InputError::Unavailable { path: source.to_owned(), object, reason: reason.to_owned() })
        };
        if !shard.is_one() {
            return Err(refused(&format!("shards are counted from 1/N to N/N, {MOST_SHARDS} at most")));
        }
        if options.skip_bad {
            return Err(refused("leaving out bad demos needs a look at all of them, which one run has"));
        }
        if old_version(source).is_some() {
            return Err(refused("a LeRobot v2.x folder is converted in one run: its columns and videos are copied"));
        }
        let opened = Opened::new(source, options, source)?;
        let total = opened.input.plan().frames().max(1);
        // a row group belongs to the shard that its first episode's first frame lies in
        let owner = |part: &Part| (part.first_frame * shard.of / total + 1).min(shard.of);
        let all = opened.groups(options);
        let mut owners = vec![0; opened.input.plan().files.len()];
        for part in all.iter().flatten().filter(|part| part.begins()) {
            for file in files_of(opened.input.plan(), part) {
                if let Some(known @ 0) = owners.get_mut(file) {
                    *known = owner(part);
                }
            }
        }
        owners.iter_mut().for_each(|owner| *owner = (*owner).max(1));
        let mine = |group: &Vec<Part>| group.first().is_some_and(|part| owner(part) == shard.index);
        let groups = all.into_iter().filter(mine).collect();
        Ok(Self { source, options, shard, opened, groups, owners })
    }

    fn plan(&self) -> &Plan {
        self.opened.input.plan()
    }

    /// What all shards of this conversion have in common and those of another have not.
    fn conversion(&self, head: &StoredHead) -> Result<String> {
        let failed = |source| DatasetError::Json { path: self.source.to_owned(), source };
        let plan = self.plan();
        let mut hash = Sha256::new();
        hash.update(format!("actrm shards {FORMAT} {CREATED_BY} {:?} {:?}\n", self.options.images, self.options.depth));
        let columns = (&head.features, &head.layout, &head.task_of);
        for part in [serde_json::to_vec(&head.info), serde_json::to_vec(&head.provenance), serde_json::to_vec(&columns)]
        {
            hash.update(part.map_err(failed)?);
        }
        for (path, bytes) in &plan.files {
            hash.update(format!("{bytes} {}\n", name_of(path)));
        }
        for demo in &plan.demos {
            hash.update(serde_json::to_vec(demo).map_err(failed)?);
        }
        match plan.files.as_slice() {
            [(path, bytes)] => sample(path, *bytes, &mut hash)?,
            // a node may have no more of the others' files than the beginning of each dataset
            _ => {
                let mut seen = BTreeSet::new();
                for (index, demo) in plan.demos.iter().enumerate() {
                    if let Some(key) = demo.keys.get("actions").filter(|key| seen.insert(key.place.file))
                        && key.shape.first().is_some_and(|&rows| rows > 0)
                    {
                        hash.update(self.opened.input.read_rows(index, "actions", 0, 1)?.bytes);
                    }
                }
            }
        }
        Ok(hex(&hash.finalize()))
    }
}

/// Bytes of a file that are looked at to tell it from others of its size.
const SAMPLED: u64 = 16 << 20;

fn sample(path: &Path, bytes: u64, hash: &mut Sha256) -> Result<()> {
    const BLOCK: u64 = 4096;
    let failed = |source| DatasetError::Io { path: path.to_owned(), operation: "read it", source };
    let file = File::open(path).map_err(failed)?;
    let step = bytes.div_ceil(SAMPLED / BLOCK).max(BLOCK);
    let mut block = [0; BLOCK as usize];
    for at in (0..bytes).step_by(step as usize) {
        let length = BLOCK.min(bytes - at) as usize;
        file.read_exact_at(&mut block[..length], at).map_err(failed)?;
        hash.update(&block[..length]);
    }
    Ok(())
}

/// The files that an episode is in.
fn files_of(plan: &Plan, part: &Part) -> BTreeSet<usize> {
    plan.demos[part.episode].keys.values().map(|key| key.place.file).collect()
}

fn name_of(path: &Path) -> String {
    path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default()
}

/// The files of `source` that conversion of a shard reads the frames of, and those of which it needs all for another reason.
///
/// # Errors
/// As [`convert_shard`].
pub fn shard_files(source: &Path, options: &ConvertOptions, shard: Shard) -> Result<Vec<PathBuf>> {
    let job = Job::new(source, options, shard)?;
    let plan = job.plan();
    let of_shard: BTreeSet<usize> = job.groups.iter().flatten().flat_map(|part| files_of(plan, part)).collect();
    let used: BTreeSet<usize> = plan.demos.iter().flat_map(|demo| demo.keys.values().map(|k| k.place.file)).collect();
    // what is in no demo's place is behind links, and may be of any
    let wanted = |index: &usize| of_shard.contains(index) || job.owners[*index] == shard.index || !used.contains(index);
    Ok((0..plan.files.len()).filter(wanted).map(|index| plan.files[index].0.clone()).collect())
}

/// Converts one shard of the demonstrations at `source` into the folder `out`, which [`merge_shards`] takes. A shard that is
/// there already, complete and of the same conversion, is left as it is.
///
/// # Errors
/// [`DatasetError::Stopped`] where `progress` says that it is enough; nothing stays behind. As [`super::convert`].
pub fn convert_shard(
    source: &Path,
    out: &Path,
    options: &ConvertOptions,
    shard: Shard,
    progress: &mut dyn FnMut(u64, u64) -> ControlFlow<()>,
) -> Result<ShardReport> {
    let there = read_state(out).ok().filter(|state| state.shard == shard);
    let job = Job::new(source, options, shard)?;
    let head = job.opened.head(source, options);
    let json = |source| DatasetError::Json { path: out.join(STATE_FILE), source };
    let stored = StoredHead::of(&head).map_err(json)?;
    let conversion = job.conversion(&stored)?;
    let notes: Vec<String> = head.notes.iter().chain(&head.last_notes).cloned().collect();
    let report = |state: &State, bytes, resumed| ShardReport {
        episodes: state.episodes,
        frames: state.frames,
        total_episodes: head.info.total_episodes,
        bytes,
        resumed,
        notes: notes.iter().cloned().chain(state.doubts.notes()).collect(),
    };
    if let Some(state) = there.filter(|state| state.conversion == conversion) {
        let names = state.files.keys().map(String::as_str).chain([STATE_FILE]);
        let size = |name: &str| match std::fs::metadata(out.join(name)) {
            Ok(meta) => Ok(meta.len()),
            Err(_) => Err(DatasetError::BadDataset {
                path: out.join(name),
                object: format!("shard {shard}"),
                expected: "the file that was written".to_owned(),
                found: "no such file; remove the folder and convert this shard again".to_owned(),
            }),
        };
        let bytes = names.map(size).sum::<Result<u64>>()?;
        return Ok(report(&state, bytes, true));
    }
    let staging = Staging::create(out)?;
    let root = staging.path();
    let mut files: Vec<WrittenFile> = Vec::new();
    if let Some(rest) = job.opened.rest()? {
        let mut bytes = Vec::new();
        put_demo(&mut bytes, &rest);
        files.push(HashingFile::write_whole(root, REST_FILE, &bytes)?);
    }
    let stop = AtomicBool::new(false);
    let (hashes, doubts) = std::thread::scope(|scope| {
        // after a failure nobody waits for the hash of a large file
        let _stop = StopWhenDropped(&stop);
        let hashes = scope.spawn(|| job.hashes(&stop));
        let (written, doubts) = job.write(root, &head, progress)?;
        files.extend(written);
        Ok::<_, DatasetError>((hashes.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?, doubts))
    })?;
    let state = State {
        format: FORMAT,
        writer: CREATED_BY.to_owned(),
        shard,
        source: name_of(source),
        conversion,
        groups: job.groups.len(),
        episodes: job.groups.iter().flatten().filter(|part| part.begins()).count(),
        frames: job.groups.iter().flatten().map(|part| part.rows.len()).sum(),
        source_files: hashes,
        head: stored,
        doubts,
        files: files.iter().map(|file| (file.path.clone(), file.sha256.clone())).collect(),
    };
    let text = serde_json::to_vec(&state).map_err(json)?;
    files.push(HashingFile::write_whole(root, STATE_FILE, &text)?);
    staging.publish()?;
    Ok(report(&state, files.iter().map(|file| file.bytes).sum(), false))
}

impl Job<'_> {
    /// Names of the source's files, with the hashes that this shard states.
    fn hashes(&self, stop: &AtomicBool) -> Result<Vec<(String, Option<String>)>> {
        let of = |((path, _), owner): (&(PathBuf, u64), &usize)| {
            let hash = (*owner == self.shard.index).then(|| hash_file_unless(path, stop)).transpose()?;
            Ok((name_of(path), hash))
        };
        self.plan().files.iter().zip(&self.owners).map(of).collect()
    }

    /// Writes the row groups and their records; gives what is to be noted of their values too.
    fn write(
        &self,
        root: &Path,
        head: &Head,
        progress: &mut dyn FnMut(u64, u64) -> ControlFlow<()>,
    ) -> Result<(Vec<WrittenFile>, Doubts)> {
        let encoders = Encoders::new(root, head)?;
        let mut rows = ShardWriter::new(root, ROWS, &encoders.data, u64::MAX, 1);
        let mut side = encoders.side_frames().map(|frames| ShardWriter::new(root, SIDE, frames, u64::MAX, 1));
        let path = root.join(RECORDS_FILE);
        let mut records = HashingFile::create(&path)?;
        let from = (self.source, self.options);
        let doubts = self.opened.each_group(from, head, &encoders, &self.groups, progress, &mut |output, beside| {
            let record = record::put(&output, beside.as_ref());
            let failed = |source| DatasetError::Io { path: path.clone(), operation: "write it", source };
            records.write_all(&(record.len() as u64).to_le_bytes()).map_err(failed)?;
            records.write_all(&record).map_err(failed)?;
            rows.append(output.group, true)?;
            if let (Some(side), Some(group)) = (&mut side, beside.and_then(|beside| beside.group)) {
                side.append(group, true)?;
            }
            Ok(())
        })?;
        let mut files = rows.finish()?;
        if let Some(side) = side {
            files.extend(side.finish()?);
        }
        files.push(records.written(RECORDS_FILE));
        Ok((files, doubts))
    }
}

/// What a shard says of itself.
fn read_state(folder: &Path) -> Result<State> {
    let path = folder.join(STATE_FILE);
    if !path.exists() {
        let found = if folder.exists() { "a folder without shard.json" } else { "nothing at that path" };
        return Err(DatasetError::BadDataset {
            path: folder.to_owned(),
            object: "shard".to_owned(),
            expected: "a folder that `actrm-data convert --shard` made".to_owned(),
            found: found.to_owned(),
        });
    }
    read_json(&path)
}

/// Where the one file of a kind of row groups lies.
fn groups_file(folder: &Path, kind: &str) -> PathBuf {
    folder.join(kind).join("chunk-000/file-000.parquet")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use serde_json::json;

    #[test]
    fn numbers_come_back_bit_for_bit_through_text() {
        let value = json!({"a": [0.1, 1e300, -0.0, 3, "x"], "b": {"c": 0.1 + 0.2}});
        let text = serde_json::to_string(&exact(value.clone())).unwrap();
        assert_eq!(inexact(serde_json::from_str(&text).unwrap()), value);
    }
}
