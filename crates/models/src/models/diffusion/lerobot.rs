//! LeRobot's diffusion files as values: `config.json` and the names of the tensors. Files are read and written in `interchange`.

use super::{Config, NetworkConfig, Prediction, Sampler};
use crate::features::Signature;
use crate::lerobot::{FeatureKeys, PolicyFile};
use crate::normaliser::{ENVIRONMENT_STATE, NormMode};
use candle_core::Tensor;
use nn::{Params, Result};
use serde::Deserialize;
use serde_json::{Value, json};
use std::collections::BTreeMap;

const DIFFUSION: PolicyFile =
    PolicyFile { kind: "diffusion", model: "LeRobot diffusion", prefix: "diffusion.", images: false };

/// Keys that do not matter to a diffusion policy at rest that sees no images.
const OF_NO_MATTER: [&str; 21] = [
    "drop_n_last_frames",
    "vision_backbone",
    "resize_shape",
    "crop_ratio",
    "crop_shape",
    "crop_is_random",
    "use_group_norm",
    "spatial_softmax_num_keypoints",
    "use_separate_rgb_encoder_per_camera",
    "gradient_checkpointing",
    // of a linear schedule, which is refused
    "beta_start",
    "beta_end",
    "compile_model",
    "compile_mode",
    "optimizer_betas",
    "optimizer_eps",
    "scheduler_name",
    "scheduler_warmup_steps",
    "use_policy_training_preset",
    "feature_mapping",
    "rtc_config",
];

/// What a LeRobot `config.json` of type `diffusion` says.
#[derive(Debug, Clone, PartialEq)]
pub struct LerobotDiffusion {
    /// the model
    pub config: Config,
    /// its inputs and outputs
    pub signature: Signature,
    /// actions executed before the next prediction
    pub n_action_steps: usize,
    /// normalisation of state, environment state and action; LeRobot leaves the environment state raw by default
    pub modes: BTreeMap<String, NormMode>,
}

/// The keys of `config.json` under LeRobot's names and with its defaults; another key is an error, as it is there.
#[derive(Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Keys {
    n_obs_steps: usize,
    horizon: usize,
    n_action_steps: usize,
    down_dims: Vec<usize>,
    kernel_size: usize,
    n_groups: usize,
    diffusion_step_embed_dim: usize,
    use_film_scale_modulation: bool,
    noise_scheduler_type: String,
    num_train_timesteps: usize,
    beta_schedule: String,
    prediction_type: Prediction,
    clip_sample: bool,
    clip_sample_range: f64,
    num_inference_steps: Option<usize>,
    do_mask_loss_for_padding: bool,
    normalization_mapping: BTreeMap<String, String>,
    input_features: BTreeMap<String, FeatureKeys>,
    output_features: BTreeMap<String, FeatureKeys>,
}

impl Default for Keys {
    fn default() -> Self {
        let network = NetworkConfig::default();
        let mapping = ["STATE", "ACTION"].map(|kind| (kind.to_string(), "MIN_MAX".to_string()));
        Self {
            n_obs_steps: 2,
            horizon: 64,
            n_action_steps: 32,
            down_dims: network.down_dims,
            kernel_size: network.kernel_size,
            n_groups: network.n_groups,
            diffusion_step_embed_dim: network.step_embed_dim,
            use_film_scale_modulation: network.film_scale,
            noise_scheduler_type: "DDPM".to_string(),
            num_train_timesteps: 100,
            beta_schedule: "squaredcos_cap_v2".to_string(),
            prediction_type: Prediction::Epsilon,
            clip_sample: true,
            clip_sample_range: 1.0,
            num_inference_steps: None,
            do_mask_loss_for_padding: false,
            normalization_mapping: BTreeMap::from(mapping),
            input_features: BTreeMap::new(),
            output_features: BTreeMap::new(),
        }
    }
}

/// Reads a `config.json`.
///
/// # Errors
/// Another type of policy, images, another schedule of noise, a missing feature, or a configuration that is impossible.
pub fn read_config(config: &Value) -> Result<LerobotDiffusion> {
    let keys: Keys = DIFFUSION.keys(config, &OF_NO_MATTER)?;
    if keys.beta_schedule != "squaredcos_cap_v2" {
        return Err(DIFFUSION.refuse("beta_schedule", keys.beta_schedule, "squaredcos_cap_v2"));
    }
    let sampler = match keys.noise_scheduler_type.as_str() {
        "DDPM" => Sampler::Ddpm,
        "DDIM" => Sampler::Ddim,
        other => return Err(DIFFUSION.refuse("noise_scheduler_type", other, "DDPM or DDIM")),
    };
    let (signature, modes) =
        DIFFUSION.read_features(&keys.input_features, &keys.output_features, &keys.normalization_mapping)?;
    let most = (keys.horizon + 1).saturating_sub(keys.n_obs_steps);
    if keys.n_action_steps == 0 || keys.n_action_steps > most {
        let expected = format!("1 to horizon - n_obs_steps + 1, {most}");
        return Err(DIFFUSION.refuse("n_action_steps", keys.n_action_steps.to_string(), &expected));
    }
    let config = Config {
        action_horizon: keys.horizon,
        network: NetworkConfig {
            down_dims: keys.down_dims,
            kernel_size: keys.kernel_size,
            n_groups: keys.n_groups,
            step_embed_dim: keys.diffusion_step_embed_dim,
            film_scale: keys.use_film_scale_modulation,
        },
        num_train_timesteps: keys.num_train_timesteps,
        prediction: keys.prediction_type,
        sampler,
        inference_steps: keys.num_inference_steps.unwrap_or(keys.num_train_timesteps),
        clip_sample: if keys.clip_sample { keys.clip_sample_range } else { 0.0 },
        mask_padding: keys.do_mask_loss_for_padding,
        transformer: None,
        vision: None,
    };
    config.validate()?;
    let signature = Signature { n_obs_steps: keys.n_obs_steps, ..signature };
    Ok(LerobotDiffusion { config, signature, n_action_steps: keys.n_action_steps, modes })
}

/// Writes a `config.json` that LeRobot 0.6.1 loads.
///
/// # Errors
/// What LeRobot's diffusion cannot read: entities, nothing but a state, or another network than its UNet.
pub fn write_config(diffusion: &LerobotDiffusion) -> Result<Value> {
    let (c, signature) = (&diffusion.config, &diffusion.signature);
    if c.transformer.is_some() {
        return Err(DIFFUSION.refuse(
            "transformer",
            "a transformer",
            "LeRobot's UNet, the only network that its diffusion has",
        ));
    }
    let own = json!({
        "horizon": c.action_horizon,
        "n_action_steps": diffusion.n_action_steps,
        "down_dims": c.network.down_dims,
        "kernel_size": c.network.kernel_size,
        "n_groups": c.network.n_groups,
        "diffusion_step_embed_dim": c.network.step_embed_dim,
        "use_film_scale_modulation": c.network.film_scale,
        "noise_scheduler_type": match c.sampler { Sampler::Ddpm => "DDPM", Sampler::Ddim => "DDIM" },
        "num_train_timesteps": c.num_train_timesteps,
        "beta_schedule": "squaredcos_cap_v2",
        "prediction_type": c.prediction,
        "clip_sample": c.clip_sample > 0.0,
        "clip_sample_range": if c.clip_sample > 0.0 { c.clip_sample } else { 1.0 },
        "num_inference_steps": c.inference_steps,
        "do_mask_loss_for_padding": c.mask_padding,
    });
    let written = DIFFUSION.write_config(signature, &diffusion.modes, own)?;
    // what it cannot read at all is named first
    if signature.get(ENVIRONMENT_STATE).is_none() {
        let expected = "observation.environment_state, without which LeRobot has no diffusion on states";
        return Err(DIFFUSION.refuse("input_features", "observation.state alone", expected));
    }
    Ok(written)
}

/// Loads the tensors of a LeRobot `model.safetensors` into the parameters of a diffusion model: the name set must be exactly
/// the model's, each with LeRobot's prefix.
///
/// # Errors
/// The first tensor that is missing, extra or misshapen.
pub fn load_tensors(params: &Params, tensors: &BTreeMap<String, Tensor>) -> Result<()> {
    params.load(&DIFFUSION.own_names(params, tensors)?)
}

/// The tensors of a LeRobot `model.safetensors` for the parameters of a diffusion model.
pub fn tensors_out(params: &Params) -> BTreeMap<String, Tensor> {
    params.tensors().into_iter().map(|(name, tensor)| (DIFFUSION.prefixed(&name), tensor)).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::features::FeatureSpec;
    use crate::normaliser::{ACTION, STATE};

    fn example() -> LerobotDiffusion {
        let network = NetworkConfig { down_dims: vec![8, 16], n_groups: 4, ..NetworkConfig::default() };
        let modes = [(STATE, NormMode::MinMax), (ENVIRONMENT_STATE, NormMode::Identity), (ACTION, NormMode::MinMax)];
        LerobotDiffusion {
            config: Config { network, clip_sample: 0.0, ..Config::default() },
            signature: Signature { n_obs_steps: 2, ..Signature::low_dimensional(3, 2, 2) },
            n_action_steps: 8,
            modes: modes.map(|(name, mode)| (name.to_string(), mode)).into(),
        }
    }

    #[test]
    fn what_is_written_reads_back() {
        let one = example();
        assert_eq!(read_config(&write_config(&one).unwrap()).unwrap(), one);
    }

    #[test]
    fn what_cannot_be_run_is_refused_by_name() {
        let good = write_config(&example()).unwrap();
        for (field, value, named) in [
            ("type", json!("act"), "act"),
            ("beta_schedule", json!("linear"), "linear"),
            ("noise_scheduler_type", json!("Euler"), "Euler"),
            ("n_action_steps", json!(16), "n_action_steps is 16, expected 1 to horizon - n_obs_steps + 1, 15"),
            ("horizon", json!(14), "a multiple of 2^2"),
            ("prediction_type", json!("v"), "config.json"),
            ("n_gruops", json!(2), "n_gruops"),
            ("normalization_mapping", json!({"STATE": "QUANTILES"}), "QUANTILES"),
            ("input_features", json!({}), "observation.state"),
            ("input_features", json!({"observation.image": {"type": "VISUAL", "shape": [3, 8, 8]}}), "VISUAL"),
        ] {
            let mut bad = good.clone();
            bad[field] = value;
            let error = read_config(&bad).unwrap_err().to_string();
            assert!(error.contains(named), "{field}: {error}");
        }
    }

    #[test]
    fn what_lerobot_cannot_read_is_not_written() {
        let mut entities = example();
        entities.signature.observation.push(FeatureSpec::entity("cube", 3, "cube", false));
        assert!(write_config(&entities).unwrap_err().to_string().contains("observation.entity.cube of kind entity"));
        entities.signature.observation.remove(1);
        assert!(write_config(&entities).unwrap_err().to_string().contains("observation.entity.cube of kind entity"));
        let mut alone = example();
        alone.signature.observation.truncate(1);
        assert!(write_config(&alone).unwrap_err().to_string().contains("observation.state alone"));
        let mut tokens = example();
        tokens.config.transformer = Some(super::super::TransformerConfig::default());
        assert!(
            write_config(&tokens).unwrap_err().to_string().contains("transformer is a transformer, expected LeRobot")
        );
    }
}
