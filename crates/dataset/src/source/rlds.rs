//! RLDS data sets as `tensorflow-datasets` stores them: TFRecord files with an episode a record, described by `features.json` and
//! `dataset_info.json`. A record is a `tf.train.Example` in which every list of `steps/...` has the values of all steps in a row.
//! Read without TensorFlow, after the descriptions of both formats.

mod example;
mod features;

use std::collections::BTreeMap;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use serde::Deserialize;
use serde_json::Value;

use self::example::{CUT, byte_strings, count, elements, lists, masked_crc};
use self::features::{Form, form, key_of, leaves};
use super::MAX_STEPS;
use super::local::Backend;
use super::value::one_line;
use crate::error::InputError;
use crate::lerobot::{decode_image, is_jpeg};
use crate::plan::{DemoPlan, Dialect, KeyPlan, Place, Plan, Problem};
use crate::tree::{Array, Attrs, Demo, Dtype};

/// Bytes of a record, at most.
const MAX_RECORD: u64 = 320 << 20;
/// Bytes of an answer, and of an image, at most.
const MAX_ROWS: usize = 320 << 20;
const MAX_IMAGE: usize = 64 << 20;
/// Bytes of a JSON file, at most.
const MAX_JSON: u64 = 16 << 20;

/// A data set of episodes.
pub(super) struct Rlds {
    path: PathBuf,
    leaves: Vec<Leaf>,
    records: Vec<Record>,
    /// The record that was read last.
    kept: Mutex<Option<(usize, Arc<Vec<u8>>)>>,
}

/// A list of `steps` that can be read.
struct Leaf {
    /// Its name in records.
    name: String,
    key: String,
    form: Form,
    /// Of a step.
    shape: Vec<usize>,
}

struct Record {
    file: PathBuf,
    /// Where its content begins.
    offset: u64,
    length: usize,
    id: String,
    attrs: Attrs,
    keys: BTreeMap<String, KeyPlan>,
    /// Whether its steps have different instructions.
    several: bool,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Stated {
    name: String,
    #[serde(default)]
    file_format: Option<String>,
    splits: Vec<Split>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Split {
    name: String,
    /// Whole numbers, as texts.
    #[serde(default)]
    shard_lengths: Vec<Value>,
    #[serde(default)]
    filepath_template: Option<String>,
}

/// What is left out without a demo being lost: the reason, and the record where it was seen first, by name.
type LeftOut = BTreeMap<String, String>;

/// Why a text is left out.
const NO_TEXT: &str = "bytes that are no UTF-8 text";

impl Rlds {
    /// Opens a folder with `features.json` and `dataset_info.json`; `None` where the path is none.
    pub fn open(path: &Path, beat: &mut dyn FnMut()) -> Result<Option<(Self, Plan)>, InputError> {
        if !path.join("features.json").is_file() || !path.join("dataset_info.json").is_file() {
            return Ok(None);
        }
        let mut set = Self { path: path.to_owned(), leaves: Vec::new(), records: Vec::new(), kept: Mutex::new(None) };
        let plan = set.plan(beat)?;
        Ok(Some((set, plan)))
    }

    fn damaged(&self, path: &Path, object: &str, reason: &str) -> InputError {
        let (path, object, operation) = (path.to_owned(), object.to_owned(), "read".to_owned());
        InputError::Damaged { path, object, operation, reason: one_line(reason) }
    }

    fn json<T: serde::de::DeserializeOwned>(&self, name: &str) -> Result<T, InputError> {
        let path = self.path.join(name);
        let failed = |e: &dyn std::fmt::Display| self.damaged(&path, name, &e.to_string());
        if std::fs::metadata(&path).map_err(|e| failed(&e))?.len() > MAX_JSON {
            return Err(failed(&format!("more than {MAX_JSON} bytes")));
        }
        let text = std::fs::read(&path).map_err(|e| failed(&e))?;
        serde_json::from_slice(&text).map_err(|e| failed(&e))
    }

    fn plan(&mut self, beat: &mut dyn FnMut()) -> Result<Plan, InputError> {
        let info: Stated = self.json("dataset_info.json")?;
        let features: Value = self.json("features.json")?;
        let format = info.file_format.as_deref().unwrap_or("tfrecord");
        if format != "tfrecord" {
            let (path, object) = (self.path.clone(), "dataset_info.json".to_owned());
            return Err(InputError::Unsupported {
                path,
                object,
                what: format!("file format {format} (tfrecord is read)"),
            });
        }
        let mut found = Vec::new();
        leaves(&features, "", 16, &mut found);
        let (mut problems, mut left_out) = (Vec::new(), LeftOut::new());
        let mut metadata = Vec::new();
        for (name, feature) in found {
            let step = name.strip_prefix("steps/");
            match (form(feature), step) {
                (Ok((Form::Images, _)), None) => {
                    left_out.insert(name, "images of an episode have no place".to_owned());
                }
                (Ok((form, shape)), None) => metadata.push(Leaf { key: name.clone(), name, form, shape }),
                (Ok((form, shape)), Some(step)) => {
                    let key = key_of(step);
                    if let Some(other) = self.leaves.iter().find(|leaf| leaf.key == key) {
                        left_out.insert(name, format!("{} becomes {key} too", other.name));
                        continue;
                    }
                    self.leaves.push(Leaf { name, key, form, shape });
                }
                (Err(what), Some(step)) => {
                    let (path, object) = (self.path.clone(), name.clone());
                    let error = InputError::Unsupported { path, object, what: one_line(&what) };
                    problems.push(Problem::new(None, Some(&key_of(step)), true, error));
                }
                (Err(what), None) => {
                    left_out.insert(name, format!("{} is not supported", one_line(&what)));
                }
            }
        }
        if self.leaves.is_empty() {
            return Err(InputError::UnknownLayout {
                path: self.path.clone(),
                expected: "an RLDS data set, whose features.json has steps".to_owned(),
                found: "features.json without any that can be read".to_owned(),
            });
        }
        let mut files = ["dataset_info.json", "features.json"].map(|name| self.path.join(name)).to_vec();
        let (mut masks, mut demos) = (BTreeMap::new(), Vec::new());
        for split in &info.splits {
            let shards = split.shard_lengths.len();
            for (shard, stated) in split.shard_lengths.iter().enumerate() {
                let file = self.shard(&info, split, shard, shards)?;
                let stated = stated.as_u64().or_else(|| stated.as_str()?.parse().ok());
                let lost = |problems: &[Problem]| problems.iter().filter(|p| p.demo.is_some()).count();
                let (whole, before) = (demos.len(), demos.len() + lost(&problems));
                self.read_shard(&file, &metadata, &mut demos, (&mut problems, &mut left_out), beat)?;
                let after = demos.len() + lost(&problems);
                if stated.is_some_and(|stated| stated != (after - before) as u64) {
                    let reason = format!(
                        "dataset_info.json states {} records, there are {}",
                        stated.unwrap_or(0),
                        after - before
                    );
                    return Err(self.damaged(&file, "its records", &reason));
                }
                let ids = demos[whole..].iter().map(|demo: &DemoPlan| demo.id.clone());
                masks.entry(split.name.clone()).or_insert_with(Vec::new).extend(ids);
                files.push(file);
            }
        }
        if demos.is_empty() && problems.iter().all(|p| p.demo.is_none()) {
            return Err(InputError::NoDemos { path: self.path.clone(), found: "no record".to_owned() });
        }
        for demo in &mut demos {
            // the folder is called after the version
            demo.task.get_or_insert_with(|| info.name.clone());
        }
        let mut notes: Vec<String> =
            left_out.iter().map(|(name, reason)| format!("{name} is left out: {reason}")).collect();
        let several: Vec<&str> = self.records.iter().filter(|r| r.several).map(|r| r.id.as_str()).collect();
        if !several.is_empty() {
            let ids = super::dialect::list(several.into_iter());
            notes.push(format!("steps have different instructions, of which the first becomes the task: {ids}"));
        }
        Ok(Plan {
            path: self.path.clone(),
            files: files.into_iter().map(|f| (f.clone(), std::fs::metadata(&f).map_or(0, |m| m.len()))).collect(),
            dialect: Dialect::Rlds,
            demos,
            env_args: None,
            env_name: None,
            env_version: None,
            masks,
            texts: BTreeMap::new(),
            notes,
            problems,
        })
    }

    /// The file of a shard.
    fn shard(&self, info: &Stated, split: &Split, shard: usize, shards: usize) -> Result<PathBuf, InputError> {
        let template = split.filepath_template.as_deref().unwrap_or("{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}");
        let name = template
            .replace("{DATASET}", &info.name)
            .replace("{SPLIT}", &split.name)
            .replace("{FILEFORMAT}", "tfrecord")
            .replace("{SHARD_X_OF_Y}", &format!("{shard:05}-of-{shards:05}"))
            .replace("{SHARD_INDEX}", &format!("{shard:05}"))
            .replace("{NUM_SHARDS}", &format!("{shards:05}"));
        if name.contains(['/', '{', '\0']) || name.starts_with('.') {
            return Err(self.damaged(&self.path.join("dataset_info.json"), "filepathTemplate", &name));
        }
        let file = self.path.join(name);
        match file.is_file() {
            true => Ok(file),
            false => Err(InputError::NotFound { path: file }),
        }
    }

    /// Takes note of every record of a file.
    fn read_shard(
        &mut self,
        path: &Path,
        metadata: &[Leaf],
        demos: &mut Vec<DemoPlan>,
        (problems, left_out): (&mut Vec<Problem>, &mut LeftOut),
        beat: &mut dyn FnMut(),
    ) -> Result<(), InputError> {
        let unreadable = |e: std::io::Error| InputError::Unreadable { path: path.to_owned(), reason: e.to_string() };
        if super::is_lfs_pointer(path) {
            return Err(InputError::LfsPointer { path: path.to_owned() });
        }
        let file = File::open(path).map_err(unreadable)?;
        let end = file.metadata().map_err(unreadable)?.len();
        let (mut at, mut number) = (0, 0);
        while at < end {
            let object = format!("record {number}");
            let mut head = [0; 12];
            if end - at < 16 {
                return Err(self.damaged(path, &object, "it is cut off"));
            }
            file.read_exact_at(&mut head, at).map_err(unreadable)?;
            let length = u64::from_le_bytes(head[..8].try_into().unwrap_or_default());
            if masked_crc(&head[..8]) != u32::from_le_bytes(head[8..].try_into().unwrap_or_default()) {
                return Err(self.damaged(path, &object, "the checksum of its length is wrong"));
            }
            if length > end - at - 16 {
                return Err(self.damaged(
                    path,
                    &object,
                    &format!("it is cut off: {length} bytes are stated, {} are left", end - at - 16),
                ));
            }
            if length > MAX_RECORD {
                return Err(InputError::TooLarge { path: path.to_owned(), object, bytes: length, limit: MAX_RECORD });
            }
            let mut content = vec![0; length as usize + 4];
            file.read_exact_at(&mut content, at + 12).map_err(unreadable)?;
            let crc = content.split_off(length as usize);
            let lost = problems.iter().filter(|p| p.demo.is_some()).count();
            let position = demos.len() + lost;
            let id = format!("demo_{position}");
            let sound = masked_crc(&content) == u32::from_le_bytes(crc[..].try_into().unwrap_or_default());
            let episode = match sound {
                true => self.episode(&content, metadata, &mut |name, reason| {
                    left_out.entry(name.to_owned()).or_insert_with(|| format!("{reason} in {id}"));
                }),
                false => Err("its checksum is wrong".to_owned()),
            };
            match episode {
                Ok((0, ..)) => problems.push(Problem::empty(path, &id, "steps")),
                Ok((steps, keys, attrs, task)) => {
                    let (task, several) = task.map_or((None, false), |(task, several)| (Some(task), several));
                    demos.push(DemoPlan {
                        id: id.clone(),
                        number: position as u64,
                        length: steps,
                        keys: keys.clone().into(),
                        attr_names: attrs.keys().cloned().collect(),
                        task,
                    });
                    let (file, offset) = (path.to_owned(), at + 12);
                    self.records.push(Record { file, offset, length: content.len(), id, attrs, keys, several });
                }
                Err(reason) => {
                    problems.push(Problem::new(Some(&id), None, true, self.damaged(path, &object, &reason)));
                }
            }
            at += 16 + length;
            number += 1;
            beat();
        }
        Ok(())
    }

    /// Steps, keys, attributes and instruction of a record, and whether there are others. Tells what it leaves out, and why.
    #[allow(clippy::type_complexity)]
    fn episode(
        &self,
        record: &[u8],
        metadata: &[Leaf],
        leave_out: &mut dyn FnMut(&str, &str),
    ) -> Result<(usize, BTreeMap<String, KeyPlan>, Attrs, Option<(String, bool)>), String> {
        let lists = lists(record)?;
        let mut steps: Option<(usize, &str)> = None;
        let mut keys = BTreeMap::new();
        let mut task: Option<(usize, (String, bool))> = None;
        let mut bare = false;
        for leaf in &self.leaves {
            let Some(&(kind, list)) = lists.get(leaf.name.as_str()) else { continue };
            if kind == 0 {
                bare = true;
                continue;
            }
            let (all, width) = (count(kind, list)?, leaf.shape.iter().product::<usize>());
            let here = all / width.max(1);
            if here * width != all || here > MAX_STEPS {
                return Err(format!("{}: {all} elements, which are no steps of {width}", leaf.name));
            }
            match steps {
                Some((there, name)) if there != here => {
                    return Err(format!("{} has {here} steps, {name} has {there}", leaf.name));
                }
                _ => steps = Some((here, &leaf.name)),
            }
            if here == 0 {
                continue;
            }
            let (mut key, mut dtype, mut shape) = (leaf.key.clone(), Dtype::U8, vec![here]);
            match &leaf.form {
                Form::Numbers(stated) => {
                    dtype = stated.clone();
                    shape.extend(&leaf.shape);
                }
                Form::Text => {
                    let texts = byte_strings(list)?;
                    if texts.iter().any(|text| std::str::from_utf8(text).is_err()) {
                        leave_out(&leaf.name, NO_TEXT);
                        continue;
                    }
                    let said = texts.iter().find(|text| !text.is_empty());
                    if let (true, Some(said)) = (leaf.name.contains("instruction"), said)
                        && task.as_ref().is_none_or(|(length, _)| leaf.name.len() < *length)
                    {
                        let several = texts.iter().any(|text| !text.is_empty() && text != said);
                        task = Some((leaf.name.len(), (String::from_utf8_lossy(said).into_owned(), several)));
                    }
                    dtype = Dtype::VarStr;
                }
                Form::Images => {
                    let files = byte_strings(list)?;
                    if files.first().is_some_and(|file| is_jpeg(file)) {
                        // kept as files: rows as long as the longest
                        shape.push(files.iter().map(|file| file.len()).max().unwrap_or(0));
                        key = key.replacen("obs/", "obs/images/", 1);
                    } else {
                        let size = files.first().and_then(|file| png_size(file));
                        let (height, width) = size.ok_or_else(|| format!("{}: neither JPEG nor PNG", leaf.name))?;
                        shape.extend([height, width, 3]);
                    }
                }
            }
            let place = Place { file: 0, path: leaf.name.as_str().into(), first_row: 0, offset: None, join: None };
            keys.insert(key, KeyPlan { dtype, shape: shape.into(), block_rows: 1, place });
        }
        let mut attrs = Attrs::new();
        for leaf in metadata {
            let Some(&(kind, list)) = lists.get(leaf.name.as_str()).filter(|(kind, _)| *kind > 0) else { continue };
            let value = match &leaf.form {
                Form::Numbers(dtype) => {
                    let bytes = elements(kind, list, dtype).map_err(|e| format!("{}: {e}", leaf.name))?;
                    let expected = leaf.shape.iter().product::<usize>() * dtype.size().unwrap_or(0);
                    let whole = Array { dtype: dtype.clone(), shape: leaf.shape.clone(), bytes };
                    if whole.bytes.len() == expected {
                        Ok(whole)
                    } else {
                        Err("another number of elements than stated")
                    }
                }
                Form::Text => {
                    let texts = byte_strings(list)?;
                    let text = texts.first().ok_or("no text");
                    text.and_then(|text| std::str::from_utf8(text).ok().ok_or(NO_TEXT)).map(Array::from_str)
                }
                Form::Images => continue,
            };
            let name = leaf.name.strip_prefix("episode_metadata/").unwrap_or(&leaf.name);
            match value {
                Ok(value) => drop(attrs.insert(name.to_owned(), value)),
                Err(reason) => leave_out(&leaf.name, reason),
            }
        }
        let steps = match steps {
            Some((steps, _)) => steps,
            None if bare => 0,
            None => return Err("none of the steps that features.json states".to_owned()),
        };
        Ok((steps, keys, attrs, task.map(|(_, said)| said)))
    }

    /// A record's content.
    fn content(&self, index: usize) -> Result<Arc<Vec<u8>>, InputError> {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, content)) = kept.as_ref().filter(|(known, _)| *known == index) {
            return Ok(Arc::clone(content));
        }
        *kept = None;
        let record = self.record(index)?;
        let unreadable =
            |e: std::io::Error| InputError::Unreadable { path: record.file.clone(), reason: e.to_string() };
        let mut content = vec![0; record.length];
        let file = File::open(&record.file).map_err(unreadable)?;
        file.read_exact_at(&mut content, record.offset).map_err(unreadable)?;
        let content = Arc::new(content);
        *kept = Some((index, Arc::clone(&content)));
        Ok(content)
    }

    fn record(&self, index: usize) -> Result<&Record, InputError> {
        self.records.get(index).ok_or_else(|| InputError::NoSuch {
            path: self.path.clone(),
            wanted: format!("demo at position {index}"),
            found: format!("{} demos", self.records.len()),
        })
    }

    fn rows_of(&self, record: &[u8], leaf: &Leaf, key: &KeyPlan, first: usize, count: usize) -> Result<Array, String> {
        let lists = lists(record)?;
        let &(kind, list) = lists.get(leaf.name.as_str()).ok_or("it is not there any more")?;
        let mut shape = key.shape.to_vec();
        shape[0] = count;
        let row = key.bytes().map_or(0, |bytes| bytes as usize / key.shape[0].max(1));
        if row.saturating_mul(count) > MAX_ROWS {
            return Err(format!("{count} rows of {row} bytes at once"));
        }
        let bytes = match &leaf.form {
            Form::Numbers(dtype) => {
                let all = elements(kind, list, dtype)?;
                all.get(first * row..(first + count) * row).ok_or(CUT)?.to_vec()
            }
            Form::Text => {
                let texts = byte_strings(list)?;
                let texts = texts.get(first..first + count).ok_or(CUT)?;
                let texts: Vec<&str> = texts
                    .iter()
                    .map(|text| std::str::from_utf8(text))
                    .collect::<Result<_, _>>()
                    .map_err(|e| e.to_string())?;
                return Ok(Array::from_strings(shape, &texts));
            }
            Form::Images => {
                let files = byte_strings(list)?;
                let mut out = Vec::new();
                for (step, file) in files.get(first..first + count).ok_or(CUT)?.iter().enumerate() {
                    match key.shape[..] {
                        [_, height, width, _] => decode_image(file, height, width, &mut out)
                            .map_err(|e| format!("step {}: {e}", first + step))?,
                        _ if file.len() > row => return Err(CUT.to_owned()),
                        _ => {
                            out.extend_from_slice(file);
                            out.resize(out.len() + row - file.len(), 0);
                        }
                    }
                }
                out
            }
        };
        Ok(Array { dtype: key.dtype.clone(), shape, bytes })
    }
}

/// Height and width of a PNG file.
fn png_size(file: &[u8]) -> Option<(usize, usize)> {
    let head = file.strip_prefix(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR")?.first_chunk::<8>()?;
    let number = |at: usize| u32::from_be_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]) as usize;
    let (width, height) = (number(0), number(4));
    let bytes = width.checked_mul(height)?.checked_mul(3)?;
    (1..=MAX_IMAGE).contains(&bytes).then_some((height, width))
}

impl Backend for Rlds {
    fn root(&self, _datasets: bool) -> Result<Demo, InputError> {
        Ok(Demo::default())
    }

    fn demo(&self, index: usize, keys: &[String]) -> Result<Demo, InputError> {
        let record = self.record(index)?;
        let mut demo = Demo { id: record.id.clone(), attrs: record.attrs.clone(), ..Demo::default() };
        for key in keys {
            let rows = record.keys.get(key).map_or(0, |plan| plan.shape[0]);
            demo.datasets.insert(key.clone(), self.rows(index, key, 0, rows)?);
        }
        Ok(demo)
    }

    fn rows(&self, index: usize, key: &str, first: usize, count: usize) -> Result<Array, InputError> {
        let record = self.record(index)?;
        let plan = record.keys.get(key);
        let leaf = plan.and_then(|plan| self.leaves.iter().find(|leaf| *leaf.name == *plan.place.path));
        let none = || InputError::NoSuch {
            path: self.path.clone(),
            wanted: format!("rows {first} and the {count} after of {key} in {}", record.id),
            found: record.keys.keys().cloned().collect::<Vec<_>>().join(", "),
        };
        let (plan, leaf) = plan.zip(leaf).ok_or_else(none)?;
        if first.checked_add(count).is_none_or(|end| end > plan.shape[0]) {
            return Err(none());
        }
        let rows = self.rows_of(&self.content(index)?, leaf, plan, first, count);
        rows.map_err(|reason| self.damaged(&record.file, &format!("{} of {}", leaf.name, record.id), &reason))
    }
}

#[cfg(test)]
mod tests;
