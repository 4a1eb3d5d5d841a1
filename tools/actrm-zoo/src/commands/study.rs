use std::path::PathBuf;
use std::process::ExitCode;

use cli::{INTERRUPTED, Screen, Stop, shown};
use study::puzzle::{PuzzleEvaluation, STUDY, StudyEvent, StudyRequest, StudyRow, run_study, study_page};
use zoo::run::TrainEvent;
use zoo::write_atomic;

use crate::places::ConfigArgs;

const GOES_ON: &str = "stopped; the same command goes on where it was";

/// Run the puzzle study, as far as it has no results yet, and write its page
///
/// Every row (experiment, seed, test) is one small file in the results folder; Ctrl-C saves a checkpoint and the same
/// command goes on from it. One thread (RAYON_NUM_THREADS=1) costs the least processor time.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo study --page docs/puzzles.md
  actrm-zoo study --only trm_dfs10 --only trm_open8 --seeds 1
  actrm-zoo study --page-only --page docs/puzzles.md
  actrm-zoo study --list")]
pub struct Args {
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

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if args.list {
        let row = |row: &StudyRow| format!("{} ({} seeds, {} tests)\n", row.experiment, row.seeds, row.tests.len());
        cli::print(&STUDY.iter().map(row).collect::<String>())?;
        return Ok(ExitCode::SUCCESS);
    }
    if let Some(name) = args.only.iter().find(|name| STUDY.iter().all(|row| row.experiment != **name)) {
        let names: Vec<&str> = STUDY.iter().map(|row| row.experiment).collect();
        anyhow::bail!("unknown experiment of the study `{name}`; there is {}", names.join(", "));
    }
    let mut whole = true;
    if !args.page_only {
        let stop = Stop::install(GOES_ON)?;
        let request = StudyRequest {
            library: args.configs.library()?,
            results: args.results.clone(),
            work: args.work.clone(),
            only: args.only.clone(),
            seeds: args.seeds,
        };
        let mut screen = Screen::new();
        let mut printed = Ok(());
        whole = run_study(&request, &|| stop.asked(), &mut |event| {
            let one = on_event(&event, &mut screen, &stop);
            if printed.is_ok() {
                printed = one;
            }
        })?;
        drop(screen);
        printed?;
    }
    if let Some(path) = &args.page {
        write_atomic(path, study_page(&args.configs.library()?, &args.results)?.as_bytes())?;
        cli::print(&(shown(path) + "\n"))?;
    }
    if !whole {
        cli::note(GOES_ON);
        return Ok(ExitCode::from(INTERRUPTED));
    }
    Ok(ExitCode::SUCCESS)
}

fn on_event(event: &StudyEvent<'_>, screen: &mut Screen, stop: &Stop) -> anyhow::Result<()> {
    match event {
        StudyEvent::Begin(experiment, seed) => screen.note(&format!("{experiment}, seed {seed}")),
        StudyEvent::Training(TrainEvent::Begin { from, steps, .. }) => {
            // until its last step a training has a checkpoint to save when it is stopped
            stop.wait_for_work(from < steps);
            screen.begin_at("train", *from, *steps);
        }
        StudyEvent::Training(TrainEvent::Step(row)) => screen.at(row.step),
        StudyEvent::Training(TrainEvent::Saved(_)) => stop.wait_for_work(!screen.is_full()),
        StudyEvent::Training(_) => {}
        StudyEvent::Result(result, there) => {
            screen.clear();
            cli::print(&(line(result, *there) + "\n"))?;
        }
    }
    Ok(())
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
