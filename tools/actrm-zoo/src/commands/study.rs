use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::Context;
use cli::{INTERRUPTED, Screen, Stop, shown};
use study::puzzle::{PuzzleEvaluation, STUDY, StudyEvent, StudyRequest, StudyRow, run_study, study_page};
use study::robots::{
    CellResult, RobotEvent, RobotStudyRequest, Study, StudyError, cells, robot_charts, robot_page, run_robot_study,
    stored_results,
};
use zoo::config::Library;
use zoo::run::{DeviceChoice, TrainEvent};
use zoo::write_atomic;

use crate::places::ConfigArgs;

const GOES_ON: &str = "stopped; run the same command again to resume";

/// Run the missing parts of a study and write its page
///
/// A study file lists the trainings, their demonstrations and seeds, the tests, and the comparisons. Without a file this
/// runs the puzzle study. The result of each training on a test is one small file in the study's results folder. Ctrl-C saves
/// checkpoints, and the same command resumes from them. One thread (RAYON_NUM_THREADS=1) needs the least processor time.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo study studies/recursion.toml --jobs 2
  actrm-zoo study studies/recursion.toml --stage 1
  actrm-zoo study studies/recursion.toml --page-only
  actrm-zoo study studies/policies.toml --only act-on-lift
  actrm-zoo study studies/policies.toml --cell act-on-lift-seed1
  actrm-zoo study --page docs/results/puzzles.md
  actrm-zoo study --only trm_dfs10 --only trm_open8 --seeds 1
  actrm-zoo study --page-only --page docs/results/puzzles.md
  actrm-zoo study studies/policies.toml --list
  actrm-zoo study --list")]
pub struct Args {
    /// Study file of robot policies; it names the folder of its results and its page
    #[arg(conflicts_with_all = ["results", "page", "seeds"])]
    study: Option<PathBuf>,
    /// Number of trainings at once, for a study of robot policies
    #[arg(long, short, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=64), requires = "study")]
    jobs: u16,
    /// Where robot policies are trained: `cpu`, `auto` (the first GPU, else the CPU), `cuda` or `cuda:N`; weights repeat on the CPU only
    #[arg(long, value_name = "DEVICE", default_value_t = DeviceChoice::Cpu, requires = "study")]
    device: DeviceChoice,
    /// Python with robosuite, for a study of robot policies
    #[arg(long, value_name = "PATH", env = "ACTRM_PYTHON")]
    python: Option<PathBuf>,
    /// Folder of results of the puzzle study, one file per row
    #[arg(long, value_name = "DIR", default_value = "docs/results/puzzles")]
    results: PathBuf,
    /// Folder for demonstrations, runs and entries
    #[arg(long, value_name = "DIR", default_value = "out/study")]
    work: PathBuf,
    /// Only this experiment, or only cells whose name contains this text; may be repeated
    #[arg(long, value_name = "EXPERIMENT")]
    only: Vec<String>,
    /// Only the cell with this name in --list; may be repeated. No page is written, so that several machines can share a study
    #[arg(long = "cell", value_name = "CELL", requires = "study", conflicts_with_all = ["only", "page_only"])]
    cells: Vec<String>,
    /// Only collect the demonstrations of a study of robot policies
    #[arg(long, requires = "study", conflicts_with = "page_only")]
    data_only: bool,
    /// Only the stages up to this one of a study of robot policies
    #[arg(long, value_name = "N", requires = "study")]
    stage: Option<u8>,
    /// Only training seeds up to this one
    #[arg(long, value_name = "N")]
    seeds: Option<u64>,
    /// File of the page
    #[arg(long, value_name = "FILE")]
    page: Option<PathBuf>,
    /// Only write the page
    #[arg(long)]
    page_only: bool,
    /// List the experiments or cells of the study with their results, and run nothing
    #[arg(long)]
    list: bool,
    #[command(flatten)]
    configs: ConfigArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if let Some(file) = &args.study {
        return robots(args, file);
    }
    if args.page_only && args.page.is_none() {
        anyhow::bail!("--page-only: expected --page FILE beside it, or a study file, which names its page");
    }
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
        let (page, chart) = study_page(&args.configs.library()?, &args.results)?;
        write_atomic(&args.results.join("success.svg"), chart.as_bytes())?;
        write_atomic(path, page.as_bytes())?;
        cli::print(&(shown(path) + "\n"))?;
    }
    if !whole {
        cli::note(GOES_ON);
        return Ok(ExitCode::from(INTERRUPTED));
    }
    Ok(ExitCode::SUCCESS)
}

/// A study of robot policies.
fn robots(args: &Args, file: &Path) -> anyhow::Result<ExitCode> {
    let study = Study::open(file)?;
    let mut left = None;
    if args.list {
        cli::print(&listed(&study, &args.configs.library()?)?)?;
        return Ok(ExitCode::SUCCESS);
    }
    if args.page_only && !has_results(&study.results) {
        let (file, results) = (shown(file), shown(&study.results));
        anyhow::bail!(
            "{file}: {results} has no results, so there is no page to write; run the study without --page-only"
        );
    }
    let mut whole = true;
    if !args.page_only {
        let stop = Stop::install(GOES_ON)?;
        stop.wait_for_work(true);
        let request = RobotStudyRequest {
            study: study.clone(),
            library: args.configs.library()?,
            work: args.work.join(file.file_stem().unwrap_or_default()),
            only: args.only.clone(),
            cells: args.cells.clone(),
            stage: args.stage,
            data_only: args.data_only,
            jobs: usize::from(args.jobs),
            device: args.device,
            python: rollout::find_python(args.python.as_deref())?,
            stop: stop.flag(),
        };
        let mut screen = Screen::new();
        screen.begin("results", 1);
        let mut printed = Ok(());
        let ran = run_robot_study(&request, &mut |event| match event {
            RobotEvent::Done(done, total) => screen.begin_at("results", done as u64, total as u64),
            RobotEvent::Collecting(name, done, all) => {
                screen.message(&format!("{name}: {done} of {all} demonstrations"))
            }
            RobotEvent::Training(cell, step, steps) => screen.message(&format!("{cell}: step {step} of {steps}")),
            RobotEvent::Testing(cell, test) => screen.message(&format!("{cell}: {test}")),
            RobotEvent::Result(result) => {
                let one = screen.print(&(cell_line(result) + "\n"));
                if printed.is_ok() {
                    printed = one;
                }
            }
        });
        drop(screen);
        match ran {
            // all else was done, and stands on the page
            Err(error @ StudyError::OtherTrainings { .. }) => left = Some(error),
            ran => whole = ran?,
        }
        printed?;
    }
    if args.cells.is_empty() && !args.data_only {
        if let Some(folder) = study.page.parent() {
            std::fs::create_dir_all(folder).with_context(|| format!("cannot create {}", shown(folder)))?;
        }
        for (path, drawing) in robot_charts(&study)? {
            write_atomic(&path, drawing.as_bytes())?;
        }
        write_atomic(&study.page, robot_page(&study, file)?.as_bytes())?;
        cli::print(&(shown(&study.page) + "\n"))?;
    }
    if let Some(error) = left {
        return Err(error.into());
    }
    if !whole {
        cli::note(GOES_ON);
        return Ok(ExitCode::from(INTERRUPTED));
    }
    Ok(ExitCode::SUCCESS)
}

fn has_results(folder: &Path) -> bool {
    let Ok(mut files) = std::fs::read_dir(folder) else { return false };
    files.any(|file| file.is_ok_and(|file| file.path().extension().is_some_and(|name| name == "json")))
}

/// A line a training: `k6-on-pickchain-200-seed1: chain (171 of 200), chain-2 (not run)`. One that stands in several stages is in
/// one line with the tests of all.
fn listed(study: &Study, library: &Library) -> anyhow::Result<String> {
    let mut lines: Vec<(String, Vec<String>)> = Vec::new();
    for cell in cells(study) {
        let results = stored_results(study, library, &cell)?;
        let tests = cell.tests.iter().zip(results).map(|(test, result)| match result {
            None => format!("{test} (not run)"),
            Some(result) => format!("{test} ({} of {})", won(&result), result.episodes.len()),
        });
        match lines.iter_mut().find(|(name, _)| *name == cell.name()) {
            Some((_, known)) => known.extend(tests.filter(|test| !known.contains(test)).collect::<Vec<_>>()),
            None => lines.push((cell.name(), tests.collect())),
        }
    }
    Ok(lines.into_iter().map(|(name, tests)| format!("{name}: {}\n", tests.join(", "))).collect())
}

fn won(result: &CellResult) -> usize {
    result.episodes.iter().filter(|episode| episode.success).count()
}

/// `k6 on pickchain-200, seed 1, chain: 171 of 200, 2.9 minutes`
fn cell_line(result: &CellResult) -> String {
    format!(
        "{} on {}, seed {}, {}: {} of {}, {:.1} minutes",
        result.arm,
        result.data,
        result.seed,
        result.test,
        won(result),
        result.episodes.len(),
        result.training.minutes
    )
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
