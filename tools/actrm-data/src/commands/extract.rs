use crate::cameras::CameraArgs;
use crate::work::{STOPPED, Work};
use anyhow::Result;
use cli::{INTERRUPTED, Screen, SimulatorArgs};
use dataset::Source;
use recording::{ExtractEnd, ExtractOptions, extract, recorded_task};
use serde_json::json;
use std::path::PathBuf;
use std::process::ExitCode;

/// Add observations, rewards and dones to a raw robosuite recording by replaying its states.
///
/// The simulator's workers build the environment named in the file and set every stored state in turn. The observations are
/// written in robomimic's layout: obs, next_obs, rewards and dones, with the recorded states, actions and model. This works for
/// every task and writes the same bytes with any number of workers.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data extract demo.hdf5 low_dim.hdf5
  actrm-data extract demo.hdf5 image.hdf5 --cameras agentview,robot0_eye_in_hand --size 84")]
pub struct Args {
    /// Raw recording
    raw: PathBuf,
    /// File to create
    out: PathBuf,
    #[command(flatten)]
    cameras: CameraArgs,
    #[command(flatten)]
    simulator: SimulatorArgs,
    /// Leave next_obs out
    #[arg(long)]
    no_next_obs: bool,
    /// Compress datasets with gzip of this level; 0 stores them as they are
    #[arg(long, value_parser = clap::value_parser!(u8).range(0..=9), default_value_t = 0)]
    gzip: u8,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let source = Source::open_guarded(&args.raw)?;
    let task = recorded_task(&args.raw, &source)?;
    recording::refuse_existing(&args.out)?;
    let work = Work::begin(&args.out)?;
    let mut spec = args.simulator.recorded_spec(&task, source.plan().env_args.as_ref())?;
    args.cameras.set(&mut spec);
    let Some(mut pool) = args.simulator.start(spec, None, work.stop())? else {
        cli::note(STOPPED);
        return Ok(ExitCode::from(INTERRUPTED));
    };
    let options = ExtractOptions {
        raw: args.raw.clone(),
        out: args.out.clone(),
        next_obs: !args.no_next_obs,
        gzip: (args.gzip > 0).then_some(args.gzip),
    };
    let total = source.plan().demos.len();
    let mut screen = Screen::new();
    screen.begin(format!("replaying {task}"), total as u64);
    let end = extract(&source, &mut pool, &options, &mut |done| screen.at(done));
    screen.clear();
    cli::close(pool);
    let extracted = match end? {
        ExtractEnd::Written(extracted) => extracted,
        ExtractEnd::Stopped(done) => {
            cli::note(&format!("stopped after {done} of {total} demos; nothing was written"));
            return Ok(ExitCode::from(INTERRUPTED));
        }
    };
    let (demos, steps) = (extracted.demos, extracted.steps);
    if args.json {
        cli::print_json(&json!({"out": cli::lossy(&args.out), "task": task, "demos": demos, "steps": steps}))?;
    } else {
        let (demos, steps) = (cli::count(demos), cli::count(steps as usize));
        cli::print(&format!("{}: {task}, {demos} demos, {steps} steps\n", args.out.display()))?;
    }
    Ok(ExitCode::SUCCESS)
}
