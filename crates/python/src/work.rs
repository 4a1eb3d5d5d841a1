//! Work that takes long: elsewhere than on the thread that Python waits in, so that Ctrl-C is heard; work in a process
//! that was forked; and threads that are at work when Python ends.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::thread::ThreadId;
use std::time::{Duration, Instant};

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
            // Python's own code, which `tell` may be, is waited for at the end
            let (heard, _inside) = released(py, move || listening.recv_timeout(LOOK));
            let news = match heard {
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
        let (done, _inside) = released(py, || working.join());
        failure.map_or_else(|| done.map_err(|panic| defect(&*panic)), Err)
    })
}

/// Does `work` without Python's lock.
pub(crate) fn unlocked<T: Send>(py: Python<'_>, work: impl FnOnce() -> PyResult<T> + Send) -> PyResult<T> {
    released(py, || catch_unwind(AssertUnwindSafe(work))).0.unwrap_or_else(|panic| Err(defect(&*panic)))
}

/// Does `work`, which does not panic, without Python's lock, and says that this thread is inside from then on.
pub(crate) fn released<T: Send>(py: Python<'_>, work: impl FnOnce() -> T + Send) -> (T, Inside) {
    py.allow_threads(|| (work(), Inside::enter()))
}

/// Does `work` with Python's lock, on a thread that does not have it.
pub(crate) fn locked<T>(work: impl FnOnce(Python<'_>) -> T) -> T {
    let _inside = Inside::enter();
    Python::with_gil(work)
}

/// The thread in which Python ends, once it does. Python kills every other one that takes its lock from then on, which
/// aborts the process where frames of ours are on its stack.
static ENDING: OnceLock<ThreadId> = OnceLock::new();
/// How many threads take Python's lock, or run Python's code, with frames of ours on their stack.
static INSIDE: AtomicUsize = AtomicUsize::new(0);
/// How long the end waits for them: Python's code may take as long as it likes.
const PATIENCE: Duration = Duration::from_secs(10);

/// That a thread is counted.
pub(crate) struct Inside(());

impl Inside {
    /// Before a thread without Python's lock takes it; at the end of Python it goes no further.
    fn enter() -> Self {
        let inside = Self::count();
        if Self::is_too_late() {
            drop(inside);
            loop {
                std::thread::park();
            }
        }
        inside
    }

    /// The same for a thread that has the lock, before it calls Python's code.
    pub(crate) fn with_lock(py: Python<'_>) -> Self {
        match Self::is_too_late() {
            true => py.allow_threads(Self::enter),
            false => Self::count(),
        }
    }

    fn count() -> Self {
        INSIDE.fetch_add(1, Ordering::SeqCst);
        Self(())
    }

    fn is_too_late() -> bool {
        ENDING.get().is_some_and(|thread| *thread != std::thread::current().id())
    }
}

impl Drop for Inside {
    fn drop(&mut self) {
        INSIDE.fetch_sub(1, Ordering::SeqCst);
    }
}

/// An exit handler that acts once Python lets go of it: Python does so only after it has called all handlers, of which
/// some wait for threads that use this package. It calls them newest first, so that ours is not the last one.
#[pyclass(frozen)]
#[derive(Default)]
pub(crate) struct Ending {
    /// Handlers are also let go of without a call, in forks that are to forget them.
    called: AtomicBool,
}

#[pymethods]
impl Ending {
    fn __call__(&self) {
        self.called.store(true, Ordering::SeqCst);
    }
}

impl Drop for Ending {
    fn drop(&mut self) {
        if self.called.load(Ordering::SeqCst) {
            Python::with_gil(ending);
        }
    }
}

/// Lets no other thread back in, and waits for those that are.
fn ending(py: Python<'_>) {
    let first = ENDING.set(std::thread::current().id()).is_ok();
    // what others counted before a fork is nobody's here
    if first && HOME.get() == Some(&getpid()) {
        py.allow_threads(|| {
            let begun = Instant::now();
            while INSIDE.load(Ordering::SeqCst) > 0 && begun.elapsed() < PATIENCE {
                std::thread::sleep(Duration::from_millis(1));
            }
        });
    }
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
