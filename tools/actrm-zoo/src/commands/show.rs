//! `actrm-zoo show`

use std::process::ExitCode;

use clap::Args;
use zoo::registry::Registry;

use super::ZooArgs;

/// Verify an entry and print its model card, its experiment or its provenance
#[derive(Args)]
#[command(after_help = "Examples:
  actrm-zoo show lift-act
  actrm-zoo show lift-act@1 --config
  actrm-zoo show lift-act@1 --json")]
pub struct ShowArgs {
    /// Entry: `name` (its newest version) or `name@version`
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

pub fn cmd_show(args: &ShowArgs) -> anyhow::Result<ExitCode> {
    let entry = Registry::open(&args.zoo.zoo).entry(&args.entry)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(entry.meta())?);
    } else if args.config {
        print!("{}", entry.config_text()?);
    } else {
        print!("{}", entry.card()?);
    }
    Ok(ExitCode::SUCCESS)
}
