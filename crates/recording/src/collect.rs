//! Collecting demonstrations of a task from its scripted expert.
//!
//! Attempt k runs in an environment seeded with `1000000 * seed + k`, and attempts are taken in this order until enough
//! have succeeded: the same collection is the same bytes with any number of workers. Attempts are kept in a hidden folder
//! beside the file until it is written, so that a collection that was stopped or killed goes on where it was.

use std::ffi::OsString;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use dataset::shuffle::SplitMix64;
use dataset::{Array, DatasetError, RobomimicWriter, WriteOptions};
use rollout::collection::{Attempt, Collection, CollectionRecord};
use rollout::{Pool, RunEnd, Skill};
use serde_json::Value;

use crate::demo::{demo, of_the_file};
use crate::error::{RecordingError, Result};

/// Share of the demonstrations in the mask `valid`.
const VALID_SHARE: f64 = 0.1;
/// Attempts for each demonstration wanted, before giving up on the expert.
const ATTEMPTS_PER_EPISODE: u64 = 20;

/// What to collect and where to put it.
#[derive(Debug, Clone)]
pub struct CollectOptions {
    /// File to create.
    pub out: PathBuf,
    /// Demonstrations to store, at least one.
    pub episodes: u64,
    /// Seed of the whole collection, at least 1: evaluations use seeds below those that this gives.
    pub seed: u64,
    /// The module of the user's that registers the environment.
    pub env_module: Option<String>,
    /// Another of the task's experts than the usual one, by its name.
    pub expert: Option<String>,
    /// How able whoever shows the demonstrations is.
    pub skill: Skill,
    /// Store `next_obs`.
    pub next_obs: bool,
    /// Level of gzip; none stores datasets as they are.
    pub gzip: Option<u8>,
}

impl CollectOptions {
    /// Seeds of attempts begin at this multiple of the collection's seed.
    pub const SEED_STRIDE: u64 = 1_000_000;
}

/// News from a collection.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CollectProgress {
    /// Attempts of an earlier start are on disk.
    GoingOn(usize),
    /// So many demonstrations are there.
    Demos(u64),
}

/// A collection that was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Collected {
    /// Demonstrations in the file.
    pub demos: usize,
    /// Their steps.
    pub steps: usize,
    /// Attempts that it took.
    pub attempts: u64,
    /// Seed of the first attempt.
    pub first_seed: u64,
}

/// How a collection ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CollectEnd {
    /// The file is written.
    Written(Collected),
    /// It was stopped with so many demonstrations; the same call goes on.
    Stopped(usize),
}

/// Refuses to begin long work whose result would have no place.
///
/// # Errors
/// [`DatasetError::OutputExists`]
pub fn refuse_existing(out: &Path) -> Result<()> {
    match out.symlink_metadata() {
        Ok(_) => Err(DatasetError::OutputExists { path: out.to_owned() }.into()),
        Err(_) => Ok(()),
    }
}

/// Collects with the workers of `pool`, whose task it is.
///
/// # Errors
/// A file that is there already or cannot be written, a simulator that fails for good, an expert that fails too often.
pub fn collect(
    pool: &mut Pool,
    options: &CollectOptions,
    progress: &mut dyn FnMut(CollectProgress),
) -> Result<CollectEnd> {
    refuse_existing(&options.out)?;
    let task = pool.ready().task.clone();
    let first_seed = options.seed * CollectOptions::SEED_STRIDE;
    let record = CollectionRecord::new(pool.ready(), first_seed, options.env_module.clone());
    let record = CollectionRecord { expert: options.expert.clone(), skill: options.skill, ..record };
    let collection = Collection::open(&attempts_folder(&options.out), &record)?;
    let earlier = collection.count()?;
    if earlier > 0 {
        progress(CollectProgress::GoingOn(earlier));
    }
    let mut good: Vec<Attempt> = Vec::new();
    let mut attempts = 0_u64;
    let mut failure = None;
    let most = (options.episodes * ATTEMPTS_PER_EPISODE).min(CollectOptions::SEED_STRIDE);
    let end = collection.run(pool, 0..most, &mut |result| {
        attempts += 1;
        match result {
            Ok(attempt) => good.extend(Some(attempt).filter(|attempt| attempt.success)),
            Err(error) => {
                failure = Some(error);
                return ControlFlow::Break(());
            }
        }
        progress(CollectProgress::Demos(good.len() as u64));
        if good.len() as u64 == options.episodes { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })?;
    if let Some(error) = failure {
        return Err(error.into());
    }
    if good.len() as u64 != options.episodes {
        if end == RunEnd::Stopped {
            return Ok(CollectEnd::Stopped(good.len()));
        }
        let (successes, wanted, kept) = (good.len(), options.episodes, attempts_folder(&options.out));
        return Err(RecordingError::TooFewSuccesses { task, successes, attempts, wanted, kept });
    }
    let env_args = with_rate(record.env_args.clone(), pool.ready().control_freq);
    write(&task, options, &collection, &good, &env_args)?;
    collection.discard()?;
    let steps = good.iter().map(|attempt| attempt.steps).sum();
    Ok(CollectEnd::Written(Collected { demos: good.len(), steps, attempts, first_seed }))
}

/// Where attempts are kept until the file is written.
fn attempts_folder(out: &Path) -> PathBuf {
    let mut name = OsString::from(".");
    name.push(out.file_name().unwrap_or_default());
    name.push(".attempts");
    out.with_file_name(name)
}

/// robosuite's `env_args` with the control frequency, which it leaves out where it is the default.
fn with_rate(mut env_args: Value, control_freq: f64) -> Value {
    const ROBOSUITE: i64 = 1;
    let robosuite = env_args["type"].as_i64() == Some(ROBOSUITE);
    if let Some(kwargs) = env_args.get_mut("env_kwargs").and_then(Value::as_object_mut).filter(|_| robosuite) {
        let whole = control_freq.fract() == 0.0 && control_freq.abs() < 1e9;
        let rate = if whole { Value::from(control_freq as i64) } else { Value::from(control_freq) };
        kwargs.entry("control_freq").or_insert(rate);
    }
    env_args
}

/// Writes the file from the attempts that succeeded.
fn write(
    task: &str,
    options: &CollectOptions,
    collection: &Collection,
    good: &[Attempt],
    env_args: &Value,
) -> Result<()> {
    let mut writer = RobomimicWriter::create(&options.out, &WriteOptions { gzip: options.gzip })?;
    let mut ids = Vec::new();
    for (index, attempt) in good.iter().enumerate() {
        let id = format!("demo_{index}");
        let lost = || RecordingError::LostAttempt { task: task.to_owned(), attempt: attempt.index };
        let episode = collection.get(attempt.index)?.ok_or_else(lost)?;
        for (name, value) in of_the_file(&episode).filter(|_| index == 0) {
            writer.set_data_attr(name, &value)?;
        }
        writer.add_demo(&demo(&id, episode, options.next_obs)?)?;
        ids.push(id);
    }
    let total: usize = good.iter().map(|attempt| attempt.steps).sum();
    let total = i64::try_from(total).expect("demonstrations have fewer steps than 2^63");
    let env_args = serde_json::to_string_pretty(env_args).expect("JSON is always text");
    writer.set_data_attr("total", &Array::from_i64(Vec::new(), &[total]))?;
    writer.set_data_attr("env_args", &Array::from_str(&env_args))?;
    // an evaluation of a policy that learned from these must not begin as they did; failed attempts count, too
    let first_seed = options.seed * CollectOptions::SEED_STRIDE;
    let last = good.last().map_or(0, |attempt| attempt.index);
    writer.set_data_attr("seeds", &Array::from_str(&format!("{first_seed}-{}", first_seed + last)))?;
    if let Some(expert) = &options.expert {
        writer.set_data_attr("expert", &Array::from_str(expert))?;
    }
    // who showed a demonstration, its own attribute says
    if !options.skill.is_good() {
        writer.set_data_attr("skill", &Array::from_str(options.skill.as_str()))?;
    }
    let (train, valid) = masks(&ids, options.seed);
    writer.set_mask("train", &train)?;
    writer.set_mask("valid", &valid)?;
    writer.finish()?;
    Ok(())
}

/// Ids of the masks `train` and `valid`: a shuffle by the collection's seed decides.
fn masks(ids: &[String], seed: u64) -> (Vec<String>, Vec<String>) {
    let mut order: Vec<usize> = (0..ids.len()).collect();
    SplitMix64::new(seed, 1).shuffle(&mut order);
    let valid = ((ids.len() as f64 * VALID_SHARE).round() as usize).min(ids.len().saturating_sub(1));
    let (mut train, mut held) = (order[valid..].to_vec(), order[..valid].to_vec());
    train.sort_unstable();
    held.sort_unstable();
    let names = |indices: Vec<usize>| indices.into_iter().map(|i| ids[i].clone()).collect();
    (names(train), names(held))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn the_control_frequency_is_recorded_where_robosuite_leaves_it_out() {
        let robosuite = |kwargs: Value| json!({"type": 1, "env_kwargs": kwargs});
        assert_eq!(with_rate(robosuite(json!({})), 20.0), robosuite(json!({"control_freq": 20})));
        assert_eq!(with_rate(robosuite(json!({})), 12.5), robosuite(json!({"control_freq": 12.5})));
        assert_eq!(with_rate(robosuite(json!({"control_freq": 10})), 20.0), robosuite(json!({"control_freq": 10})));
        for other in [json!({"type": 2, "env_kwargs": {}}), json!({"type": 1}), Value::Null] {
            assert_eq!(with_rate(other.clone(), 20.0), other);
        }
    }

    #[test]
    fn masks_split_the_demos_once_and_by_seed() {
        let ids: Vec<String> = (0..50).map(|i| format!("demo_{i}")).collect();
        let (train, valid) = masks(&ids, 1);
        assert_eq!((train.len(), valid.len()), (45, 5));
        let mut all: Vec<String> = train.iter().chain(&valid).cloned().collect();
        all.sort();
        let mut expected = ids.clone();
        expected.sort();
        assert_eq!(all, expected);
        assert_eq!(masks(&ids, 1), masks(&ids, 1));
        assert_ne!(masks(&ids, 1), masks(&ids, 2));
        assert_eq!(masks(&ids[..1], 1).1.len(), 0);
    }

    #[test]
    fn attempts_lie_beside_the_file() {
        assert_eq!(attempts_folder(Path::new("a/lift.hdf5")), Path::new("a/.lift.hdf5.attempts"));
        assert_eq!(attempts_folder(Path::new("lift.hdf5")), Path::new(".lift.hdf5.attempts"));
    }
}
