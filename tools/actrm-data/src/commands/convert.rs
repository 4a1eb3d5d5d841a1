use crate::work::Work;
use anyhow::{Result, anyhow, bail};
use dataset::{
    ActionKind, ConvertOptions, ConvertReport, DatasetError, ImageForm, InputError, NonFinite, RotationForm, Shard,
    VideoOptions, WriteOptions,
};
use serde_json::json;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

/// Convert demonstrations into a LeRobotDataset v3.0 directory, or into robomimic HDF5.
///
/// The layout is recognised by its content. robomimic, robosuite, MimicGen, Isaac Lab, LIBERO, robocasa and D4RL have many demos
/// in a file. ALOHA, RoboTwin and DROID have a folder of episodes, ManiSkill a file with JSON beside it. A folder of LIBERO files
/// becomes one data set. Isaac Lab without observations gets them from its states. BEHAVIOR without observations is refused.
/// Where observation keys are the recorder's own, observation.state takes all vectors, and a note lists them.
///
/// Other sources are zarr v2 replay buffers, RLDS data sets, and LeRobot v2.0 or v2.1 folders. A zarr store (Diffusion Policy, UMI)
/// may be a folder or a zip file. An RLDS data set is the folder with features.json that tensorflow-datasets writes. Of a LeRobot
/// v2.x folder columns stay as they are; its videos are joined (AV1) or copied (H.264), never encoded again.
///
/// Columns: observation.state, observation.environment_state, observation.entity.<name>, observation.images.<camera>, action, next.reward,
/// next.done, next.success, mistake (of a demo that marks its mistakes), and the five index columns. What the format has no place for is kept in the side folder
/// `actrm/`, from which `actrm-data export` rebuilds the source. So are grey and RGBA images, which LeRobot does not
/// record, and a note says so. Recorded JPEG files (newer ALOHA) stay the files they are. Depth (obs/<camera>_depth: float
/// metres or uint16 millimetres, height x width x 1) becomes observation.images.<camera>_depth, a TIFF file a frame, as
/// LeRobot records it. No file says its unit, and robosuite's own camera_depths, before robomimic makes metres of them,
/// go from 0 to 1. OUT appears whole or not at all.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-data convert data/lift.hdf5 lift
  actrm-data convert image.hdf5 set --images ppm --jobs 2
  actrm-data convert image.hdf5 set --video
  actrm-data convert replay.zarr.zip umi --fps 20
  actrm-data convert can.hdf5 can --state-keys robot0_eef_pos,robot0_gripper_qpos --env-keys object
  actrm-data convert stack.hdf5 stack --entity \"a=cubeA_pos,cubeA_pos - robot0_eef_pos\"
  actrm-data convert square.hdf5 square --actions absolute --rotation 6d
  actrm-data convert recorded recorded.hdf5 --to robomimic
  actrm-data convert many.hdf5 parts/2 --shard 2/8   # on one of 8 machines; then actrm-data merge many parts/*")]
pub struct Args {
    /// HDF5 file, or a folder with one file an episode or a task; zarr store, RLDS or LeRobot v2.x folder
    source: PathBuf,
    /// Directory to create, or HDF5 file
    out: PathBuf,
    /// What to write [default: robomimic where OUT ends in .hdf5 or .h5, else lerobot]
    #[arg(long, value_enum, value_name = "FORMAT")]
    to: Option<Format>,
    /// With --to robomimic: compress datasets with gzip of this level
    #[arg(long, value_parser = clap::value_parser!(u8).range(1..=9), value_name = "LEVEL")]
    gzip: Option<u8>,
    /// Observation keys of observation.state, in order [default: those of the file's layout]
    #[arg(long, value_delimiter = ',', value_name = "KEYS")]
    state_keys: Option<Vec<String>>,
    /// Observation keys of observation.environment_state, in order; "" makes no such column. instruction_words is made
    /// of the instruction of LIBERO's own files [default: object, where there is one]
    #[arg(long, value_delimiter = ',', value_name = "KEYS")]
    env_keys: Option<Vec<String>>,
    /// An entity: observation.entity.NAME of these observation keys, of parts of them (key[0:3]), of differences
    /// ("a - b"), of what an episode began with ("first(key)") and of a quaternion's axes ("axes(key)"). May be given
    /// again
    #[arg(long = "entity", value_name = "NAME=KEYS", value_parser = entity)]
    entities: Vec<(String, Vec<String>)>,
    /// Frames a second [default: the control frequency that the file states, or the usual one of its layout]
    #[arg(long, allow_negative_numbers = true)]
    fps: Option<f64>,
    /// How to store images
    #[arg(long, value_enum, default_value_t = Images::Png)]
    images: Images,
    /// Store images as videos (AV1 unless --video-encoder says otherwise), which are small and not exact; the side folder keeps the exact images
    #[arg(long, conflicts_with = "images")]
    video: bool,
    /// With --video: AV1 by FFmpeg, H.264 by FFmpeg, or AV1 without FFmpeg, which is slower. FFmpeg is the program that
    /// ACTRM_FFMPEG names, or `ffmpeg` on the PATH [default: libsvtav1 where FFmpeg has it, else builtin]
    #[arg(long, value_enum, value_name = "ENCODER", requires = "video")]
    video_encoder: Option<VideoEncoder>,
    /// With --video: 1 (large, nearly exact) to 255 (small)
    #[arg(long, value_name = "N", default_value_t = VideoOptions::default().quantizer, requires = "video", value_parser = clap::value_parser!(u8).range(1..))]
    quantizer: u8,
    /// With --video: 0 (slow, small) to 10
    #[arg(long, value_name = "N", default_value_t = VideoOptions::default().speed, requires = "video", value_parser = clap::value_parser!(u8).range(..=10))]
    video_speed: u8,
    /// With --video: leave the exact images out of the side folder. It is smaller, but the source cannot be rebuilt
    #[arg(long, requires = "video")]
    no_side_pictures: bool,
    /// Make no columns of depth: the side folder alone keeps it, whatever its values
    #[arg(long)]
    no_depth: bool,
    /// Which actions to take: as the controller got them, or absolute poses (actions_abs)
    #[arg(long, value_enum, default_value_t = Actions::Delta)]
    actions: Actions,
    /// How to write rotations in actions
    #[arg(long, value_enum, default_value_t = Rotation::AxisAngle)]
    rotation: Rotation,
    /// Values that are NaN or infinite, or too large for the float32 of their column: refuse the file, naming demo, key and
    /// step, or keep them. Statistics are those of the finite values
    #[arg(long, value_enum, default_value_t = Nonfinite::Refuse)]
    nonfinite: Nonfinite,
    /// Leave out demos that cannot be converted and say why, instead of refusing the file. A key counts as wanted when half
    /// of the demos have it
    #[arg(long)]
    skip_bad: bool,
    /// Leave the side folder out: smaller, but the source cannot be rebuilt
    #[arg(long)]
    no_lossless: bool,
    /// Size at which a data file is closed, in MiB
    #[arg(long, value_name = "MIB", default_value_t = FILE_SIZE, value_parser = positive)]
    file_size: f64,
    /// Size at which a video file is closed, in MiB
    #[arg(long, value_name = "MIB", default_value_t = 200.0, requires = "video", value_parser = positive)]
    video_file_size: f64,
    /// Convert one of N parts of the episodes into the folder OUT, which `actrm-data merge` takes. All parts come to the bytes of
    /// one run. A part that OUT holds already is left as it is
    #[arg(long, value_name = "I/N", conflicts_with = "skip_bad")]
    shard: Option<Shard>,
    /// With --shard: convert nothing, print the files of SOURCE that the part needs
    #[arg(long, requires = "shard")]
    list_files: bool,
    /// Threads [default: one a core]
    #[arg(long, default_value_t = 0, hide_default_value = true)]
    jobs: usize,
    /// Report as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, PartialEq, clap::ValueEnum)]
enum Format {
    Lerobot,
    Robomimic,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum VideoEncoder {
    #[value(name = "libsvtav1", alias = "ffmpeg")]
    SvtAv1,
    H264,
    Builtin,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Images {
    Png,
    Ppm,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Nonfinite {
    Refuse,
    Keep,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Actions {
    Delta,
    Absolute,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Rotation {
    AxisAngle,
    #[value(name = "6d")]
    SixD,
}

/// `--env-keys ""` gives no keys, which makes no column.
fn keys(given: &[String]) -> Vec<String> {
    given.iter().filter(|key| !key.is_empty()).cloned().collect()
}

/// `cube0=cube0_pos,cube0_pos - robot0_eef_pos`
fn entity(text: &str) -> Result<(String, Vec<String>), String> {
    let (name, items) = text.split_once('=').ok_or("expected NAME=KEYS")?;
    Ok((name.to_owned(), items.split(',').map(|item| item.trim().to_owned()).collect()))
}

/// What an option says of each name, which may be given once.
pub(super) fn once<T: Clone>(option: &str, pairs: &[(String, T)]) -> Result<BTreeMap<String, T>> {
    let mut all = BTreeMap::new();
    for (name, value) in pairs {
        if all.insert(name.clone(), value.clone()).is_some() {
            bail!("{option} {name}=... is given twice; expected each name once");
        }
    }
    Ok(all)
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(v) if v.is_finite() && v > 0.0 => Ok(v),
        _ => Err("expected a number above 0".to_owned()),
    }
}

/// Demonstrations become robomimic HDF5 as they are: what chooses or changes columns is refused.
fn refuse_choices(args: &Args, set: bool) -> Result<()> {
    let Args { state_keys, env_keys, entities, fps, images, video, no_depth, .. } = args;
    let Args { actions, rotation, nonfinite, skip_bad, no_lossless, file_size, shard, .. } = args;
    let given = [
        (state_keys.is_some(), "--state-keys"),
        (env_keys.is_some(), "--env-keys"),
        (!entities.is_empty(), "--entity"),
        (fps.is_some(), "--fps"),
        (!matches!(images, Images::Png), "--images"),
        (*video, "--video"),
        (*no_depth, "--no-depth"),
        (!matches!(actions, Actions::Delta), "--actions"),
        (!matches!(rotation, Rotation::AxisAngle), "--rotation"),
        (set && !matches!(nonfinite, Nonfinite::Refuse), "--nonfinite"),
        (*skip_bad, "--skip-bad"),
        (*no_lossless, "--no-lossless"),
        (*file_size != FILE_SIZE, "--file-size"),
        (shard.is_some(), "--shard"),
    ];
    match given.into_iter().find(|(given, _)| *given) {
        None => Ok(()),
        Some((_, option)) => {
            bail!("{option} is for --to lerobot; a data set that it wrote becomes robomimic HDF5 after it")
        }
    }
}

/// Size at which a data file is closed, in MiB.
const FILE_SIZE: f64 = 100.0;

/// Writes a robomimic file, of a LeRobot data set or of demonstrations of any layout.
fn to_robomimic(args: &Args) -> Result<ExitCode> {
    let export =
        super::export::Args { dir: args.source.clone(), out: args.out.clone(), gzip: args.gzip, json: args.json };
    let set = args.source.join("meta/info.json").exists();
    refuse_choices(args, set)?;
    if set {
        return super::export::run(&export);
    }
    let nonfinite = args.nonfinite.into();
    let _work = Work::begin(&args.out)?;
    let mut screen = cli::Screen::new();
    let options = WriteOptions { gzip: args.gzip };
    let report = dataset::rewrite(&args.source, &args.out, nonfinite, &options, &mut screen.advance("converting"));
    screen.clear();
    super::export::tell(&export, report.map_err(|error| advised(error, None))?)
}

impl From<Nonfinite> for NonFinite {
    fn from(choice: Nonfinite) -> Self {
        match choice {
            Nonfinite::Refuse => Self::Refuse,
            Nonfinite::Keep => Self::Keep,
        }
    }
}

pub fn run(args: &Args) -> Result<ExitCode> {
    let file = args.out.extension().is_some_and(|extension| extension == "hdf5" || extension == "h5");
    let robomimic = args.to == Some(Format::Robomimic) || (args.to.is_none() && file);
    if robomimic {
        return to_robomimic(args);
    }
    if args.gzip.is_some() {
        bail!("--gzip is for --to robomimic");
    }
    let options = ConvertOptions {
        state_keys: args.state_keys.as_deref().map(keys),
        env_keys: args.env_keys.as_deref().map(keys),
        entities: once("--entity", &args.entities)?,
        fps: args.fps,
        images: match args.images {
            Images::Png => ImageForm::Png,
            Images::Ppm => ImageForm::Ppm,
        },
        depth: !args.no_depth,
        actions: match args.actions {
            Actions::Delta => ActionKind::Delta,
            Actions::Absolute => ActionKind::Absolute,
        },
        rotation: match args.rotation {
            Rotation::AxisAngle => RotationForm::AxisAngle,
            Rotation::SixD => RotationForm::SixD,
        },
        video: args.video.then(|| VideoOptions {
            encoder: match args.video_encoder {
                None => dataset::VideoEncoder::Auto,
                Some(VideoEncoder::SvtAv1) => dataset::VideoEncoder::SvtAv1,
                Some(VideoEncoder::H264) => dataset::VideoEncoder::H264,
                Some(VideoEncoder::Builtin) => dataset::VideoEncoder::Builtin,
            },
            speed: args.video_speed,
            quantizer: args.quantizer,
            side_pictures: !args.no_side_pictures,
            ..VideoOptions::default()
        }),
        nonfinite: args.nonfinite.into(),
        skip_bad: args.skip_bad,
        lossless: !args.no_lossless,
        jobs: args.jobs,
        data_file_mb: args.file_size,
        video_file_mb: args.video_file_size,
    };
    if let Some(shard) = args.shard {
        return convert_shard(args, &options, shard);
    }
    let work = Work::begin(&args.out)?;
    let start = Instant::now();
    let mut screen = cli::Screen::new();
    let mut advance = screen.advance("converting");
    let report = dataset::convert_unless(&args.source, &args.out, &options, &mut |done, total| {
        advance(done, total);
        work.goes_on()
    });
    drop(advance);
    screen.clear();
    let set = args.source.join("meta/info.json").exists();
    let report = report
        .map_err(|error| advised(error, (!args.skip_bad && !set).then_some("--skip-bad leaves such demos out")))?;
    let source = Some(args.source.as_path());
    tell(&report, source, &args.out, start.elapsed().as_secs_f64(), args.json)
}

/// An error with what can be done about bad demos: `skip` says how to leave them out, if they can be.
fn advised(error: DatasetError, skip: Option<&str>) -> anyhow::Error {
    let nonfinite = matches!(error, DatasetError::Input(InputError::NotFinite { .. }));
    let keep = nonfinite.then_some("--nonfinite keep stores such values");
    let skip = match error {
        // of demonstrations, a picture
        DatasetError::Input(InputError::NotFinite { .. } | InputError::WrongLength { .. })
        | DatasetError::BadDataset { .. } => skip,
        _ => None,
    };
    let advice: Vec<&str> = skip.into_iter().chain(keep).collect();
    if advice.is_empty() { error.into() } else { anyhow!("{error} ({})", advice.join(", ")) }
}

fn convert_shard(args: &Args, options: &ConvertOptions, shard: Shard) -> Result<ExitCode> {
    if args.list_files {
        let files = dataset::shard_files(&args.source, options, shard)?;
        match args.json {
            true => cli::print_json(&files.iter().map(|file| cli::lossy(file)).collect::<Vec<_>>())?,
            false => cli::print(&files.iter().map(|file| format!("{}\n", file.display())).collect::<String>())?,
        }
        return Ok(ExitCode::SUCCESS);
    }
    let work = Work::begin(&args.out)?;
    let mut screen = cli::Screen::new();
    let mut advance = screen.advance("converting");
    let report = dataset::convert_shard(&args.source, &args.out, options, shard, &mut |done, total| {
        advance(done, total);
        work.goes_on()
    });
    drop(advance);
    screen.clear();
    let report = report.map_err(|error| advised(error, Some("--skip-bad without --shard leaves such demos out")))?;
    report.notes.iter().for_each(|note| cli::note(&format!("note: {note}")));
    if args.json {
        cli::print_json(&json!({
            "source": cli::lossy(&args.source), "out": cli::lossy(&args.out), "shard": shard.to_string(),
            "episodes": report.episodes, "frames": report.frames, "total_episodes": report.total_episodes,
            "bytes": report.bytes, "resumed": report.resumed, "notes": report.notes,
        }))?;
        return Ok(ExitCode::SUCCESS);
    }
    cli::print(&format!(
        "{}: shard {shard}, {} of {} episodes, {} frames, {}{}\n",
        args.out.display(),
        cli::count(report.episodes),
        cli::count(report.total_episodes),
        cli::count(report.frames),
        cli::bytes(report.bytes),
        if report.resumed { " (complete already)" } else { "" },
    ))?;
    Ok(ExitCode::SUCCESS)
}

/// Prints what a conversion or a merge made.
pub fn tell(
    report: &ConvertReport,
    source: Option<&Path>,
    out: &Path,
    seconds: f64,
    as_json: bool,
) -> Result<ExitCode> {
    for note in &report.notes {
        cli::note(&format!("note: {note}"));
    }
    for demo in &report.skipped {
        cli::note(&format!("left out: {}: {}", demo.demo, demo.reason));
    }
    let skipped: Vec<_> = report.skipped.iter().map(|s| json!({"demo": s.demo, "reason": s.reason})).collect();
    if as_json {
        let features: serde_json::Map<_, _> = report
            .features
            .iter()
            .map(|(name, dtype, shape)| (name.clone(), json!({"dtype": dtype, "shape": shape})))
            .collect();
        cli::print_json(&json!({
            "source": source.map(cli::lossy), "out": cli::lossy(out), "layout": report.dialect, "episodes": report.episodes,
            "frames": report.frames, "tasks": report.tasks, "features": features, "files": report.files,
            "bytes": report.bytes, "fingerprint": report.fingerprint, "seconds": seconds, "notes": report.notes,
            "skipped": skipped,
        }))?;
        return Ok(ExitCode::SUCCESS);
    }
    let rows: Vec<Vec<String>> = report
        .features
        .iter()
        .map(|(name, dtype, shape)| vec![name.clone(), dtype.clone(), cli::shape(shape)])
        .collect();
    let mut text = cli::table(&["column", "type", "shape"], &rows, &[]);
    text.push_str(&format!(
        "{}: {} episodes, {} frames, {} files, {} in {seconds:.2} s\n",
        out.display(),
        cli::count(report.episodes),
        cli::count(report.frames),
        report.files,
        cli::bytes(report.bytes),
    ));
    if !skipped.is_empty() {
        text.push_str(&format!("{} of {} demos left out\n", skipped.len(), skipped.len() + report.episodes));
    }
    cli::print(&text)?;
    Ok(ExitCode::SUCCESS)
}
