use std::process::ExitCode;

use crate::places::{ZooArgs, entry_names};

/// Verify an entry and print its model card, its experiment or its provenance
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo show lift-act
  actrm-zoo show lift-act@1 --config
  actrm-zoo show lift-act@1 --json")]
pub struct Args {
    /// Entry: `name` (its newest version) or `name@version`
    #[arg(add = entry_names())]
    entry: String,
    /// Print the resolved experiment
    #[arg(long, conflicts_with = "json")]
    config: bool,
    /// Print the provenance and the hashes of all files
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let entry = args.zoo.registry().entry(&args.entry)?;
    if args.json {
        cli::print_json(entry.meta())?;
    } else if args.config {
        cli::print(&entry.config_text()?)?;
    } else {
        cli::print(&entry.card()?)?;
    }
    Ok(ExitCode::SUCCESS)
}
