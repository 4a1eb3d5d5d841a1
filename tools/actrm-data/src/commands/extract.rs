use crate::recording::{self, CameraArgs, Recording};
use anyhow::{Context, Result, bail};
use cli::{INTERRUPTED, Screen, SimulatorArgs, Stop};
use dataset::{Array, RobomimicWriter, Source, WriteOptions};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::process::ExitCode;
use rollout::RolloutError;

/// Add observations, rewards and dones to a raw robosuite recording by replaying its states.
///
/// The environment named in the file is built by the simulator's workers, every stored state is set in turn, and what
/// is observed there is written in robomimic's layout: obs, next_obs, rewards, dones, with the recorded states, actions
/// and model. Works for every task, with any number of workers, and writes the same bytes with any number.
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
    /// Report as JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let source = Source::open_guarded(&args.raw)?;
    let plan = source.plan();
    let Some(task) = plan.env_name.clone() else {
        bail!("{}: names no environment: expected env_args, env_info or env", args.raw.display());
    };
    for demo in &plan.demos {
        for key in ["states", "actions"] {
            if !demo.keys.contains_key(key) {
                bail!("{}: {}: no {key}; replaying needs states and actions", args.raw.display(), demo.id);
            }
        }
    }
    let mut writer = RobomimicWriter::create(&args.out, &WriteOptions { gzip: (args.gzip > 0).then_some(args.gzip) })?;
    let stop = Stop::install("stopped; nothing was written")?;
    let out = args.out.clone();
    stop.last_act(move || recording::remove_unfinished(&out));
    let mut spec = args.simulator.recorded_spec(&task, plan.env_args.as_ref())?;
    args.cameras.set(&mut spec);
    let Some(mut pool) = args.simulator.start(spec, None, &stop)? else {
        cli::note("stopped; nothing was written");
        return Ok(ExitCode::from(INTERRUPTED));
    };
    let env_args = env_args(plan.env_args.as_ref(), &pool.ready().env_args);

    let mut screen = Screen::new();
    screen.begin(format!("replaying {task}"), plan.demos.len() as u64);
    let mut steps = 0_u64;
    let mut done = 0_usize;
    let mut failure: Option<anyhow::Error> = None;
    let work = |(): &mut (), worker: &mut rollout::Worker, job: u64| {
        let failed = |source: Box<dyn std::error::Error + Send + Sync>| {
            let operation = "reading the recording";
            RolloutError::Policy { seed: job, step: 0, operation, source }
        };
        let wanted = |key: &str| key == "states" || key == "actions";
        let recorded = source.read_demo_where(job as usize, &wanted).map_err(|error| failed(error.into()))?;
        let Recording { model, ep_meta, states, actions } =
            Recording::of(&recorded).map_err(|error| failed(error.into()))?;
        let episode = worker.extract(&model, &ep_meta, states, actions)?;
        Ok((recorded, episode))
    };
    let jobs = plan.demos.len() as u64;
    let end = pool.run(0..jobs, &|job| job, &|| Ok(()), &work, &mut |job, result| {
        let id = &plan.demos[job as usize].id;
        let outcome = result.map_err(anyhow::Error::from).and_then(|(recorded, episode)| {
            steps += episode.steps as u64;
            let mut made = recording::demo(id, episode, !args.no_next_obs)?;
            // what was recorded stays as it was recorded
            for (name, value) in recorded.attrs {
                made.attrs.entry(name).or_insert(value);
            }
            made.datasets.extend(recorded.datasets);
            writer.add_demo(&made)?;
            done += 1;
            Ok(())
        });
        screen.at(done as u64);
        match outcome {
            Ok(()) => ControlFlow::Continue(()),
            Err(error) => {
                failure = Some(error.context(format!("{}: {id}", args.raw.display())));
                ControlFlow::Break(())
            }
        }
    });
    screen.clear();
    cli::close(pool);
    end?;
    if let Some(error) = failure {
        return Err(error);
    }
    if done != plan.demos.len() {
        cli::note(&format!("stopped after {done} of {} demos; nothing was written", plan.demos.len()));
        return Ok(ExitCode::from(INTERRUPTED));
    }
    writer.set_data_attr("total", &Array::from_i64(Vec::new(), &[steps as i64]))?;
    let text = serde_json::to_string_pretty(&env_args).context("environment arguments")?;
    writer.set_data_attr("env_args", &Array::from_str(&text))?;
    for (name, demos) in &plan.masks {
        writer.set_mask(name, demos)?;
    }
    writer.finish()?;
    if args.json {
        cli::print_json(&json!({"out": cli::lossy(&args.out), "task": task, "demos": done, "steps": steps}))?;
    } else {
        cli::print(&format!(
            "{}: {task}, {} demos, {} steps\n",
            args.out.display(),
            cli::count(done),
            cli::count(steps as usize)
        ))?;
    }
    Ok(ExitCode::SUCCESS)
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
