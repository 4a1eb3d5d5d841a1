//! Batches of a data set: which samples make which, and who makes them.

use std::collections::VecDeque;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::sync::{Mutex, PoisonError};

use ::dataset::shuffle::{Sampler, order};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use rayon::{ThreadPool, ThreadPoolBuilder};
use rustix::process::{Pid, getpid};

use crate::arrays::{Number, filled, flags, zeros};
use crate::dataset::PyDataset;
use crate::error::{Error, defect};
use crate::work::{LOOK, released};

/// The most threads that make batches ahead.
const MOST_THREADS: usize = 256;

/// What an array is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    Numbers,
    /// Truth values, a byte each.
    Flags,
    /// Numbers whose last axis are the colours; LeRobot has them before height and width.
    Picture,
}

/// Where the columns of a batch go.
pub(crate) trait Columns {
    /// An array of this shape, whose values `fill` writes, row-major.
    fn add<T: Number>(&mut self, name: &str, shape: &[usize], kind: Kind, fill: impl FnOnce(&mut [T])) -> PyResult<()>;

    /// Texts, or one of them by itself; Python's None where there is none.
    fn texts(&mut self, name: &str, texts: Vec<Option<&str>>, alone: bool) -> PyResult<()>;
}

/// At once into arrays of a dict.
pub(crate) struct Arrays<'a, 'py>(pub(crate) &'a Bound<'py, PyDict>);

impl Columns for Arrays<'_, '_> {
    fn add<T: Number>(&mut self, name: &str, shape: &[usize], kind: Kind, fill: impl FnOnce(&mut [T])) -> PyResult<()> {
        let py = self.0.py();
        let made = match kind {
            Kind::Flags => flags(py, shape, fill)?,
            Kind::Numbers | Kind::Picture => filled(py, shape, fill)?,
        };
        if kind != Kind::Picture {
            return self.0.set_item(name, made);
        }
        // LeRobot's order, colours first, over memory that has them last
        let axes = shape.len();
        let order = (0..axes - 3).chain([axes - 1, axes - 3, axes - 2]);
        self.0.set_item(name, made.call_method1("transpose", PyTuple::new(py, order.collect::<Vec<_>>())?)?)
    }

    fn texts(&mut self, name: &str, texts: Vec<Option<&str>>, alone: bool) -> PyResult<()> {
        match (alone, texts.as_slice()) {
            (true, [text]) => self.0.set_item(name, text),
            _ => self.0.set_item(name, texts),
        }
    }
}

/// A column that has still to become Python's.
type Part = Box<dyn FnOnce(&mut Arrays<'_, '_>) -> PyResult<()> + Send>;

/// Into memory of ours, where Python's lock is not held.
#[derive(Default)]
struct Ahead(Vec<Part>);

impl Columns for Ahead {
    fn add<T: Number>(&mut self, name: &str, shape: &[usize], kind: Kind, fill: impl FnOnce(&mut [T])) -> PyResult<()> {
        let (name, shape) = (name.to_owned(), shape.to_owned());
        let mut values = zeros(shape.iter().product())?;
        fill(&mut values);
        self.0.push(Box::new(move |arrays| arrays.add(&name, &shape, kind, |out| out.copy_from_slice(&values))));
        Ok(())
    }

    fn texts(&mut self, name: &str, texts: Vec<Option<&str>>, alone: bool) -> PyResult<()> {
        let (name, texts) =
            (name.to_owned(), texts.into_iter().map(|text| text.map(str::to_owned)).collect::<Vec<_>>());
        self.0.push(Box::new(move |arrays| arrays.texts(&name, texts.iter().map(Option::as_deref).collect(), alone)));
        Ok(())
    }
}

/// Which samples make which batch.
pub(crate) enum Order {
    Once { order: Vec<u32>, next: usize, drop_last: bool },
    Training { sampler: Sampler, next: u64, end: u64 },
}

impl Order {
    /// Every sample once: in their order, or in that of an epoch of training.
    pub(crate) fn once(seed: Option<u64>, epoch: u64, len: usize, drop_last: bool) -> Self {
        let order = seed.map_or_else(|| (0..len as u32).collect(), |seed| order(seed, epoch, len));
        Self::Once { order, next: 0, drop_last }
    }

    /// As training reads them in these steps.
    pub(crate) fn training(seed: u64, batch_size: usize, steps: Range<u64>) -> Self {
        Self::Training { sampler: Sampler::new(seed, batch_size), next: steps.start, end: steps.end }
    }

    fn next(&mut self, size: usize, len: usize) -> Option<Vec<u32>> {
        match self {
            Self::Once { order, next, drop_last } => {
                let end = next.saturating_add(size).min(order.len());
                let batch = order.get(*next..end).filter(|batch| !batch.is_empty())?;
                if *drop_last && batch.len() < size {
                    return None;
                }
                let batch = batch.to_vec();
                *next = end;
                Some(batch)
            }
            Self::Training { sampler, next, end } => {
                let step = (*next < *end).then_some(*next)?;
                *next += 1;
                Some(sampler.batch(len, step))
            }
        }
    }

    fn left(&self, size: usize) -> usize {
        match self {
            Self::Once { order, next, drop_last: true } => (order.len() - next) / size,
            Self::Once { order, next, drop_last: false } => (order.len() - next).div_ceil(size),
            Self::Training { next, end, .. } => usize::try_from(end - next).unwrap_or(usize::MAX),
        }
    }
}

/// Batches of a data set, one after the other: what `batches` of a `Dataset` gives.
#[pyclass(frozen, module = "actrm")]
pub(crate) struct Batches {
    dataset: Py<PyDataset>,
    batch_size: usize,
    coming: Mutex<Coming>,
    pool: Option<ThreadPool>,
    /// The process whose threads the pool has.
    home: Pid,
}

/// What is still to come.
struct Coming {
    order: Order,
    /// Batches that threads make, in their order.
    ahead: VecDeque<Receiver<PyResult<Vec<Part>>>>,
}

impl Batches {
    pub(crate) fn new(dataset: Py<PyDataset>, batch_size: usize, order: Order, threads: usize) -> PyResult<Self> {
        if threads > MOST_THREADS {
            return Err(PyValueError::new_err(format!("threads: expected 0 to {MOST_THREADS}, found {threads}")));
        }
        let pool = match threads {
            0 => None,
            threads => Some(ThreadPoolBuilder::new().num_threads(threads).build().map_err(crate::error::raised)?),
        };
        let coming = Mutex::new(Coming { order, ahead: VecDeque::new() });
        Ok(Self { dataset, batch_size, coming, pool, home: getpid() })
    }

    /// The next batch of those that threads make, and one more asked for in its place.
    fn ahead(&self, py: Python<'_>, pool: &ThreadPool) -> Option<Receiver<PyResult<Vec<Part>>>> {
        let dataset = self.dataset.get();
        let mut coming = self.coming.lock().unwrap_or_else(PoisonError::into_inner);
        let coming = &mut *coming;
        // one that each thread makes, and one that each has made
        while coming.ahead.len() < 2 * pool.current_num_threads() {
            let Some(samples) = coming.order.next(self.batch_size, dataset.len()) else { break };
            let (sender, receiver) = sync_channel(1);
            let dataset = self.dataset.clone_ref(py);
            pool.spawn(move || {
                let make = || {
                    let mut parts = Ahead::default();
                    dataset.get().columns(&samples, Some(samples.len()), &mut parts)?;
                    Ok(parts.0)
                };
                let made = catch_unwind(AssertUnwindSafe(make)).unwrap_or_else(|panic| Err(defect(&*panic)));
                // nobody waits for it any more if the batches were given up
                let _ = sender.send(made);
            });
            coming.ahead.push_back(receiver);
        }
        coming.ahead.pop_front()
    }
}

#[pymethods]
impl Batches {
    fn __iter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    /// Batches that are still to come.
    fn __len__(&self) -> usize {
        let coming = self.coming.lock().unwrap_or_else(PoisonError::into_inner);
        coming.order.left(self.batch_size).saturating_add(coming.ahead.len())
    }

    fn __next__<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyDict>>> {
        let dataset = self.dataset.get();
        let Some(pool) = &self.pool else {
            let mut coming = self.coming.lock().unwrap_or_else(PoisonError::into_inner);
            let next = coming.order.next(self.batch_size, dataset.len());
            drop(coming);
            return next.map(|samples| dataset.gather(py, &samples, Some(samples.len()))).transpose();
        };
        if getpid() != self.home {
            return Err(Error::new_err("batches: their threads are another process's, from which this one was forked"));
        }
        let Some(mut made) = self.ahead(py, pool) else { return Ok(None) };
        let parts = loop {
            let waiting = &mut made;
            match released(py, move || waiting.recv_timeout(LOOK)).0 {
                Ok(parts) => break parts?,
                Err(RecvTimeoutError::Timeout) => {
                    if let Err(error) = py.check_signals() {
                        // the next call waits for this batch again
                        self.coming.lock().unwrap_or_else(PoisonError::into_inner).ahead.push_front(made);
                        return Err(error);
                    }
                }
                Err(RecvTimeoutError::Disconnected) => return Err(Error::new_err("a thread that makes batches ended")),
            }
        };
        let batch = PyDict::new(py);
        parts.into_iter().try_for_each(|part| part(&mut Arrays(&batch)))?;
        Ok(Some(batch))
    }
}
