use std::path::PathBuf;
use std::process::ExitCode;

use cli::shown;
use interchange::lerobot::export;
use interchange::onnx;
use zoo::entry::export_hub;

use crate::card::model_index_of;
use crate::places::{ProtocolArgs, ResultsArgs, ZooArgs, entry_names};

/// Export an entry to LeRobot, to ONNX or as a folder for the Hugging Face Hub
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo export lerobot lift-act@1 lift-act-lerobot
  actrm-zoo export onnx lift-act@1 lift-act.onnx
  actrm-zoo export hub lift-act@1 lift-act-hub")]
pub struct Args {
    #[command(subcommand)]
    to: To,
}

#[derive(clap::Subcommand)]
enum To {
    Lerobot(LerobotArgs),
    Onnx(OnnxArgs),
    Hub(HubArgs),
}

/// Write a folder for the Hugging Face Hub: the entry's files, with its valid results in the model card
///
/// The entry's own folder can also be pushed. Its card has no results, because it was sealed before there were any. An exported
/// folder that is copied to ZOO/NAME/VERSION is the entry again, since results in the card are not part of its seal.
#[derive(clap::Args)]
struct HubArgs {
    /// Entry: `name` (its newest version) or `name@version`
    #[arg(add = entry_names())]
    entry: String,
    /// Folder to create
    folder: PathBuf,
    #[command(flatten)]
    results: ResultsArgs,
    #[command(flatten)]
    protocols: ProtocolArgs,
    #[command(flatten)]
    zoo: ZooArgs,
}

/// Write a checkpoint folder that LeRobot 0.6.1 loads
#[derive(clap::Args)]
struct LerobotArgs {
    /// Entry: `name` (its newest version) or `name@version`
    #[arg(add = entry_names())]
    entry: String,
    /// Folder to create
    folder: PathBuf,
    #[command(flatten)]
    zoo: ZooArgs,
}

/// Write ACT or BC as an ONNX model, with its weights and its normalisation
///
/// Inputs are the entry's features under their names, (batch, width); the output is `action`, (batch, horizon, width). All are in
/// the units of the data. Policies of images, of several observations and of other types are refused. The entry's name and its
/// conventions are the model's metadata.
#[derive(clap::Args)]
struct OnnxArgs {
    /// Entry: `name` (its newest version) or `name@version`
    #[arg(add = entry_names())]
    entry: String,
    /// File to create
    file: PathBuf,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let (entry, folder) = match &args.to {
        To::Lerobot(args) => {
            let entry = args.zoo.registry().entry(&args.entry)?;
            let _parents = cli::make_parent(&args.folder)?;
            export(&entry, &args.folder)?;
            (entry, &args.folder)
        }
        To::Onnx(args) => {
            let entry = args.zoo.registry().entry(&args.entry)?;
            let _parents = cli::make_parent(&args.file)?;
            onnx::export(&entry.load()?, &args.file)?;
            (entry, &args.file)
        }
        To::Hub(args) => {
            let entry = args.zoo.registry().entry(&args.entry)?;
            let results = model_index_of(&entry, &args.zoo, &args.results, &args.protocols)?;
            let _parents = cli::make_parent(&args.folder)?;
            export_hub(&entry, &args.folder, &results)?;
            (entry, &args.folder)
        }
    };
    cli::print(&format!("{} is in {}\n", entry.id(), shown(folder)))?;
    Ok(ExitCode::SUCCESS)
}
