use crate::output;
use anyhow::{Context, Result, bail};
use dataset::shuffle::SplitMix64;
use dataset::{Array, Demo, Dtype, RobomimicWriter, WriteOptions};
use serde_json::json;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;
use zoo::rollout::{self, FrameTensor, Pool, PoolOptions, RecordedEpisode, WorkerSpec};

/// Share of the demonstrations in the mask `valid`.
const VALID_SHARE: f64 = 0.1;
/// Seeds of attempts begin at this multiple of `--seed`; evaluations use seeds far below.
const SEED_STRIDE: u64 = 1_000_000;
/// Attempts for each demonstration wanted, before giving up on the expert.
const ATTEMPTS_PER_EPISODE: u64 = 20;

/// Collect demonstrations of a task from its scripted expert in the simulator.
///
/// Attempt k runs in an environment seeded with 1000000 * SEED + k, and attempts are taken in this order until
/// enough have succeeded, so that the same command writes the same bytes with any number of workers. Failures are
/// counted and not stored. The file is in robomimic's layout, with masks `train` (90%) and `valid` (10%).
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data collect --task Lift --episodes 50 --seed 1 --out lift.hdf5
  actrm-data collect --task Stack --episodes 200 --seed 7 --workers 4 --out stack.hdf5")]
pub struct Args {
    /// Task, as robosuite or the environment module names it
    #[arg(long)]
    task: String,
    /// Demonstrations to store
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    episodes: u64,
    /// Seed of the whole collection, 1 or more
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    seed: u64,
    /// File to create
    #[arg(long)]
    out: PathBuf,
    /// Simulators at once [default: one a core]
    #[arg(long)]
    workers: Option<usize>,
    /// Leave next_obs out
    #[arg(long)]
    no_next_obs: bool,
    /// Compress datasets with gzip of this level; 0 stores them as they are, which is smaller for short demos
    #[arg(long, value_parser = clap::value_parser!(u8).range(0..=9), default_value_t = 0)]
    gzip: u8,
    /// Python with robosuite [default: $ACTRM_PYTHON, else .venv/bin/python here or above, else python3]
    #[arg(long)]
    python: Option<PathBuf>,
    /// Report as JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let start = Instant::now();
    let mut writer = RobomimicWriter::create(&args.out, &WriteOptions { gzip: (args.gzip > 0).then_some(args.gzip) })?;
    let stop = Arc::new(AtomicBool::new(false));
    let raise = Arc::clone(&stop);
    ctrlc::set_handler(move || raise.store(true, Ordering::Relaxed)).context("cannot catch ctrl-C")?;
    let workers = args.workers.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from));
    let python = rollout::find_python(args.python.as_deref())?;
    let spec = WorkerSpec::new(python, rollout::harness_folder()?, &args.task);
    let mut pool = Pool::start(PoolOptions { stop: stopped(stop), ..PoolOptions::new(spec, workers) })?;
    let env_args = serde_json::to_string_pretty(&pool.ready().env_args).context("environment arguments")?;

    let bar = output::bar("demos").with_message(format!("collecting {}", args.task));
    bar.set_length(args.episodes);
    let mut stored: Vec<String> = Vec::new();
    let mut total_steps = 0_u64;
    let mut attempts = 0_u64;
    let mut failure: Option<anyhow::Error> = None;
    let first = args.seed * SEED_STRIDE;
    let most = (args.episodes * ATTEMPTS_PER_EPISODE).min(SEED_STRIDE);
    let end = pool.expert_episodes(0..most, &|attempt| first + attempt, &mut |_, result| {
        attempts += 1;
        let outcome = result.map_err(anyhow::Error::from).and_then(|episode| {
            if !episode.success {
                return Ok(());
            }
            let id = format!("demo_{}", stored.len());
            total_steps += episode.steps as u64;
            writer.add_demo(&demo(&id, episode, !args.no_next_obs)?)?;
            stored.push(id);
            Ok(())
        });
        bar.set_position(stored.len() as u64);
        match outcome {
            Err(error) => {
                failure = Some(error);
                ControlFlow::Break(())
            }
            Ok(()) if stored.len() as u64 == args.episodes => ControlFlow::Break(()),
            Ok(()) => ControlFlow::Continue(()),
        }
    });
    bar.finish_and_clear();
    let end = end?;
    let incidents = pool.incidents().to_vec();
    pool.close();
    for incident in &incidents {
        eprintln!("note: {}", incident.text);
    }
    if let Some(error) = failure {
        return Err(error);
    }
    if stored.len() as u64 != args.episodes {
        match end {
            rollout::RunEnd::Stopped => {
                bail!("stopped after {} of {} demos; nothing was written", stored.len(), args.episodes)
            }
            rollout::RunEnd::Complete => bail!(
                "the expert succeeded in {} of {attempts} attempts at {}: too few for {} demos; nothing was written",
                stored.len(),
                args.task,
                args.episodes
            ),
        }
    }
    writer.set_data_attr("total", &Array::from_i64(Vec::new(), &[total_steps as i64]))?;
    writer.set_data_attr("env_args", &Array::from_str(&env_args))?;
    let (train, valid) = masks(&stored, args.seed);
    writer.set_mask("train", &train)?;
    writer.set_mask("valid", &valid)?;
    writer.finish()?;

    let rate = stored.len() as f64 / attempts as f64;
    let size = std::fs::metadata(&args.out).map_or(0, |m| m.len());
    let seconds = start.elapsed().as_secs_f64();
    if args.json {
        output::print_json(&json!({
            "out": args.out, "task": args.task, "demos": stored.len(), "steps": total_steps, "attempts": attempts,
            "expert_success_rate": rate, "first_seed": first, "bytes": size, "seconds": seconds,
        }))?;
    } else {
        output::print(&format!(
            "{}: {} demos, {} steps, {} in {seconds:.1} s\nexpert: {} of {attempts} attempts succeeded ({:.1}%)\n",
            args.out.display(),
            stored.len(),
            output::count(total_steps as usize),
            output::bytes(size),
            stored.len(),
            100.0 * rate,
        ))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// What the pool asks between jobs.
pub fn stopped(flag: Arc<AtomicBool>) -> Arc<dyn Fn() -> bool + Send + Sync> {
    Arc::new(move || flag.load(Ordering::Relaxed))
}

/// A demo in robomimic's layout from what a worker recorded.
pub fn demo(id: &str, episode: RecordedEpisode, next_obs: bool) -> Result<Demo> {
    let mut demo = Demo { id: id.to_owned(), ..Demo::default() };
    for (name, value) in &episode.attrs {
        let text = match value {
            serde_json::Value::String(text) => text.clone(),
            other => other.to_string(),
        };
        demo.attrs.insert(name.clone(), Array::from_str(&text));
    }
    let steps = i64::try_from(episode.steps).context("number of steps")?;
    demo.attrs.insert("num_samples".to_owned(), Array::from_i64(Vec::new(), &[steps]));
    for (name, tensor) in episode.tensors {
        if next_obs || !name.starts_with("next_obs/") {
            let array = array(&name, tensor)?;
            demo.datasets.insert(name, array);
        }
    }
    Ok(demo)
}

fn array(name: &str, tensor: FrameTensor) -> Result<Array> {
    use safetensors::Dtype as Wire;
    let dtype = match tensor.dtype {
        Wire::F64 => Dtype::F64,
        Wire::F32 => Dtype::F32,
        Wire::I64 => Dtype::I64,
        Wire::U8 => Dtype::U8,
        Wire::BOOL => Dtype::Bool,
        other => bail!("{name}: a worker sent {other:?}, expected numbers that HDF5 files of demonstrations hold"),
    };
    Ok(Array { dtype, shape: tensor.shape, bytes: tensor.bytes })
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
    use super::*;

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
}
