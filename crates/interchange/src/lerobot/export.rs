//! An entry whose policy LeRobot has too becomes a folder that it loads.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::{Value, json};

use results::files::new_folder;
use zoo::entry::Entry;
use zoo::{ZooError, sha256_file, tensors, write_atomic};

use super::checkpoint::Checkpoint;
use super::config::{NormaliserStep, Pipeline, Step};
use super::provenance::{self, PROVENANCE};
use super::{CONFIG_FILE, MODEL_FILE, POSTPROCESSOR, PREPROCESSOR};

/// Writes `entry` into the new folder `out`.
///
/// # Errors
/// When `out` exists, the entry is neither ACT nor diffusion, or a file cannot be written.
pub fn export(entry: &Entry, out: &Path) -> Result<(), ZooError> {
    let loaded = entry.load()?;
    let experiment = loaded.experiment();
    let (meta, rollout) = (entry.meta(), &experiment.rollout);
    let checkpoint = Checkpoint {
        policy: experiment.policy.clone(),
        signature: meta.signature.clone(),
        n_action_steps: rollout.n_action_steps,
        temporal_ensemble: rollout.temporal_ensemble,
        modes: experiment.normalisation.modes(&meta.signature),
    };
    let Some(config) = checkpoint.write() else {
        let reason = format!("LeRobot export takes ACT and diffusion, found {}", experiment.policy_type());
        return Err(ZooError::NotPossible { what: format!("entry {}", entry.id()), reason });
    };
    let model_error = || experiment.model_error("export");
    let config = config.map_err(model_error())?;
    let (weights, of_pictures) = checkpoint.tensors(loaded.model().params()).map_err(model_error())?;
    let mut statistics = loaded.preprocess().normaliser().tensors().map_err(model_error())?;
    statistics.extend(of_pictures);

    let (inputs, outputs) = (&config["input_features"], &config["output_features"]);
    let norm_map: BTreeMap<String, String> =
        serde_json::from_value(config["normalization_mapping"].clone()).expect("names of modes");
    let mut features = inputs.clone();
    for (name, feature) in outputs.as_object().expect("features by name") {
        features[name] = feature.clone();
    }
    let device = || step("device_processor", json!({"device": "cpu", "float_dtype": null}));
    let normalise = |name: &str, features: Value, pipeline: &str, index: usize| Step {
        state_file: Some(format!("{pipeline}_step_{index}_{name}.safetensors")),
        ..step(
            name,
            to_json(&NormaliserStep {
                eps: 1e-8,
                features,
                norm_map: norm_map.clone(),
                normalize_observation_keys: None,
            }),
        )
    };
    let before = Pipeline {
        name: PREPROCESSOR.to_owned(),
        steps: vec![
            step("rename_observations_processor", json!({"rename_map": {}})),
            step("to_batch_processor", json!({})),
            device(),
            normalise("normalizer_processor", features, PREPROCESSOR, 3),
        ],
    };
    let after = Pipeline {
        name: POSTPROCESSOR.to_owned(),
        steps: vec![normalise("unnormalizer_processor", outputs.clone(), POSTPROCESSOR, 0), device()],
    };

    let about = json!({"entry": entry.id().to_string(), "sha256": meta.content_sha256()});
    new_folder(out, |folder| {
        let put = |name: &str, bytes: &[u8]| write_atomic(&folder.join(name), bytes);
        put(MODEL_FILE, &tensors::to_bytes(out, &weights, &about)?)?;
        put(CONFIG_FILE, pretty(&config).as_bytes())?;
        put(PROVENANCE, provenance::text(meta, &sha256_file(&folder.join(MODEL_FILE))?).as_bytes())?;
        for pipeline in [&before, &after] {
            put(&format!("{}.json", pipeline.name), pretty(&to_json(pipeline)).as_bytes())?;
            for file in pipeline.steps.iter().filter_map(|s| s.state_file.as_ref()) {
                put(file, &tensors::to_bytes(out, &statistics, &about)?)?;
            }
        }
        Ok(())
    })
}

fn step(registry_name: &str, config: Value) -> Step {
    Step { registry_name: registry_name.to_owned(), config, state_file: None }
}

fn to_json<T: serde::Serialize>(value: &T) -> Value {
    serde_json::to_value(value).expect("names and numbers become JSON")
}

fn pretty(value: &Value) -> String {
    format!("{value:#}\n")
}
