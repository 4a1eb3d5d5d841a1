//! robomimic's checkpoints (`.pth`) of BC-RNN and BC-Transformer become entries. A `.pth` is a pickle, which the harness reads
//! without running it (`rollout::read_robomimic`); what stands in it is `models::robomimic`'s business; here is the entry.

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::Tensor;
use models::{Backend, NormMode, Normaliser, PolicyConfig, Preprocess, robomimic};
use rollout::Python;
use serde_json::{Value, json};

use zoo::entry::{CardWords, EntryDraft, EntryId, EntryMeta, reference};
use zoo::experiment::{DataSection, Experiment, NormalisationSection, RolloutSection, TaskSection};
use zoo::run::TrainSection;
use zoo::{ZooError, tensors};

/// What the checkpoint does not say about itself.
#[derive(Debug, Clone)]
pub struct ImportOptions {
    /// Name of the entry.
    pub name: String,
    /// Task that the policy was trained for.
    pub task: String,
    /// Observation keys that make its state, in order.
    pub state_keys: Vec<String>,
    /// Observation keys that make its environment state, in order.
    pub env_keys: Vec<String>,
}

/// robomimic's number of environments of robosuite.
const ROBOSUITE: u64 = 1;

/// Makes an entry in `zoo` of robomimic's checkpoint `path`, which `python` reads.
///
/// # Errors
/// A file that is no checkpoint, options that our models cannot hold, tensors or statistics that are missing, extra or
/// misshapen, each by name.
pub fn import(path: &Path, options: &ImportOptions, python: &Python, zoo: &Path) -> Result<EntryId, ZooError> {
    let (given, stored) = tensors::from_bytes(path, &rollout::read_robomimic(python, path)?)?;
    let given = tensors::in_f32(path, given)?;
    tensors::check_finite(path, &given)?;
    let malformed = |reason: String| ZooError::Malformed { path: path.to_owned(), reason };
    let misfit = |error: models::ModelError| malformed(error.to_string());
    let checkpoint = robomimic::read_checkpoint(&stored, &options.state_keys, &options.env_keys).map_err(misfit)?;
    let (signature, env) = (&checkpoint.signature, environment(&stored["env_metadata"]).map_err(malformed)?);

    let words = match &checkpoint.policy {
        PolicyConfig::BcRnn(_) => "BC-RNN",
        _ => "BC-Transformer",
    };
    let experiment = Experiment {
        entry: options.name.clone(),
        description: format!("{words} imported from a checkpoint of robomimic, for {}.", options.task),
        task: TaskSection { name: options.task.clone() },
        data: DataSection {
            state_keys: options.state_keys.clone(),
            env_keys: options.env_keys.clone(),
            n_obs_steps: signature.n_obs_steps,
            ..DataSection::default()
        },
        normalisation: NormalisationSection {
            state: checkpoint.observation,
            environment_state: checkpoint.observation,
            entities: NormMode::default(),
            // robomimic's actions are those of the demonstrations
            action: NormMode::Identity,
        },
        policy: checkpoint.policy.clone(),
        train: TrainSection::default(),
        rollout: RolloutSection { n_action_steps: 1, temporal_ensemble: None, max_steps: None },
    };
    experiment.check()?;

    // before a model of these sizes is built
    let weights = checkpoint.weights(&given).map_err(misfit)?;
    let model =
        experiment.policy.build(signature, 0, &Backend::CPU).map_err(experiment.model_error("build the policy of"))?;
    model.params().load(&weights).map_err(misfit)?;
    let preprocess = Normaliser::new(&experiment.normalisation.modes(signature), &checkpoint.statistics)
        .and_then(|normaliser| Preprocess::new(signature.clone(), normaliser, model.params().device()))
        .map_err(experiment.model_error("take the statistics of"))?;

    let statistics = preprocess.normaliser().tensors().map_err(experiment.model_error("store the normaliser of"))?;
    let weights: BTreeMap<String, Tensor> = model.params().tensors().into_iter().collect();
    let about = json!({"format": 1, "policy": experiment.policy_type()});
    let name = EntryId { name: options.name.clone(), version: 0 };
    let draft = EntryDraft {
        reference: reference(&name, &experiment, preprocess.signature(), &weights, &statistics)?,
        card: CardWords::default(),
        metrics: None,
        command: None,
        meta: EntryMeta {
            format: 0,
            name: options.name.clone(),
            version: 0,
            description: experiment.description.clone(),
            experiment: "imported from robomimic".to_owned(),
            policy: experiment.policy_type(),
            task: options.task.clone(),
            env_name: Some(env.name),
            env_version: env.version,
            env_module: None,
            env_args: Some(env.args),
            parameters: model.params().count() as u64,
            signature: preprocess.signature().clone(),
            keys: experiment.data.feature_keys()?,
            data: None,
            kind: None,
            section: None,
            training: None,
            parent: None,
            license: None,
            versions: zoo::versions(),
            files: BTreeMap::new(),
        },
        model: tensors::to_bytes(path, &weights, &about)?,
        config: experiment.to_toml(),
        normaliser: tensors::to_bytes(path, &statistics, &json!({"format": 1}))?,
    };
    draft.seal(zoo)
}

/// The simulator that the demonstrations were recorded in.
struct RecordedIn {
    name: String,
    version: Option<String>,
    /// Its robots and controllers.
    args: Value,
}

fn environment(metadata: &Value) -> Result<RecordedIn, String> {
    let kind = &metadata["type"];
    if kind.as_u64() != Some(ROBOSUITE) {
        return Err(format!("env_metadata.type: expected {ROBOSUITE}, robosuite, found {kind}"));
    }
    let text = |key: &str| metadata[key].as_str().map(str::to_owned);
    let name = text("env_name").ok_or("env_metadata.env_name: expected text, found none")?;
    Ok(RecordedIn { name, version: text("env_version"), args: crate::without_module(metadata.clone()) })
}
