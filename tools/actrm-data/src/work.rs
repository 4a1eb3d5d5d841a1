//! Work that writes a file or folder, and that Ctrl-C ends: nothing that it began to write stays.

use anyhow::Result;
use cli::{Parents, Stop};
use std::ops::ControlFlow;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

/// What a program says that Ctrl-C ended.
pub const STOPPED: &str = "stopped; nothing was written";

/// Work on one output, whose folders are made. Those that stay empty are removed in the end.
pub struct Work {
    stop: Stop,
    parents: Arc<Mutex<Option<Parents>>>,
}

impl Work {
    /// Begins with an output.
    pub fn begin(out: &Path) -> Result<Self> {
        let stop = Stop::install(STOPPED)?;
        let parents = Arc::new(Mutex::new(Some(cli::make_parent(out)?)));
        let (path, made) = (out.to_owned(), Arc::clone(&parents));
        stop.last_act(move || {
            while !dataset::remove_unfinished(&path) {
                // the result is there: the work says so and ends by itself
                std::thread::park();
            }
            remove(&made);
        });
        Ok(Self { stop, parents })
    }

    /// What Ctrl-C asks to stop.
    pub fn stop(&self) -> &Stop {
        &self.stop
    }

    /// Whether to go on.
    pub fn goes_on(&self) -> ControlFlow<()> {
        if self.stop.asked() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    }
}

impl Drop for Work {
    fn drop(&mut self) {
        remove(&self.parents);
    }
}

fn remove(parents: &Mutex<Option<Parents>>) {
    drop(parents.lock().unwrap_or_else(PoisonError::into_inner).take());
}
