//! `actrm-zoo study`

use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::Ordering;

use clap::Args;
use indicatif::ProgressBar;
use study::puzzle::{PuzzleEvaluation, STUDY, StudyEvent, StudyRequest, run_study, study_page};
use zoo::run::TrainEvent;
use zoo::write_atomic;

use super::{ConfigArgs, shown};
use crate::{stop, terminal};

/// Run the puzzle study, as far as it has no results yet, and write its page
///
/// Every row (experiment, seed, test) is one small file in the results folder; Ctrl-C saves a checkpoint and the same
/// command goes on from it. One thread (RAYON_NUM_THREADS=1) costs the least processor time.
#[derive(Args)]
#[command(after_help = "Examples:
  actrm-zoo study --page docs/puzzles.md
  actrm-zoo study --only trm_dfs10 --only trm_open8 --seeds 1
  actrm-zoo study --page-only --page docs/puzzles.md
  actrm-zoo study --list")]
pub struct StudyArgs {
    /// Folder of results, one file a row
    #[arg(long, value_name = "DIR", default_value = "docs/puzzles")]
    results: PathBuf,
    /// Folder for runs and entries
    #[arg(long, value_name = "DIR", default_value = "out/study")]
    work: PathBuf,
    /// Only this experiment; may be repeated
    #[arg(long, value_name = "EXPERIMENT")]
    only: Vec<String>,
    /// Only the seeds up to this
    #[arg(long, value_name = "N")]
    seeds: Option<u64>,
    /// Write the page here
    #[arg(long, value_name = "FILE")]
    page: Option<PathBuf>,
    /// Run nothing
    #[arg(long, requires = "page")]
    page_only: bool,
    /// List the experiments of the study and end
    #[arg(long)]
    list: bool,
    #[command(flatten)]
    configs: ConfigArgs,
}

pub fn cmd_study(args: &StudyArgs) -> anyhow::Result<ExitCode> {
    if args.list {
        for row in STUDY {
            println!("{} ({} seeds, {} tests)", row.experiment, row.seeds, row.tests.len());
        }
        return Ok(ExitCode::SUCCESS);
    }
    if let Some(name) = args.only.iter().find(|name| STUDY.iter().all(|row| row.experiment != **name)) {
        let names: Vec<&str> = STUDY.iter().map(|row| row.experiment).collect();
        anyhow::bail!("unknown experiment of the study `{name}`; there is {}", names.join(", "));
    }
    let mut whole = true;
    if !args.page_only {
        let asked = stop::install()?;
        let request = StudyRequest {
            library: args.configs.library()?,
            results: args.results.clone(),
            work: args.work.clone(),
            only: args.only.clone(),
            seeds: args.seeds,
        };
        let mut bar = ProgressBar::hidden();
        let done = run_study(&request, &|| asked.load(Ordering::SeqCst), &mut |event| on_event(&event, &mut bar));
        bar.finish_and_clear();
        whole = done?;
    }
    if let Some(path) = &args.page {
        write_atomic(path, study_page(&args.configs.library()?, &args.results)?.as_bytes())?;
        println!("{}", shown(path));
    }
    if !whole {
        eprintln!("stopped; the same command goes on where it was");
        return Ok(ExitCode::from(stop::INTERRUPTED));
    }
    Ok(ExitCode::SUCCESS)
}

fn on_event(event: &StudyEvent<'_>, bar: &mut ProgressBar) {
    match event {
        StudyEvent::Begin(experiment, seed) => bar.suspend(|| eprintln!("{experiment}, seed {seed}")),
        StudyEvent::Training(TrainEvent::Begin { from, steps, .. }) => {
            bar.finish_and_clear();
            *bar = terminal::bar("train", *steps);
            bar.set_position(*from);
            bar.reset_eta();
        }
        StudyEvent::Training(TrainEvent::Step(row)) => bar.set_position(row.step),
        StudyEvent::Training(_) => {}
        StudyEvent::Result(result, there) => {
            bar.finish_and_clear();
            println!("{}", line(result, *there));
        }
    }
}

/// `trm_dfs10 seed 1 on dfs10: right 99.5%, exact 99.5%, 61 CPU s`
fn line(result: &PuzzleEvaluation, there: bool) -> String {
    let counts = &result.answers;
    format!(
        "{} seed {} on {}: right {:.1}%, exact {:.1}%, {:.0} CPU s{}",
        result.experiment,
        result.training.seed,
        result.task,
        100.0 * counts.share(counts.valid),
        100.0 * counts.share(counts.exact),
        result.cpu_seconds,
        if there { " (there already)" } else { "" }
    )
}
