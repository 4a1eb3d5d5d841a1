//! `actrm-zoo list`

use std::process::ExitCode;

use clap::Args;
use comfy_table::{Table, presets};
use study::puzzle::PuzzleMeta;
use zoo::entry::Entry;
use zoo::registry::Registry;

use super::{ConfigArgs, ZooArgs, shown};

/// List the entries of the zoo, or the experiments that can be trained
#[derive(Args)]
#[command(after_help = "Examples:
  actrm-zoo list
  actrm-zoo list --zoo my-zoo
  actrm-zoo list --experiments")]
pub struct ListArgs {
    /// List experiments instead of entries
    #[arg(long)]
    experiments: bool,
    #[command(flatten)]
    configs: ConfigArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn cmd_list(args: &ListArgs) -> anyhow::Result<ExitCode> {
    if args.experiments {
        for name in args.configs.library()?.names()? {
            println!("{name}");
        }
        return Ok(ExitCode::SUCCESS);
    }
    let registry = Registry::open(&args.zoo.zoo);
    let ids = registry.ids()?;
    if ids.is_empty() {
        eprintln!("no entries in {}; make one with: actrm-zoo train act_lift", shown(&args.zoo.zoo));
        return Ok(ExitCode::SUCCESS);
    }
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.set_header(["entry", "policy", "task", "parameters", "steps", "minutes", "data"]);
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
        table.add_row([
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
    println!("{}", table.trim_fmt());
    for failure in &failures {
        eprintln!("error: {failure:#}");
    }
    Ok(if failures.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}
