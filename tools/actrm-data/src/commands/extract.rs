use crate::commands::collect::{demo, stopped};
use crate::output;
use anyhow::{Context, Result, bail};
use dataset::{Array, RobomimicWriter, Source, WriteOptions};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use zoo::rollout::{self, FrameTensor, Pool, PoolOptions, RolloutError, WorkerSpec};

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
    /// Cameras to render
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    cameras: Vec<String>,
    /// Side of the images, in pixels
    #[arg(long, default_value_t = 84, value_parser = clap::value_parser!(u16).range(1..=4096))]
    size: u16,
    /// Simulators at once [default: one a core]
    #[arg(long)]
    workers: Option<usize>,
    /// Leave next_obs out
    #[arg(long)]
    no_next_obs: bool,
    /// Compress datasets with gzip of this level; 0 stores them as they are
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
    let stop = Arc::new(AtomicBool::new(false));
    let raise = Arc::clone(&stop);
    ctrlc::set_handler(move || raise.store(true, Ordering::Relaxed)).context("cannot catch ctrl-C")?;
    let workers = args.workers.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from));
    let mut spec = WorkerSpec::new(rollout::find_python(args.python.as_deref())?, rollout::harness_folder()?, &task);
    spec.cameras = args.cameras.clone();
    spec.image_size = usize::from(args.size);
    let mut pool = Pool::start(PoolOptions { stop: stopped(stop), ..PoolOptions::new(spec, workers) })?;
    let env_args = env_args(plan.env_args.as_ref(), &pool.ready().env_args);

    let bar = output::bar("demos").with_message(format!("replaying {task}"));
    bar.set_length(plan.demos.len() as u64);
    let mut steps = 0_u64;
    let mut done = 0_usize;
    let mut failure: Option<anyhow::Error> = None;
    let work = |(): &mut (), worker: &mut rollout::Worker, job: u64| {
        let index = job as usize;
        let failed = |error: dataset::DatasetError| RolloutError::Policy {
            seed: job,
            step: 0,
            operation: "reading the recording",
            source: Box::new(error),
        };
        let recorded = source.read_demo_where(index, &|key| key == "states" || key == "actions").map_err(failed)?;
        let tensor = |key: &str| -> FrameTensor {
            let array = &recorded.datasets[key];
            FrameTensor::from_f64(&array.shape, &array.to_f64().unwrap_or_default())
        };
        let model = recorded.attrs.get("model_file").and_then(Array::to_text).unwrap_or_default();
        let episode = worker.extract(&model, tensor("states"), tensor("actions"))?;
        Ok((recorded, episode))
    };
    let jobs = plan.demos.len() as u64;
    let end = pool.run(0..jobs, &|job| job, &|| Ok(()), &work, &mut |job, result| {
        let id = &plan.demos[job as usize].id;
        let outcome = result.map_err(anyhow::Error::from).and_then(|(recorded, episode)| {
            steps += episode.steps as u64;
            let mut made = demo(id, episode, !args.no_next_obs)?;
            // what was recorded stays as it was recorded
            for (name, value) in recorded.attrs {
                made.attrs.entry(name).or_insert(value);
            }
            made.datasets.extend(recorded.datasets);
            writer.add_demo(&made)?;
            done += 1;
            Ok(())
        });
        bar.set_position(done as u64);
        match outcome {
            Ok(()) => ControlFlow::Continue(()),
            Err(error) => {
                failure = Some(error.context(format!("{}: {id}", args.raw.display())));
                ControlFlow::Break(())
            }
        }
    });
    bar.finish_and_clear();
    end?;
    for incident in pool.incidents() {
        eprintln!("note: {}", incident.text);
    }
    pool.close();
    if let Some(error) = failure {
        return Err(error);
    }
    if done != plan.demos.len() {
        bail!("stopped after {done} of {} demos; nothing was written", plan.demos.len());
    }
    writer.set_data_attr("total", &Array::from_i64(Vec::new(), &[steps as i64]))?;
    let text = serde_json::to_string_pretty(&env_args).context("environment arguments")?;
    writer.set_data_attr("env_args", &Array::from_str(&text))?;
    for (name, demos) in &plan.masks {
        writer.set_mask(name, demos)?;
    }
    writer.finish()?;
    if args.json {
        output::print_json(&json!({"out": args.out, "task": task, "demos": done, "steps": steps}))?;
    } else {
        output::print(&format!(
            "{}: {task}, {} demos, {} steps\n",
            args.out.display(),
            output::count(done),
            output::count(steps as usize)
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
