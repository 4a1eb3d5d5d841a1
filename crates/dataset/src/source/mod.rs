//! Reading files of demonstrations and writing robomimic ones.

use std::path::Path;

use crate::error::Result;
use crate::plan::Plan;
use crate::tree::{Array, Demo};

/// An opened file or folder of demonstrations. Shared freely between threads: what lies in the file as it is in
/// memory is read in parallel, the rest one request at a time.
pub struct Source {}

impl Source {
    /// Opens in this process: for files that are trusted.
    pub fn open(_path: &Path) -> Result<Self> {
        unimplemented!()
    }

    /// Opens with all parsing done in a child process with memory and time limits. The program has to have called
    /// [`isolation::serve_if_child`] first.
    pub fn open_isolated(_path: &Path) -> Result<Self> {
        unimplemented!()
    }

    /// [`Self::open_isolated`] where the program has armed it, [`Self::open`] otherwise (tests, other programs).
    pub fn open_guarded(path: &Path) -> Result<Self> {
        if isolation::armed() {
            Self::open_isolated(path)
        } else {
            Self::open(path)
        }
    }

    /// What there is.
    pub fn plan(&self) -> &Plan {
        unimplemented!()
    }

    /// Everything in the file that belongs to no demo: attributes, masks, extra datasets and groups, by path
    /// (`mask/train`; the attributes of `data` are `inner_attrs["data"]`).
    pub fn root(&self) -> Result<Demo> {
        unimplemented!()
    }

    /// Reads and checks a demo. Refuses one beyond 512 MB: read that with [`Self::read_demo_where`] and
    /// [`Self::read_rows`].
    pub fn read_demo(&self, index: usize) -> Result<Demo> {
        self.read_demo_where(index, &|_| true)
    }

    /// As [`Self::read_demo`], with only the datasets that are wanted; attributes and groups are always there.
    pub fn read_demo_where(&self, _index: usize, _wanted: &dyn Fn(&str) -> bool) -> Result<Demo> {
        unimplemented!()
    }

    /// Rows `first .. first + count` of one dataset of a demo.
    pub fn read_rows(
        &self,
        _index: usize,
        _key: &str,
        _first: usize,
        _count: usize,
    ) -> Result<Array> {
        unimplemented!()
    }
}

/// Keeping hostile files away from the program.
pub mod isolation {
    /// First statement of `main`: in a reading process this serves its parent and never returns; in any other it
    /// arms [`super::Source::open_isolated`] and returns at once.
    pub fn serve_if_child() {
        unimplemented!()
    }

    /// Whether [`serve_if_child`] has been called.
    pub fn armed() -> bool {
        false
    }
}

/// How to store.
#[derive(Debug, Clone, Default)]
pub struct WriteOptions {
    /// Compress datasets with shuffle and gzip of this level (1-9).
    pub gzip: Option<u8>,
}

/// Writes a robomimic file: under a temporary name, renamed by [`Self::finish`]; the same calls give the same bytes.
pub struct RobomimicWriter {}

impl RobomimicWriter {
    /// Starts a file; refuses a path that exists.
    pub fn create(_path: &Path, _options: &WriteOptions) -> Result<Self> {
        unimplemented!()
    }

    /// Sets an attribute of the group `data` (`env_args`, `total`).
    pub fn set_data_attr(&mut self, _name: &str, _value: &Array) -> Result<()> {
        unimplemented!()
    }

    /// Writes what [`Source::root`] returned: attributes, masks and extras outside the demos.
    pub fn set_root(&mut self, _root: &Demo) -> Result<()> {
        unimplemented!()
    }

    /// Writes a demo under its id.
    pub fn add_demo(&mut self, _demo: &Demo) -> Result<()> {
        unimplemented!()
    }

    /// Writes a filter key.
    pub fn set_mask(&mut self, _name: &str, _demos: &[String]) -> Result<()> {
        unimplemented!()
    }

    /// Flushes, syncs and gives the file its name.
    pub fn finish(self) -> Result<()> {
        unimplemented!()
    }
}
