use std::path::PathBuf;
use std::process::ExitCode;

use cli::shown;
use zoo::lerobot::export;

use crate::places::{ZooArgs, entry_names};

/// Write an entry in the form of another library
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo export lerobot lift-act@1 lift-act-lerobot")]
pub struct Args {
    #[command(subcommand)]
    to: To,
}

#[derive(clap::Subcommand)]
enum To {
    Lerobot(LerobotArgs),
}

/// A checkpoint folder that LeRobot 0.6.1 loads
#[derive(clap::Args)]
struct LerobotArgs {
    /// Entry: `name` (its newest version) or `name@version`
    #[arg(add = entry_names())]
    entry: String,
    /// New folder
    folder: PathBuf,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let To::Lerobot(args) = &args.to;
    let entry = args.zoo.registry().entry(&args.entry)?;
    export(&entry, &args.folder)?;
    cli::print(&format!("{} is in {}\n", entry.id(), shown(&args.folder)))?;
    Ok(ExitCode::SUCCESS)
}
