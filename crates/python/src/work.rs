//! Work that takes long: elsewhere than on the thread that Python waits in, so that Ctrl-C is heard; and work in a
//! process that was forked.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use pyo3::prelude::*;
use rayon::{ThreadPool, ThreadPoolBuilder};
use rustix::process::{Pid, getpid};

use crate::error::defect;

/// How often Ctrl-C is looked for.
pub(crate) const LOOK: Duration = Duration::from_millis(50);

/// Does `work` on a thread of its own. What it sends is told to `tell` here; it is asked to end, through the flag, as
/// soon as `tell` fails or Ctrl-C is pressed, and its result is then that exception.
pub(crate) fn interruptible<T: Send, M: Send>(
    py: Python<'_>,
    work: impl FnOnce(&Arc<AtomicBool>, &Sender<M>) -> T + Send,
    mut tell: impl FnMut(M) -> PyResult<()>,
) -> PyResult<T> {
    let stop = Arc::new(AtomicBool::new(false));
    let (sender, mut receiver) = channel();
    std::thread::scope(|scope| {
        let working = {
            let stop = Arc::clone(&stop);
            scope.spawn(move || run(|| work(&stop, &sender)))
        };
        let mut failure = None;
        let mut going = true;
        while going {
            let listening = &mut receiver;
            let news = match py.allow_threads(move || listening.recv_timeout(LOOK)) {
                Ok(message) if failure.is_none() => tell(message),
                Ok(_) | Err(RecvTimeoutError::Timeout) => Ok(()),
                Err(RecvTimeoutError::Disconnected) => {
                    going = false;
                    Ok(())
                }
            };
            if let Err(error) = news.and_then(|()| py.check_signals()) {
                stop.store(true, Ordering::SeqCst);
                failure.get_or_insert(error);
            }
        }
        let done = py.allow_threads(|| working.join());
        failure.map_or_else(|| done.map_err(|panic| defect(&*panic)), Err)
    })
}

/// Does `work` without Python's lock.
pub(crate) fn unlocked<T: Send>(py: Python<'_>, work: impl FnOnce() -> PyResult<T> + Send) -> PyResult<T> {
    py.allow_threads(|| catch_unwind(AssertUnwindSafe(work))).unwrap_or_else(|panic| Err(defect(&*panic)))
}

/// The process that loaded this library.
static HOME: OnceLock<Pid> = OnceLock::new();
/// A forked process's own threads: those of the process that it was forked from are not there.
static FORKED: Mutex<Option<(Pid, Arc<ThreadPool>)>> = Mutex::new(None);

/// Remembers this process as the one with the usual threads.
pub(crate) fn at_home() {
    HOME.get_or_init(getpid);
}

/// Does what may spread over several threads.
pub(crate) fn run<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    let here = getpid();
    if *HOME.get_or_init(getpid) == here {
        return work();
    }
    let pool = {
        let mut forked = FORKED.lock().unwrap_or_else(PoisonError::into_inner);
        match &*forked {
            Some((process, pool)) if *process == here => Some(Arc::clone(pool)),
            _ => {
                let made = ThreadPoolBuilder::new().build().ok().map(Arc::new);
                *forked = made.clone().map(|pool| (here, pool));
                made
            }
        }
    };
    match pool {
        Some(pool) => pool.install(work),
        None => work(),
    }
}
