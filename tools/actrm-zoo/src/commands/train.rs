use std::cell::Cell;
use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, anyhow, bail};
use clap::builder::ArgPredicate;
use cli::{INTERRUPTED, Screen, Stop, command_line, limits, shown};
use models::DeviceChoice;
use study::puzzle::{AnyExperiment, TrainOptions};
use zoo::ZooError;
use zoo::config::{Library, nearest};
use zoo::entry::member_name;
use zoo::run::{
    COMMAND_FILE, Extended, Place, TrainEvent, TrainOutcome, TrainRequest, extend, finished_in, locate, short_hash,
    train,
};
use zoo::write_atomic;

use crate::places::{ConfigArgs, ZooArgs, entry_names, experiment_names};
use crate::training::show;

/// Train an experiment and add the result to the zoo
///
/// Ctrl-C saves a checkpoint. `--resume` continues from it and ends in the same bytes as an uninterrupted training.
/// `actrm-zoo runs` lists interrupted runs with the command that resumes each.
///
/// Demonstrations must be of the experiment's task. The names that a LeRobot data set gives to its dimensions must be those of the
/// experiment's observation keys. Dimensions in another order are reordered, other names are refused. A task that no simulator
/// has (`task.name`) takes the keys of the data set.
///
/// `--seeds 1..8` trains eight entries with the seeds 1 to 8 (`lift-act-s1` to `lift-act-s8`). The leaderboard shows such a
/// family as one row, whose interval includes the variance between seeds. The same command resumes, and does not repeat
/// finished trainings.
#[derive(clap::Args, Clone)]
#[command(after_help = "Examples:
  actrm-zoo train act_lift
  actrm-zoo train act_lift train.steps=2000 policy.dim_model=256
  actrm-zoo train policy=diffusion task=stack
  actrm-zoo train act_stack inputs=image
  actrm-zoo train act_lift --data demos.hdf5 --zoo my-zoo
  actrm-zoo train act_lift --data aloha task.name=transfer_cube entry=aloha-act
  actrm-zoo train my.toml
  actrm-zoo train act_lift --from lift-act train.steps=500
  actrm-zoo train --extend runs/act_lift/001 train.steps=5000
  actrm-zoo train act_lift --resume
  actrm-zoo train act_lift --seeds 1..8
  actrm-zoo train act_lift inputs=image --device cuda
  actrm-zoo train trm_dfs10 train.seed=2
  actrm-zoo train act_lift --print-config")]
pub struct Args {
    /// Experiment: a name of `actrm-zoo list --experiments`, the path of a TOML file, or parts such as `policy=act`
    #[arg(required_unless_present = "extend", default_value_if("extend", ArgPredicate::IsPresent, ""), add = experiment_names())]
    experiment: String,
    /// Settings to override, such as `train.steps=5000` or `inputs=image`; `--print-config` shows all
    #[arg(value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Demonstrations: an HDF5 file or a LeRobotDataset folder [default: the experiment's]
    #[arg(long, value_name = "PATH")]
    data: Option<PathBuf>,
    /// Begin with the weights of this entry, as far as names and shapes are the same (fine-tuning)
    #[arg(long, value_name = "ENTRY", add = entry_names())]
    from: Option<String>,
    /// Continue the finished run in this folder, in a new folder, to `train.steps=N`; its schedule must be constant
    #[arg(long, value_name = "RUN", conflicts_with_all = ["run", "resume", "seeds", "data", "from", "print_config"])]
    extend: Option<PathBuf>,
    /// Train even if the demonstrations are of another task or their dimensions have other names
    #[arg(long)]
    force: bool,
    /// Folder of runs; this run is stored in DIR/EXPERIMENT/NUMBER
    #[arg(long, value_name = "DIR", default_value = "runs")]
    runs: PathBuf,
    /// Folder of this run, new or empty
    #[arg(long, value_name = "DIR")]
    run: Option<PathBuf>,
    /// Resume the latest run of this experiment that is not finished, or the one in --run
    #[arg(long)]
    resume: bool,
    /// Train once with each of these seeds: `1..8` (both ends included), `3` or `1,4,7`
    #[arg(long, value_name = "SEEDS", conflicts_with_all = ["run", "resume"])]
    seeds: Option<TrainingSeeds>,
    /// Memory for images, such as 2G or 500M; the rest is kept in a file [default: half of the free memory]
    #[arg(long, value_name = "SIZE", value_parser = limits::bytes)]
    image_memory: Option<u64>,
    /// Where to train: `auto` (the first GPU, else the CPU), `cpu`, `cuda` or `cuda:N`; GPUs need the program of `make cuda`
    #[arg(long, value_name = "DEVICE", default_value_t = DeviceChoice::Auto)]
    device: DeviceChoice,
    /// Print the resolved experiment and do not train
    #[arg(long)]
    print_config: bool,
    #[command(flatten)]
    configs: ConfigArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

/// Seeds of trainings.
#[derive(Clone, Debug, PartialEq, Eq)]
struct TrainingSeeds(Vec<u64>);

impl std::str::FromStr for TrainingSeeds {
    type Err = String;
    fn from_str(text: &str) -> Result<Self, String> {
        const MOST: u64 = 1000;
        let wrong = || format!("seeds {text:?}: expected `1..8` (both ends included), `3` or `1,4,7`");
        let number = |text: &str| text.trim().parse::<u64>().map_err(|e| format!("{}: {e}", wrong()));
        let mut seeds = Vec::new();
        for part in text.split(',') {
            let (first, last) = part.split_once("..").unwrap_or((part, part));
            let (first, last) = (number(first)?, number(last)?);
            if last < first || last - first >= MOST {
                return Err(format!("{}, rising, at most {MOST}", wrong()));
            }
            seeds.extend(first..=last);
        }
        seeds.sort_unstable();
        match seeds.windows(2).any(|pair| pair[0] == pair[1]) {
            true => Err(format!("seeds {text:?}: expected each seed once")),
            false => Ok(Self(seeds)),
        }
    }
}

impl Args {
    /// The same with an experiment that is a path taken apart: `mine/my.toml` is `my` of the folder `mine`.
    fn named(&self) -> anyhow::Result<Self> {
        let path = Path::new(&self.experiment);
        if path.extension().is_none_or(|extension| extension != "toml") {
            return Ok(self.clone());
        }
        if !path.is_file() {
            bail!("experiment {}: no such file", shown(path));
        }
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        if let Some(ignored) = self.configs.configs.as_deref().filter(|configs| *configs != folder) {
            cli::note(&format!(
                "note: {} is not read: the experiment is a file, and others come from its folder, {}",
                shown(ignored),
                shown(folder)
            ));
        }
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Ok(Self { experiment: name, configs: ConfigArgs { configs: Some(folder.to_owned()) }, ..self.clone() })
    }
}

/// The error of a value, with Rust's names of types in words.
fn in_words(error: ZooError) -> ZooError {
    match error {
        ZooError::InvalidValue { key, expected, found } => {
            let words = match &*expected {
                "u64" | "u32" | "u16" | "u8" | "usize" => "a positive integer",
                "f64" | "f32" => "a number",
                "a boolean" => "true or false",
                "a sequence" => "a list, such as '[\"agentview\"]'",
                other => other,
            };
            ZooError::InvalidValue { key, expected: words.to_owned(), found }
        }
        other => other,
    }
}

/// What to do about a change of the policy's type, which leaves the other settings of another policy behind.
fn other_policy(args: &Args, library: &Library) -> Option<String> {
    let policy = args.overrides.iter().find_map(|set| set.strip_prefix("policy.type="))?.replace('-', "_");
    let known = library.policies().ok()?;
    if known.contains(&policy) {
        return Some(format!("another policy has other settings; did you mean `policy={policy}`?"));
    }
    Some(format!("did you mean `policy={}`?", nearest(&policy, &known)?))
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if let Some(run) = &args.extend {
        return extend_run(args, run);
    }
    let args = &args.named()?;
    let library = args.configs.library()?;
    let words: Vec<String> = [&args.experiment].into_iter().chain(&args.overrides).cloned().collect();
    let (experiment, mut overrides) = library.choose(&words)?;
    if let Some(from) = &args.from {
        // of a name, the version that is the newest now
        overrides.push(format!("train.from={}", args.zoo.registry().resolve(from)?));
    }
    let args = &Args { experiment, overrides, from: None, ..args.clone() };
    let load = |overrides: &[String]| {
        AnyExperiment::load(&library, &args.experiment, overrides).map_err(in_words).with_context(
            || match other_policy(args, &library) {
                Some(hint) => format!("experiment `{}`: {hint}", args.experiment),
                None => format!("experiment `{}`", args.experiment),
            },
        )
    };
    let experiment = load(&args.overrides)?;
    if args.print_config {
        cli::print(&experiment.to_toml())?;
        return Ok(ExitCode::SUCCESS);
    }
    // only the paths of experiments are looked up elsewhere, too
    if let Some(path) = args.data.as_ref().filter(|path| !path.exists()) {
        let (path, tried) = (path.clone(), Vec::new());
        return Err(where_data_is(ZooError::DataNotFound { path, tried }, &experiment));
    }
    let asked =
        Stop::install("stopped without a new checkpoint; --resume continues from the last one, if there is one")?;
    let Some(TrainingSeeds(seeds)) = &args.seeds else {
        let one = One { run: args.run.clone(), resume: args.resume, seeded: false, own: Vec::new() };
        return train_one(args, experiment, &one, &asked);
    };
    if let Some(set) = args.overrides.iter().find(|set| set.starts_with("train.seed=") || set.starts_with("entry=")) {
        bail!("--seeds: expected no `{set}` beside it: every training has a seed and an entry of its own");
    }
    // other settings or demonstrations are another family, with runs of its own
    let data = experiment.data().map(|data| args.data.as_deref().unwrap_or(data));
    let data = data.map(|data| short_hash(&locate(data)?)).transpose();
    let data = data.map_err(|error| where_data_is(error, &experiment))?;
    let settings = zoo::sha256_hex(format!("{}\n{data:?}", experiment.to_toml()).as_bytes());
    for &seed in seeds {
        let name = member_name(experiment.entry(), seed);
        let own = vec![format!("train.seed={seed}"), format!("entry={name}")];
        let overrides: Vec<String> = args.overrides.iter().chain(&own).cloned().collect();
        let run = args.runs.join(&args.experiment).join(format!("{}-s{seed}", &settings[..8]));
        if let Some((entry, there)) = finished_in(&run, &args.zoo.zoo)? {
            let (run, zoo) = (shown(&run), shown(&args.zoo.zoo));
            // of another zoo, or removed: it has to be trained again, which only the user can decide
            if !there {
                bail!(
                    "seed {seed}: {run} is finished and made {entry}, which is not in {zoo}; remove that folder to train it again"
                );
            }
            cli::print(&format!("{entry} is in {zoo} already (run {run})\n"))?;
            continue;
        }
        let one = One { resume: run.join("config.toml").is_file(), run: Some(run), seeded: true, own };
        let code = train_one(args, load(&overrides)?, &one, &asked)?;
        if code != ExitCode::SUCCESS {
            return Ok(code);
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Goes on with a finished run.
fn extend_run(args: &Args, run: &Path) -> anyhow::Result<ExitCode> {
    let mut set = std::iter::once(&args.experiment).chain(&args.overrides).filter(|word| !word.is_empty());
    let steps = set.next().and_then(|word| word.strip_prefix("train.steps=")?.parse::<u64>().ok());
    let (Some(steps), None) = (steps, set.next()) else {
        bail!("--extend: expected train.steps=N and no other setting beside it");
    };
    let Extended { name, experiment, folder, command } = extend(run, &args.runs, steps)?;
    let stop = Stop::install("stopped without a new checkpoint; the new run's folder says how to resume")?;
    let resume = command.as_ref().map(|command| {
        let mut words: Vec<OsString> = vec!["--zoo".into(), args.zoo.zoo.clone().into()];
        words.extend(["--run".into(), folder.clone().into(), "--resume".into()]);
        format!("{command} {}\n", command_line(&words))
    });
    if let Some(text) = &resume {
        write_atomic(&folder.join(COMMAND_FILE), text.as_bytes())?;
    }
    let mut screen = Screen::new();
    let request = TrainRequest {
        name,
        experiment,
        data: None,
        runs: PathBuf::new(),
        run: Some(folder.clone()),
        resume: true,
        zoo: args.zoo.zoo.clone(),
        from_zoo: None,
        force: args.force,
        image_memory: args.image_memory,
        command: None,
        device: args.device,
    };
    let begun = Cell::new(false);
    let outcome = train(&request, &|| stop.asked(), &mut |event| {
        begun.set(begun.get() || matches!(event, TrainEvent::Step(_)));
        show(&event, &mut screen, &stop);
    });
    drop(screen);
    if outcome.is_err() && !begun.get() {
        // nothing is in it but copies: it must not be the latest run, which --resume takes up
        let _ = std::fs::remove_dir_all(&folder);
    }
    match outcome? {
        TrainOutcome::Finished { entry, run, minutes } => {
            let (zoo, run) = (shown(&args.zoo.zoo), shown(&run));
            cli::print(&format!("{entry} is in {zoo} after {minutes:.1} minutes of training (run {run})\n"))?;
            Ok(ExitCode::SUCCESS)
        }
        TrainOutcome::Stopped { step, .. } => {
            let how = resume.map_or_else(String::new, |text| format!("; resume with: {}", text.trim_end()));
            cli::note(&format!("stopped after step {step}{how}"));
            Ok(ExitCode::from(INTERRUPTED))
        }
    }
}

/// One training: where it takes place, and whether it is one of several.
struct One {
    run: Option<PathBuf>,
    resume: bool,
    seeded: bool,
    /// Changes to the experiment that are its alone.
    own: Vec<String>,
}

/// An error, with what to do where demonstrations are missing or a run began with other settings.
fn where_data_is(error: ZooError, experiment: &AnyExperiment) -> anyhow::Error {
    match error {
        ZooError::ResumeMismatch { ref folder, .. } => match std::fs::read_to_string(folder.join(COMMAND_FILE)) {
            Ok(command) => anyhow!("{error}; it is resumed by: {}", command.trim_end()),
            Err(_) => error.into(),
        },
        ZooError::DataNotFound { path, .. } => anyhow!(
            "no demonstrations at {}: name yours with --data PATH, or record some with `{}`",
            shown(&path),
            experiment.collect().unwrap_or_default()
        ),
        other => other.into(),
    }
}

fn train_one(args: &Args, experiment: AnyExperiment, one: &One, asked: &Stop) -> anyhow::Result<ExitCode> {
    let mut screen = Screen::new();
    let stop = || asked.asked();
    let place = Place {
        name: args.experiment.clone(),
        runs: args.runs.clone(),
        run: one.run.clone(),
        resume: one.resume,
        zoo: args.zoo.zoo.clone(),
        command: Some(command_line(&trains(args, &one.own))),
    };
    if args.data.is_some() && experiment.data().is_none() {
        bail!("--data: experiment `{}` draws its own puzzles", args.experiment);
    }
    let (data, force, image_memory) = (args.data.clone(), args.force, args.image_memory);
    let options = TrainOptions { place, data, force, image_memory, device: args.device };
    // the error of a file that is for people only must not end a training
    let mut unwritten = None;
    let mut on_event = |event: TrainEvent<'_>| {
        if let TrainEvent::Folder(folder) = &event {
            let text = format!("{}\n", going_on(args, folder, one.seeded));
            unwritten = write_atomic(&folder.join(COMMAND_FILE), text.as_bytes()).err();
        }
        show(&event, &mut screen, asked);
    };
    let described = experiment.clone();
    let outcome = experiment.train(options, &stop, &mut on_event);
    drop(screen);
    if let Some(error) = unwritten {
        cli::note(&format!("note: {error}"));
    }
    let outcome = outcome.map_err(|error| where_data_is(error, &described))?;
    match outcome {
        TrainOutcome::Finished { entry, run, minutes } => {
            let (zoo, run) = (shown(&args.zoo.zoo), shown(&run));
            cli::print(&format!("{entry} is in {zoo} after {minutes:.1} minutes of training (run {run})\n"))?;
            Ok(ExitCode::SUCCESS)
        }
        TrainOutcome::Stopped { step, run } => {
            cli::note(&format!("stopped after step {step}; resume with: {}", going_on(args, &run, one.seeded)));
            Ok(ExitCode::from(INTERRUPTED))
        }
    }
}

/// What decides the weights, as a command: the same wherever runs and zoo are.
fn trains(args: &Args, own: &[String]) -> Vec<OsString> {
    let mut words: Vec<OsString> = ["actrm-zoo", "train", &args.experiment].map(OsString::from).to_vec();
    words.extend(args.overrides.iter().chain(own).map(OsString::from));
    let mut option = |name: &str, path: &Path| words.extend([name.into(), path.as_os_str().to_owned()]);
    if let Some(data) = &args.data {
        option("--data", data);
    }
    if let Some(configs) = &args.configs.configs {
        option("--configs", configs);
    }
    if args.force {
        words.push("--force".into());
    }
    if args.device != DeviceChoice::Auto {
        words.extend(["--device".into(), args.device.to_string().into()]);
    }
    words
}

/// The command that goes on with the run in `folder`: everything that was asked for, wherever it came from.
fn going_on(args: &Args, folder: &Path, seeded: bool) -> String {
    let mut words = trains(args, &[]);
    let mut option = |name: &str, path: &Path| words.extend([name.into(), path.as_os_str().to_owned()]);
    if let Some(bytes) = args.image_memory {
        option("--image-memory", Path::new(&bytes.to_string()));
    }
    option("--zoo", &args.zoo.zoo);
    match &args.seeds {
        // the other trainings belong to it
        Some(TrainingSeeds(seeds)) if seeded => {
            option("--runs", &args.runs);
            let seeds: Vec<String> = seeds.iter().map(u64::to_string).collect();
            words.extend(["--seeds".into(), seeds.join(",").into()]);
        }
        _ => {
            option("--run", folder);
            words.push("--resume".into());
        }
    }
    command_line(&words)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_policy_that_is_not_there_is_not_suggested() {
        #[derive(clap::Parser)]
        struct Line {
            #[command(flatten)]
            args: Args,
        }
        let hint = |set: &str| {
            let line: Line = clap::Parser::parse_from(["train", "act_lift", set]);
            other_policy(&line.args, &Library::built_in())
        };
        let other = |policy: &str| Some(format!("another policy has other settings; did you mean `policy={policy}`?"));
        assert_eq!(hint("policy.type=diffusion"), other("diffusion"));
        assert_eq!(hint("policy.type=bc-rnn"), other("bc_rnn"));
        assert_eq!(hint("policy.type=actt").as_deref(), Some("did you mean `policy=act`?"));
        assert_eq!((hint("policy.type=something_else"), hint("train.steps=5")), (None, None));
    }

    #[test]
    fn seeds_are_ranges_and_lists() {
        let read = |text: &str| text.parse::<TrainingSeeds>().map(|seeds| seeds.0);
        assert_eq!(read("1..8").unwrap(), (1..=8).collect::<Vec<_>>());
        assert_eq!(read("7,1..3").unwrap(), [1, 2, 3, 7]);
        assert_eq!(read("5").unwrap(), [5]);
        for wrong in ["", "a", "8..1", "1..", "1,1", "1..3,2", "0..18446744073709551615", "-1"] {
            assert!(read(wrong).unwrap_err().contains("seeds"), "{wrong}");
        }
    }
}
