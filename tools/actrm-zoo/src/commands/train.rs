//! `actrm-zoo train`

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::Ordering;

use anyhow::{Context, bail};
use clap::Args;
use indicatif::ProgressBar;
use study::puzzle::{AnyExperiment, PuzzleTrainRequest, train_puzzles};
use zoo::run::{MetricsRow, TrainEvent, TrainOutcome, TrainRequest, train};

use super::{ConfigArgs, ZooArgs, shown};
use crate::{stop, terminal};

/// Train an experiment and put the result into the zoo
///
/// Ctrl-C saves a checkpoint; `--resume` goes on from it to the same bytes that an uninterrupted training gives.
#[derive(Args)]
#[command(after_help = "Examples:
  actrm-zoo train act_lift
  actrm-zoo train act_lift train.steps=2000 policy.dim_model=256
  actrm-zoo train act_lift --data demos.hdf5 --zoo my-zoo
  actrm-zoo train act_lift --resume
  actrm-zoo train trm_dfs10 train.seed=2
  actrm-zoo train act_lift --print-config")]
pub struct TrainArgs {
    /// Experiment, by name (`actrm-zoo list --experiments`)
    experiment: String,
    /// Changes to it: `train.steps=5000`, `task.name=Stack`
    #[arg(value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Demonstrations: an HDF5 file or a LeRobotDataset folder, instead of the experiment's
    #[arg(long, value_name = "PATH")]
    data: Option<PathBuf>,
    /// Folder of runs; this one becomes RUNS/EXPERIMENT/NUMBER
    #[arg(long, value_name = "DIR", default_value = "runs")]
    runs: PathBuf,
    /// Exactly this folder for the run
    #[arg(long, value_name = "DIR")]
    run: Option<PathBuf>,
    /// Go on with the latest run of this experiment, or with the one in --run
    #[arg(long)]
    resume: bool,
    /// Print the resolved experiment and end
    #[arg(long)]
    print_config: bool,
    #[command(flatten)]
    configs: ConfigArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn cmd_train(args: &TrainArgs) -> anyhow::Result<ExitCode> {
    let library = args.configs.library()?;
    let experiment = AnyExperiment::load(&library, &args.experiment, &args.overrides)
        .with_context(|| format!("experiment `{}`", args.experiment))?;
    if args.print_config {
        print!("{}", experiment.to_toml());
        return Ok(ExitCode::SUCCESS);
    }
    let asked = stop::install()?;
    let mut bar = ProgressBar::hidden();
    let stop = || asked.load(Ordering::SeqCst);
    let (name, runs, run) = (args.experiment.clone(), args.runs.clone(), args.run.clone());
    let (resume, zoo) = (args.resume, args.zoo.zoo.clone());
    let outcome = match experiment {
        AnyExperiment::Robot(experiment) => {
            let data = args.data.clone();
            let request = TrainRequest { name, experiment: *experiment, data, runs, run, resume, zoo };
            train(&request, &stop, &mut |event| on_event(&event, &mut bar))
        }
        AnyExperiment::Puzzle(experiment) => {
            if args.data.is_some() {
                bail!("--data: experiment `{name}` draws its own puzzles");
            }
            let request = PuzzleTrainRequest { name, experiment: *experiment, runs, run, resume, zoo };
            train_puzzles(&request, &stop, &mut |event| on_event(&event, &mut bar))
        }
    };
    bar.finish_and_clear();
    match outcome? {
        TrainOutcome::Finished { entry, run, minutes } => {
            println!(
                "{entry} is in {} after {minutes:.1} minutes of training (run {})",
                shown(&args.zoo.zoo),
                shown(&run)
            );
            Ok(ExitCode::SUCCESS)
        }
        TrainOutcome::Stopped { step, run } => {
            eprintln!(
                "stopped after step {step}; go on with: actrm-zoo train {} --resume --run {}",
                args.experiment,
                shown(&run)
            );
            Ok(ExitCode::from(stop::INTERRUPTED))
        }
    }
}

fn on_event(event: &TrainEvent<'_>, bar: &mut ProgressBar) {
    match event {
        TrainEvent::Folder(path) => eprintln!("run folder: {}", shown(path)),
        TrainEvent::Converting(done, total) => {
            if bar.length() != Some(*total) || bar.is_hidden() {
                bar.finish_and_clear();
                *bar = terminal::bar("convert", *total);
            }
            bar.set_position(*done);
        }
        TrainEvent::Note(note) => bar.suspend(|| eprintln!("note: {note}")),
        TrainEvent::Begin { from, steps, parameters, windows } => {
            bar.finish_and_clear();
            let examples = match windows {
                0 => "puzzles drawn as they are needed".to_owned(),
                n => format!("{n} examples"),
            };
            eprintln!("{parameters} parameters, {examples}, {steps} steps");
            if *from > 0 {
                eprintln!("resumed after step {from}");
            }
            *bar = terminal::bar("train", *steps);
            bar.set_position(*from);
            bar.reset_eta();
        }
        TrainEvent::Step(row) => {
            bar.set_position(row.step);
            bar.set_message(summary(row));
        }
        TrainEvent::Saved(_) => {}
    }
}

/// `loss 0.1234 (kld 0.0012, l1 0.1100) grad 1.2 lr 9.8e-4 580/s valid 0.0921`
fn summary(row: &MetricsRow) -> String {
    let value = |name: &str| row.values.get(name).copied();
    let named = ["loss", "grad_norm", "lr", "samples_per_s", "valid_loss"];
    let parts: Vec<String> = row
        .values
        .iter()
        .filter(|(name, _)| !named.contains(&name.as_str()))
        .map(|(name, x)| format!("{} {x:.4}", name.trim_end_matches("_loss")))
        .collect();
    let mut text = format!(
        "loss {:.4} ({}) grad {:.2} lr {:.1e}",
        value("loss").unwrap_or(f64::NAN),
        parts.join(", "),
        value("grad_norm").unwrap_or(f64::NAN),
        value("lr").unwrap_or(f64::NAN),
    );
    if let Some(rate) = value("samples_per_s") {
        text.push_str(&format!(" {rate:.0}/s"));
    }
    if let Some(valid) = value("valid_loss") {
        text.push_str(&format!(" valid {valid:.4}"));
    }
    text
}
