//! zarr v2 replay buffers, as Diffusion Policy and UMI record them: `data/<key>` with the steps of all episodes one after the
//! other, and `meta/episode_ends`; a folder, or a zip file of it.
//!
//! The format is read here: an array is a JSON file and a file a chunk. The crate `zarrs` would bring 45 packages along, and C code.

mod blosc;
mod store;

use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use half::f16;
use serde::Deserialize;
use serde_json::Value;

use super::MAX_STEPS;
use super::local::Backend;
use crate::error::InputError;
use crate::plan::{DemoPlan, Dialect, KeyPlan, Place, Plan, Problem};
use crate::tree::{Array, Demo, Dtype};
use store::{MARK, MARK_3, Store, ZARR_3};

/// Bytes of a chunk, and of a step, at most.
const MAX_CHUNK: u64 = 192 << 20;
/// Chunks side by side in one step, at most.
const MAX_BESIDE: u64 = 4096;
/// Bytes of unpacked chunks that are kept.
const KEPT: usize = 192 << 20;
/// Bytes of a JSON file, at most.
const MAX_JSON: u64 = 1 << 20;
/// Where the attributes of an array or a group are.
const ATTRIBUTES: &str = ".zattrs";
/// Chunks of at most so many bytes are worth reading whole.
const WHOLE: u64 = 16 << 20;

/// A replay buffer.
pub(super) struct Buffer {
    path: PathBuf,
    store: Store,
    arrays: BTreeMap<String, ZArray>,
    /// Which rows of all are a demo's.
    demos: Vec<(String, std::ops::Range<usize>)>,
    /// Unpacked chunks, the last used at the end.
    kept: Mutex<Vec<(String, Arc<Vec<u8>>)>>,
}

/// What `.zarray` says.
#[derive(Deserialize)]
struct Stated {
    zarr_format: u32,
    shape: Vec<u64>,
    chunks: Vec<u64>,
    dtype: Value,
    #[serde(default)]
    compressor: Value,
    #[serde(default)]
    fill_value: Value,
    #[serde(default)]
    order: Option<String>,
    #[serde(default)]
    filters: Value,
    #[serde(default)]
    dimension_separator: Option<String>,
}

/// An array whose elements can be read.
struct ZArray {
    /// Its path in the store.
    path: String,
    /// As it is stored: bytes of an element, and whether they are in the other order.
    stored: Stored,
    shape: Vec<usize>,
    chunks: Vec<usize>,
    codec: Codec,
    /// An element where a chunk is not stored.
    fill: Vec<u8>,
    separator: String,
}

#[derive(Clone)]
struct Stored {
    size: usize,
    swapped: bool,
    kind: Kind,
    /// What it is read as.
    dtype: Dtype,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Plain,
    Half,
    Bool,
    /// float32 that holds whole numbers from 0 to 255: images of Diffusion Policy.
    Levels,
}

enum Codec {
    None,
    Blosc,
    Zstd,
    Lz4,
    Zlib,
    Gzip,
}

/// LZ4's block format.
fn lz4(packed: &[u8], expected: usize) -> Result<Vec<u8>, String> {
    lz4_flex::block::decompress(packed, expected).map_err(|e| e.to_string())
}

fn zstd(packed: &[u8], expected: usize) -> Result<Vec<u8>, String> {
    ::zstd::bulk::decompress(packed, expected).map_err(|e| e.to_string())
}

fn inflate(from: impl Read, expected: usize) -> Result<Vec<u8>, String> {
    let mut out = Vec::new();
    from.take(expected as u64 + 1).read_to_end(&mut out).map_err(|e| e.to_string())?;
    Ok(out)
}

impl Stated {
    /// Checks what is stated of an array; its type in words where that cannot be read.
    fn array(self, path: String) -> Result<ZArray, String> {
        if self.zarr_format != 2 {
            return Err(format!("zarr format {} (2 is read)", self.zarr_format));
        }
        let dtype = self.dtype.as_str().map_or_else(|| self.dtype.to_string(), str::to_owned);
        let stored = stored(&dtype).ok_or_else(|| format!("elements of type {dtype}"))?;
        if self.shape.is_empty() || self.shape.len() != self.chunks.len() || self.chunks.contains(&0) {
            return Err(format!("shape {:?} in chunks of {:?}", self.shape, self.chunks));
        }
        if self.order.as_deref().is_some_and(|order| order != "C") && self.shape.len() > 1 {
            return Err("order F".to_owned());
        }
        if self.filters.as_array().is_some_and(|filters| !filters.is_empty()) {
            return Err(format!("filters {}", self.filters));
        }
        let bytes = |extents: &[u64]| extents.iter().try_fold(stored.size as u64, |n, &extent| n.checked_mul(extent));
        for (what, extents) in [("a chunk", &self.chunks[..]), ("a step", &self.shape[1..])] {
            if bytes(extents).is_none_or(|bytes| bytes > MAX_CHUNK) {
                return Err(format!("{what} of more than {} MiB", MAX_CHUNK >> 20));
            }
        }
        let beside = self.shape.iter().zip(&self.chunks).skip(1).map(|(n, chunk)| n.div_ceil(*chunk));
        let beside = beside.fold(1_u64, u64::saturating_mul);
        if beside > MAX_BESIDE || bytes(&self.shape).is_none() {
            return Err(format!("shape {:?} in chunks of {:?}", self.shape, self.chunks));
        }
        let codec = match self.compressor.get("id").and_then(Value::as_str) {
            None if self.compressor.is_null() => Codec::None,
            Some("blosc") => Codec::Blosc,
            Some("zstd") => Codec::Zstd,
            Some("lz4") => Codec::Lz4,
            Some("zlib") => Codec::Zlib,
            Some("gzip") => Codec::Gzip,
            other => {
                return Err(format!(
                    "compressor {} (write it again with Blosc or zstd)",
                    other.unwrap_or("without id")
                ));
            }
        };
        let fill = stored.fill(&self.fill_value).ok_or_else(|| format!("the fill_value {}", self.fill_value))?;
        let number = |all: Vec<u64>| all.into_iter().map(|n| n as usize).collect();
        let separator = self.dimension_separator.unwrap_or_else(|| ".".to_owned());
        Ok(ZArray { path, stored, shape: number(self.shape), chunks: number(self.chunks), codec, fill, separator })
    }
}

/// numpy's name of a type.
fn stored(name: &str) -> Option<Stored> {
    let (order, rest) = (name.get(..1)?, name.get(1..)?);
    let (dtype, kind) = match rest {
        "b1" => (Dtype::Bool, Kind::Bool),
        "u1" => (Dtype::U8, Kind::Plain),
        "i1" => (Dtype::I8, Kind::Plain),
        "u2" => (Dtype::U16, Kind::Plain),
        "i2" => (Dtype::I16, Kind::Plain),
        "u4" => (Dtype::U32, Kind::Plain),
        "i4" => (Dtype::I32, Kind::Plain),
        "u8" => (Dtype::U64, Kind::Plain),
        "i8" => (Dtype::I64, Kind::Plain),
        "f2" => (Dtype::F32, Kind::Half),
        "f4" => (Dtype::F32, Kind::Plain),
        "f8" => (Dtype::F64, Kind::Plain),
        text => {
            let width = text.strip_prefix('S')?.parse().ok().filter(|width| (1..=1 << 16).contains(width))?;
            (Dtype::FixedStr(width), Kind::Plain)
        }
    };
    let size = if kind == Kind::Half { 2 } else { dtype.size()? };
    matches!(order, "<" | ">" | "|").then(|| Stored { size, swapped: order == ">" && dtype.is_numeric(), kind, dtype })
}

impl Stored {
    /// An element of this value, as it is stored; `None` where none can be made of it.
    fn fill(&self, value: &Value) -> Option<Vec<u8>> {
        let padded = |mut bytes: Vec<u8>| {
            bytes.resize(self.size, 0);
            if self.swapped {
                bytes.reverse();
            }
            bytes
        };
        let number = match value {
            // bytes are written in base64
            Value::String(text) if !self.dtype.is_numeric() => {
                return STANDARD.decode(text).ok().filter(|bytes| bytes.len() <= self.size).map(padded);
            }
            // the bits of a NaN that is another than numpy's
            Value::String(text) if text.starts_with("0x") => {
                let bits = u64::from_str_radix(&text[2..], 16).ok()?;
                let fits = self.size >= 8 || bits >> (8 * self.size) == 0;
                return fits.then(|| padded(bits.to_le_bytes()[..self.size.min(8)].to_vec()));
            }
            Value::String(text) => text.replace("Infinity", "inf").parse().ok()?,
            Value::Bool(truth) => f64::from(u8::from(*truth)),
            Value::Null => 0.0,
            other => other.as_f64()?,
        };
        Some(padded(match self.dtype {
            Dtype::F32 if self.kind != Kind::Half => (number as f32).to_le_bytes().to_vec(),
            Dtype::F64 => number.to_le_bytes().to_vec(),
            Dtype::U64 => value.as_u64().unwrap_or(0).to_le_bytes().to_vec(),
            Dtype::F32 => f16::from_f64(number).to_le_bytes().to_vec(),
            _ if !self.dtype.is_numeric() => Vec::new(),
            _ => value.as_i64().unwrap_or(number as i64).to_le_bytes().to_vec(),
        }))
    }

    /// Elements as they are stored, as they are read.
    fn read(&self, mut bytes: Vec<u8>) -> Result<Vec<u8>, String> {
        if self.swapped && self.size > 1 {
            bytes.chunks_exact_mut(self.size).for_each(<[u8]>::reverse);
        }
        Ok(match self.kind {
            Kind::Plain => bytes,
            Kind::Bool => bytes.into_iter().map(|v| u8::from(v != 0)).collect(),
            Kind::Half => {
                let (halves, _) = bytes.as_chunks::<2>();
                halves.iter().flat_map(|&half| f16::from_le_bytes(half).to_f32().to_le_bytes()).collect()
            }
            Kind::Levels => {
                let (values, _) = bytes.as_chunks::<4>();
                values.iter().map(|&v| level(f32::from_le_bytes(v))).collect::<Option<_>>().ok_or_else(|| {
                    "an image of float32 whose values are not whole numbers from 0 to 255, as those before".to_owned()
                })?
            }
        })
    }
}

fn level(value: f32) -> Option<u8> {
    (value.fract() == 0.0 && (0.0..=255.0).contains(&value)).then_some(value as u8)
}

impl ZArray {
    /// Bytes of a step, as they are stored.
    fn step_bytes(&self) -> usize {
        self.shape[1..].iter().product::<usize>() * self.stored.size
    }

    fn chunk_bytes(&self) -> usize {
        self.chunks.iter().product::<usize>() * self.stored.size
    }

    /// The chunk at a place of the grid, as it is stored unpacked.
    fn unpack(&self, store: &Store, name: &str) -> Result<Vec<u8>, String> {
        let expected = self.chunk_bytes();
        let Some(packed) = store.get(name, 2 * MAX_CHUNK)? else {
            return Ok(self.fill.iter().copied().cycle().take(expected).collect());
        };
        let unpacked = match self.codec {
            Codec::None => Ok(packed),
            Codec::Blosc => blosc::decode(&packed, expected),
            Codec::Zstd => zstd(&packed, expected),
            Codec::Lz4 => match packed.split_first_chunk::<4>() {
                Some((_, packed)) => lz4(packed, expected),
                None => Err("a chunk of less than 4 bytes".to_owned()),
            },
            Codec::Zlib => inflate(flate2::read::ZlibDecoder::new(&packed[..]), expected),
            Codec::Gzip => inflate(flate2::read::GzDecoder::new(&packed[..]), expected),
        };
        match unpacked {
            Ok(bytes) if bytes.len() == expected => Ok(bytes),
            Ok(bytes) => Err(format!("{name} unpacks to {} bytes, expected {expected}", bytes.len())),
            Err(reason) => Err(format!("{name}: {reason}")),
        }
    }

    /// Puts what a chunk has of the rows `first..first + rows` into `out`; `place` is its place in the grid.
    fn copy(&self, chunk: &[u8], place: &[usize], first: usize, rows: usize, out: &mut [u8]) {
        let size = self.stored.size;
        let from = (place[0] * self.chunks[0]).max(first);
        let to = ((place[0] + 1) * self.chunks[0]).min(first + rows);
        // axes that lie whole in every chunk are one with the axis before them
        let mut inner = self.shape.len() - 1;
        while inner > 1 && self.chunks[inner] == self.shape[inner] {
            inner -= 1;
        }
        // lines along the last axis, at their place in the chunk and in the step
        let mut lines: Vec<(usize, usize)> = vec![(0, 0)];
        let axes = place.iter().zip(&self.chunks).zip(&self.shape).take(inner).skip(1);
        for ((&place, &chunk), &whole) in axes {
            let begin = place * chunk;
            let count = chunk.min(whole - begin);
            let of_line = |&(here, there): &(usize, usize)| {
                (0..count).map(move |i| (here * chunk + i, there * whole + begin + i))
            };
            lines = lines.iter().flat_map(of_line).collect();
        }
        let (last_chunk, last, begin) = match inner {
            0 => (1, 1, 0),
            _ => {
                let rest = self.shape[inner + 1..].iter().product::<usize>();
                (self.chunks[inner] * rest, self.shape[inner] * rest, place[inner] * self.chunks[inner] * rest)
            }
        };
        let length = last_chunk.min(last - begin) * size;
        let chunk_row = self.chunks[1..].iter().product::<usize>() * size;
        for row in from..to {
            let source = &chunk[(row - place[0] * self.chunks[0]) * chunk_row..];
            let target = &mut out[(row - first) * self.step_bytes()..];
            for &(here, there) in &lines {
                let (here, there) = (here * last_chunk * size, (there * last + begin) * size);
                target[there..there + length].copy_from_slice(&source[here..here + length]);
            }
        }
    }
}

impl Buffer {
    /// Opens a replay buffer; `None` where the path is none.
    pub fn open(path: &Path, beat: &mut dyn FnMut()) -> Result<Option<(Self, Plan)>, InputError> {
        let unavailable = |object: &str, reason: String| {
            let reason = super::value::one_line(&reason);
            InputError::Unavailable { path: path.to_owned(), object: object.to_owned(), reason }
        };
        let store = match path.is_dir() {
            true if path.join(MARK).is_file() => Store::Folder(path.to_owned()),
            true if path.join(MARK_3).is_file() => return Err(unavailable("the folder", ZARR_3.to_owned())),
            false if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("zip")) => {
                match Store::zip(path).map_err(|reason| unavailable("the zip file", reason))? {
                    Some(store) => store,
                    None => return Ok(None),
                }
            }
            _ => return Ok(None),
        };
        let (arrays, demos, kept) = (BTreeMap::new(), Vec::new(), Mutex::new(Vec::new()));
        let mut buffer = Self { path: path.to_owned(), store, arrays, demos, kept };
        let plan = buffer.plan(beat)?;
        Ok(Some((buffer, plan)))
    }

    fn damaged(&self, object: &str, reason: String) -> InputError {
        let (path, object) = (self.path.clone(), object.to_owned());
        InputError::Damaged { path, object, operation: "read".to_owned(), reason: super::value::one_line(&reason) }
    }

    /// What is stated of an array.
    fn stated(&self, path: &str) -> Result<Stated, InputError> {
        let text = self.store.get(&format!("{path}/.zarray"), MAX_JSON).map_err(|e| self.damaged(path, e))?;
        let text = text.ok_or_else(|| self.damaged(path, "no .zarray".to_owned()))?;
        // Python writes NaN
        let value = crate::lerobot::python_json(&text).map_err(|e| self.damaged(path, e.to_string()))?;
        serde_json::from_value(value).map_err(|e| self.damaged(path, e.to_string()))
    }

    fn plan(&mut self, beat: &mut dyn FnMut()) -> Result<Plan, InputError> {
        let ends = self.ends()?;
        let steps = ends.last().copied().unwrap_or(0);
        let (mut notes, mut problems) = (Vec::new(), Vec::new());
        let mut keys: Vec<(String, KeyPlan)> = Vec::new();
        let members = |mark: &str| self.store.members("data", mark).map_err(|e| self.damaged("data", e));
        let (names, groups) = (members(".zarray")?, members(".zgroup")?);
        let groups: Vec<String> = groups.iter().map(|name| format!("data/{name}")).collect();
        // the array that ends first, where one lacks steps
        let mut short: Option<(usize, String, String)> = None;
        for name in names {
            beat();
            let path = format!("data/{name}");
            let stated = self.stated(&path)?;
            let looks_like_images = stated.shape.len() == 4;
            let key = match name.as_str() {
                "action" => "actions".to_owned(),
                "reward" => "rewards".to_owned(),
                "done" => "dones".to_owned(),
                _ => format!("obs/{name}"),
            };
            let mut array = match stated.array(path.clone()) {
                Ok(array) => array,
                Err(what) => {
                    let what = super::value::one_line(&what);
                    let error = InputError::Unsupported { path: self.path.clone(), object: path, what };
                    // images are what a policy looks at: not left out with a note
                    if looks_like_images {
                        return Err(error);
                    }
                    problems.push(Problem::new(None, Some(&key), true, error));
                    continue;
                }
            };
            let rows = array.shape[0];
            if short.as_ref().map_or(steps, |(least, ..)| *least) > rows {
                short = Some((rows, path.clone(), format!("shape {:?}", array.shape)));
            }
            if rows > steps {
                let more = rows - steps;
                notes.push(format!("data/{name}: {more} steps after the end of the last episode are left out"));
            }
            if array.stored.dtype == Dtype::F32 && array.shape.len() == 4 && array.shape[3] == 3 && steps > 0 {
                self.levels(&mut array, &mut notes)?;
            }
            let block = if array.chunk_bytes() as u64 <= WHOLE { array.chunks[0] } else { 1 };
            let place = Place { file: 0, path: path.into(), first_row: 0, offset: None, join: None };
            let plan = KeyPlan {
                dtype: array.stored.dtype.clone(),
                shape: array.shape.clone().into(),
                block_rows: block,
                place,
            };
            self.arrays.insert(key.clone(), array);
            keys.push((key, plan));
        }
        self.poses(&mut keys, &mut notes);
        if !groups.is_empty() {
            let names = super::dialect::list(groups.iter().map(String::as_str));
            if !keys.iter().any(|(key, _)| key.starts_with("obs/")) {
                let advice = format!("groups below data are not read: {names}; put their arrays into data itself");
                return Err(InputError::NoObservations { path: self.path.clone(), advice });
            }
            notes.push(format!("groups below data are not read: {names}"));
        }
        let others = self.others().map_err(|e| self.damaged("the store", e))?;
        if !others.is_empty() {
            let names = super::dialect::list(others.iter().map(String::as_str));
            notes.push(format!("only the arrays in data and meta/episode_ends are read: left out are {names}"));
        }
        // a recording whose observations cannot be read is not one without any
        let unread = problems.iter().find(|p: &&Problem| p.key.as_ref().is_some_and(|key| key.starts_with("obs/")));
        if let Some(unread) = unread.filter(|_| !keys.iter().any(|(key, _)| key.starts_with("obs/"))) {
            return Err(unread.error.clone());
        }
        let mut demos = Vec::with_capacity(ends.len());
        let mut first = 0;
        for (number, &end) in ends.iter().enumerate() {
            let id = format!("demo_{number}");
            if end == first {
                problems.push(Problem::empty(&self.path, &id, "meta/episode_ends"));
                continue;
            }
            let wrong = match short.as_ref().filter(|(rows, ..)| end > *rows) {
                Some((_, key, found)) => Some((key.clone(), format!("{steps} (meta/episode_ends)"), found.clone())),
                // chunks that are not stored state any number of steps
                None => (end - first > MAX_STEPS).then(|| {
                    ("meta/episode_ends".to_owned(), format!("at most {MAX_STEPS}"), (end - first).to_string())
                }),
            };
            if let Some((key, expected, found)) = wrong {
                let error = InputError::WrongLength { path: self.path.clone(), demo: id.clone(), key, expected, found };
                problems.push(Problem::new(Some(&id), None, true, error));
                first = end;
                continue;
            }
            let of_demo = keys.iter().map(|(key, plan)| {
                let mut plan = plan.clone();
                plan.shape[0] = end - first;
                plan.place.first_row = first;
                (key.clone(), plan)
            });
            demos.push(DemoPlan {
                id: id.clone(),
                number: number as u64,
                length: end - first,
                keys: of_demo.collect::<BTreeMap<_, _>>().into(),
                attr_names: Vec::new(),
                task: None,
            });
            self.demos.push((id, first..end));
            first = end;
        }
        if demos.is_empty() {
            let none = || InputError::NoDemos {
                path: self.path.clone(),
                found: "meta/episode_ends without an end".to_owned(),
            };
            return Err(problems.iter().find(|p| p.demo.is_some()).map_or_else(none, |p| p.error.clone()));
        }
        Ok(Plan {
            path: self.path.clone(),
            files: self.store.files(&self.path),
            dialect: Dialect::Zarr,
            demos,
            env_args: None,
            env_name: None,
            env_version: None,
            masks: BTreeMap::new(),
            texts: BTreeMap::new(),
            notes,
            problems,
        })
    }

    /// What the store has beside the arrays in `data` and `meta/episode_ends`.
    fn others(&self) -> Result<Vec<String>, String> {
        let mut others = Vec::new();
        let mut with_attributes = vec![String::new()];
        for (group, read) in [("", &["data", "meta"][..]), ("meta", &["episode_ends"]), ("data", &[])] {
            let full = |name: &String| if group.is_empty() { name.clone() } else { format!("{group}/{name}") };
            let arrays = self.store.members(group, ".zarray")?;
            // what is wrong with those in `data` is said where they are read
            if group != "data" {
                let groups = self.store.members(group, ".zgroup")?;
                let unread = arrays.iter().chain(&groups).filter(|name| !read.contains(&name.as_str()));
                others.extend(unread.map(full));
            }
            let known = |name: &&String| read.contains(&name.as_str()) || (group == "data" && arrays.contains(name));
            with_attributes.extend(self.store.members(group, ATTRIBUTES)?.iter().filter(known).map(full));
        }
        for object in with_attributes {
            let path = if object.is_empty() { ATTRIBUTES.to_owned() } else { format!("{object}/{ATTRIBUTES}") };
            let text = self.store.get(&path, MAX_JSON)?.unwrap_or_default();
            if !matches!(serde_json::from_slice(&text), Ok(Value::Object(all)) if all.is_empty()) && !text.is_empty() {
                others.push(path);
            }
        }
        Ok(others)
    }

    /// The step after each episode's last.
    fn ends(&self) -> Result<Vec<usize>, InputError> {
        const PATH: &str = "meta/episode_ends";
        let array = self.stated(PATH)?.array(PATH.to_owned());
        let array =
            array.map_err(|what| InputError::Unsupported { path: self.path.clone(), object: PATH.to_owned(), what })?;
        let bad = |found: String| self.damaged(PATH, found);
        if array.shape.len() != 1 || array.shape[0] as u64 > MAX_CHUNK / 8 {
            return Err(bad(format!("expected a number an episode, found shape {:?}", array.shape)));
        }
        let bytes = self.rows_of(&array, 0, array.shape[0]).map_err(bad)?;
        let values = Array { dtype: array.stored.dtype.clone(), shape: array.shape.clone(), bytes }.to_f64();
        let mut ends: Vec<usize> = Vec::new();
        for value in values.unwrap_or_default() {
            let before = ends.last().copied().unwrap_or(0);
            if value.fract() != 0.0 || !(0.0..9e15).contains(&value) || (value as usize) < before {
                return Err(bad(format!("expected ends that ascend, found {value} after {before}")));
            }
            ends.push(value as usize);
        }
        Ok(ends)
    }

    /// Reads images of float32 as uint8 where their values are whole numbers, as Diffusion Policy stores them.
    fn levels(&self, array: &mut ZArray, notes: &mut Vec<String>) -> Result<(), InputError> {
        let first = self.rows_of(array, 0, 1).map_err(|e| self.damaged(&array.path, e))?;
        let (values, _) = first.as_chunks::<4>();
        if array.stored.kind == Kind::Plain && values.iter().all(|&v| level(f32::from_le_bytes(v)).is_some()) {
            (array.stored.kind, array.stored.dtype) = (Kind::Levels, Dtype::U8);
            notes.push(format!("{}: float32 images of whole numbers from 0 to 255 are read as uint8", array.path));
        }
        Ok(())
    }

    /// UMI stores no actions: its own loader takes the poses and gripper widths of all grippers, one after the other.
    fn poses(&self, keys: &mut Vec<(String, KeyPlan)>, notes: &mut Vec<String>) {
        if keys.iter().any(|(key, _)| key == "actions") {
            return;
        }
        let parts = self.pose_parts();
        let Some(first) = parts.first().and_then(|part| keys.iter().find(|(key, _)| key == part)) else { return };
        let mut plan = first.1.clone();
        plan.shape =
            [plan.shape[0], parts.iter().map(|part| self.arrays[part].shape[1..].iter().product::<usize>()).sum()]
                .into();
        plan.place.path = "data/action".into();
        keys.push(("actions".to_owned(), plan));
        let names: Vec<&str> = parts.iter().map(|part| part.trim_start_matches("obs/")).collect();
        notes.push(format!("no action is stored: it is {}, as UMI's own loader has it", names.join(", ")));
    }

    /// Keys that UMI's actions are made of: all of one type, or none.
    fn pose_parts(&self) -> Vec<String> {
        let mut parts = Vec::new();
        for robot in 0.. {
            let names =
                ["eef_pos", "eef_rot_axis_angle", "gripper_width"].map(|name| format!("obs/robot{robot}_{name}"));
            match names.iter().all(|name| self.arrays.get(name).is_some_and(|a| a.stored.dtype == Dtype::F32)) {
                true => parts.extend(names),
                false => break,
            }
        }
        parts
    }

    fn chunk(&self, array: &ZArray, place: &[usize]) -> Result<Arc<Vec<u8>>, String> {
        let numbers: Vec<String> = place.iter().map(usize::to_string).collect();
        let name = format!("{}/{}", array.path, numbers.join(&array.separator));
        let kept = || self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, chunk)) = kept().iter().find(|(known, _)| *known == name) {
            return Ok(Arc::clone(chunk));
        }
        let chunk = Arc::new(array.unpack(&self.store, &name)?);
        let mut kept = kept();
        kept.push((name, Arc::clone(&chunk)));
        let mut bytes: usize = kept.iter().map(|(_, chunk)| chunk.len()).sum();
        while bytes > KEPT && kept.len() > 1 {
            bytes -= kept.remove(0).1.len();
        }
        Ok(chunk)
    }

    /// Rows of an array as they are read.
    fn rows_of(&self, array: &ZArray, first: usize, count: usize) -> Result<Vec<u8>, String> {
        let bytes = (array.step_bytes() as u64).saturating_mul(count as u64);
        if bytes > 2 * MAX_CHUNK {
            return Err(format!("{bytes} bytes at once"));
        }
        let mut out = vec![0; bytes as usize];
        if out.is_empty() {
            return Ok(out);
        }
        let beside: Vec<usize> = array.shape.iter().zip(&array.chunks).map(|(n, chunk)| n.div_ceil(*chunk)).collect();
        for at in first / array.chunks[0]..=(first + count - 1) / array.chunks[0] {
            let mut place = vec![0; array.shape.len()];
            place[0] = at;
            loop {
                array.copy(&self.chunk(array, &place)?, &place, first, count, &mut out);
                // the next chunk of the same rows
                let Some(axis) = (1..place.len()).rev().find(|&axis| place[axis] + 1 < beside[axis]) else { break };
                place[axis] += 1;
                place[axis + 1..].fill(0);
            }
        }
        array.stored.read(out)
    }

    fn no_such(&self, wanted: String, found: String) -> InputError {
        InputError::NoSuch { path: self.path.clone(), wanted, found }
    }
}

impl Backend for Buffer {
    fn root(&self, _datasets: bool) -> Result<Demo, InputError> {
        Ok(Demo::default())
    }

    fn demo(&self, index: usize, keys: &[String]) -> Result<Demo, InputError> {
        let none = || self.no_such(format!("demo at position {index}"), format!("{} demos", self.demos.len()));
        let (id, rows) = self.demos.get(index).ok_or_else(none)?;
        let mut demo = Demo { id: id.clone(), ..Demo::default() };
        for key in keys {
            demo.datasets.insert(key.clone(), self.rows(index, key, 0, rows.len())?);
        }
        Ok(demo)
    }

    fn rows(&self, index: usize, key: &str, first: usize, count: usize) -> Result<Array, InputError> {
        let (id, rows) =
            self.demos.get(index).ok_or_else(|| self.no_such(format!("demo at position {index}"), String::new()))?;
        if first.checked_add(count).is_none_or(|end| end > rows.len()) {
            return Err(
                self.no_such(format!("rows {first} and the {count} after of {key}"), format!("{} of {id}", rows.len()))
            );
        }
        if let Some(array) = self.arrays.get(key) {
            let bytes = self.rows_of(array, rows.start + first, count);
            let bytes = bytes.map_err(|reason| self.damaged(&format!("{} of {id}", array.path), reason))?;
            let shape = std::iter::once(count).chain(array.shape[1..].iter().copied()).collect();
            return Ok(Array { dtype: array.stored.dtype.clone(), shape, bytes });
        }
        let parts = self.pose_parts();
        if key != "actions" || parts.is_empty() {
            return Err(
                self.no_such(format!("{key} in {id}"), self.arrays.keys().cloned().collect::<Vec<_>>().join(", "))
            );
        }
        let parts = parts.iter().map(|part| self.rows(index, part, first, count)).collect::<Result<Vec<_>, _>>()?;
        let mut bytes = Vec::new();
        for row in 0..count {
            for part in &parts {
                let width = part.bytes.len() / count;
                bytes.extend_from_slice(&part.bytes[row * width..(row + 1) * width]);
            }
        }
        let width = bytes.len() / 4 / count.max(1);
        Ok(Array { dtype: Dtype::F32, shape: vec![count, width], bytes })
    }
}

#[cfg(test)]
mod tests;
