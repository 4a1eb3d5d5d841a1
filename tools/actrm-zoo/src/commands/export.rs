//! `actrm-zoo export`

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Subcommand};
use zoo::lerobot::export;
use zoo::registry::Registry;

use super::{ZooArgs, shown};

/// Write an entry in the form of another library
#[derive(Args)]
#[command(after_help = "Examples:
  actrm-zoo export lerobot lift-act@1 lift-act-lerobot")]
pub struct ExportArgs {
    #[command(subcommand)]
    to: To,
}

#[derive(Subcommand)]
enum To {
    Lerobot(LerobotArgs),
}

/// A checkpoint folder that LeRobot 0.6.1 loads
#[derive(Args)]
struct LerobotArgs {
    /// Entry: `name` (its newest version) or `name@version`
    entry: String,
    /// New folder
    folder: PathBuf,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn cmd_export(args: &ExportArgs) -> anyhow::Result<ExitCode> {
    let To::Lerobot(args) = &args.to;
    let entry = Registry::open(&args.zoo.zoo).entry(&args.entry)?;
    export(&entry, &args.folder)?;
    println!("{} is in {}", entry.id(), shown(&args.folder));
    Ok(ExitCode::SUCCESS)
}
