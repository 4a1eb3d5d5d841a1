//! A data set as PyTorch and LeRobot expect one: map-style, with LeRobot's keys and shapes; and batches of it.

use std::collections::BTreeMap;
use std::path::PathBuf;

use ::dataset::{DepthUnit, Feature, NumberKind, SampleColumn, SampleSpec, Samples};
use pyo3::exceptions::{PyIndexError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList, PyTuple};

use crate::arrays::array;
use crate::batches::{Arrays, Batches, Columns, Kind, Order};
use crate::error::{natural, raised, words};
use crate::work::{run, unlocked};

/// The most samples in a batch.
const MOST_SAMPLES: usize = 1 << 24;

/// The largest whole number up to which float32 holds each, in which columns are kept in memory.
const MOST_WHOLE: f32 = 16_777_216.0;

/// A LeRobotDataset v3.0 folder, written by actrm or by LeRobot, as a map-style data set.
///
/// Sample `i` is the `i`-th frame of the chosen episodes: a dict with LeRobot's keys and shapes. A numeric column is an
/// array (a scalar without an axis), a camera (3, height, width), depth (1, height, width). Numbers are float32,
/// booleans bool, texts str (None where a frame has none) and whole numbers int64 (beyond 2^24 rounded to float32;
/// `notes` says so). All columns stay in memory.
///
/// Parameters
/// ----------
/// path: the folder.
/// delta_timestamps: for each column the offsets of the frames in a sample. Integers count frames; if any is a float,
///     all are seconds, as in LeRobot. The column then has a leading axis of frames, and `<column>_is_pad` marks the
///     frames outside the episode, which repeat its first or last frame. A camera with one offset has that axis too;
///     LeRobot leaves it out where the camera is stored as video.
/// split: only the episodes of this mask (`train`, `valid`, ...).
/// episodes: only these episodes, instead of `split`.
/// cameras: cameras to read; all unless given.
/// depth: depth columns to read; all unless given.
/// depth_output_unit: unit of depth and of its statistics, `mm` or `m`.
/// return_uint8: images as they are stored, 0 to 255, instead of float32 from 0 to 1.
///
/// It can be pickled (by path), and works in a `torch.utils.data.DataLoader` whose workers are forked or spawned. It has
/// no subclasses: a class of yours that changes samples holds one and has `__len__` and `__getitem__`.
#[pyclass(frozen, module = "actrm", name = "Dataset")]
pub(crate) struct PyDataset {
    given: Given,
    dataset: dataset::Dataset,
    chosen: Vec<usize>,
    samples: Samples,
    tasks: Tasks,
    /// Of each frame of the whole set, by column.
    texts: BTreeMap<String, dataset::Texts>,
    /// Seconds of each frame of the whole set, where its files have them.
    times: Option<Vec<f32>>,
    notes: Vec<String>,
}

/// Where a frame's task stands.
enum Tasks {
    /// Nowhere.
    None,
    /// The index of each frame's.
    OfFrames(Vec<usize>),
    /// The index of each episode's only task, where frames state none.
    OfEpisodes(Vec<usize>),
}

/// What it was made with.
struct Given {
    path: PathBuf,
    offsets: BTreeMap<String, Vec<i64>>,
    cameras: Vec<String>,
    depth: Vec<String>,
    depth_unit: DepthUnit,
    return_uint8: bool,
}

#[pymethods]
impl PyDataset {
    #[new]
    #[pyo3(signature = (path, delta_timestamps=None, split=None, *, episodes=None, cameras=None, depth=None,
                        depth_output_unit="mm", return_uint8=false))]
    #[expect(clippy::too_many_arguments, reason = "options by name")]
    fn new(
        py: Python<'_>,
        path: PathBuf,
        delta_timestamps: Option<&Bound<'_, PyAny>>,
        split: Option<&str>,
        episodes: Option<Vec<i128>>,
        cameras: Option<Vec<String>>,
        depth: Option<Vec<String>>,
        depth_output_unit: &str,
        return_uint8: bool,
    ) -> PyResult<Self> {
        let depth_unit = DepthUnit::named(depth_output_unit).ok_or_else(|| {
            PyValueError::new_err(format!("depth_output_unit: expected mm or m, found {depth_output_unit}"))
        })?;
        let path = std::path::absolute(path)?;
        let dataset = unlocked(py, || run(|| dataset::Dataset::open(&path)).map_err(raised))?;
        let chosen = match (split, episodes) {
            (Some(_), Some(_)) => return Err(PyValueError::new_err("split and episodes: expected one of them")),
            (Some(split), None) => dataset.required_split(split).map_err(raised)?,
            (None, Some(episodes)) => {
                episodes.into_iter().map(|episode| natural("episodes", episode)).collect::<PyResult<_>>()?
            }
            (None, None) => (0..dataset.episodes().len()).collect(),
        };
        let offsets = delta_timestamps.map_or_else(|| Ok(BTreeMap::new()), |given| offsets(&dataset, given))?;
        let cameras = cameras.unwrap_or_else(|| dataset.cameras().map(str::to_owned).collect());
        let depth = depth.unwrap_or_else(|| dataset.depth_names().map(str::to_owned).collect());
        let spec = SampleSpec { offsets, cameras, depth, depth_unit, episodes: chosen.clone() };
        let samples = unlocked(py, || run(|| dataset.samples(&spec)).map_err(raised))?;
        let texts = unlocked(py, || run(|| dataset.texts()).map_err(raised))?;
        let times = unlocked(py, || run(|| dataset.frame_times()).map_err(raised))?;
        let times = times.map(|(times, _)| times.into_iter().map(|seconds| seconds as f32).collect());
        let (tasks, notes) = unlocked(py, || {
            let (tasks, untold) = tasks_of(&dataset);
            Ok((tasks, dataset.notes().iter().cloned().chain(untold).chain(notes(&dataset, &samples)).collect()))
        })?;
        let SampleSpec { offsets, cameras, depth, .. } = spec;
        let given = Given { path, offsets, cameras, depth, depth_unit, return_uint8 };
        Ok(Self { given, dataset, chosen, samples, tasks, texts, times, notes })
    }

    fn __len__(&self) -> usize {
        self.samples.len()
    }

    fn __getitem__<'py>(&self, py: Python<'py>, index: isize) -> PyResult<Bound<'py, PyDict>> {
        self.gather(py, &[self.sample(index)?], None)
    }

    /// Several samples at once, as PyTorch's loader asks for them.
    fn __getitems__<'py>(&self, py: Python<'py>, indices: Vec<isize>) -> PyResult<Bound<'py, PyList>> {
        let sample = |index| self.gather(py, &[self.sample(index)?], None);
        PyList::new(py, indices.into_iter().map(sample).collect::<PyResult<Vec<_>>>()?)
    }

    /// Several samples in one dict, each column with a leading axis of samples.
    fn batch<'py>(&self, py: Python<'py>, indices: Vec<isize>) -> PyResult<Bound<'py, PyDict>> {
        let samples: Vec<u32> = indices.into_iter().map(|index| self.sample(index)).collect::<PyResult<_>>()?;
        self.gather(py, &samples, Some(samples.len()))
    }

    /// The samples in batches, one dict of arrays each.
    ///
    /// Without a seed the samples keep their order. With one they have the order in which `actrm-zoo train` reads them with
    /// this seed. That is one epoch, the `epoch`-th, whose last batch is smaller unless `drop_last`. With `steps` it is the
    /// batches of as many training steps from step `start` on: epochs follow each other, all batches have one size. With
    /// `threads`, as many threads prepare batches while Python runs: the same batches in the same order.
    #[pyo3(signature = (batch_size, seed=None, *, epoch=0, steps=None, start=0, drop_last=false, threads=0))]
    #[expect(clippy::too_many_arguments, reason = "options by name")]
    fn batches(
        slf: Bound<'_, Self>,
        batch_size: i128,
        seed: Option<i128>,
        epoch: i128,
        steps: Option<i128>,
        start: i128,
        drop_last: bool,
        threads: i128,
    ) -> PyResult<Batches> {
        let len = slf.get().samples.len();
        if !(1..=MOST_SAMPLES as i128).contains(&batch_size) {
            return Err(PyValueError::new_err(format!("batch_size: expected 1 to {MOST_SAMPLES}, found {batch_size}")));
        }
        let seed: Option<u64> = seed.map(|seed| natural("seed", seed)).transpose()?;
        let steps: Option<u64> = steps.map(|steps| natural("steps", steps)).transpose()?;
        let (epoch, start): (u64, u64) = (natural("epoch", epoch)?, natural("start", start)?);
        let (batch_size, threads): (usize, usize) = (natural("batch_size", batch_size)?, natural("threads", threads)?);
        if start > 0 && steps.is_none() {
            return Err(PyValueError::new_err("start: expected steps with it, found none"));
        }
        if epoch > 0 && (seed.is_none() || steps.is_some()) {
            let found = if steps.is_some() { "steps" } else { "no seed" };
            return Err(PyValueError::new_err(format!("epoch: expected a seed with it and no steps, found {found}")));
        }
        let last = start.checked_add(steps.unwrap_or(0)).and_then(|end| end.checked_mul(batch_size as u64));
        if last.is_none() {
            return Err(PyValueError::new_err("start and steps: more samples than there are numbers"));
        }
        if len == 0 && steps.is_some_and(|steps| steps > 0) {
            return Err(PyValueError::new_err("steps: expected samples to make batches of, found none"));
        }
        let order = match (seed, steps) {
            (Some(seed), Some(steps)) if len > 0 => Order::training(seed, batch_size, start..start + steps),
            (None, Some(_)) => return Err(PyValueError::new_err("steps: expected a seed with them, found none")),
            (seed, _) => Order::once(seed, epoch, len, drop_last),
        };
        Batches::new(slf.unbind(), batch_size, order, threads)
    }

    /// Stored statistics over all episodes, of depth in its output unit: for each column `min`, `max`, `mean`,
    /// `std`, quantiles and `count`, as far as they are stored.
    #[getter]
    fn stats<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for (name, stats) in self.dataset.stats() {
            let of = PyDict::new(py);
            let lists = [
                ("min", &stats.min),
                ("max", &stats.max),
                ("mean", &stats.mean),
                ("std", &stats.std),
                ("q01", &stats.q01),
                ("q10", &stats.q10),
                ("q50", &stats.q50),
                ("q90", &stats.q90),
                ("q99", &stats.q99),
            ];
            let feature = self.dataset.info().features.get(name);
            let factor = self.given.depth_unit.factor(feature.and_then(Feature::depth_unit));
            // one number a channel, which fits images with their channels first
            let axes = if feature.is_some_and(Feature::is_visual) { &[1, 1][..] } else { &[] };
            for (statistic, values) in lists.into_iter().filter(|(_, values)| !values.is_empty()) {
                let values: Vec<f64> = values.iter().map(|value| value * factor).collect();
                of.set_item(statistic, array(py, &[&[values.len()], axes].concat(), &values)?)?;
            }
            of.set_item("count", array(py, &[1], &[stats.count as i64])?)?;
            all.set_item(name, of)?;
        }
        Ok(all)
    }

    /// The chosen episodes: for each its `episode_index`, `length`, `dataset_from_index`, `dataset_to_index`, `tasks`, and
    /// the `demo` that it was converted from, if it was.
    #[getter]
    fn episodes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyList>> {
        let row = |&index: &usize| -> PyResult<Bound<'py, PyDict>> {
            let episode = &self.dataset.episodes()[index];
            let row = PyDict::new(py);
            row.set_item("episode_index", episode.index)?;
            row.set_item("length", episode.length)?;
            row.set_item("dataset_from_index", episode.from)?;
            row.set_item("dataset_to_index", episode.to)?;
            row.set_item("tasks", &episode.tasks)?;
            row.set_item("demo", &episode.demo)?;
            Ok(row)
        };
        PyList::new(py, self.chosen.iter().map(row).collect::<PyResult<Vec<_>>>()?)
    }

    /// What `meta/info.json` says of every column: `dtype`, `shape`, `names`, and `info` of depth and videos.
    #[getter]
    fn features<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let text = serde_json::to_string(&self.dataset.info().features).map_err(raised)?;
        let all = py.import("json")?.call_method1("loads", (text,))?;
        for (name, feature) in &self.dataset.info().features.0 {
            all.get_item(name)?.set_item("shape", PyTuple::new(py, &feature.shape)?)?;
        }
        Ok(all)
    }

    /// The folder.
    #[getter]
    fn root(&self) -> PathBuf {
        self.given.path.clone()
    }

    /// Frames a second.
    #[getter]
    fn fps(&self) -> f64 {
        self.dataset.info().fps
    }

    /// Task texts, in the order of `task_index`.
    #[getter]
    fn tasks(&self) -> Vec<String> {
        self.dataset.tasks().to_vec()
    }

    /// Faults of the data set that were read as LeRobot reads them, columns whose whole numbers are rounded, and columns
    /// that samples lack.
    #[getter]
    fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Names of the masks that `split` takes.
    #[getter]
    fn splits(&self) -> Vec<&str> {
        self.dataset.split_names()
    }

    /// Frames of the chosen episodes.
    #[getter]
    fn num_frames(&self) -> usize {
        self.samples.len()
    }

    /// The number of chosen episodes.
    #[getter]
    fn num_episodes(&self) -> usize {
        self.chosen.len()
    }

    /// SHA-256 of the content, the same whatever the file layout.
    #[getter]
    fn fingerprint(&self) -> &str {
        self.dataset.fingerprint()
    }

    fn __repr__(&self) -> String {
        let columns = self.samples.numbers().chain(self.samples.pictures()).map(|column| column.name.as_str());
        let columns: Vec<&str> = columns.chain(self.texts.keys().map(String::as_str)).collect();
        format!(
            "Dataset({:?}, {} episodes, {} frames: {})",
            self.given.path.display().to_string(),
            self.chosen.len(),
            self.samples.len(),
            columns.join(", ")
        )
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyTuple>)> {
        let (py, this) = (slf.py(), slf.get());
        let Given { path, offsets, cameras, depth, depth_unit, return_uint8 } = &this.given;
        let options = PyDict::new(py);
        options.set_item("delta_timestamps", offsets)?;
        options.set_item("episodes", &this.chosen)?;
        options.set_item("cameras", cameras)?;
        options.set_item("depth", depth)?;
        options.set_item("depth_output_unit", depth_unit.name())?;
        options.set_item("return_uint8", return_uint8)?;
        let partial = py.import("functools")?.getattr("partial")?;
        let make = partial.call((slf.get_type(), path), Some(&options))?;
        Ok((make, PyTuple::empty(py)))
    }
}

impl PyDataset {
    /// The sample that `index` means; a negative one counts from the end.
    fn sample(&self, index: isize) -> PyResult<u32> {
        let len = self.samples.len();
        let at = if index < 0 { index.checked_add_unsigned(len) } else { Some(index) };
        at.and_then(|at| usize::try_from(at).ok())
            .filter(|at| *at < len)
            .map(|at| at as u32)
            .ok_or_else(|| PyIndexError::new_err(format!("no sample {index}; there are {len}")))
    }

    /// Their number.
    pub(crate) fn len(&self) -> usize {
        self.samples.len()
    }

    /// The dict of these samples: of one of them, or of `batch` with an axis of them in front.
    pub(crate) fn gather<'py>(
        &self,
        py: Python<'py>,
        samples: &[u32],
        batch: Option<usize>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let sample = PyDict::new(py);
        self.columns(samples, batch, &mut Arrays(&sample))?;
        Ok(sample)
    }

    /// All that belongs to these samples, into `out`.
    pub(crate) fn columns(&self, samples: &[u32], batch: Option<usize>, out: &mut impl Columns) -> PyResult<()> {
        for (i, column) in self.samples.numbers().enumerate() {
            let shape = self.shape(batch, column);
            match column.kind {
                NumberKind::Real => out.add(&column.name, &shape, Kind::Numbers, |out| {
                    self.samples.copy_numbers(i, samples, out);
                })?,
                NumberKind::Whole => out.add(&column.name, &shape, Kind::Numbers, |out: &mut [i64]| {
                    self.converted(i, column.width(), samples, out, |value| value as i64);
                })?,
                NumberKind::Truth => out.add(&column.name, &shape, Kind::Flags, |out: &mut [u8]| {
                    self.converted(i, column.width(), samples, out, |value| u8::from(value != 0.0));
                })?,
            }
            self.padding(samples, batch, column, out)?;
        }
        for (i, column) in self.samples.pictures().enumerate() {
            let shape = self.shape(batch, column);
            match self.given.return_uint8 {
                true => out.add(&column.name, &shape, Kind::Picture, |out| {
                    self.samples.copy_pictures(i, samples, out);
                })?,
                false => {
                    out.add(&column.name, &shape, Kind::Picture, |out| self.bright(i, column.width(), samples, out))?;
                }
            }
            self.padding(samples, batch, column, out)?;
        }
        for (name, texts) in &self.texts {
            let chosen = samples.iter().map(|&sample| texts.get(self.samples.place(sample).index));
            out.texts(name, chosen.collect(), batch.is_none())?;
        }
        self.places(samples, batch, out)
    }

    /// Extent of a column in a batch, or in one sample.
    fn shape(&self, batch: Option<usize>, column: &SampleColumn) -> Vec<usize> {
        let rows = column.offsets.as_ref().map(Vec::len);
        // LeRobot's columns of one number have no axis
        let row = if column.shape == [1] { &[][..] } else { &column.shape };
        batch.into_iter().chain(rows).chain(row.iter().copied()).collect()
    }

    /// Numbers of another type than they have in memory.
    fn converted<T>(&self, column: usize, each: usize, samples: &[u32], out: &mut [T], to: impl Fn(f32) -> T) {
        let mut values = vec![0.0; each];
        for (sample, out) in samples.iter().zip(out.chunks_exact_mut(each.max(1))) {
            self.samples.copy_numbers(column, &[*sample], &mut values);
            out.iter_mut().zip(&values).for_each(|(out, &value)| *out = to(value));
        }
    }

    /// Pictures from 0 to 1, as PyTorch scales them.
    fn bright(&self, camera: usize, each: usize, samples: &[u32], out: &mut [f32]) {
        let scale: Vec<f32> = (0..=255_u8).map(|byte| f32::from(byte) / 255.0).collect();
        let mut bytes = vec![0; each];
        for (sample, out) in samples.iter().zip(out.chunks_exact_mut(each.max(1))) {
            self.samples.copy_pictures(camera, &[*sample], &mut bytes);
            out.iter_mut().zip(&bytes).for_each(|(out, &byte)| *out = scale[usize::from(byte)]);
        }
    }

    fn padding(
        &self,
        samples: &[u32],
        batch: Option<usize>,
        column: &SampleColumn,
        out: &mut impl Columns,
    ) -> PyResult<()> {
        let Some(offsets) = &column.offsets else { return Ok(()) };
        let shape: Vec<usize> = batch.into_iter().chain([offsets.len()]).collect();
        out.add(&format!("{}_is_pad", column.name), &shape, Kind::Flags, |out| {
            self.samples.padding(column, samples, out);
        })
    }

    /// The times of the frames, and the index columns, which follow from where samples lie.
    fn places(&self, samples: &[u32], batch: Option<usize>, out: &mut impl Columns) -> PyResult<()> {
        let places: Vec<_> = samples.iter().map(|&sample| self.samples.place(sample)).collect();
        let shape: Vec<usize> = batch.into_iter().collect();
        let fps = self.dataset.info().fps;
        out.add("timestamp", &shape, Kind::Numbers, |out: &mut [f32]| {
            out.iter_mut().zip(&places).for_each(|(out, place)| {
                *out =
                    self.times.as_ref().map_or_else(|| (place.frame as f64 / fps) as f32, |times| times[place.index]);
            });
        })?;
        let mut set = |name: &str, of: &dyn Fn(&dataset::SamplePlace) -> usize| {
            out.add(name, &shape, Kind::Numbers, |out: &mut [i64]| {
                out.iter_mut().zip(&places).for_each(|(out, place)| *out = of(place) as i64);
            })
        };
        set("frame_index", &|place| place.frame)?;
        set("episode_index", &|place| place.episode)?;
        set("index", &|place| place.index)?;
        let task = |place: &dataset::SamplePlace| match &self.tasks {
            Tasks::None => 0,
            Tasks::OfEpisodes(tasks) => tasks[place.episode],
            Tasks::OfFrames(tasks) => tasks[place.index],
        };
        if matches!(self.tasks, Tasks::None) {
            return Ok(());
        }
        set("task_index", &task)?;
        let texts = places.iter().map(|place| self.dataset.tasks().get(task(place)).map(String::as_str));
        out.texts("task", texts.collect(), batch.is_none())
    }
}

/// `delta_timestamps` in frames: whole numbers count them, floats are seconds.
fn offsets(dataset: &dataset::Dataset, given: &Bound<'_, PyAny>) -> PyResult<BTreeMap<String, Vec<i64>>> {
    let mut all = BTreeMap::new();
    for pair in given.call_method0("items")?.try_iter()? {
        let (name, values): (String, Bound<'_, PyAny>) = pair?.extract()?;
        let values: Vec<Bound<'_, PyAny>> = values.try_iter()?.collect::<PyResult<_>>()?;
        let whole: PyResult<Vec<i64>> = values.iter().map(|value| value.extract()).collect();
        let frames = match whole {
            Ok(frames) => frames,
            Err(_) => {
                let seconds: Vec<f64> = values.iter().map(|value| value.extract()).collect::<PyResult<_>>()?;
                dataset.offsets(&name, &seconds).map_err(raised)?
            }
        };
        all.insert(name, frames);
    }
    Ok(all)
}

/// The tasks that frames state, as LeRobot reads them, else those of episodes that have one; and why there are none.
fn tasks_of(dataset: &dataset::Dataset) -> (Tasks, Option<String>) {
    let index = |episode: &dataset::EpisodeMeta| match episode.tasks.as_slice() {
        [task] => dataset.tasks().iter().position(|text| text == task),
        _ => None,
    };
    match dataset.frame_tasks() {
        Ok(Some(tasks)) => (Tasks::OfFrames(tasks), None),
        Ok(None) => {
            let tasks: Option<_> = dataset.episodes().iter().map(index).collect();
            (tasks.map_or(Tasks::None, Tasks::OfEpisodes), None)
        }
        Err(error) => (Tasks::None, Some(format!("samples have no task: {}", words(&error)))),
    }
}

/// Columns whose whole numbers are rounded, and columns that samples lack.
fn notes(dataset: &dataset::Dataset, samples: &Samples) -> Vec<String> {
    let large = |column: &&SampleColumn| {
        let values = dataset.column(&column.name).map_or(&[][..], |column| column.data);
        column.kind == NumberKind::Whole && values.iter().any(|value| value.abs() >= MOST_WHOLE)
    };
    let rounded = samples.numbers().filter(large);
    let rounded = rounded.map(|c| format!("{}: whole numbers beyond {MOST_WHOLE} are rounded to float32", c.name));
    let features = &dataset.info().features.0;
    let language = features.iter().filter(|(_, feature)| feature.dtype == "language");
    rounded.chain(language.map(|(name, _)| format!("{name}: samples lack columns of language"))).collect()
}
