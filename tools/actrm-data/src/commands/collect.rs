use crate::recording::{self, CameraArgs};
use anyhow::{Context, Result, bail};
use cli::{INTERRUPTED, Screen, SimulatorArgs, Stop};
use dataset::shuffle::SplitMix64;
use dataset::{Array, RobomimicWriter, WriteOptions};
use rollout::RunEnd;
use rollout::collection::{Attempt, Collection, CollectionRecord};
use serde_json::json;
use std::ffi::OsString;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

/// Share of the demonstrations in the mask `valid`.
const VALID_SHARE: f64 = 0.1;
/// Seeds of attempts begin at this multiple of `--seed`; evaluations use seeds far below.
const SEED_STRIDE: u64 = 1_000_000;
/// Attempts for each demonstration wanted, before giving up on the expert.
const ATTEMPTS_PER_EPISODE: u64 = 20;
const GOES_ON: &str = "stopped; the same command goes on where it was";

/// Collect demonstrations of a task from its scripted expert in the simulator.
///
/// Attempt k runs in an environment seeded with 1000000 * SEED + k, and attempts are taken in this order until
/// enough have succeeded, so that the same command writes the same bytes with any number of workers. Failures are
/// counted and not stored. The file is in robomimic's layout, with masks `train` (90%) and `valid` (10%).
///
/// Attempts are kept in a hidden folder beside the file until it is written: stopped or killed, the same command goes on
/// where it was, and ends in the same bytes.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data collect --task Lift --episodes 50 --seed 1 --out lift.hdf5
  actrm-data collect --task Stack --episodes 200 --seed 7 --workers 4 --out stack.hdf5
  actrm-data collect --task Lift --episodes 20 --cameras agentview,robot0_eye_in_hand --out lift_image.hdf5")]
pub struct Args {
    /// Task, as robosuite or the environment module names it
    #[arg(long)]
    task: String,
    /// Demonstrations to store
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=SEED_STRIDE))]
    episodes: u64,
    /// Seed of the whole collection, 1 or more
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    seed: u64,
    /// File to create
    #[arg(long)]
    out: PathBuf,
    #[command(flatten)]
    cameras: CameraArgs,
    #[command(flatten)]
    simulator: SimulatorArgs,
    /// Leave next_obs out
    #[arg(long)]
    no_next_obs: bool,
    /// Compress datasets with gzip of this level; 0 stores them as they are, which is smaller for short demos
    #[arg(long, value_parser = clap::value_parser!(u8).range(0..=9), default_value_t = 0)]
    gzip: u8,
    /// Report as JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let start = Instant::now();
    recording::refuse_existing(&args.out)?;
    let stop = Stop::install(GOES_ON)?;
    let mut spec = args.simulator.spec(&args.task)?;
    args.cameras.set(&mut spec);
    let Some(mut pool) = args.simulator.start(spec, None, &stop)? else {
        cli::note(GOES_ON);
        return Ok(ExitCode::from(INTERRUPTED));
    };
    let first = args.seed * SEED_STRIDE;
    let record = CollectionRecord::new(pool.ready(), first, args.simulator.env_module.clone());
    let collection = Collection::open(&attempts_folder(&args.out), &record)?;
    let earlier = collection.count()?;
    if earlier > 0 {
        cli::note(&format!("note: going on after {earlier} attempts"));
    }

    let mut screen = Screen::new();
    screen.begin(format!("collecting {}", args.task), args.episodes);
    let mut good: Vec<Attempt> = Vec::new();
    let mut attempts = 0_u64;
    let mut failure = None;
    let most = (args.episodes * ATTEMPTS_PER_EPISODE).min(SEED_STRIDE);
    let end = collection.run(&mut pool, 0..most, &mut |result| {
        attempts += 1;
        match result {
            Ok(attempt) => good.extend(Some(attempt).filter(|attempt| attempt.success)),
            Err(error) => {
                failure = Some(error);
                return ControlFlow::Break(());
            }
        }
        screen.at(good.len() as u64);
        if good.len() as u64 == args.episodes { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    screen.clear();
    cli::close(pool);
    let end = end?;
    if let Some(error) = failure {
        return Err(error.into());
    }
    if good.len() as u64 != args.episodes {
        match end {
            RunEnd::Stopped => {
                let (done, wanted) = (good.len(), args.episodes);
                cli::note(&format!("stopped after {done} of {wanted} demos; the same command goes on where it was"));
                return Ok(ExitCode::from(INTERRUPTED));
            }
            RunEnd::Complete => {
                collection.discard()?;
                bail!(
                    "the expert succeeded in {} of {attempts} attempts at {}: too few for {} demos; nothing was written",
                    good.len(),
                    args.task,
                    args.episodes
                )
            }
        }
    }
    write(args, &collection, &good, &record.env_args)?;
    collection.discard()?;

    let total_steps: usize = good.iter().map(|attempt| attempt.steps).sum();
    let rate = good.len() as f64 / attempts as f64;
    let size = std::fs::metadata(&args.out).map_or(0, |m| m.len());
    let seconds = start.elapsed().as_secs_f64();
    if args.json {
        cli::print_json(&json!({
            "out": cli::lossy(&args.out), "task": args.task, "demos": good.len(), "steps": total_steps, "attempts": attempts,
            "expert_success_rate": rate, "first_seed": first, "bytes": size, "seconds": seconds,
        }))?;
    } else {
        cli::print(&format!(
            "{}: {} demos, {} steps, {} in {seconds:.1} s\nexpert: {} of {attempts} attempts succeeded ({:.1}%)\n",
            args.out.display(),
            good.len(),
            cli::count(total_steps),
            cli::bytes(size),
            good.len(),
            100.0 * rate,
        ))?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Where attempts are kept until the file is written.
fn attempts_folder(out: &Path) -> PathBuf {
    let mut name = OsString::from(".");
    name.push(out.file_name().unwrap_or_default());
    name.push(".attempts");
    out.with_file_name(name)
}

/// Writes the file from the attempts that succeeded.
fn write(args: &Args, collection: &Collection, good: &[Attempt], env_args: &serde_json::Value) -> Result<()> {
    let options = WriteOptions { gzip: (args.gzip > 0).then_some(args.gzip) };
    let mut writer = RobomimicWriter::create(&args.out, &options)?;
    let mut ids = Vec::new();
    for (index, attempt) in good.iter().enumerate() {
        let id = format!("demo_{index}");
        let episode = collection.get(attempt.index)?;
        let episode = episode.with_context(|| format!("attempt {} is not on disk any more", attempt.index))?;
        writer.add_demo(&recording::demo(&id, episode, !args.no_next_obs)?)?;
        ids.push(id);
    }
    let total = i64::try_from(good.iter().map(|attempt| attempt.steps).sum::<usize>()).context("number of steps")?;
    let env_args = serde_json::to_string_pretty(env_args).context("environment arguments")?;
    writer.set_data_attr("total", &Array::from_i64(Vec::new(), &[total]))?;
    writer.set_data_attr("env_args", &Array::from_str(&env_args))?;
    let (train, valid) = masks(&ids, args.seed);
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

    #[test]
    fn attempts_lie_beside_the_file() {
        assert_eq!(attempts_folder(Path::new("a/lift.hdf5")), Path::new("a/.lift.hdf5.attempts"));
        assert_eq!(attempts_folder(Path::new("lift.hdf5")), Path::new(".lift.hdf5.attempts"));
    }
}
