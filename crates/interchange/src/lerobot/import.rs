//! A LeRobot checkpoint of ACT or of diffusion becomes an entry.

use std::collections::BTreeMap;
use std::path::Path;

use candle_core::Tensor;
use models::{
    ACTION, Backend, ENVIRONMENT_STATE, FeatureKind, FeatureSpec, ModelError, NormMode, Normaliser, PolicyConfig,
    Preprocess, STATE, Signature, lerobot,
};
use serde_json::Value;

use results::files::read_file;
use zoo::entry::{CamerasMeta, CardWords, EntryDraft, EntryId, EntryMeta, ParentMeta, reference};
use zoo::experiment::{DataSection, Experiment, IMAGE_PREFIX, NormalisationSection, RolloutSection, TaskSection};
use zoo::run::TrainSection;
use zoo::{ZooError, tensors};

use super::checkpoint::Checkpoint;
use super::config::{self, NormaliserStep, Pipeline};
use super::older;
use super::provenance;
use super::{CONFIG_FILE, MODEL_FILE, POSTPROCESSOR, PREPROCESSOR, TRAIN_CONFIG};

/// What the checkpoint does not say about itself.
#[derive(Debug, Clone)]
pub struct ImportOptions {
    /// Name of the entry.
    pub name: String,
    /// Task that the policy was trained for.
    pub task: String,
    /// Observation keys that make its state, in order. Where none are given: those of the entry that was exported, or the usual.
    pub state_keys: Option<Vec<String>>,
    /// Observation keys that make its environment state, in order; as for the state.
    pub env_keys: Option<Vec<String>>,
    /// Whether the pictures that it learned from were drawn without reflections and multisampling.
    pub fast_render: bool,
}

/// Makes an entry in `zoo` of the checkpoint in `folder`.
///
/// # Errors
/// Files, keys, tensors or statistics that are missing, extra or misshapen, each by name.
pub fn import(folder: &Path, options: &ImportOptions, zoo: &Path) -> Result<EntryId, ZooError> {
    let config_path = folder.join(CONFIG_FILE);
    let config: Value = config::read(&config_path)?;
    let checkpoint = Checkpoint::read(&config).map_err(config::misfit(&config_path))?;
    let Checkpoint { policy, signature, n_action_steps, temporal_ensemble, .. } = &checkpoint;

    if options.fast_render && signature.of_kind(FeatureKind::Image).next().is_none() {
        return Err(ZooError::InvalidValue {
            key: "fast rendering".to_owned(),
            expected: "a policy that sees images".to_owned(),
            found: "one that sees none".to_owned(),
        });
    }
    let model_path = folder.join(MODEL_FILE);
    let mut weights = tensors::read_weights(&model_path)?;
    let (before, after) = match is_older(folder) {
        false => (
            step(folder, PREPROCESSOR, "normalizer_processor")?,
            step(folder, POSTPROCESSOR, "unnormalizer_processor")?,
        ),
        true => {
            let statistics = older::take(&mut weights, signature).ok_or_else(|| ZooError::Malformed {
                path: folder.join(format!("{PREPROCESSOR}.json")),
                reason: format!(
                    "expected this file, or statistics in {MODEL_FILE} (normalize_inputs.buffer_observation_state.mean, \
                     as LeRobot 0.3 and before wrote them); found neither"
                ),
            })?;
            let config = older::step(&config).map_err(|e| ZooError::Malformed {
                path: config_path.clone(),
                reason: format!("normalization_mapping: expected names of modes: {e}"),
            })?;
            let path = config_path.clone();
            let before = Normalising { path: path.clone(), config: config.clone(), statistics: statistics.before };
            (before, Normalising { path, config, statistics: statistics.after })
        }
    };
    let normalisation = NormalisationSection {
        state: before.mode("STATE")?,
        environment_state: before.mode("ENV")?,
        entities: NormMode::default(),
        action: after.mode("ACTION")?,
    };
    // observations as they go in, actions as they come out
    let mut statistics = before.statistics.clone();
    statistics.retain(|name, _| !name.starts_with(ACTION));
    statistics.extend(after.statistics.into_iter().filter(|(name, _)| name.starts_with(ACTION)));

    let origin = provenance::read(folder)?;
    let usual = DataSection::default();
    let experiment = Experiment {
        entry: options.name.clone(),
        description: format!("{} imported from a LeRobot checkpoint, for {}.", name_of(policy), options.task),
        task: TaskSection { name: options.task.clone() },
        data: DataSection {
            state_keys: keys_of(
                options.state_keys.as_ref(),
                origin.as_ref(),
                (STATE, "--state-keys"),
                usual.state_keys,
            )?,
            env_keys: match signature.get(ENVIRONMENT_STATE) {
                None => Vec::new(),
                Some(_) => {
                    let named = (ENVIRONMENT_STATE, "--env-keys");
                    keys_of(options.env_keys.as_ref(), origin.as_ref(), named, usual.env_keys)?
                }
            },
            n_obs_steps: signature.n_obs_steps,
            cameras: cameras(signature).map_err(config::misfit(&config_path))?,
            ..DataSection::default()
        },
        normalisation,
        policy: policy.clone(),
        train: TrainSection::default(),
        rollout: RolloutSection {
            n_action_steps: *n_action_steps,
            temporal_ensemble: *temporal_ensemble,
            max_steps: None,
        },
    };
    experiment.check()?;
    experiment.policy.check_size(&weights).map_err(config::misfit(&model_path))?;

    let model =
        experiment.policy.build(signature, 0, &Backend::CPU).map_err(experiment.model_error("build the policy of"))?;
    checkpoint
        .load(model.params(), &weights, &before.config.norm_map, &before.statistics)
        .map_err(config::misfit(&model_path))?;
    let modes = experiment.normalisation.modes(signature);
    let preprocess = Normaliser::new(&modes, &statistics)
        .and_then(|normaliser| Preprocess::new(signature.clone(), normaliser, model.params().device()))
        .map_err(experiment.model_error("take the statistics of"))?;

    let statistics = preprocess.normaliser().tensors().map_err(experiment.model_error("store the normaliser of"))?;
    let about = serde_json::json!({"format": 1, "policy": experiment.policy_type()});
    if let Some(origin) = origin.as_ref().filter(|origin| origin.task != options.task) {
        return Err(ZooError::InvalidValue {
            key: "--task".to_owned(),
            expected: format!("{}, the task of the exported entry", origin.task),
            found: options.task.clone(),
        });
    }
    let of_origin = origin.as_ref();
    let (weights, name) = (model.params().tensors(), EntryId { name: options.name.clone(), version: 0 });
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
            experiment: match of_origin {
                Some(origin) => format!("{}, exported to LeRobot as {} and imported", origin.experiment, origin.id()),
                None => format!("imported from LeRobot{}", trained_as(folder)),
            },
            policy: experiment.policy_type(),
            task: options.task.clone(),
            env_name: of_origin.and_then(|origin| origin.env_name.clone()),
            env_version: of_origin.and_then(|origin| origin.env_version.clone()),
            env_module: None,
            env_args: of_origin
                .and_then(|origin| origin.env_args.clone().map(crate::without_module))
                .or_else(|| options.fast_render.then(CamerasMeta::fast)),
            parameters: model.params().count() as u64,
            signature: preprocess.signature().clone(),
            keys: experiment.data.feature_keys()?,
            data: of_origin.and_then(|origin| origin.data.clone()),
            kind: None,
            section: None,
            training: of_origin.and_then(|origin| origin.training.clone()),
            parent: of_origin
                .map(|origin| ParentMeta { entry: origin.id().to_string(), content_sha256: origin.content_sha256() }),
            license: of_origin.map(|origin| origin.license().to_owned()),
            versions: zoo::versions(),
            files: BTreeMap::new(),
        },
        model: tensors::to_bytes(&model_path, &weights, &about)?,
        config: experiment.to_toml(),
        normaliser: tensors::to_bytes(&model_path, &statistics, &serde_json::json!({"format": 1}))?,
    };
    draft.seal(zoo)
}

/// The keys of a feature: those that were asked for, which must be those of the entry that was exported, if it was one.
fn keys_of(
    asked: Option<&Vec<String>>,
    origin: Option<&EntryMeta>,
    (feature, option): (&str, &str),
    usual: Vec<String>,
) -> Result<Vec<String>, ZooError> {
    let known = origin.map(|origin| origin.keys.of(feature)).filter(|keys| !keys.is_empty());
    match (asked, known) {
        (Some(asked), Some(known)) if *asked != known => Err(ZooError::InvalidValue {
            key: option.to_owned(),
            expected: format!("{}, the keys of the exported entry", known.join(",")),
            found: asked.join(","),
        }),
        (Some(asked), _) => Ok(asked.clone()),
        (None, known) => Ok(known.unwrap_or(usual)),
    }
}

/// Whether LeRobot wrote the checkpoint before it had processors.
fn is_older(folder: &Path) -> bool {
    [PREPROCESSOR, POSTPROCESSOR].iter().all(|name| !folder.join(format!("{name}.json")).exists())
}

/// What `lerobot-train` left beside the checkpoint about its training: `, trained on lerobot/pusht, 100000 steps of 8, seed 1000`.
fn trained_as(folder: &Path) -> String {
    let read = |path: &Path| {
        let text = read_file(path, config::MOST_TEXT).ok()?;
        serde_json::from_slice::<Value>(&text).ok()
    };
    let Some(config) = read(&folder.join(TRAIN_CONFIG)) else { return String::new() };
    let state = folder.parent().and_then(|parent| read(&parent.join("training_state/training_step.json")));
    let steps = state.as_ref().and_then(|state| state["step"].as_u64()).or_else(|| config["steps"].as_u64());
    let data = config["dataset"]["repo_id"].as_str().map(|name| format!(", trained on {name}"));
    let steps = steps.map(|steps| match config["batch_size"].as_u64() {
        Some(batch) => format!(", {steps} steps of {batch}"),
        None => format!(", {steps} steps"),
    });
    let seed = config["seed"].as_u64().map(|seed| format!(", seed {seed}"));
    [data, steps, seed].into_iter().flatten().collect()
}

/// The policy in the words of a description.
fn name_of(policy: &PolicyConfig) -> &'static str {
    match policy {
        PolicyConfig::Diffusion(_) => "A diffusion policy",
        _ => "ACT",
    }
}

/// The simulator's names of the cameras: what their features are called after LeRobot's prefix.
fn cameras(signature: &Signature) -> Result<Vec<String>, ModelError> {
    let name = |spec: &FeatureSpec| match spec.name.strip_prefix(IMAGE_PREFIX) {
        Some(camera) => Ok(camera.to_owned()),
        None => Err(ModelError::Input {
            operation: "import",
            object: "image",
            found: spec.name.clone(),
            expected: format!("{IMAGE_PREFIX}<camera>"),
        }),
    };
    signature.of_kind(FeatureKind::Image).map(name).collect()
}

/// The normalising step of a processor.
struct Normalising {
    path: std::path::PathBuf,
    config: NormaliserStep,
    statistics: BTreeMap<String, Tensor>,
}

impl Normalising {
    fn mode(&self, kind: &str) -> Result<NormMode, ZooError> {
        lerobot::mode_of(&self.config.norm_map, kind).map_err(config::misfit(&self.path))
    }
}

/// Steps that leave numbers as they are: another step would change what the network reads or what becomes of its actions.
const PASSING: [&str; 3] = ["rename_observations_processor", "to_batch_processor", "device_processor"];

fn step(folder: &Path, name: &str, registry_name: &str) -> Result<Normalising, ZooError> {
    let path = folder.join(format!("{name}.json"));
    let malformed = |reason: String| ZooError::Malformed { path: path.clone(), reason };
    let pipeline: Pipeline = config::read(&path)?;
    for step in &pipeline.steps {
        let renames = step.config.get("rename_map").and_then(|m| m.as_object()).is_some_and(|m| !m.is_empty());
        if renames {
            return Err(malformed("rename_map: expected no renamed observations".to_owned()));
        }
        let off = step.config.get("enabled").and_then(Value::as_bool) == Some(false);
        if step.registry_name != registry_name && !PASSING.contains(&step.registry_name.as_str()) && !off {
            let expected = format!("{registry_name}, {}, or a step with `enabled` false", PASSING.join(", "));
            return Err(malformed(format!("step `{}`: expected {expected}", step.registry_name)));
        }
    }
    let known: Vec<String> = pipeline.steps.iter().map(|s| s.registry_name.clone()).collect();
    let step = pipeline.steps.into_iter().find(|s| s.registry_name == registry_name);
    let step = step.ok_or_else(|| malformed(format!("no step `{registry_name}`; steps: {}", known.join(", "))))?;
    let config: NormaliserStep =
        serde_json::from_value(step.config).map_err(|e| malformed(format!("step `{registry_name}`: {e}")))?;
    if let Some(only) = &config.normalize_observation_keys {
        let found = only.join(", ");
        return Err(malformed(format!("normalize_observation_keys: expected none, so that all are, found {found}")));
    }
    if config.eps != 1e-8 {
        return Err(malformed(format!("eps: expected 1e-8, found {:e}", config.eps)));
    }
    let file = step.state_file.ok_or_else(|| malformed(format!("step `{registry_name}` has no state_file")))?;
    if file.contains('/') {
        return Err(malformed(format!("state_file: expected a file beside this one, found `{file}`")));
    }
    let statistics = tensors::read_weights(&folder.join(file))?;
    Ok(Normalising { path, config, statistics })
}
