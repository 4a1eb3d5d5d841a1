//! Writing robomimic files.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::path::{Path, PathBuf};

use hdf5::{Extents, Group, Location, SimpleExtents};
use tempfile::NamedTempFile;

use super::value;
use crate::error::{DatasetError, Result};
use crate::tree::{Array, Attrs, Demo};

/// How to store.
#[derive(Debug, Clone, Default)]
pub struct WriteOptions {
    /// Compress datasets with shuffle and gzip of this level (1-9).
    pub gzip: Option<u8>,
}

/// Rows are packed together up to about this many bytes.
const BLOCK: usize = 256 << 10;
/// What an object may take beyond its elements.
const OVERHEAD: u64 = 256 << 10;
/// Letters and digits that tell unfinished files of one process apart.
const RANDOM: usize = 6;
/// Smaller datasets are not worth packing.
const WORTH_PACKING: usize = 1 << 10;

/// Writes a robomimic file: under a temporary name, renamed by [`Self::finish`]; the same calls give the same
/// bytes. Dropped unfinished, it leaves nothing.
pub struct RobomimicWriter {
    path: PathBuf,
    temporary: NamedTempFile,
    file: hdf5::File,
    options: WriteOptions,
    groups: BTreeMap<String, Group>,
    datasets: BTreeSet<String>,
    /// Bytes of the disk that are ours already.
    reserved: u64,
}

impl std::fmt::Debug for RobomimicWriter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("RobomimicWriter").field("path", &self.path).finish_non_exhaustive()
    }
}

impl RobomimicWriter {
    /// Starts a file; refuses a path that exists.
    pub fn create(path: &Path, options: &WriteOptions) -> Result<Self> {
        if path.symlink_metadata().is_ok() {
            return Err(DatasetError::OutputExists { path: path.to_owned() });
        }
        let folder = folder_of(path);
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        let io = |operation| {
            let path = path.to_owned();
            move |source| DatasetError::Io { path, operation, source }
        };
        sweep(folder, &name);
        let temporary = tempfile::Builder::new()
            .prefix(&format!(".{name}.{}-", process()))
            .rand_bytes(RANDOM)
            .suffix(".part")
            .permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666))
            .tempfile_in(folder)
            .map_err(io("create a file beside it"))?;
        let file = hdf5::File::with_options()
            .with_fcpl(|p| p.obj_track_times(false))
            // since 1.8 an attribute may exceed 64 KB; a model_file does
            .with_fapl(|p| p.libver_v18().file_locking(false))
            .create(temporary.path())
            .map_err(|source| DatasetError::Hdf5Write {
                path: path.to_owned(),
                object: "the file".to_owned(),
                source,
            })?;
        // for those that sweep on another machine; libhdf5, which may lock the file itself, opens it first
        let _ = temporary.as_file().try_lock();
        let mut writer = Self {
            path: path.to_owned(),
            temporary,
            file,
            options: options.clone(),
            groups: BTreeMap::new(),
            datasets: BTreeSet::new(),
            reserved: 0,
        };
        writer.groups.insert(String::new(), (*writer.file).clone());
        writer.group("data")?;
        Ok(writer)
    }

    fn hdf5(&self, object: &str) -> impl FnOnce(hdf5::Error) -> DatasetError + use<> {
        let (path, object) = (self.path.clone(), object.to_owned());
        move |source| DatasetError::Hdf5Write { path, object, source }
    }

    fn bad(&self, object: &str, reason: impl Into<String>) -> DatasetError {
        let (path, object, reason) = (self.path.clone(), object.to_owned(), reason.into());
        DatasetError::BadTree { path, object, reason }
    }

    /// Makes sure that the disk has room for an object of this many bytes. libhdf5 crashes when a file is closed
    /// after a write has failed, so it must never see a full disk.
    fn reserve(&mut self, bytes: usize) -> Result<()> {
        let end = self.file.size() + bytes as u64 + OVERHEAD;
        if end <= self.reserved {
            return Ok(());
        }
        let step = (end - self.reserved).max(1 << 20);
        let reserved = take_room(self.temporary.as_file(), self.reserved, step, end);
        let operation = "reserve disk space for the file beside it";
        reserved.map_err(|e| DatasetError::Io { path: self.path.clone(), operation, source: e.into() })?;
        self.reserved += step;
        Ok(())
    }

    /// The group at a path; it and those above it are made if they are not there.
    fn group(&mut self, path: &str) -> Result<Group> {
        if let Some(group) = self.groups.get(path) {
            return Ok(group.clone());
        }
        let (above, name) = path.rsplit_once('/').unwrap_or(("", path));
        if name.is_empty() || name == "." || name == ".." {
            return Err(self.bad(path, "a name that HDF5 cannot hold"));
        }
        let above = self.group(above)?;
        let group = above.create_group_builder().obj_track_times(false).create(name).map_err(self.hdf5(path))?;
        self.groups.insert(path.to_owned(), group.clone());
        Ok(group)
    }

    fn attribute(&mut self, to: &Location, object: &str, name: &str, value: &Array) -> Result<()> {
        let full = format!("attribute {name} of {object}");
        self.reserve(value.bytes.len())?;
        let check = |r: value::ValueResult<()>| r.map_err(|reason| self.bad(&full, reason));
        check(value::check(value))?;
        let descriptor = value::descriptor_of(&value.dtype).map_err(|reason| self.bad(&full, reason))?;
        let attr =
            to.new_attr_builder().empty_as(&descriptor).shape(extents(value)).create(name).map_err(self.hdf5(&full))?;
        check(value::write(&attr, value))
    }

    fn attributes(&mut self, to: &Location, object: &str, attrs: &Attrs) -> Result<()> {
        attrs.iter().try_for_each(|(name, value)| self.attribute(to, object, name, value))
    }

    fn dataset(&mut self, path: &str, value: &Array) -> Result<()> {
        self.reserve(value.bytes.len())?;
        let check = |r: value::ValueResult<()>| r.map_err(|reason| self.bad(path, reason));
        check(value::check(value))?;
        let descriptor = value::descriptor_of(&value.dtype).map_err(|reason| self.bad(path, reason))?;
        let (above, name) = path.rsplit_once('/').unwrap_or(("", path));
        if name.is_empty() {
            return Err(self.bad(path, "a name that HDF5 cannot hold"));
        }
        let group = self.group(above)?;
        let mut builder = group.new_dataset_builder();
        if let (Some(level), true) = (self.options.gzip, worth_packing(value)) {
            let row = value.bytes.len() / value.shape[0].max(1);
            let mut block = value.shape.clone();
            block[0] = (BLOCK / row.max(1)).clamp(1, value.shape[0]);
            builder = builder.chunk(block).shuffle().deflate(level);
        }
        let dataset = builder.empty_as(&descriptor).shape(extents(value)).create(name).map_err(self.hdf5(path))?;
        value::write(&dataset, value).map_err(|reason| self.bad(path, reason))?;
        self.datasets.insert(path.to_owned());
        Ok(())
    }

    /// Writes a tree below a path.
    fn tree(&mut self, base: &str, tree: &Demo) -> Result<()> {
        let full = |below: &str| if base.is_empty() { below.to_owned() } else { format!("{base}/{below}") };
        let home = self.group(base)?;
        self.attributes(&home, if base.is_empty() { "/" } else { base }, &tree.attrs)?;
        for group in &tree.groups {
            self.group(&full(group))?;
        }
        for (key, value) in &tree.datasets {
            self.dataset(&full(key), value)?;
        }
        for (below, attrs) in &tree.inner_attrs {
            let path = full(below);
            if self.datasets.contains(&path) {
                let dataset = self.file.dataset(&path).map_err(self.hdf5(&path))?;
                self.attributes(&dataset, &path, attrs)?;
            } else {
                let group = self.group(&path)?;
                self.attributes(&group, &path, attrs)?;
            }
        }
        Ok(())
    }

    /// Sets an attribute of the group `data` (`env_args`, `total`).
    pub fn set_data_attr(&mut self, name: &str, value: &Array) -> Result<()> {
        let data = self.group("data")?;
        self.attribute(&data, "data", name, value)
    }

    /// Writes what [`super::Source::root`] returned: attributes, masks and extras outside the demos.
    pub fn set_root(&mut self, root: &Demo) -> Result<()> {
        self.tree("", root)
    }

    /// Writes a demo under its id.
    pub fn add_demo(&mut self, demo: &Demo) -> Result<()> {
        let base = format!("data/{}", demo.id);
        if demo.id.is_empty() || demo.id.contains('/') {
            return Err(self.bad(&base, "a demo needs an id without a slash"));
        }
        if self.groups.contains_key(&base) {
            return Err(self.bad(&base, "written already"));
        }
        self.tree(&base, demo)
    }

    /// Writes a filter key, as byte strings of the longest id's length.
    pub fn set_mask(&mut self, name: &str, demos: &[String]) -> Result<()> {
        self.dataset(&format!("mask/{name}"), &Array::from_fixed_strings(demos))
    }

    /// Flushes, syncs and gives the file its name.
    pub fn finish(self) -> Result<()> {
        let Self { path, temporary, file, groups, .. } = self;
        drop(groups);
        let hdf5 = |source| DatasetError::Hdf5Write { path: path.clone(), object: "the file".to_owned(), source };
        let io = |operation| {
            let path = path.clone();
            move |source| DatasetError::Io { path, operation, source }
        };
        file.flush().map_err(hdf5)?;
        file.close().map_err(hdf5)?;
        // gives back what was reserved beyond the end
        let length = temporary.as_file().metadata().map_err(io("look at the file beside"))?.len();
        temporary.as_file().set_len(length).map_err(io("set the length of the file beside"))?;
        temporary.as_file().sync_all().map_err(io("sync"))?;
        temporary.persist_noclobber(&path).map_err(|e| match e.error.kind() {
            std::io::ErrorKind::AlreadyExists => DatasetError::OutputExists { path: path.clone() },
            _ => io("rename the finished file to")(e.error),
        })?;
        File::open(folder_of(&path)).and_then(|f| f.sync_all()).map_err(io("sync the folder of"))?;
        Ok(())
    }
}

/// This process, as a number.
fn process() -> i32 {
    rustix::process::getpid().as_raw_nonzero().get()
}

/// Removes what killed writers of the file `name` left. Best effort: what is locked, or of a process that lives, is in
/// use.
fn sweep(folder: &Path, name: &str) {
    for (path, owner) in unfinished(folder, name) {
        // in a container every run may have the same number
        let dead = owner == process() || rustix::process::Pid::from_raw(owner).is_none_or(is_dead);
        if dead && File::open(&path).is_ok_and(|file| file.try_lock().is_ok()) {
            let _ = std::fs::remove_file(path);
        }
    }
}

fn is_dead(process: rustix::process::Pid) -> bool {
    rustix::process::test_kill_process(process) == Err(rustix::io::Errno::SRCH)
}

/// Removes the unfinished file that this process keeps beside `path`: before it ends without unwinding.
pub fn remove_unfinished(path: &Path) {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    for (unfinished, _) in unfinished(folder_of(path), &name).filter(|(_, owner)| *owner == process()) {
        // what stays is removed by the next writer
        let _ = std::fs::remove_file(unfinished);
    }
}

/// Unfinished files of the name `name` in a folder, each with the process that writes it.
fn unfinished(folder: &Path, name: &str) -> impl Iterator<Item = (PathBuf, i32)> {
    let begin = format!(".{name}.");
    let owner = move |item: std::fs::DirEntry| {
        let found = item.file_name();
        let (process, random) = found.to_str()?.strip_prefix(&begin)?.strip_suffix(".part")?.split_once('-')?;
        let ours = random.len() == RANDOM && random.bytes().all(|byte| byte.is_ascii_alphanumeric());
        Some((item.path(), process.parse().ok().filter(|_| ours)?))
    };
    std::fs::read_dir(folder).into_iter().flatten().flatten().filter_map(owner)
}

/// Takes `step` bytes of the disk for a file of which `from` bytes are taken and which is about to grow to `end`.
fn take_room(file: &File, from: u64, step: u64, end: u64) -> rustix::io::Result<()> {
    use rustix::io::Errno;
    // what is reserved without growing the file is not held against the limit on the size of files
    if rustix::process::getrlimit(rustix::process::Resource::Fsize).current.is_some_and(|most| end > most) {
        return Err(Errno::FBIG);
    }
    match rustix::fs::fallocate(file, rustix::fs::FallocateFlags::KEEP_SIZE, from, step) {
        // a file system that cannot reserve can still be asked
        Err(Errno::OPNOTSUPP | Errno::NOSYS) => {
            let disk = rustix::fs::fstatvfs(file)?;
            if disk.f_bavail.saturating_mul(disk.f_frsize) < step { Err(Errno::NOSPC) } else { Ok(()) }
        }
        other => other,
    }
}

fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

fn extents(value: &Array) -> Extents {
    if value.is_null() {
        Extents::null()
    } else if value.shape.is_empty() {
        Extents::scalar()
    } else {
        Extents::simple(SimpleExtents::fixed(value.shape.clone()))
    }
}

fn worth_packing(value: &Array) -> bool {
    value.dtype.is_numeric() && !value.shape.is_empty() && value.bytes.len() >= WORTH_PACKING
}
