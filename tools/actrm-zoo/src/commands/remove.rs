use std::collections::BTreeSet;
use std::process::ExitCode;

use cli::shown;

use crate::places::{ResultsArgs, ZooArgs, entry_names};

/// Remove versions of entries that have neither results nor aliases
///
/// The number of a removed version is never used again.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo remove lift-act@2")]
pub struct Args {
    /// Entries, each with its version
    #[arg(required = true, value_name = "NAME@VERSION", add = entry_names())]
    entries: Vec<String>,
    #[command(flatten)]
    results: ResultsArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let registry = args.zoo.registry();
    if let Some(text) = args.entries.iter().find(|text| !text.contains('@')) {
        anyhow::bail!("{text}: expected a version, such as {}", registry.resolve(text)?);
    }
    // all are there before the first is gone
    let ids = args.entries.iter().map(|text| registry.resolve(text)).collect::<Result<BTreeSet<_>, _>>()?;
    for id in ids {
        registry.remove(&id, &args.results.folder(&args.zoo))?;
        cli::print(&format!("{id} is no longer in {}\n", shown(&args.zoo.zoo)))?;
    }
    Ok(ExitCode::SUCCESS)
}
