use std::path::PathBuf;
use std::process::ExitCode;

use cli::shown;
use interchange::{lerobot, robomimic};
use zoo::experiment::DataSection;

use crate::places::ZooArgs;

/// Import a policy of LeRobot or robomimic as an entry
#[derive(clap::Args)]
#[command(after_help = "Examples:
  actrm-zoo import lerobot outputs/train/checkpoints/last/pretrained_model --name lift-theirs --task Lift
  actrm-zoo import robomimic bc_trained_models/lift/20260101120000/models/model_epoch_600.pth --name lift-theirs --task Lift")]
pub struct Args {
    #[command(subcommand)]
    from: From,
}

#[derive(clap::Subcommand)]
enum From {
    Lerobot(LerobotArgs),
    Robomimic(RobomimicArgs),
}

/// What both do not say about themselves.
#[derive(clap::Args)]
struct NamedArgs {
    /// Name of the entry
    #[arg(long)]
    name: String,
    /// Task that the policy was trained for
    #[arg(long)]
    task: String,
    /// Observation keys of the robot state, in order [default: those of the exported entry, else
    /// robot0_eef_pos,robot0_eef_quat,robot0_gripper_qpos]
    #[arg(long, value_delimiter = ',', value_name = "KEYS")]
    state_keys: Option<Vec<String>>,
    /// Observation keys of the environment state, in order [default: those of the exported entry, else object]
    #[arg(long, value_delimiter = ',', value_name = "KEYS")]
    env_keys: Option<Vec<String>>,
}

/// Import a checkpoint folder of LeRobot's ACT or diffusion
///
/// Weights may be stored in f16, bf16, f32 or f64, and in several files with their `model.safetensors.index.json`. Checkpoints of
/// LeRobot 0.3 and before have no processors: their statistics are among the weights.
#[derive(clap::Args)]
struct LerobotArgs {
    /// Folder with config.json, model.safetensors and the two processors
    folder: PathBuf,
    #[command(flatten)]
    named: NamedArgs,
    /// The images of its demonstrations were rendered as by `collect --fast-render`
    #[arg(long)]
    fast_render: bool,
    #[command(flatten)]
    zoo: ZooArgs,
}

/// Import a checkpoint of robomimic's BC-RNN or BC-Transformer with a mixture of Gaussians
///
/// The file is a pickle. A separate process reads tensors and plain values from it and executes nothing. Anything else in the
/// file is an error that names it.
#[derive(clap::Args)]
struct RobomimicArgs {
    /// File that robomimic 0.3's training saved: models/model_epoch_N.pth
    file: PathBuf,
    #[command(flatten)]
    named: NamedArgs,
    /// Python with numpy [default: $ACTRM_PYTHON, else .venv/bin/python here or above, else python3]
    #[arg(long, value_name = "PATH")]
    python: Option<PathBuf>,
    #[command(flatten)]
    zoo: ZooArgs,
}

pub fn run(args: &Args) -> anyhow::Result<ExitCode> {
    let (id, zoo) = match &args.from {
        From::Lerobot(args) => {
            let NamedArgs { name, task, state_keys, env_keys } = &args.named;
            let options = lerobot::ImportOptions {
                name: name.clone(),
                task: task.clone(),
                state_keys: state_keys.clone(),
                env_keys: env_keys.clone(),
                fast_render: args.fast_render,
            };
            (lerobot::import(&args.folder, &options, &args.zoo.zoo)?, &args.zoo.zoo)
        }
        From::Robomimic(args) => {
            let NamedArgs { name, task, state_keys, env_keys } = &args.named;
            let usual = DataSection::default();
            let env_keys = env_keys.clone().unwrap_or(usual.env_keys);
            let options = robomimic::ImportOptions {
                name: name.clone(),
                task: task.clone(),
                state_keys: state_keys.clone().unwrap_or(usual.state_keys),
                // "" makes none
                env_keys: env_keys.into_iter().filter(|key| !key.is_empty()).collect(),
            };
            let python = rollout::find_python(args.python.as_deref())?;
            (robomimic::import(&args.file, &options, &python, &args.zoo.zoo)?, &args.zoo.zoo)
        }
    };
    cli::print(&format!("{id} is in {}\n", shown(zoo)))?;
    Ok(ExitCode::SUCCESS)
}
