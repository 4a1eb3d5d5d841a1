//! Reading files of demonstrations and writing robomimic ones.

pub(crate) mod codec;
mod dialect;
mod field;
pub mod isolation;
mod local;
mod rlds;
mod value;
mod video;
mod walk;
mod writer;
mod zarr;

use std::collections::BTreeSet;
use std::fs::File;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use rustix::buffer::spare_capacity;

use crate::error::{InputError, Result};
use crate::lerobot::{old_version, refuse_shard};
use crate::plan::{DemoPlan, KeyPlan, Plan};
use crate::tree::{Array, Attrs, Demo};
use local::{Backend, Local};

pub(crate) use dialect::list;
pub(crate) use local::{file_number, files};
pub use video::{VideoFile, VideoInfo};
pub(crate) use walk::is_lfs_pointer;
pub(crate) use writer::remove_unfinished;
pub use writer::{RobomimicWriter, WriteOptions};

/// The most that [`Source::read_demo`] reads at once.
const MAX_DEMO: u64 = 512 << 20;
/// Steps of an episode, at most, where they are stated and not stored.
const MAX_STEPS: usize = 1 << 24;
/// How much is asked of the HDF5 library in one go.
const WINDOW: u64 = 16 << 20;
/// How much is read straight from the file at once where it is used in order: it stays in a processor's cache.
const DIRECT_WINDOW: u64 = 1 << 20;

/// What is done with values that are NaN or infinite.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum NonFinite {
    /// They are an error, with demo, key and step.
    #[default]
    Refuse,
    /// They are kept as they are.
    Keep,
}

/// An opened file or folder of demonstrations. Shared freely between threads: what lies in the file as it is in
/// memory is read in parallel and without libhdf5, the rest one request at a time.
pub struct Source {
    plan: Plan,
    files: Vec<File>,
    backend: Box<dyn Backend>,
    /// The backend's position of each demo, once some are left out.
    positions: Option<Vec<usize>>,
    nonfinite: NonFinite,
    /// Keys whose values may be NaN or infinite whatever `nonfinite` says.
    exempt: BTreeSet<String>,
}

impl std::fmt::Debug for Source {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Source").field("path", &self.plan.path).finish_non_exhaustive()
    }
}

impl Source {
    /// Opens in this process: for files that are trusted.
    pub fn open(path: &Path) -> Result<Self> {
        exists(path)?;
        let (backend, plan) = open_backend(path, &mut || {})?;
        Self::with(Arc::unwrap_or_clone(plan), backend)
    }

    /// Opens with all parsing done in a child process with memory and time limits. The program has to have called
    /// [`isolation::serve_if_child`] first.
    pub fn open_isolated(path: &Path) -> Result<Self> {
        exists(path)?;
        let (remote, plan) = isolation::Remote::open(path)?;
        Self::with(plan, Box::new(remote))
    }

    /// [`Self::open_isolated`] where the program has armed it, [`Self::open`] otherwise (tests, other programs).
    pub fn open_guarded(path: &Path) -> Result<Self> {
        if isolation::armed() { Self::open_isolated(path) } else { Self::open(path) }
    }

    fn with(plan: Plan, backend: Box<dyn Backend>) -> Result<Self> {
        let mut files = Vec::new();
        // a folder of thousands of episodes would use up the file descriptors: those are opened as they are read
        if plan.files.len() <= 64 {
            for (path, _) in &plan.files {
                files.push(open_file(path)?);
            }
        }
        let exempt = BTreeSet::new();
        Ok(Self { plan, files, backend, positions: None, nonfinite: NonFinite::default(), exempt })
    }

    /// Says what is done with values that are NaN or infinite; they are refused unless it is called.
    pub fn nonfinite(mut self, nonfinite: NonFinite) -> Self {
        self.nonfinite = nonfinite;
        self
    }

    /// Lets the values of these keys be NaN or infinite.
    pub(crate) fn exempt(&mut self, keys: impl IntoIterator<Item = String>) {
        self.exempt.extend(keys);
    }

    /// Leaves out the demos of these ids, and every problem of a demo that is not there.
    pub(crate) fn leave_out(&mut self, bad: &BTreeSet<&str>) {
        let demos = std::mem::take(&mut self.plan.demos);
        let before = self.positions.take().unwrap_or_else(|| (0..demos.len()).collect());
        let kept = before.into_iter().zip(demos).filter(|(_, demo)| !bad.contains(demo.id.as_str()));
        let (positions, demos) = kept.unzip();
        (self.positions, self.plan.demos) = (Some(positions), demos);
        let Plan { demos, problems, .. } = &mut self.plan;
        let ids: BTreeSet<&str> = demos.iter().map(|demo| demo.id.as_str()).collect();
        problems.retain(|p| p.demo.as_ref().is_none_or(|id| ids.contains(id.as_str())));
    }

    /// Where the backend has a demo.
    fn position(&self, index: usize) -> usize {
        self.positions.as_ref().map_or(index, |positions| positions[index])
    }

    /// What there is.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Everything in the file that belongs to no demo: attributes, masks, extra datasets and groups, by path
    /// (`mask/train`; the attributes of `data` are `inner_attrs["data"]`).
    pub fn root(&self) -> Result<Demo> {
        Ok(self.backend.root(true)?)
    }

    /// The attributes of the group of all demos.
    pub fn data_attrs(&self) -> Result<Attrs> {
        Ok(self.backend.root(false)?.inner_attrs.remove("data").unwrap_or_default())
    }

    /// Reads and checks a demo. Refuses one beyond 512 MB: read that with [`Self::read_demo_where`] and
    /// [`Self::read_rows`].
    pub fn read_demo(&self, index: usize) -> Result<Demo> {
        self.read_demo_where(index, &|_| true)
    }

    /// As [`Self::read_demo`], with only the datasets that are wanted; attributes and groups are always there.
    /// What is wrong with datasets that are not wanted is no fault.
    pub fn read_demo_where(&self, index: usize, wanted: &dyn Fn(&str) -> bool) -> Result<Demo> {
        let plan = self.check(index, wanted)?;
        let chosen: Vec<(&str, &KeyPlan)> = plan.keys.iter().filter(|(key, _)| wanted(key)).collect();
        let bytes =
            chosen.iter().fold(0_u64, |sum, (_, k)| sum.saturating_add(k.bytes().unwrap_or(u64::from(u8::MAX))));
        if bytes > MAX_DEMO {
            let largest = chosen.iter().max_by_key(|(_, k)| k.bytes()).map_or("", |(key, _)| key);
            return Err(InputError::TooLarge {
                path: self.plan.path.clone(),
                object: format!("{}, of which {largest} is the largest", plan.id),
                bytes,
                limit: MAX_DEMO,
            }
            .into());
        }
        let (direct, rest): (Vec<_>, Vec<_>) = chosen.into_iter().partition(|(_, k)| k.place.offset.is_some());
        let small = |k: &KeyPlan| k.bytes().is_none_or(|b| b <= WINDOW / 16);
        let (small, large): (Vec<_>, Vec<_>) = rest.into_iter().partition(|(_, k)| small(k));
        let mut demo: Option<Demo> = None;
        let mut batch: Vec<String> = Vec::new();
        let mut batch_bytes = 0;
        let mut ask = |batch: &mut Vec<String>, last: bool| -> Result<()> {
            if batch.is_empty() && (demo.is_some() || !last) {
                return Ok(());
            }
            let part = self.backend.demo(self.position(index), batch)?;
            batch.clear();
            match &mut demo {
                Some(demo) => demo.datasets.extend(part.datasets),
                None => demo = Some(part),
            }
            Ok(())
        };
        for (key, k) in small {
            batch.push(key.to_owned());
            batch_bytes += k.bytes().unwrap_or(1 << 16);
            if batch_bytes > WINDOW {
                ask(&mut batch, false)?;
                batch_bytes = 0;
            }
        }
        ask(&mut batch, true)?;
        let mut demo = demo.unwrap_or_default();
        for (key, k) in direct {
            let rows = k.shape.first().copied();
            let array = self.read_direct(k, 0, rows)?;
            demo.datasets.insert(key.to_owned(), array);
        }
        for (key, k) in large {
            let rows = k.shape.first().copied().unwrap_or(0);
            let array = self.read_rows(index, key, 0, rows)?;
            demo.datasets.insert(key.to_owned(), array);
        }
        for (key, array) in &demo.datasets {
            self.check_values(&plan.id, key, array, 0)?;
        }
        Ok(demo)
    }

    /// Rows of one dataset of a demo, cut into windows that are cheap to read one by one: small where the elements lie in
    /// the file as they are in memory, one window otherwise.
    pub(crate) fn windows(&self, index: usize, key: &str, rows: Range<usize>) -> impl Iterator<Item = Range<usize>> {
        let plan = self.plan.demos.get(index).and_then(|demo| demo.keys.get(key));
        let step = plan.filter(|k| k.place.offset.is_some()).map_or(rows.len(), |k| {
            let row = k.bytes().unwrap_or(0) / k.shape.first().map_or(1, |&n| n.max(1) as u64);
            (DIRECT_WINDOW / row.max(1)) as usize
        });
        let (end, step) = (rows.end, step.max(1));
        rows.step_by(step).map(move |at| at..(at + step).min(end))
    }

    /// Rows `first .. first + count` of one dataset of a demo.
    pub fn read_rows(&self, index: usize, key: &str, first: usize, count: usize) -> Result<Array> {
        let plan = self.check(index, &|k| k == key)?;
        let none = |wanted: String, found: String| InputError::NoSuch { path: self.plan.path.clone(), wanted, found };
        let Some(k) = plan.keys.get(key) else {
            let found = dialect::list(plan.keys.keys());
            return Err(none(format!("{key} in {}", plan.id), found).into());
        };
        let rows = k.shape.first().copied();
        if rows.is_none_or(|rows| first.checked_add(count).is_none_or(|end| end > rows)) {
            let wanted = format!("rows {first} and the {count} after of {key} in {}", plan.id);
            return Err(none(wanted, format!("shape {:?}", k.shape)).into());
        }
        if k.place.offset.is_some() {
            let array = self.read_direct(k, first, Some(count))?;
            self.check_values(&plan.id, key, &array, first)?;
            return Ok(array);
        }
        // in windows of whole stored blocks, so that nothing is unpacked twice and no answer is long
        let row = k.bytes().unwrap_or(WINDOW) / (rows.unwrap_or(1).max(1) as u64);
        let blocks = (WINDOW / row.max(1)) as usize / k.block_rows;
        let window = blocks.max(1) * k.block_rows;
        let mut shape = k.shape.to_vec();
        shape[0] = count;
        let mut bytes = Vec::with_capacity(row as usize * count);
        let mut at = first;
        while at < first + count {
            let end = ((at / window + 1) * window).min(first + count);
            let part = self.backend.rows(self.position(index), key, at, end - at)?;
            bytes.extend_from_slice(&part.bytes);
            at = end;
        }
        let array = Array { dtype: k.dtype.clone(), shape, bytes };
        self.check_values(&plan.id, key, &array, first)?;
        Ok(array)
    }

    /// The demo's plan, if nothing fatal is known about what is wanted of it.
    fn check(&self, index: usize, wanted: &dyn Fn(&str) -> bool) -> Result<&DemoPlan, InputError> {
        let plan = self.plan.demos.get(index).ok_or_else(|| InputError::NoSuch {
            path: self.plan.path.clone(),
            wanted: format!("demo at position {index}"),
            found: format!("{} demos", self.plan.demos.len()),
        })?;
        let fatal = self.plan.problems.iter().find(|p| {
            p.fatal && p.demo.as_ref().is_none_or(|id| *id == plan.id) && p.key.as_ref().is_none_or(|key| wanted(key))
        });
        match fatal {
            Some(problem) => Err(problem.error.clone()),
            None => Ok(plan),
        }
    }

    /// Elements that lie in the file as they are in memory: straight from there.
    fn read_direct(&self, k: &KeyPlan, first: usize, count: Option<usize>) -> Result<Array> {
        let mut shape = k.shape.to_vec();
        if let (Some(extent), Some(count)) = (shape.first_mut(), count) {
            *extent = count;
        }
        let size = k.dtype.size().expect("elements of a known place have a known size");
        let row = k.shape.iter().skip(1).product::<usize>() * size;
        let offset = k.place.offset.expect("the place is known") + (first * row) as u64;
        let wanted = shape.iter().product::<usize>() * size;
        let (path, stated) = &self.plan.files[k.place.file];
        let read = match self.files.get(k.place.file) {
            Some(file) => read_at(file, offset, wanted),
            None => read_at(&open_file(path)?, offset, wanted),
        };
        let bytes = read.map_err(|e| match e.kind() {
            std::io::ErrorKind::UnexpectedEof => InputError::Truncated {
                path: path.clone(),
                expected: *stated,
                found: std::fs::metadata(path).map_or(0, |m| m.len()),
            },
            _ => InputError::Unreadable { path: path.clone(), reason: e.to_string() },
        })?;
        Ok(Array { dtype: k.dtype.clone(), shape, bytes })
    }

    /// Values have to be finite; `first` is the step of the array's first row.
    fn check_values(&self, demo: &str, key: &str, array: &Array, first: usize) -> Result<(), InputError> {
        match self.nonfinite == NonFinite::Keep || self.exempt.contains(key) {
            true => Ok(()),
            false => self.first_not_finite(demo, key, array, first, false).map_or(Ok(()), Err),
        }
    }

    /// The first value of an array of a demo that is NaN or infinite, or that no float32 column of it could hold; `first`
    /// is the step of its first row.
    pub fn not_finite(&self, demo: &str, key: &str, array: &Array, first: usize) -> Option<InputError> {
        let column = key.starts_with("obs/") || matches!(key, "actions" | "actions_abs" | "rewards");
        self.first_not_finite(demo, key, array, first, column)
    }

    /// The first value of an array that is NaN or infinite, or that float32 cannot hold where `as_f32`.
    pub(crate) fn first_not_finite(
        &self,
        demo: &str,
        key: &str,
        array: &Array,
        first: usize,
        as_f32: bool,
    ) -> Option<InputError> {
        let at = array.first_not_finite(as_f32)?;
        let width = array.shape.iter().skip(1).product::<usize>().max(1);
        let value = array.to_f64().and_then(|v| v.get(at).copied()).unwrap_or(f64::NAN);
        Some(InputError::NotFinite {
            path: self.plan.path.clone(),
            demo: demo.to_owned(),
            key: key.to_owned(),
            step: first + at / width,
            dimension: at % width,
            found: if value.is_finite() { format!("{value:e}, which float32 cannot hold") } else { value.to_string() },
        })
    }
}

/// Opens a source of any format in this process.
fn open_backend(path: &Path, beat: &mut dyn FnMut()) -> Result<(Box<dyn Backend>, Arc<Plan>), InputError> {
    if let Some((buffer, plan)) = zarr::Buffer::open(path, beat)? {
        return Ok((Box::new(buffer), Arc::new(plan)));
    }
    if let Some((set, plan)) = rlds::Rlds::open(path, beat)? {
        return Ok((Box::new(set), Arc::new(plan)));
    }
    let (local, plan) = Local::open(path, beat)?;
    Ok((Box::new(local), plan))
}

fn exists(path: &Path) -> Result<(), InputError> {
    refuse_shard(path)?;
    if let Some(version) = old_version(path) {
        let reason = "`actrm-data convert` makes a LeRobot v3.0 set of it".to_owned();
        let (path, object) = (path.to_owned(), format!("a LeRobot {version} folder"));
        return Err(InputError::Unavailable { path, object, reason });
    }
    match std::fs::metadata(path) {
        // libhdf5's binding takes text
        Ok(_) if path.to_str().is_none() => {
            let reason = "the HDF5 library takes paths in UTF-8 only; link it under another name".to_owned();
            Err(InputError::Unreadable { path: path.to_owned(), reason })
        }
        Ok(_) => Ok(()),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Err(InputError::NotFound { path: path.to_owned() }),
        Err(e) => Err(InputError::Unreadable { path: path.to_owned(), reason: e.to_string() }),
    }
}

/// Reads so many bytes from there, into memory that is not cleared first.
fn read_at(file: &File, offset: u64, wanted: usize) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::with_capacity(wanted);
    while bytes.len() < wanted {
        let at = offset + bytes.len() as u64;
        match rustix::io::pread(file, spare_capacity(&mut bytes), at) {
            Ok(0) => return Err(std::io::ErrorKind::UnexpectedEof.into()),
            Ok(_) | Err(rustix::io::Errno::INTR) => {}
            Err(e) => return Err(e.into()),
        }
    }
    // a vector may have room for more than was asked for
    bytes.truncate(wanted);
    Ok(bytes)
}

fn open_file(path: &Path) -> Result<File, InputError> {
    File::open(path).map_err(|e| InputError::Unreadable { path: path.to_owned(), reason: e.to_string() })
}

#[cfg(test)]
mod content_hash;
#[cfg(test)]
mod dialect_tests;
#[cfg(test)]
mod roundtrip_tests;
#[cfg(test)]
mod tests;
