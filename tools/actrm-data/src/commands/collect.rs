use crate::cameras::CameraArgs;
use anyhow::Result;
use cli::{INTERRUPTED, Screen, SimulatorArgs, Stop};
use recording::{CollectEnd, CollectOptions, CollectProgress, Collected, collect};
use rollout::Skill;
use serde_json::json;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Instant;

const GOES_ON: &str = "stopped; run the same command again to resume";

/// Collect demonstrations of a task from its scripted expert in the simulator.
///
/// Attempt k runs in an environment seeded with 1000000 * SEED + k. Attempts are taken in this order until enough have
/// succeeded. The same command writes the same bytes with any number of workers. Failures are counted and not stored. The file
/// is in robomimic's layout, with masks `train` (90%) and `valid` (10%).
///
/// Attempts are kept in a hidden folder beside the file until it is written. If collection is stopped or killed, the same
/// command resumes it and ends in the same bytes.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data collect --task Lift --episodes 50 --seed 1 --out lift.hdf5
  actrm-data collect --task Stack --episodes 200 --seed 7 --workers 4 --out stack.hdf5
  actrm-data collect --task StackColor --episodes 200 --expert recoveries --out stackcolor.hdf5
  actrm-data collect --task PickPlaceCan --episodes 200 --skill mixed --out can_mixed.hdf5
  actrm-data collect --task Lift --episodes 50 --robots UR5e --out lift_ur5e.hdf5
  actrm-data collect --task Lift --episodes 20 --cameras agentview,robot0_eye_in_hand --out lift_image.hdf5")]
pub struct Args {
    /// Task, as robosuite or the environment module names it
    #[arg(long)]
    task: String,
    /// Demonstrations to store
    #[arg(long, short = 'n', value_name = "N", value_parser = clap::value_parser!(u64).range(1..=CollectOptions::SEED_STRIDE))]
    episodes: u64,
    /// Seed of the whole collection, 1 or more
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    seed: u64,
    /// An expert that makes mistakes and recovers from them. `recoveries`: towers of cubes, the square nut, PickPlace, ToolHang
    /// and TwoArmTransport. `regrasps` also misses grasps of cubes and handle. `misreaches` misses cubes and the square nut at
    /// the last moment
    #[arg(long, value_name = "NAME")]
    expert: Option<String>,
    /// Skill of the scripted expert. `good`: the expert unchanged. `poor`: slow, with hesitation, detours and missed grasps.
    /// `mixed`: each episode draws good, middling or poor, and the demo's attribute `skill` records it
    #[arg(long, default_value_t = Skill::Good)]
    skill: Skill,
    /// Robot in place of the task's own, with its usual controller, such as UR5e; two names with a comma for two arms. The experts
    /// are made for the task's own robot: fewer attempts may succeed
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    robots: Vec<String>,
    /// File to create
    #[arg(long, short)]
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
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let start = Instant::now();
    recording::refuse_existing(&args.out)?;
    let _parents = cli::make_parent(&args.out)?;
    let stop = Stop::install(GOES_ON)?;
    let mut spec = args.simulator.spec(&args.task)?;
    if !args.robots.is_empty() {
        spec.env_args = Some(rollout::robots_of(&args.task, &args.robots));
    }
    args.cameras.set(&mut spec);
    let Some(mut pool) = args.simulator.start(spec, None, &stop)? else {
        cli::note(GOES_ON);
        return Ok(ExitCode::from(INTERRUPTED));
    };
    let options = CollectOptions {
        out: args.out.clone(),
        episodes: args.episodes,
        seed: args.seed,
        env_module: args.simulator.env_module.clone(),
        expert: args.expert.clone(),
        skill: args.skill,
        next_obs: !args.no_next_obs,
        gzip: (args.gzip > 0).then_some(args.gzip),
    };
    let mut screen = Screen::new();
    let mut begun = false;
    let end = collect(&mut pool, &options, &mut |progress| match progress {
        CollectProgress::GoingOn(attempts) => cli::note(&format!("note: going on after {attempts} attempts")),
        CollectProgress::Demos(demos) => {
            if !std::mem::replace(&mut begun, true) {
                screen.begin(format!("collecting {}", args.task), args.episodes);
            }
            screen.at(demos);
        }
    });
    screen.clear();
    cli::close(pool);
    let Collected { demos, steps, attempts, first_seed } = match end? {
        CollectEnd::Written(collected) => collected,
        CollectEnd::Stopped(done) => {
            cli::note(&format!(
                "stopped after {done} of {} demos; run the same command again to resume",
                args.episodes
            ));
            return Ok(ExitCode::from(INTERRUPTED));
        }
    };
    let rate = demos as f64 / attempts as f64;
    let size = std::fs::metadata(&args.out).map_or(0, |m| m.len());
    let seconds = start.elapsed().as_secs_f64();
    if args.json {
        cli::print_json(&json!({
            "out": cli::lossy(&args.out), "task": args.task, "skill": args.skill, "demos": demos, "steps": steps,
            "attempts": attempts, "expert_success_rate": rate, "first_seed": first_seed, "bytes": size,
            "seconds": seconds,
        }))?;
    } else {
        cli::print(&format!(
            "{}: {demos} demos, {} steps, {} in {seconds:.1} s\nexpert: {demos} of {attempts} attempts succeeded ({:.1}%)\n",
            args.out.display(),
            cli::count(steps),
            cli::bytes(size),
            100.0 * rate,
        ))?;
    }
    Ok(ExitCode::SUCCESS)
}
