use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use analysis::depth::thinking_subject;
use anyhow::Context;
use audit::{KnownEntries, LeftOut, audit};
use cli::{INTERRUPTED, Screen, SimulatorArgs, Stop, limits};
use models::actrm::{Intervention, Thinking};
use report::Depth;
use report::statistics::wilson_interval;
use rollout::Control;
use serde::Serialize;
use zoo::ZooError;
use zoo::evaluation::{EvaluationEnd, EvaluationOptions, Progress, evaluate};
use zoo::results::{ResultsError, Seeds, StoredEvaluation};

use crate::places::{ZooArgs, entry_names};
use crate::simulation::{drawn, worker};

const GOES_ON: &str = "stopped; run the same command again to resume";

/// Where the outcomes go unless another folder is named.
pub(super) const WORK: &str = "out/depth";

/// The folder of the results at so many steps: `8-whole`.
fn folder_name(steps: usize, how: &str) -> String {
    format!("{steps}-{how}")
}

/// What such a folder's name says: the steps, and how they were thought.
fn of_folder(name: &str) -> Option<(u64, &str)> {
    let (steps, how) = name.split_once('-')?;
    Some((steps.parse().ok().filter(|steps| *steps > 0)?, how))
}

/// The depths in `work` that are of `entries`, for the report's page, and what is wrong with the others. Those of entries
/// that are not there are somebody else's.
pub(super) fn depths(work: &Path, entries: &KnownEntries) -> anyhow::Result<(Vec<Depth>, Vec<LeftOut>)> {
    let (mut depths, mut left_out) = (Vec::new(), Vec::new());
    let Ok(folders) = std::fs::read_dir(work) else { return Ok((depths, left_out)) };
    let mut folders: Vec<PathBuf> = folders.flatten().map(|folder| folder.path()).collect();
    folders.sort();
    for folder in folders {
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let Some((steps, how)) = of_folder(&name) else { continue };
        let found = audit(&folder, entries)?;
        depths.extend(found.standing.iter().map(|evaluation| Depth::new(steps, how, evaluation)));
        let ours = |left: &LeftOut| !matches!(&left.reason, ZooError::Results(ResultsError::Unfit { what, .. }) if what.ends_with("entry"));
        left_out.extend(found.left_out.into_iter().filter(ours));
    }
    Ok((depths, left_out))
}

/// Evaluate a recursive policy with more or fewer refinement steps, or with its latent state changed
///
/// Nothing is trained. The entry's weights are applied the given number of times, or until they halt. `freeze` keeps the latent
/// state of the first step. `shuffle` replaces it after every update by that of another episode's beginning. The outcomes are
/// kept apart from the zoo's results. `leaderboard` shows them in a section of their own.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo depth pickchain-actrm --steps 1,2,4,8,16,32
  actrm-zoo depth pickchain-actrm --steps 6 --intervene shuffle --episodes 200
  actrm-zoo depth pickchain-actrm --steps 8,32 --halting --json")]
pub struct Args {
    /// Entry: `name` (its newest version) or `name@version`
    #[arg(add = entry_names())]
    entry: String,
    /// Numbers of supervision steps, separated by commas
    #[arg(long, value_name = "N,...", value_delimiter = ',', default_value = "1,2,4,8,16,32",
        value_parser = clap::value_parser!(u64).range(1..=1000))]
    steps: Vec<u64>,
    /// Allow it to halt earlier, as it was trained to
    #[arg(long, conflicts_with = "intervene")]
    halting: bool,
    /// Change of the latent state: `freeze` or `shuffle`
    #[arg(long, value_name = "HOW", value_parser = intervention)]
    intervene: Option<Intervention>,
    /// Episodes for each number of steps
    #[arg(long, short = 'n', value_name = "N", default_value_t = 50, value_parser = limits::episodes)]
    episodes: u64,
    /// Seed of the first episode; the seeds after it count up
    #[arg(long = "seed-start", value_name = "SEED", default_value_t = 30_000)]
    seed: u64,
    #[command(flatten)]
    simulator: SimulatorArgs,
    /// Folder for the episodes' outcomes
    #[arg(long, value_name = "DIR", default_value = WORK)]
    work: PathBuf,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    zoo: ZooArgs,
}

fn intervention(text: &str) -> Result<Intervention, String> {
    let found = Intervention::ALL.into_iter().find(|intervention| intervention.name() == text);
    found.ok_or_else(|| format!("expected {}", Intervention::ALL.map(Intervention::name).join(" or ")))
}

/// What came of one number of steps.
#[derive(Serialize)]
struct Row {
    #[serde(flatten)]
    thinking: Thinking,
    episodes: u64,
    successes: u64,
    /// Successes and episodes by group.
    groups: BTreeMap<String, (u64, u64)>,
    /// Median of a query.
    query_ms: f64,
    query_flops: Option<f64>,
}

impl Row {
    fn new(thinking: Thinking, query_flops: Option<f64>, evaluation: &StoredEvaluation) -> Self {
        let mut groups: BTreeMap<String, (u64, u64)> = BTreeMap::new();
        for episode in &evaluation.episodes {
            if let Some(group) = &episode.group {
                let (successes, all) = groups.entry(group.clone()).or_default();
                (*successes, *all) = (*successes + u64::from(episode.success), *all + 1);
            }
        }
        let mut times: Vec<f64> = evaluation.timings.iter().flat_map(|t| t.inference_ms.iter().copied()).collect();
        times.sort_by(f64::total_cmp);
        Self {
            thinking,
            episodes: evaluation.episodes.len() as u64,
            successes: evaluation.episodes.iter().filter(|episode| episode.success).count() as u64,
            groups,
            query_ms: times.get(times.len() / 2).copied().unwrap_or_default(),
            query_flops,
        }
    }
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    limits::check_seeds(args.seed, args.episodes)?;
    let entry = args.zoo.registry().entry(&args.entry)?;
    let loaded = entry.load()?;
    let thoughts: Vec<Thinking> = args
        .steps
        .iter()
        .map(|&steps| {
            let steps = Some(usize::try_from(steps)?);
            let halting = args.halting.then_some(true);
            Ok(Thinking { steps, halting, intervene: args.intervene, ..Thinking::default() })
        })
        .collect::<anyhow::Result<_>>()?;
    // before anything is started: whether it can think so at all
    thoughts.iter().try_for_each(|thinking| loaded.thinking(thinking).map(drop))?;
    let environment = drawn(&args.simulator, None, entry.meta())?;
    let stop = Stop::install(GOES_ON)?;
    let spec = worker(&environment, &args.simulator, Control::Compiled)?;
    let options = EvaluationOptions {
        seeds: Seeds { start: args.seed, count: args.episodes },
        shard: None,
        env_module: environment.env_module.clone(),
        force: false,
    };
    let Some(mut pool) = args.simulator.start(spec, None, &stop)? else { return Ok(ExitCode::from(INTERRUPTED)) };
    let mut rows = Vec::new();
    for thinking in thoughts {
        let how = thinking.intervene.map_or(if args.halting { "halting" } else { "whole" }, Intervention::name);
        let results = args.work.join(folder_name(thinking.steps.unwrap_or_default(), how));
        let Some(subject) = thinking_subject(&loaded, &thinking, &mut pool)? else { break };
        let mut screen = Screen::new();
        let end = evaluate(&subject, &mut pool, &results, &options, &mut |progress| match progress {
            Progress::Begin { done, total, .. } => {
                screen.begin_at(format!("{} steps", thinking.steps.unwrap_or_default()), done, total);
            }
            Progress::Episode(_) => screen.step(),
            Progress::Apart(other) => screen.note(&format!("note: {other}")),
        });
        drop(screen);
        match end.with_context(|| format!("entry {}", entry.id()))? {
            EvaluationEnd::Complete(evaluation) => {
                let flops = loaded.thinking(&thinking)?.model().query_flops();
                rows.push(Row::new(thinking, flops, &evaluation));
            }
            EvaluationEnd::Stopped { .. } => break,
            EvaluationEnd::Failed { errors, .. } => {
                let first = errors.into_iter().next().context("an evaluation failed without saying why")?;
                return Err(first.into());
            }
        }
    }
    cli::close(pool);
    match args.json {
        true => cli::print_json(&rows)?,
        false => cli::print(&table(&rows))?,
    }
    if stop.asked() {
        cli::note(GOES_ON);
        return Ok(ExitCode::from(INTERRUPTED));
    }
    Ok(ExitCode::SUCCESS)
}

fn table(rows: &[Row]) -> String {
    let groups: Vec<&String> = rows.first().map(|row| row.groups.keys().collect()).unwrap_or_default();
    let mut header = vec!["steps", "success", "interval"];
    header.extend(groups.iter().map(|group| group.as_str()));
    header.extend(["a query, ms", "MFLOP"]);
    let cells = |row: &Row| {
        let (low, high) = wilson_interval(row.successes, row.episodes);
        let mut cells = vec![
            row.thinking.steps.unwrap_or_default().to_string(),
            format!("{} of {}", row.successes, row.episodes),
            format!("{:.0}-{:.0}%", 100.0 * low, 100.0 * high),
        ];
        let of = |group: &&String| row.groups.get(*group).map_or("-".to_owned(), |(won, all)| format!("{won}/{all}"));
        cells.extend(groups.iter().map(of));
        cells.push(format!("{:.2}", row.query_ms));
        cells.push(row.query_flops.map_or("-".to_owned(), |flops| format!("{:.1}", flops / 1e6)));
        cells
    };
    let rows: Vec<Vec<String>> = rows.iter().map(cells).collect();
    cli::table(&header, &rows, &(0..header.len()).collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use super::{folder_name, of_folder};

    #[test]
    fn a_folder_says_how_deep_and_how() {
        for (steps, how) in [(1, "whole"), (32, "halting"), (6, "shuffle")] {
            assert_eq!(of_folder(&folder_name(steps, how)), Some((steps as u64, how)));
        }
        for other in ["whole", "x-whole", "0-whole", "lift-act@1_Lift_1-2_abc", ""] {
            assert_eq!(of_folder(other), None, "{other}");
        }
    }
}
