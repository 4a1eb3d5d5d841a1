//! LeRobot's ACT files as values: `config.json`, the names of the tensors and the statistics of images. Files are read and
//! written in `interchange`.

use super::Config;
use crate::encoders::{Architecture, IMAGE_MEAN, IMAGE_STD, ImageEncoder, ImageNorm, TokenKind, VisionConfig};
use crate::features::{FeatureKind, Signature};
use crate::layers::{AUXILIARY_HEAD, Activation, sinusoid_table};
use crate::lerobot::{FeatureKeys, PolicyFile, mode_of};
use crate::normaliser::NormMode;
use candle_core::{DType, Device, Tensor};
use nn::{ModelError, Params, Result, some_names};
use serde::de::Error as _;
use serde::{Deserialize, Deserializer};
use serde_json::{Value, json};
use std::collections::BTreeMap;

const ACT: PolicyFile = PolicyFile { kind: "act", model: "LeRobot act", prefix: "model.", images: true };
/// Channels of the first layer of torchvision's networks.
const LEROBOTS_WIDTH: usize = 64;
/// Buffers of ours that stand among LeRobot's statistics, not among its weights.
const OF_IMAGES: [&str; 2] = [IMAGE_MEAN, IMAGE_STD];
/// LeRobot saves this fixed table with the weights.
const POSITION_BUFFER: &str = "vae_encoder_pos_enc";
/// How far its sines and cosines may be off: bf16 rounds numbers below 1 to 1/512.
const TABLE_TOLERANCE: f32 = 1.0 / 256.0;

/// What a LeRobot `config.json` of type `act` says.
#[derive(Debug, Clone, PartialEq)]
pub struct LerobotAct {
    /// the model
    pub config: Config,
    /// its inputs and outputs
    pub signature: Signature,
    /// actions executed before the next prediction
    pub n_action_steps: usize,
    /// temporal ensembling instead
    pub temporal_ensemble_coeff: Option<f64>,
    /// normalisation of state, environment state and action; LeRobot leaves the environment state raw by default
    pub modes: BTreeMap<String, NormMode>,
}

/// The keys of `config.json` under LeRobot's names and with its defaults; another key is an error, as it is there.
#[derive(Debug, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Keys {
    chunk_size: usize,
    n_action_steps: usize,
    n_obs_steps: usize,
    pre_norm: bool,
    dim_model: usize,
    n_heads: usize,
    dim_feedforward: usize,
    feedforward_activation: Activation,
    n_encoder_layers: usize,
    n_decoder_layers: usize,
    use_vae: bool,
    latent_dim: usize,
    n_vae_encoder_layers: usize,
    temporal_ensemble_coeff: Option<f64>,
    dropout: f64,
    kl_weight: f64,
    vision_backbone: String,
    #[serde(deserialize_with = "truth")]
    replace_final_stride_with_dilation: bool,
    normalization_mapping: BTreeMap<String, String>,
    input_features: BTreeMap<String, FeatureKeys>,
    output_features: BTreeMap<String, FeatureKeys>,
}

/// True or false, or 1 or 0: LeRobot calls the value a number, writes `false` in a first training and `0` in one that goes on.
fn truth<'de, D: Deserializer<'de>>(from: D) -> std::result::Result<bool, D::Error> {
    match Value::deserialize(from)? {
        Value::Bool(value) => Ok(value),
        number if number == 0 => Ok(false),
        number if number == 1 => Ok(true),
        other => Err(D::Error::custom(format!("{other} where true, false, 0 or 1 is expected"))),
    }
}

impl Default for Keys {
    fn default() -> Self {
        let config = Config::default();
        let mapping = ["VISUAL", "STATE", "ACTION"].map(|k| (k.to_string(), "MEAN_STD".to_string()));
        Self {
            chunk_size: config.action_horizon,
            n_action_steps: 100,
            n_obs_steps: 1,
            pre_norm: config.pre_norm,
            dim_model: config.dim_model,
            n_heads: config.n_heads,
            dim_feedforward: config.dim_feedforward,
            feedforward_activation: config.feedforward_activation,
            n_encoder_layers: config.n_encoder_layers,
            n_decoder_layers: config.n_decoder_layers,
            use_vae: config.use_vae,
            latent_dim: config.latent_dim,
            n_vae_encoder_layers: config.n_vae_encoder_layers,
            temporal_ensemble_coeff: None,
            dropout: config.dropout,
            kl_weight: config.kl_weight,
            vision_backbone: "resnet18".to_string(),
            replace_final_stride_with_dilation: false,
            normalization_mapping: BTreeMap::from(mapping),
            input_features: BTreeMap::new(),
            output_features: BTreeMap::new(),
        }
    }
}

/// Reads a `config.json`.
///
/// # Errors
/// Another type of policy, another image encoder than ResNet18 and ResNet34, several observation steps, a missing feature,
/// or a configuration that is impossible.
pub fn read_config(config: &Value) -> Result<LerobotAct> {
    let keys: Keys = ACT.keys(config, &["optimizer_lr_backbone"])?;
    if keys.n_obs_steps != 1 {
        return Err(ACT.refuse("n_obs_steps", keys.n_obs_steps.to_string(), "1"));
    }
    let (signature, modes) =
        ACT.read_features(&keys.input_features, &keys.output_features, &keys.normalization_mapping)?;
    let seen = signature.of_kind(FeatureKind::Image).next().is_some();
    if keys.n_action_steps == 0 || keys.n_action_steps > keys.chunk_size {
        let expected = format!("1 to chunk_size, {}", keys.chunk_size);
        return Err(ACT.refuse("n_action_steps", keys.n_action_steps.to_string(), &expected));
    }
    if keys.temporal_ensemble_coeff.is_some() && keys.n_action_steps != 1 {
        return Err(ACT.refuse("n_action_steps", keys.n_action_steps.to_string(), "1 with temporal_ensemble_coeff"));
    }
    let config = Config {
        action_horizon: keys.chunk_size,
        pre_norm: keys.pre_norm,
        dim_model: keys.dim_model,
        n_heads: keys.n_heads,
        dim_feedforward: keys.dim_feedforward,
        feedforward_activation: keys.feedforward_activation,
        n_encoder_layers: keys.n_encoder_layers,
        n_decoder_layers: keys.n_decoder_layers,
        use_vae: keys.use_vae,
        latent_dim: keys.latent_dim,
        n_vae_encoder_layers: keys.n_vae_encoder_layers,
        dropout: keys.dropout,
        kl_weight: keys.kl_weight,
        vision: if seen { Some(vision(&keys)?) } else { None },
        pointer: None,
        auxiliary: None,
    };
    config.validate()?;
    Ok(LerobotAct {
        config,
        signature,
        n_action_steps: keys.n_action_steps,
        temporal_ensemble_coeff: keys.temporal_ensemble_coeff,
        modes,
    })
}

/// The image encoder that LeRobot builds: torchvision's by name. A narrow one, which somebody put among torchvision's under
/// a name like `resnet18_w8`, has as many channels in its first layer.
fn vision(keys: &Keys) -> Result<VisionConfig> {
    let name = keys.vision_backbone.as_str();
    let (name, width) = match name.split_once("_w").map(|(name, width)| (name, width.parse())) {
        Some((name, Ok(width))) => (name, width),
        _ => (name, LEROBOTS_WIDTH),
    };
    let encoder = match name {
        "resnet18" => Architecture::Resnet18,
        "resnet34" => Architecture::Resnet34,
        _ => return Err(ACT.refuse("vision_backbone", &keys.vision_backbone, "resnet18 or resnet34")),
    };
    if keys.replace_final_stride_with_dilation {
        return Err(ACT.refuse("replace_final_stride_with_dilation", "true", "false: basic blocks are not dilated"));
    }
    let norm = ImageNorm::Frozen;
    // what normalises images comes with the statistics
    Ok(VisionConfig { encoder, width, norm, lr_backbone: Some(1.0), ..VisionConfig::default() })
}

/// Writes what LeRobot builds an image encoder from, or says what it cannot hold.
fn write_vision(vision: &VisionConfig, into: &mut Value) -> Result<()> {
    let cannot = |field, found: String, expected: &str| Err(ACT.refuse(field, found, expected));
    if vision.norm != ImageNorm::Frozen {
        return cannot("vision.norm", "group".to_string(), "frozen: LeRobot's ACT has no other norm");
    }
    if vision.width != LEROBOTS_WIDTH {
        let expected = format!("{LEROBOTS_WIDTH}: LeRobot takes torchvision's networks");
        return cannot("vision.width", vision.width.to_string(), &expected);
    }
    if let Some(side) = vision.crop {
        return cannot("vision.crop", side.to_string(), "none: LeRobot's ACT does not crop");
    }
    if let Some(blocks) = vision.blocks {
        return cannot("vision.blocks", format!("{blocks:?}"), "none: LeRobot takes torchvision's networks");
    }
    if vision.tokens != TokenKind::Map {
        return cannot("vision.tokens", "keypoints".to_string(), "map: LeRobot's ACT has no keypoints");
    }
    let name = match vision.encoder {
        Architecture::Resnet18 => "resnet18",
        Architecture::Resnet34 => "resnet34",
    };
    into["vision_backbone"] = json!(name);
    // null, or LeRobot asks the network for ImageNet's weights before it reads ours
    into["pretrained_backbone_weights"] = Value::Null;
    into["replace_final_stride_with_dilation"] = json!(false);
    Ok(())
}

/// Writes a `config.json` that LeRobot 0.6.1 loads.
///
/// # Errors
/// What LeRobot's ACT cannot hold: entities, a history, a crop, GroupNorm, a narrow network.
pub fn write_config(act: &LerobotAct) -> Result<Value> {
    let c = &act.config;
    if act.signature.n_obs_steps != 1 {
        return Err(ACT.refuse("n_obs_steps", act.signature.n_obs_steps.to_string(), "1"));
    }
    let mut config = json!({
        "chunk_size": c.action_horizon,
        "n_action_steps": act.n_action_steps,
        "temporal_ensemble_coeff": act.temporal_ensemble_coeff,
        "pre_norm": c.pre_norm,
        "dim_model": c.dim_model,
        "n_heads": c.n_heads,
        "dim_feedforward": c.dim_feedforward,
        "feedforward_activation": c.feedforward_activation,
        "n_encoder_layers": c.n_encoder_layers,
        "n_decoder_layers": c.n_decoder_layers,
        "use_vae": c.use_vae,
        "latent_dim": c.latent_dim,
        "n_vae_encoder_layers": c.n_vae_encoder_layers,
        "dropout": c.dropout,
        "kl_weight": c.kl_weight,
    });
    if act.signature.of_kind(FeatureKind::Image).next().is_some() {
        write_vision(c.vision.as_ref().unwrap_or(&VisionConfig::default()), &mut config)?;
    }
    ACT.write_config(&act.signature, &act.modes, config)
}

/// Loads the tensors of a LeRobot `model.safetensors` into the parameters of an ACT: the name set must be exactly the
/// model's, each with LeRobot's prefix, plus the fixed position table, which must hold LeRobot's values.
///
/// # Errors
/// The first tensor that is missing, extra, misshapen or, for the table, different.
pub fn load_tensors(params: &Params, config: &Config, tensors: &BTreeMap<String, Tensor>) -> Result<()> {
    let mut own = ACT.own_names(params, tensors)?;
    if config.use_vae {
        let name = ACT.prefixed(POSITION_BUFFER);
        let table = own
            .remove(POSITION_BUFFER)
            .ok_or_else(|| ModelError::MissingTensor { name: name.clone(), given: some_names(tensors.keys()) })?;
        let expected = sinusoid_table(config.action_horizon + 2, config.dim_model, &Device::Cpu)?;
        if table.dims() != expected.dims() {
            let (expected, found) = (expected.dims().to_vec(), table.dims().to_vec());
            return Err(ModelError::MisshapenTensor { name, expected, found });
        }
        let off = (table - expected)?.abs()?.flatten_all()?.max(0)?.to_scalar::<f32>()?;
        if off.is_nan() || off > TABLE_TOLERANCE {
            return Err(ModelError::Input {
                operation: "load LeRobot act",
                object: POSITION_BUFFER,
                found: format!("{off} away from the sinusoid"),
                expected: format!("LeRobot's sinusoid to {TABLE_TOLERANCE}"),
            });
        }
    }
    // what normalises images is not among LeRobot's weights; `load_statistics` takes it
    for (name, buffer) in params.buffers().filter(|(name, _)| OF_IMAGES.contains(name)) {
        own.insert(name.to_string(), buffer.as_detached_tensor());
    }
    params.load(&own)
}

/// Takes what normalises images from LeRobot's statistics, `<feature>.mean` and `.std` of shape (3, 1, 1) each; images
/// without statistics pass as they are, as they do there.
///
/// # Errors
/// Statistics of another shape.
pub fn load_statistics(
    params: &Params,
    signature: &Signature,
    mapping: &BTreeMap<String, String>,
    statistics: &BTreeMap<String, Tensor>,
) -> Result<()> {
    let (mut means, mut stds) = (Vec::new(), Vec::new());
    let mode = mode_of(mapping, "VISUAL")?;
    for spec in signature.of_kind(FeatureKind::Image) {
        if mode == NormMode::MinMax {
            return Err(ACT.refuse("normalization mapping", "VISUAL MIN_MAX", "MEAN_STD or IDENTITY"));
        }
        let of = |statistic: &str, otherwise: f32| -> Result<[f32; 3]> {
            let name = format!("{}.{statistic}", spec.name);
            let Some(tensor) = statistics.get(&name).filter(|_| mode == NormMode::MeanStd) else {
                return Ok([otherwise; 3]);
            };
            let values = tensor.to_dtype(DType::F32)?.flatten_all()?.to_vec1::<f32>()?;
            let (expected, found) = (vec![3, 1, 1], tensor.dims().to_vec());
            values.try_into().map_err(|_given: Vec<f32>| ModelError::MisshapenTensor { name, expected, found })
        };
        means.push(of("mean", 0.0)?);
        stds.push(of("std", 1.0)?);
    }
    if means.is_empty() { Ok(()) } else { ImageEncoder::set_statistics(params, &means, &stds) }
}

/// What normalises images, as LeRobot's statistics: `<feature>.mean` and `.std`, (3, 1, 1) each.
///
/// # Errors
/// If the tensor library fails.
pub fn statistics_out(params: &Params, signature: &Signature) -> Result<BTreeMap<String, Tensor>> {
    let mut statistics = BTreeMap::new();
    for (buffer, statistic) in OF_IMAGES.iter().zip(["mean", "std"]) {
        let Some((_, values)) = params.buffers().find(|(name, _)| name == buffer) else { continue };
        for (i, spec) in signature.of_kind(FeatureKind::Image).enumerate() {
            let row = values.as_tensor().get(i)?.copy()?.reshape((3, 1, 1))?;
            statistics.insert(format!("{}.{statistic}", spec.name), row);
        }
    }
    Ok(statistics)
}

/// The tensors of a LeRobot `model.safetensors` for the parameters of an ACT.
///
/// # Errors
/// If the tensor library fails.
pub fn tensors_out(params: &Params, config: &Config) -> Result<BTreeMap<String, Tensor>> {
    // what only training reads is of no use there
    let theirs = |name: &str| !OF_IMAGES.contains(&name) && !name.starts_with(AUXILIARY_HEAD);
    let named = params.tensors().into_iter().filter(|(name, _)| theirs(name));
    let named = named.map(|(name, t)| (ACT.prefixed(&name), t));
    let mut tensors: BTreeMap<String, Tensor> = named.collect();
    if config.use_vae {
        let table = sinusoid_table(config.action_horizon + 2, config.dim_model, &Device::Cpu)?;
        tensors.insert(ACT.prefixed(POSITION_BUFFER), table);
    }
    Ok(tensors)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::features::FeatureSpec;
    use crate::layers::AuxiliaryConfig;
    use crate::model::PolicyModel;
    use crate::models::act::Act;
    use crate::normaliser::{ACTION, ENVIRONMENT_STATE, STATE};

    fn example() -> LerobotAct {
        LerobotAct {
            config: Config {
                action_horizon: 4,
                dim_model: 8,
                n_heads: 2,
                dim_feedforward: 12,
                pre_norm: true,
                ..Default::default()
            },
            signature: Signature::low_dimensional(3, 2, 2),
            n_action_steps: 4,
            temporal_ensemble_coeff: None,
            modes: BTreeMap::from([
                (STATE.to_string(), NormMode::MeanStd),
                (ENVIRONMENT_STATE.to_string(), NormMode::MinMax),
                (ACTION.to_string(), NormMode::MeanStd),
            ]),
        }
    }

    #[test]
    fn config_and_tensors_come_back() {
        let one = example();
        assert_eq!(read_config(&write_config(&one).unwrap()).unwrap(), one);
        let [a, b] = [1, 2].map(|seed| Act::new(&one.config, &one.signature, seed, &nn::Backend::CPU).unwrap());
        let tensors = tensors_out(a.params(), &one.config).unwrap();
        let load_into_b = |tensors: &BTreeMap<String, Tensor>| load_tensors(b.params(), &one.config, tensors);
        load_into_b(&tensors).unwrap();
        let weight = |act: &Act| act.params().get("action_head.weight").unwrap().to_vec2::<f32>().unwrap();
        assert_eq!(weight(&a), weight(&b));

        let mut bad = tensors.clone();
        let moved = bad.remove("model.decoder.norm.weight").unwrap();
        assert!(load_into_b(&bad).unwrap_err().to_string().contains("decoder.norm.weight is missing"));
        bad.insert("model.decoder.norm.wait".to_string(), moved.clone());
        assert!(load_into_b(&bad).is_err());
        let mut bad = tensors.clone();
        bad.insert("decoder.stray".to_string(), moved);
        assert!(load_into_b(&bad).unwrap_err().to_string().contains("decoder.stray"));
        let mut bad = tensors;
        let table = &bad["model.vae_encoder_pos_enc"];
        bad.insert("model.vae_encoder_pos_enc".to_string(), (table * 1.1).unwrap());
        assert!(load_into_b(&bad).is_err());
    }

    #[test]
    fn what_training_alone_reads_is_not_written() {
        let one = example();
        let told = Config { auxiliary: Some(AuxiliaryConfig::default()), ..one.config.clone() };
        let signature = Signature { auxiliary_dim: 3, ..one.signature.clone() };
        let act = Act::new(&told, &signature, 1, &nn::Backend::CPU).unwrap();
        let names = |act: &Act, config| tensors_out(act.params(), config).unwrap().into_keys().collect::<Vec<_>>();
        assert!(act.params().get("auxiliary_head.weight").is_some());
        assert_eq!(
            names(&act, &told),
            names(&Act::new(&one.config, &one.signature, 1, &nn::Backend::CPU).unwrap(), &one.config)
        );
    }

    #[test]
    fn a_training_that_went_on_writes_numbers_for_truth_values() {
        let mut config = write_config(&example()).unwrap();
        config["replace_final_stride_with_dilation"] = json!(0);
        assert_eq!(read_config(&config).unwrap(), example());
    }

    #[test]
    fn what_cannot_be_run_is_refused_by_name() {
        let good = write_config(&example()).unwrap();
        for (field, value, named) in [
            ("type", json!("diffusion"), "diffusion"),
            ("n_obs_steps", json!(2), "n_obs_steps"),
            ("n_action_steps", json!(5), "n_action_steps"),
            ("n_heads", json!(3), "n_heads"),
            ("feedforward_activation", json!("glu"), "glu"),
            ("chunk_size", json!("many"), "config.json"),
            ("n_haeds", json!(2), "n_haeds"),
            ("replace_final_stride_with_dilation", json!(2), "0 or 1 is expected"),
            ("normalization_mapping", json!({"STATE": "QUANTILES"}), "QUANTILES"),
            ("input_features", json!({}), "observation.state"),
        ] {
            let mut bad = good.clone();
            bad[field] = value;
            let error = read_config(&bad).unwrap_err().to_string();
            assert!(error.contains(named), "{error}");
        }
    }

    #[test]
    fn what_lerobot_cannot_read_is_not_written() {
        let mut entities = example();
        entities.signature.observation.push(FeatureSpec::entity("cube", 3, "cube", false));
        let error = write_config(&entities).unwrap_err().to_string();
        assert!(error.contains("observation.entity.cube of kind entity"), "{error}");
        let mut history = example();
        history.signature.n_obs_steps = 2;
        assert!(write_config(&history).unwrap_err().to_string().contains("n_obs_steps is 2"));
    }
}
