//! Conversion of demonstrations.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::atomic::Ordering;

use dataset::{ActionKind, ConvertOptions, ImageForm, NonFinite, RotationForm, VideoOptions, convert_unless};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::error::{natural, raised};
use crate::work::interruptible;

/// `actrm.convert` without its bar: `tell(done, total)` is called as frames are written.
#[pyfunction]
#[pyo3(signature = (src, dst, tell, *, state_keys, env_keys, entities, fps, images, depth, actions, rotation, nonfinite, skip_bad, lossless, jobs))]
#[expect(clippy::too_many_arguments, reason = "options by name")]
pub(crate) fn convert<'py>(
    py: Python<'py>,
    src: PathBuf,
    dst: PathBuf,
    tell: &Bound<'py, PyAny>,
    state_keys: Option<Vec<String>>,
    env_keys: Option<Vec<String>>,
    entities: BTreeMap<String, Vec<String>>,
    fps: Option<f64>,
    images: &str,
    depth: bool,
    actions: &str,
    rotation: &str,
    nonfinite: &str,
    skip_bad: bool,
    lossless: bool,
    jobs: i128,
) -> PyResult<Bound<'py, PyDict>> {
    let (images, video) = match images {
        "png" => (ImageForm::Png, None),
        "ppm" => (ImageForm::Ppm, None),
        "video" => (ImageForm::default(), Some(VideoOptions::default())),
        other => return Err(unknown("images", "png, ppm or video", other)),
    };
    let actions = match actions {
        "delta" => ActionKind::Delta,
        "absolute" => ActionKind::Absolute,
        other => return Err(unknown("actions", "delta or absolute", other)),
    };
    let rotation = match rotation {
        "axis-angle" => RotationForm::AxisAngle,
        "6d" => RotationForm::SixD,
        other => return Err(unknown("rotation", "axis-angle or 6d", other)),
    };
    let nonfinite = match nonfinite {
        "refuse" => NonFinite::Refuse,
        "keep" => NonFinite::Keep,
        other => return Err(unknown("nonfinite", "refuse or keep", other)),
    };
    let jobs = natural("jobs", jobs)?;
    let options = ConvertOptions {
        state_keys,
        env_keys,
        entities,
        fps,
        images,
        video,
        depth,
        actions,
        rotation,
        nonfinite,
        skip_bad,
        lossless,
        jobs,
        ..ConvertOptions::default()
    };
    let report = interruptible(
        py,
        |stop, news| {
            convert_unless(&src, &dst, &options, &mut |done, total| {
                // nobody listens any more once the other thread has failed
                let _ = news.send((done, total));
                match stop.load(Ordering::SeqCst) {
                    true => ControlFlow::Break(()),
                    false => ControlFlow::Continue(()),
                }
            })
        },
        |(done, total): (u64, u64)| tell.call1((done, total)).map(drop),
    )?
    .map_err(raised)?;
    let summary = PyDict::new(py);
    summary.set_item("layout", report.dialect)?;
    summary.set_item("episodes", report.episodes)?;
    summary.set_item("frames", report.frames)?;
    summary.set_item("tasks", report.tasks)?;
    summary.set_item("files", report.files)?;
    summary.set_item("bytes", report.bytes)?;
    summary.set_item("fingerprint", report.fingerprint)?;
    summary.set_item("notes", report.notes)?;
    let skipped: Vec<(String, String)> = report.skipped.into_iter().map(|s| (s.demo, s.reason)).collect();
    summary.set_item("skipped", skipped)?;
    Ok(summary)
}

fn unknown(option: &str, expected: &str, found: &str) -> PyErr {
    PyValueError::new_err(format!("{option}: expected {expected}, found {found}"))
}
