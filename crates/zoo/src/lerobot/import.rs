//! A LeRobot ACT checkpoint becomes an entry.

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::Tensor;
use models::act::POSITION_BUFFER;
use models::layers::sinusoid_table;
use models::{ACTION, Dims, ENVIRONMENT_STATE, Normaliser, PolicyConfig, STATE};

use crate::entry::{EntryDraft, EntryId, EntryMeta};
use crate::experiment::{DataSection, Experiment, NormalisationSection, RolloutSection, TaskSection};
use crate::run::TrainSection;
use crate::{ZooError, tensors};

use super::config::{self, ActConfig, Features, NormaliserStep, Pipeline};
use super::{CONFIG_FILE, MODEL_FILE, POSTPROCESSOR, PREFIX, PREPROCESSOR};

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

/// Makes an entry in `zoo` of the checkpoint in `folder`.
///
/// # Errors
/// Files, keys, tensors or statistics that are missing, extra or misshapen, each by name.
pub fn import(folder: &Path, options: &ImportOptions, zoo: &Path) -> Result<EntryId, ZooError> {
    let config_path = folder.join(CONFIG_FILE);
    let act: ActConfig = config::read(&config_path)?;
    let policy = PolicyConfig::Act(act.model(&config_path)?);
    let dims = dims(&config_path, &act)?;

    let before = step(folder, PREPROCESSOR, "normalizer_processor")?;
    let after = step(folder, POSTPROCESSOR, "unnormalizer_processor")?;
    let normalisation = NormalisationSection {
        state: config::mode(&before.path, &before.config.norm_map, "STATE")?,
        environment_state: config::mode(&before.path, &before.config.norm_map, "ENV")?,
        action: config::mode(&after.path, &after.config.norm_map, "ACTION")?,
    };
    // observations as they go in, actions as they come out
    let mut statistics = before.statistics;
    statistics.retain(|name, _| !name.starts_with(ACTION));
    statistics.extend(after.statistics.into_iter().filter(|(name, _)| name.starts_with(ACTION)));

    let experiment = Experiment {
        entry: options.name.clone(),
        description: format!("ACT imported from a LeRobot checkpoint, for {}.", options.task),
        task: TaskSection { name: options.task.clone() },
        data: DataSection {
            state_keys: options.state_keys.clone(),
            env_keys: match dims.environment_state {
                0 => Vec::new(),
                _ => options.env_keys.clone(),
            },
            ..DataSection::default()
        },
        normalisation,
        policy,
        train: TrainSection::default(),
        rollout: RolloutSection {
            n_action_steps: act.n_action_steps,
            temporal_ensemble: act.temporal_ensemble_coeff,
            max_steps: None,
        },
    };
    experiment.check()?;

    let model = experiment.policy.build(&dims, 0).map_err(experiment.model_error("build the policy of"))?;
    let model_path = folder.join(MODEL_FILE);
    let weights = weights(&model_path, act.chunk_size)?;
    model.params().load(&weights).map_err(experiment.model_error("load the weights of"))?;
    let modes = experiment.normalisation.modes(dims.environment_state > 0);
    let normaliser = Normaliser::new(&modes, &statistics).map_err(experiment.model_error("take the statistics of"))?;
    let lengths = [(STATE, dims.state), (ENVIRONMENT_STATE, dims.environment_state), (ACTION, dims.action)];
    for (feature, dim) in lengths.into_iter().filter(|(_, dim)| *dim > 0) {
        normaliser.normalise(feature, &mut vec![0.0; dim]).map_err(experiment.model_error("normalise for"))?;
    }

    let statistics = normaliser.tensors().map_err(experiment.model_error("store the normaliser of"))?;
    let about = serde_json::json!({"format": 1, "policy": experiment.policy_type()});
    let draft = EntryDraft {
        meta: EntryMeta {
            format: 0,
            name: options.name.clone(),
            version: 0,
            description: experiment.description.clone(),
            experiment: "imported from LeRobot".to_owned(),
            policy: experiment.policy_type(),
            task: options.task.clone(),
            env_name: None,
            env_version: None,
            parameters: model.params().count() as u64,
            state_keys: experiment.data.state_keys.clone(),
            env_keys: experiment.data.env_keys.clone(),
            dims,
            data: None,
            puzzle: None,
            training: None,
            versions: crate::versions(),
            files: BTreeMap::new(),
        },
        model: tensors::to_bytes(&model_path, &model.params().tensors(), &about)?,
        config: experiment.to_toml(),
        normaliser: tensors::to_bytes(&model_path, &statistics, &serde_json::json!({"format": 1}))?,
    };
    draft.seal(zoo)
}

fn dims(path: &Path, act: &ActConfig) -> Result<Dims, ZooError> {
    let malformed = |reason: String| ZooError::Malformed { path: path.to_owned(), reason };
    let length = |features: &Features, name: &str| match features.get(name).map(|f| f.shape.as_slice()) {
        None => Ok(0),
        Some([n]) => Ok(*n),
        Some(shape) => Err(malformed(format!("{name}: expected a vector, found shape {shape:?}"))),
    };
    let dims = Dims {
        state: length(&act.input_features, STATE)?,
        environment_state: length(&act.input_features, ENVIRONMENT_STATE)?,
        action: length(&act.output_features, ACTION)?,
    };
    if dims.state == 0 || dims.action == 0 {
        return Err(malformed(format!(
            "expected features {STATE} and {ACTION}, found {act_in:?} and {act_out:?}",
            act_in = act.input_features.keys().collect::<Vec<_>>(),
            act_out = act.output_features.keys().collect::<Vec<_>>()
        )));
    }
    Ok(dims)
}

/// The normalising step of a processor.
struct Normalising {
    path: std::path::PathBuf,
    config: NormaliserStep,
    statistics: BTreeMap<String, Tensor>,
}

fn step(folder: &Path, name: &str, registry_name: &str) -> Result<Normalising, ZooError> {
    let path = folder.join(format!("{name}.json"));
    let malformed = |reason: String| ZooError::Malformed { path: path.clone(), reason };
    let pipeline: Pipeline = config::read(&path)?;
    for step in &pipeline.steps {
        let renames = step.config.get("rename_map").and_then(|m| m.as_object()).is_some_and(|m| !m.is_empty());
        if renames {
            return Err(malformed("rename_map: expected no renamed observations".to_owned()));
        }
    }
    let known: Vec<String> = pipeline.steps.iter().map(|s| s.registry_name.clone()).collect();
    let step = pipeline.steps.into_iter().find(|s| s.registry_name == registry_name);
    let step = step.ok_or_else(|| malformed(format!("no step `{registry_name}`; steps: {}", known.join(", "))))?;
    let config: NormaliserStep =
        serde_json::from_value(step.config).map_err(|e| malformed(format!("step `{registry_name}`: {e}")))?;
    if config.eps != 1e-8 {
        return Err(malformed(format!("eps: expected 1e-8, found {:e}", config.eps)));
    }
    let file = step.state_file.ok_or_else(|| malformed(format!("step `{registry_name}` has no state_file")))?;
    if file.contains('/') {
        return Err(malformed(format!("state_file: expected a file beside this one, found `{file}`")));
    }
    let (statistics, _) = tensors::read(&folder.join(file))?;
    Ok(Normalising { path, config, statistics })
}

/// LeRobot's weights under our names; the stored position table must be the computed one.
fn weights(path: &Path, action_horizon: usize) -> Result<BTreeMap<String, Tensor>, ZooError> {
    let malformed = |reason: String| ZooError::Malformed { path: path.to_owned(), reason };
    let (stored, _) = tensors::read(path)?;
    let mut weights = BTreeMap::new();
    for (name, tensor) in stored {
        let Some(ours) = name.strip_prefix(PREFIX) else {
            return Err(malformed(format!("tensor `{name}`: expected a name that begins with `{PREFIX}`")));
        };
        if ours != POSITION_BUFFER {
            weights.insert(ours.to_owned(), tensor);
            continue;
        }
        let difference = || {
            let dim = tensor.dims().last().copied().unwrap_or(0);
            let table = sinusoid_table(action_horizon + 2, dim).map_err(candle_core::Error::wrap)?;
            (tensor.flatten_all()? - table.flatten_all()?)?.abs()?.max_all()?.to_scalar::<f32>()
        };
        let largest = difference().map_err(|e| malformed(format!("tensor `{name}`: {e}")))?;
        // the table is sines and cosines in f32
        if largest.is_nan() || largest > 1e-5 {
            return Err(malformed(format!(
                "tensor `{name}`: expected the sinusoid table, found {largest:e} away from it"
            )));
        }
    }
    Ok(weights)
}
