//! Adding observations, rewards and dones to a raw recording by replaying its states.
//!
//! Every stored state is set in turn, and what is observed there is written in robomimic's layout. What was recorded stays
//! as it was recorded. The same file is written with any number of workers.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use dataset::{Array, RobomimicWriter, Source, WriteOptions};
use rollout::{FaultKind, Pool, Ready, RolloutError, Worker};
use serde_json::Value;

use crate::demo::{Recording, demo};
use crate::error::{RecordingError, Result};

/// What is looked up in the simulator; all else of a demo, such as `action_dict`, stays as it was recorded.
const COMPUTED: [&str; 4] = ["obs", "next_obs", "rewards", "dones"];

/// Attributes of the group `data` that are written anew; all others, such as `seeds`, stay as they were recorded.
const WRITTEN: [&str; 2] = ["total", "env_args"];

/// What to extract and where to put it.
#[derive(Debug, Clone)]
pub struct ExtractOptions {
    /// The raw recording's path, for messages.
    pub raw: PathBuf,
    /// File to create.
    pub out: PathBuf,
    /// Store `next_obs`.
    pub next_obs: bool,
    /// Level of gzip; none stores datasets as they are.
    pub gzip: Option<u8>,
}

/// A file that was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Extracted {
    /// Demonstrations in it.
    pub demos: usize,
    /// Their steps.
    pub steps: u64,
}

/// How an extraction ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExtractEnd {
    /// The file is written.
    Written(Extracted),
    /// It was stopped after so many demonstrations; nothing was written.
    Stopped(usize),
}

/// The task of a recording that can be replayed.
///
/// # Errors
/// A file that names no environment, or a demo without states or actions.
pub fn recorded_task(raw: &Path, source: &Source) -> Result<String> {
    let unfit = |demo: Option<&str>, what: &str, expected: &str| RecordingError::Unfit {
        path: raw.to_owned(),
        demo: demo.map(str::to_owned),
        what: what.to_owned(),
        expected: expected.to_owned(),
        found: "none".to_owned(),
    };
    let plan = source.plan();
    for demo in &plan.demos {
        for key in ["states", "actions"] {
            if !demo.keys.contains_key(key) {
                return Err(unfit(Some(&demo.id), key, "a dataset: replaying needs states and actions"));
            }
        }
    }
    plan.env_name.clone().ok_or_else(|| unfit(None, "the environment's name", "env_args, env_info or env"))
}

/// Refuses a recording of another generation of robosuite: its models do not load there, or mean something else.
fn same_generation(raw: &Path, recorded: Option<&str>, simulator: &str, running: Option<&str>) -> Result<()> {
    let generation = |version: &str| {
        let mut parts = version.split('.').map(|part| part.trim().parse::<u32>().ok());
        Some((parts.next()??, parts.next()??))
    };
    let (Some(recorded), Some(running), "robosuite") = (recorded, running, simulator) else { return Ok(()) };
    match (generation(recorded), generation(running)) {
        (Some(a), Some(b)) if a != b => Err(RecordingError::Unfit {
            path: raw.to_owned(),
            demo: None,
            what: "simulator".to_owned(),
            expected: format!(
                "robosuite {}.{}, which recorded it ({recorded}); --python names one that has it",
                a.0, a.1
            ),
            found: format!("robosuite {running}"),
        }),
        _ => Ok(()),
    }
}

/// What is said of a demo that a worker could not replay.
pub fn replay_error(path: &Path, demo: &str, ready: &Ready, error: RolloutError) -> RecordingError {
    let fault = match error {
        RolloutError::Episode { fault, .. } => fault,
        other => return other.into(),
    };
    let version = ready.simulator_version().map_or(String::new(), |version| format!(" {version}"));
    RecordingError::Replay {
        path: path.to_owned(),
        demo: demo.to_owned(),
        simulator: format!("{}{version}", ready.simulator),
        reason: match fault.kind {
            FaultKind::Reported { message, .. } => message,
            _ => fault.to_string(),
        },
    }
}

/// Replays all demos of `source` with the workers of `pool`; `progress` is told how many are done.
///
/// # Errors
/// A file that is there already or cannot be written, states that the simulator refuses.
pub fn extract(
    source: &Source,
    pool: &mut Pool,
    options: &ExtractOptions,
    progress: &mut dyn FnMut(u64),
) -> Result<ExtractEnd> {
    let plan = source.plan();
    if let Some((_, error)) = plan.lost().next() {
        return Err(dataset::DatasetError::from(error.clone()).into());
    }
    let ready = pool.ready().clone();
    same_generation(&options.raw, plan.env_version.as_deref(), &ready.simulator, ready.simulator_version())?;
    let of_data = source.data_attrs()?;
    let mut writer = RobomimicWriter::create(&options.out, &WriteOptions { gzip: options.gzip })?;
    let env_args = env_args(plan.env_args.as_ref(), &pool.ready().env_args);
    let (mut steps, mut done) = (0_u64, 0_usize);
    let mut failure: Option<RecordingError> = None;
    let work = |(): &mut (), worker: &mut Worker, job: u64| {
        let failed = |source: Box<dyn std::error::Error + Send + Sync>| {
            let operation = "reading the recording";
            RolloutError::Policy { seed: job, step: 0, operation, source }
        };
        let wanted = |key: &str| !COMPUTED.iter().any(|name| key == *name || key.starts_with(&format!("{name}/")));
        let recorded = source.read_demo_where(job as usize, &wanted).map_err(|error| failed(error.into()))?;
        let Recording { model, ep_meta, states, actions } =
            Recording::of(&options.raw, &recorded).map_err(|error| failed(error.into()))?;
        let episode = worker.extract(&model, &ep_meta, states, actions)?;
        Ok((recorded, episode))
    };
    let jobs = plan.demos.len() as u64;
    pool.run(0..jobs, &|job| job, &|| Ok(()), &work, &mut |job, result| {
        let id = &plan.demos[job as usize].id;
        let outcome =
            result.map_err(|error| replay_error(&options.raw, id, &ready, error)).and_then(|(recorded, episode)| {
                steps += episode.steps as u64;
                let mut made = demo(id, episode, options.next_obs)?;
                // what was recorded stays as it was recorded; the worker counted the steps
                made.attrs.extend(recorded.attrs.into_iter().filter(|(name, _)| name != "num_samples"));
                made.datasets.extend(recorded.datasets);
                writer.add_demo(&made)?;
                done += 1;
                Ok(())
            });
        progress(done as u64);
        match outcome {
            Ok(()) => ControlFlow::Continue(()),
            Err(error) => {
                failure = Some(error);
                ControlFlow::Break(())
            }
        }
    })?;
    if let Some(error) = failure {
        return Err(error);
    }
    if done != plan.demos.len() {
        return Ok(ExtractEnd::Stopped(done));
    }
    writer.set_data_attr("total", &Array::from_i64(Vec::new(), &[steps as i64]))?;
    let text = serde_json::to_string_pretty(&env_args).expect("JSON is always text");
    writer.set_data_attr("env_args", &Array::from_str(&text))?;
    for (name, value) in of_data.iter().filter(|(name, _)| !WRITTEN.contains(&name.as_str())) {
        writer.set_data_attr(name, value)?;
    }
    for (name, demos) in &plan.masks {
        writer.set_mask(name, demos)?;
    }
    writer.finish()?;
    Ok(ExtractEnd::Written(Extracted { demos: done, steps }))
}

/// The recording's own arguments where it has them, with the cameras that were rendered now.
fn env_args(recorded: Option<&Value>, now: &Value) -> Value {
    let Some(recorded) = recorded.filter(|v| v.is_object()) else { return now.clone() };
    let mut merged = recorded.clone();
    const OURS: [&str; 5] =
        ["camera_names", "camera_heights", "camera_widths", "use_camera_obs", "has_offscreen_renderer"];
    let kwargs: BTreeMap<&str, &Value> =
        OURS.into_iter().filter_map(|key| Some((key, now.get("env_kwargs")?.get(key)?))).collect();
    if let Some(target) = merged.get_mut("env_kwargs").and_then(Value::as_object_mut) {
        for (key, value) in kwargs {
            target.insert(key.to_owned(), value.clone());
        }
    }
    merged
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_generation_of_robosuite_is_named_with_both_versions() {
        let check = |recorded, simulator, running| same_generation(Path::new("a.hdf5"), recorded, simulator, running);
        for (recorded, running) in [(Some("1.5.0"), Some("1.5.2")), (None, Some("1.5.2")), (Some("x"), Some("1.5.2"))] {
            assert!(check(recorded, "robosuite", running).is_ok(), "{recorded:?} {running:?}");
        }
        assert!(check(Some("1.4.1"), "another", Some("1.5.2")).is_ok());
        let text = check(Some("1.4.1"), "robosuite", Some("1.5.2")).map_or_else(|e| e.to_string(), |()| String::new());
        assert!(text.contains("1.4.1") && text.contains("1.5.2") && text.contains("a.hdf5"), "{text}");
        assert!(!text.contains('\n'), "{text}");
    }
}
