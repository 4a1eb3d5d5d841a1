use crate::work::STOPPED;
use anyhow::{Context, Result, bail};
use cli::{INTERRUPTED, Screen, SimulatorArgs, Stop, VideoWriter};
use dataset::{Demo, Source, WriteOptions};
use recording::Recording;
use rollout::{FrameTensor, Image, RecordedEpisode, RunEnd, Worker};
use safetensors::Dtype;
use serde_json::json;
use std::ops::{ControlFlow, Range};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Steps that a worker is asked to draw at a time.
const PART: usize = 32;

/// The task whose states do not say what was done before: robosuite counts what is wiped as it looks at one after the other.
const COUNTS_ON: &str = "Wipe";

/// Show a demonstration as a video, by setting its recorded states in the simulator one after the other.
///
/// This works for robomimic files and raw robosuite recordings, and for converted data sets whose side folder `actrm/` keeps the
/// states. Only the step after the last action is simulated. Rendering needs EGL or OSMesa.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data replay lift.hdf5 --demo 3 --video lift_3.mp4
  actrm-data replay lift --demo demo_3 --video lift_3.mp4 --camera frontview --size 512")]
pub struct Args {
    /// File or data set directory
    input: PathBuf,
    /// Number or name of the demonstration
    #[arg(long, value_name = "DEMO")]
    demo: String,
    /// Video to create (AV1 in MP4)
    #[arg(long, value_name = "OUT")]
    video: PathBuf,
    /// Camera of the video
    #[arg(long, value_name = "NAME", default_value = "agentview")]
    camera: String,
    /// Side of the images, in pixels: an even number
    #[arg(long, default_value_t = 256, value_parser = cli::limits::video_side::<1024>)]
    size: u16,
    #[command(flatten)]
    simulator: SimulatorArgs,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

pub fn run(args: &Args) -> Result<ExitCode> {
    recording::refuse_existing(&args.video)?;
    // a data set is taken back to the file that it was made of
    let rebuilt = tempfile::tempdir().context("a folder for the rebuilt file")?;
    let stop = Stop::install(STOPPED)?;
    let folder = rebuilt.path().to_owned();
    stop.last_act(move || drop(std::fs::remove_dir_all(folder)));
    let file = match args.input.is_dir() {
        true => rebuild(&args.input, rebuilt.path())?,
        false => args.input.clone(),
    };
    let (task, env_args, recorded) = read(args, &file)?;
    let id = recorded.id.clone();
    let recording = Recording::of(&args.input, &recorded)?;
    let steps = rows(&recording.actions);
    if steps == 0 || rows(&recording.states) != steps {
        let found = rows(&recording.states);
        bail!("{}: {id}: states: expected {steps} rows, one an action and at least one, found {found}", file.display());
    }

    let mut spec = args.simulator.recorded_spec(&task, env_args.as_ref())?;
    (spec.cameras, spec.image_size) = (vec![args.camera.clone()], usize::from(args.size));
    let Some(mut pool) = args.simulator.start(spec, None, &stop)? else {
        cli::note(STOPPED);
        return Ok(ExitCode::from(INTERRUPTED));
    };
    let size = (usize::from(args.size), usize::from(args.size));
    let ready = pool.ready().clone();
    let rate = ready.control_freq;
    let mut video = VideoWriter::begin(&args.video, size, rate)?;
    let mut screen = Screen::new();
    screen.begin(format!("drawing {id}"), steps as u64);
    let length = if task == COUNTS_ON { steps } else { PART };
    let parts = steps.div_ceil(length);
    let part = |job: u64| job as usize * length..steps.min((job as usize + 1) * length);
    let work = |(): &mut (), worker: &mut Worker, job: u64| {
        let Recording { model, ep_meta, states, actions } = &recording;
        // and the next part's first, which is looked at as it was recorded: what follows the last is simulated
        let rows = part(job).start..steps.min(part(job).end + 1);
        let cut = |tensor: &FrameTensor| slice(tensor, rows.clone());
        Ok(worker.extract(model, ep_meta, cut(states), cut(actions))?)
    };
    let (mut success, mut images) = (false, 0);
    let mut failure: Option<anyhow::Error> = None;
    let end = pool.run(0..parts as u64, &|job| job, &|| Ok(()), &work, &mut |job, result| {
        let last = job + 1 == parts as u64;
        let failed = |error| anyhow::Error::from(recording::replay_error(&args.input, &id, &ready, error));
        let drawn = result.map_err(failed).and_then(|episode| {
            success |= if last { episode.success } else { solved(&episode) };
            let drawn = pictures(&args.camera, size, &episode, last);
            let drawn = drawn.with_context(|| format!("{}: {id}", args.input.display()))?;
            drawn.iter().try_for_each(|image| video.push(image))?;
            images += drawn.len();
            Ok(())
        });
        screen.at(part(job).end as u64);
        match drawn {
            Ok(()) => ControlFlow::Continue(()),
            Err(error) => {
                failure = Some(error);
                ControlFlow::Break(())
            }
        }
    });
    screen.clear();
    cli::close(pool);
    let end = end?;
    if let Some(error) = failure {
        return Err(error);
    }
    if end == RunEnd::Stopped {
        cli::note(&format!("stopped after {images} of {} images; nothing was written", steps + 1));
        return Ok(ExitCode::from(INTERRUPTED));
    }
    video.finish()?;
    if args.json {
        cli::print_json(&json!({
            "video": cli::lossy(&args.video), "task": task, "demo": id, "images": images, "rate": rate, "success": success,
        }))?;
    } else {
        let word = if success { "success" } else { "no success" };
        cli::print(&format!("{}: {task} {id}, {images} images at {rate} Hz, {word}\n", args.video.display()))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn rebuild(set: &Path, folder: &Path) -> Result<PathBuf> {
    let file = folder.join("source.hdf5");
    let mut screen = Screen::new();
    let report = dataset::export(set, &file, &WriteOptions::default(), &mut screen.advance("rebuilding the recording"));
    screen.clear();
    report?;
    Ok(file)
}

/// The task, its environment's arguments and the demo that was asked for, with what replaying needs.
fn read(args: &Args, file: &Path) -> Result<(String, Option<serde_json::Value>, Demo)> {
    let shown = args.input.display();
    let source = Source::open_guarded(file)?;
    let plan = source.plan();
    let Some(task) = plan.env_name.clone() else {
        bail!("{shown}: names no environment: expected env_args, env_info or env");
    };
    let names = [args.demo.clone(), format!("demo_{}", args.demo)];
    let Some(index) = plan.demos.iter().position(|demo| names.contains(&demo.id)) else {
        let (first, last) = (plan.demos.first(), plan.demos.last());
        let range = first.zip(last).map_or("none".to_owned(), |(first, last)| format!("{} to {}", first.id, last.id));
        bail!("{shown}: no demo {:?}; there are {}: {range}", args.demo, plan.demos.len());
    };
    for key in ["states", "actions"] {
        if !plan.demos[index].keys.contains_key(key) {
            bail!("{shown}: {}: no {key}; replaying needs states and actions", plan.demos[index].id);
        }
    }
    let demo = source.read_demo_where(index, &|key| key == "states" || key == "actions")?;
    Ok((task, plan.env_args.clone(), demo))
}

fn rows(tensor: &FrameTensor) -> usize {
    tensor.shape.first().copied().unwrap_or(0)
}

/// Some rows of a matrix.
fn slice(tensor: &FrameTensor, rows: Range<usize>) -> FrameTensor {
    let width = tensor.bytes.len() / tensor.shape[0].max(1);
    let mut shape = tensor.shape.clone();
    shape[0] = rows.len();
    FrameTensor { dtype: tensor.dtype, shape, bytes: tensor.bytes[rows.start * width..rows.end * width].to_vec() }
}

/// Whether the task was solved in a part, whose last step is simulated and does not count.
fn solved(episode: &RecordedEpisode) -> bool {
    let dones = episode.tensors.get("dones").map_or(&[][..], |dones| dones.bytes.as_slice());
    let (dones, _) = dones.as_chunks();
    dones.split_last().is_some_and(|(_, looked_at)| looked_at.iter().any(|done| i64::from_le_bytes(*done) != 0))
}

/// The images of a part; of the last one also what the last action led to, of others without the next one's first.
fn pictures(camera: &str, size: (usize, usize), episode: &RecordedEpisode, last: bool) -> Result<Vec<Image>> {
    let (height, width) = size;
    let take = |group: &str| {
        let name = format!("{group}/{camera}_image");
        match episode.tensors.get(&name) {
            Some(tensor) if tensor.dtype == Dtype::U8 && tensor.shape == [episode.steps, height, width, 3] => {
                Ok(tensor.bytes.chunks_exact(height * width * 3))
            }
            Some(tensor) => {
                bail!("{name}: expected U8[{}, {height}, {width}, 3], found {:?}", episode.steps, tensor.shape)
            }
            None => bail!("{name}: the worker drew nothing"),
        }
    };
    let image = |rgb: &[u8]| Image { height, width, rgb: rgb.to_vec() };
    let mut images: Vec<Image> = take("obs")?.map(image).collect();
    match last {
        true => images.extend(take("next_obs")?.next_back().map(image)),
        false => drop(images.pop()),
    }
    Ok(images)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_rows() {
        let whole = FrameTensor::from_f64(&[3, 2], &[0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
        assert_eq!(slice(&whole, 1..3), FrameTensor::from_f64(&[2, 2], &[2.0, 3.0, 4.0, 5.0]));
        assert_eq!(slice(&whole, 0..0).shape, [0, 2]);
    }

    /// The last step of a part is the simulator's, not the recording's.
    #[test]
    fn a_part_is_solved_where_a_recorded_state_is() {
        let part = |dones: [i64; 3]| {
            let bytes = dones.iter().flat_map(|done| done.to_le_bytes()).collect();
            let dones = FrameTensor { dtype: Dtype::I64, shape: vec![3], bytes };
            let tensors = [("dones".to_owned(), dones)].into();
            RecordedEpisode { success: true, steps: 3, attrs: Default::default(), tensors }
        };
        assert!(solved(&part([0, 1, 1])) && !solved(&part([0, 0, 1])));
    }
}
