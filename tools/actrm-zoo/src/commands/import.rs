use std::path::PathBuf;
use std::process::ExitCode;

use cli::shown;
use zoo::lerobot::{ImportOptions, import};

use crate::places::ZooArgs;

/// Make an entry of a policy that was trained elsewhere
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo import lerobot outputs/train/checkpoints/last/pretrained_model --name lift-theirs --task Lift")]
pub struct Args {
    #[command(subcommand)]
    from: From,
}

#[derive(clap::Subcommand)]
enum From {
    Lerobot(LerobotArgs),
}

/// A checkpoint folder of LeRobot's ACT or diffusion
#[derive(clap::Args)]
struct LerobotArgs {
    /// Folder with config.json, model.safetensors and the two processors
    folder: PathBuf,
    /// Name of the entry
    #[arg(long)]
    name: String,
    /// Task that the policy was trained for
    #[arg(long)]
    task: String,
    /// Observation keys that make its state, in order
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "KEYS",
        default_value = "robot0_eef_pos,robot0_eef_quat,robot0_gripper_qpos"
    )]
    state_keys: Vec<String>,
    /// Observation keys that make its environment state, in order
    #[arg(long, value_delimiter = ',', value_name = "KEYS", default_value = "object")]
    env_keys: Vec<String>,
    /// Its pictures were drawn without reflections and multisampling, as `collect --fast-render` draws
    #[arg(long)]
    fast_render: bool,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let From::Lerobot(args) = &args.from;
    let options = ImportOptions {
        name: args.name.clone(),
        task: args.task.clone(),
        state_keys: args.state_keys.clone(),
        env_keys: args.env_keys.clone(),
        fast_render: args.fast_render,
    };
    let id = import(&args.folder, &options, &args.zoo.zoo)?;
    cli::print(&format!("{id} is in {}\n", shown(&args.zoo.zoo)))?;
    Ok(ExitCode::SUCCESS)
}
