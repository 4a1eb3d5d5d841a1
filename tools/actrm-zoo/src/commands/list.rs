use std::process::ExitCode;

use cli::{Column, Table, shown};
use study::puzzle::PuzzleMeta;
use zoo::entry::Entry;

use crate::places::{ConfigArgs, ZooArgs};

/// List the entries of the zoo, or the experiments that can be trained
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo list
  actrm-zoo list --zoo my-zoo
  actrm-zoo list --experiments")]
pub struct Args {
    /// List experiments instead of entries
    #[arg(long)]
    experiments: bool,
    /// Show all columns, however narrow the terminal is
    #[arg(long)]
    wide: bool,
    #[command(flatten)]
    configs: ConfigArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    if args.experiments {
        let names = args.configs.library()?.names()?;
        cli::print(&names.iter().map(|name| format!("{name}\n")).collect::<String>())?;
        return Ok(ExitCode::SUCCESS);
    }
    let registry = args.zoo.registry();
    let ids = registry.ids()?;
    if ids.is_empty() {
        cli::note(&format!("no entries in {}; make one with: actrm-zoo train act_lift", shown(&args.zoo.zoo)));
        return Ok(ExitCode::SUCCESS);
    }
    let mut table = Table::new(vec![
        Column::new("entry"),
        Column::new("policy"),
        Column::new("task"),
        Column::new("parameters").right().dispensable(1),
        Column::new("steps").right().dispensable(2),
        Column::new("minutes").right().dispensable(3),
        Column::new("data").dispensable(4),
    ]);
    let mut failures = Vec::new();
    for id in ids {
        // one bad entry must not hide the others
        let entry = match Entry::open_meta(registry.folder(), &id) {
            Ok(entry) => entry,
            Err(error) => {
                failures.push(anyhow::Error::new(error).context(format!("entry {id}")));
                continue;
            }
        };
        let meta = entry.meta();
        let training = meta.training.as_ref();
        let number = |value: Option<String>| value.unwrap_or_else(|| "-".to_owned());
        table.push(vec![
            id.to_string(),
            meta.policy.clone(),
            meta.task.clone(),
            meta.parameters.to_string(),
            number(training.map(|t| t.steps.to_string())),
            number(training.map(|t| format!("{:.1}", t.minutes))),
            number(match (&meta.data, PuzzleMeta::of(&entry)?) {
                (Some(data), _) => Some(format!("{} ({} demos)", data.name, data.train_episodes)),
                (None, Some(puzzle)) => Some(format!("{} puzzles", puzzle.train_puzzles)),
                (None, None) => None,
            }),
        ]);
    }
    cli::print(&table.text(args.wide))?;
    for failure in &failures {
        cli::note(&format!("error: {failure:#}"));
    }
    Ok(if failures.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
