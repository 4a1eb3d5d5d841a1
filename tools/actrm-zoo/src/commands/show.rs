use std::process::ExitCode;

use zoo::conventions::NAMES;

use crate::card::model_index_of;
use crate::places::{ProtocolArgs, ResultsArgs, ZooArgs, entry_names};

/// Verify an entry and print its model card, experiment, conventions or provenance
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo show lift-act
  actrm-zoo show lift-act@1 --card
  actrm-zoo show lift-act@1 --config
  actrm-zoo show lift-act@1 --conventions
  actrm-zoo show lift-act@1 --json")]
pub struct Args {
    /// Entry: `name` (its newest version) or `name@version`
    #[arg(add = entry_names())]
    entry: String,
    /// Print the model card for the Hugging Face Hub, with metadata and its valid results as `model-index`
    #[arg(long, conflicts_with_all = ["config", "json"])]
    card: bool,
    /// Print the resolved experiment
    #[arg(long, conflicts_with = "json")]
    config: bool,
    /// Print how its numbers are meant: control rate, action space, order of the state
    #[arg(long, conflicts_with_all = ["card", "config"])]
    conventions: bool,
    /// Print the provenance and the hashes of all files; with --conventions, those
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    results: ResultsArgs,
    #[command(flatten)]
    protocols: ProtocolArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let entry = args.zoo.registry().entry(&args.entry)?;
    if args.conventions {
        let said = entry.conventions()?;
        let lines =
            NAMES.iter().filter_map(|(name, what)| Some(format!("{name:14}  {:36}  {what}\n", said.get(name)?)));
        match args.json {
            true => cli::print_json(&said)?,
            false => cli::print(&lines.collect::<String>())?,
        }
    } else if args.json {
        cli::print_json(entry.meta())?;
    } else if args.config {
        cli::print(&entry.config_text()?)?;
    } else if args.card {
        cli::print(&entry.hub_card(&model_index_of(&entry, &args.zoo, &args.results, &args.protocols)?)?)?;
    } else {
        cli::print(&entry.card_body()?)?;
    }
    Ok(ExitCode::SUCCESS)
}
