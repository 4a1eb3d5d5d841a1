//! robomimic's checkpoints of BC-RNN and BC-Transformer with a mixture of Gaussians, as values: the options and shapes that
//! its `save_model` stores, and its names of tensors. This is the one place that knows them; files are read in `zoo`.
//!
//! What stands in a checkpoint and what ours cannot hold is an error with its name; robomimic's options of training (its
//! optimiser, its losses, its data loader) do not matter to a policy at rest.

use crate::features::Signature;
use crate::layers::Cell;
use crate::models::{bc_rnn, bc_transformer};
use crate::normaliser::{ENVIRONMENT_STATE, NormMode, Normaliser, STATE};
use crate::registry::PolicyConfig;
use candle_core::{Device, Tensor};
use nn::{ModelError, Result, some_names};
use serde::Deserialize;
use serde_json::{Map, Value};
use std::collections::BTreeMap;

/// Steps of a sequence, and numbers of an observation key: more of them are no checkpoint.
const LONGEST: usize = 1 << 16;

/// What a checkpoint says of its policy.
#[derive(Debug, Clone)]
pub struct RobomimicBc {
    /// the model
    pub policy: PolicyConfig,
    /// its inputs and outputs
    pub signature: Signature,
    /// normalisation of the observation: by mean and deviation, or none
    pub observation: NormMode,
    /// its statistics by our names, each (D); empty without normalisation
    pub statistics: BTreeMap<String, Tensor>,
    /// for each number of our observation, state before environment state, its place in robomimic's
    places: Vec<usize>,
}

/// What is read beside the weights.
#[derive(Deserialize)]
struct Stored {
    format: u32,
    algo_name: String,
    /// JSON in a text
    config: String,
    /// keys and shapes in the order in which the network takes them
    all_shapes: Vec<(String, Vec<usize>)>,
    shape_metadata: ShapeKeys,
    obs_normalization_stats: Option<BTreeMap<String, Statistics>>,
}

#[derive(Deserialize)]
struct ShapeKeys {
    ac_dim: usize,
}

/// Of one observation key, (1, D) each.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Statistics {
    mean: Vec<Vec<f64>>,
    std: Vec<Vec<f64>>,
}

#[derive(Deserialize)]
struct Keys {
    algo: AlgoKeys,
    train: TrainKeys,
    observation: ObservationKeys,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct AlgoKeys {
    actor_layer_dims: Vec<usize>,
    gaussian: Switch,
    gmm: GmmKeys,
    vae: Switch,
    rnn: RnnKeys,
    transformer: Option<TransformerKeys>,
    // of training
    #[serde(rename = "optim_params")]
    _optim_params: Value,
    #[serde(rename = "loss")]
    _loss: Value,
}

/// A part that is on or off, and what else it says is of no matter where it is off.
#[derive(Deserialize)]
struct Switch {
    enabled: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct GmmKeys {
    enabled: bool,
    num_modes: usize,
    min_std: f64,
    std_activation: String,
    low_noise_eval: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RnnKeys {
    enabled: bool,
    horizon: usize,
    hidden_dim: usize,
    rnn_type: String,
    num_layers: usize,
    #[serde(default)]
    open_loop: bool,
    #[serde(default)]
    kwargs: Map<String, Value>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct TransformerKeys {
    enabled: bool,
    context_length: usize,
    embed_dim: usize,
    num_layers: usize,
    num_heads: usize,
    emb_dropout: f64,
    attn_dropout: f64,
    block_output_dropout: f64,
    sinusoidal_embedding: bool,
    activation: String,
    nn_parameter_for_timesteps: bool,
    // of training: at rest the last step alone is asked
    #[serde(rename = "supervise_all_steps")]
    _supervise_all_steps: bool,
}

#[derive(Deserialize)]
struct TrainKeys {
    #[serde(default = "one")]
    frame_stack: usize,
    #[serde(default)]
    hdf5_normalize_obs: bool,
}

#[derive(Deserialize)]
struct ObservationKeys {
    /// lists of keys by group (`obs`, `goal`) and kind (`low_dim`, `rgb`, …)
    modalities: BTreeMap<String, BTreeMap<String, Vec<String>>>,
    encoder: BTreeMap<String, EncoderKeys>,
}

#[derive(Deserialize)]
struct EncoderKeys {
    core_class: Option<String>,
    obs_randomizer_class: Option<Value>,
}

fn one() -> usize {
    1
}

fn refuse(field: &'static str, found: impl ToString, expected: &str) -> ModelError {
    ModelError::Config { model: "robomimic bc", field, found: found.to_string(), expected: expected.to_string() }
}

/// Fails unless `found` is what ours is.
fn want<T: PartialEq + ToString>(field: &'static str, found: &T, expected: &T) -> Result<()> {
    if found == expected { Ok(()) } else { Err(refuse(field, found.to_string(), &expected.to_string())) }
}

/// Reads what `save_model` stored beside the weights, for observations of which `state_keys` make our state and `env_keys` our
/// environment state.
///
/// # Errors
/// The first option that ours cannot hold, and keys or statistics that are missing, extra or misshapen, by name.
pub fn read_checkpoint(stored: &Value, state_keys: &[String], env_keys: &[String]) -> Result<RobomimicBc> {
    let stored = Stored::deserialize(stored).map_err(|e| refuse("checkpoint", e, "what save_model stores"))?;
    want("format", &stored.format, &1)?;
    want("algo_name", &stored.algo_name, &"bc".to_string())?;
    let keys: Keys = serde_json::from_str(&stored.config)
        .map_err(|e| refuse("config", e, "robomimic 0.3's keys and types of `bc`"))?;
    let policy = policy(&keys)?;
    let (n_obs_steps, stacked) = match &keys.algo.transformer {
        Some(transformer) if transformer.enabled => (transformer.context_length, transformer.context_length),
        _ => (keys.algo.rnn.horizon, 1),
    };
    want("train.frame_stack", &keys.train.frame_stack, &stacked)?;
    if n_obs_steps > LONGEST {
        return Err(refuse("algo.rnn.horizon or context_length", n_obs_steps, &format!("at most {LONGEST} steps")));
    }
    let columns = columns(&keys.observation, &stored.all_shapes)?;
    let (places, [state, env]) = order(&columns, [("state", state_keys), ("environment state", env_keys)])?;
    let signature = Signature::low_dimensional(state.len(), env.len(), stored.shape_metadata.ac_dim);
    let given = stored.obs_normalization_stats.as_ref();
    if given.is_some() != keys.train.hdf5_normalize_obs {
        let found = if given.is_some() { "there" } else { "absent" };
        return Err(refuse("obs_normalization_stats", found, "statistics where train.hdf5_normalize_obs is true"));
    }
    let mut statistics = BTreeMap::new();
    for (feature, keys) in [(STATE, state_keys), (ENVIRONMENT_STATE, env_keys)] {
        let Some(given) = given.filter(|_| !keys.is_empty()) else { continue };
        for (name, values) in pooled(given, keys, &columns)? {
            let count = values.len();
            statistics.insert(format!("{feature}.{name}"), Tensor::from_vec(values, count, &Device::Cpu)?);
        }
    }
    Ok(RobomimicBc {
        policy,
        signature: Signature { n_obs_steps, ..signature },
        observation: if given.is_some() { NormMode::MeanStd } else { NormMode::Identity },
        statistics,
        places,
    })
}

/// The model that these options describe.
fn policy(keys: &Keys) -> Result<PolicyConfig> {
    let AlgoKeys { gmm, rnn, transformer, .. } = &keys.algo;
    let transformer = transformer.as_ref().filter(|transformer| transformer.enabled);
    for (field, switch) in [("algo.gaussian.enabled", &keys.algo.gaussian), ("algo.vae.enabled", &keys.algo.vae)] {
        want(field, &switch.enabled, &false)?;
    }
    if rnn.enabled == transformer.is_some() {
        let expected = "one of algo.rnn and algo.transformer: a perceptron alone ends with tanh there, and not here";
        return Err(refuse("algo", if rnn.enabled { "both enabled" } else { "neither enabled" }, expected));
    }
    want("algo.gmm.enabled", &gmm.enabled, &true)?;
    want("algo.gmm.std_activation", &gmm.std_activation, &"softplus".to_string())?;
    want("algo.gmm.low_noise_eval", &gmm.low_noise_eval, &true)?;
    let policy = match transformer {
        None => {
            let cell = match rnn.rnn_type.as_str() {
                "LSTM" => Cell::Lstm,
                "GRU" => Cell::Gru,
                other => return Err(refuse("algo.rnn.rnn_type", other, "LSTM or GRU")),
            };
            want("algo.rnn.open_loop", &rnn.open_loop, &false)?;
            if let Some((key, value)) = rnn.kwargs.iter().find(|(k, v)| *k != "bidirectional" || **v != false) {
                return Err(refuse("algo.rnn.kwargs", format!("{key} = {value}"), "bidirectional = false alone"));
            }
            if !keys.algo.actor_layer_dims.is_empty() {
                let found = format!("{:?}", keys.algo.actor_layer_dims);
                return Err(refuse(
                    "algo.actor_layer_dims",
                    found,
                    "none: no layers between the recurrent ones and the mixture",
                ));
            }
            PolicyConfig::BcRnn(bc_rnn::Config {
                action_horizon: rnn.horizon,
                hidden_dim: rnn.hidden_dim,
                n_layers: rnn.num_layers,
                cell,
                n_modes: gmm.num_modes,
                min_std: gmm.min_std,
                vision: None,
            })
        }
        Some(t) => {
            want("algo.transformer.sinusoidal_embedding", &t.sinusoidal_embedding, &false)?;
            want("algo.transformer.nn_parameter_for_timesteps", &t.nn_parameter_for_timesteps, &true)?;
            want("algo.transformer.activation", &t.activation, &"gelu".to_string())?;
            want("algo.transformer.attn_dropout", &t.attn_dropout, &t.emb_dropout)?;
            want("algo.transformer.block_output_dropout", &t.block_output_dropout, &t.emb_dropout)?;
            PolicyConfig::BcTransformer(bc_transformer::Config {
                action_horizon: 1,
                dim_model: t.embed_dim,
                n_heads: t.num_heads,
                n_layers: t.num_layers,
                dropout: t.emb_dropout,
                n_modes: gmm.num_modes,
                min_std: gmm.min_std,
                vision: None,
            })
        }
    };
    match &policy {
        PolicyConfig::BcRnn(config) => config.validate()?,
        PolicyConfig::BcTransformer(config) => config.validate()?,
        _ => {}
    }
    Ok(policy)
}

/// Where each observation key lies in what robomimic's network takes: its first number and its width.
fn columns(observation: &ObservationKeys, shapes: &[(String, Vec<usize>)]) -> Result<BTreeMap<String, (usize, usize)>> {
    let mut seen: Vec<&String> = Vec::new();
    for (group, kinds) in &observation.modalities {
        for (kind, keys) in kinds {
            match (group.as_str(), kind.as_str()) {
                ("obs", "low_dim") => seen.extend(keys),
                _ if keys.is_empty() => {}
                _ => {
                    let found = format!("{group}.{kind}: {}", keys.join(", "));
                    return Err(refuse("observation.modalities", found, "keys in obs.low_dim alone"));
                }
            }
        }
    }
    if let Some(encoder) = observation.encoder.get("low_dim") {
        if let Some(core) = &encoder.core_class {
            return Err(refuse("observation.encoder.low_dim.core_class", core, "null: numbers go in as they are"));
        }
        if let Some(class) = encoder.obs_randomizer_class.as_ref().filter(|class| !class.is_null()) {
            return Err(refuse("observation.encoder.low_dim.obs_randomizer_class", class, "null"));
        }
    }
    let (mut columns, mut next) = (BTreeMap::new(), 0);
    for (key, shape) in shapes {
        let width = match shape.as_slice() {
            &[width] if width <= LONGEST => width,
            _ => {
                let expected = format!("one dimension of at most {LONGEST}");
                return Err(refuse("shape_metadata.all_shapes", format!("{key} of shape {shape:?}"), &expected));
            }
        };
        columns.insert(key.clone(), (next, width));
        next += width;
    }
    seen.sort();
    if !seen.iter().copied().eq(columns.keys()) {
        let expected = format!("those of observation.modalities.obs.low_dim, {}", some_names(seen));
        return Err(refuse("shape_metadata.all_shapes", some_names(columns.keys()), &expected));
    }
    Ok(columns)
}

/// The places of our numbers in robomimic's, all of them and by feature; every key of theirs must be named once.
fn order(
    columns: &BTreeMap<String, (usize, usize)>,
    features: [(&str, &[String]); 2],
) -> Result<(Vec<usize>, [Vec<usize>; 2])> {
    let mut left = columns.clone();
    let mut places: [Vec<usize>; 2] = Default::default();
    for ((feature, keys), places) in features.into_iter().zip(&mut places) {
        for key in keys {
            let Some((start, width)) = left.remove(key) else {
                let expected = format!("keys of the checkpoint, each once: {}", some_names(columns.keys()));
                return Err(refuse("observation keys", format!("{key} in the {feature}"), &expected));
            };
            places.extend(start..start + width);
        }
    }
    if let Some(key) = left.keys().next() {
        let expected = "every key of the checkpoint in the state or the environment state";
        return Err(refuse("observation keys", format!("{key} in neither"), expected));
    }
    if places[0].is_empty() {
        return Err(refuse("observation keys", "no state", "at least one key"));
    }
    Ok((places.concat(), places))
}

/// Mean and deviation of the keys, one after the other. robomimic divides by the deviation, we by it and a little more: so much is
/// taken away.
fn pooled(
    given: &BTreeMap<String, Statistics>,
    keys: &[String],
    columns: &BTreeMap<String, (usize, usize)>,
) -> Result<[(&'static str, Vec<f32>); 2]> {
    let (mut means, mut stds) = (Vec::new(), Vec::new());
    for key in keys {
        let Statistics { mean, std } = given
            .get(key)
            .ok_or_else(|| refuse("obs_normalization_stats", some_names(given.keys()), &format!("{key} among them")))?;
        let width = columns[key].1;
        for (what, values, into) in [("mean", mean, &mut means), ("std", std, &mut stds)] {
            let [row] = values.as_slice() else {
                let found = format!("{key}.{what} of {} rows", values.len());
                return Err(refuse("obs_normalization_stats", found, "one row"));
            };
            if row.len() != width {
                let found = format!("{key}.{what} of {} numbers", row.len());
                return Err(refuse("obs_normalization_stats", found, &format!("{width} numbers")));
            }
            into.extend(row);
        }
        if let Some(std) = std[0].iter().find(|std| **std <= 2.0 * f64::from(Normaliser::EPS)) {
            return Err(refuse("obs_normalization_stats", format!("{key}.std with {std}"), "deviations above 0"));
        }
    }
    let exact = |values: Vec<f64>, less: f64| values.into_iter().map(|value| (value - less) as f32).collect();
    Ok([("mean", exact(means, 0.0)), ("std", exact(stds, f64::from(Normaliser::EPS)))])
}

/// Our name of a tensor of robomimic's, or none where it has no place in ours.
fn our_name(name: &str) -> Option<String> {
    let name = name.strip_prefix("policy.")?;
    if name == "params.embed_timestep" {
        return Some("embed_timestep".to_string());
    }
    let name = name.strip_prefix("nets.")?;
    if let Some(rest) = name.strip_prefix("transformer.nets.") {
        let Some(block) = rest.strip_prefix("transformer.") else { return Some(rest.to_string()) };
        let (index, rest) = block.split_once(".nets.")?;
        return Some(format!("transformer.{index}.{rest}"));
    }
    if let Some(rest) = name.strip_prefix("rnn.per_step_net.nets.").or_else(|| name.strip_prefix("decoder.nets.")) {
        return Some(format!("decoder.{rest}"));
    }
    Some(name.strip_prefix("rnn.nets.").map_or_else(|| name.to_string(), |rest| format!("rnn.{rest}")))
}

impl RobomimicBc {
    /// The weights under our names, for an observation in our order.
    ///
    /// # Errors
    /// A name that is not one of robomimic's networks', copies of one tensor that differ, or a mask that is not causal.
    pub fn weights(&self, tensors: &BTreeMap<String, Tensor>) -> Result<BTreeMap<String, Tensor>> {
        let mut weights: BTreeMap<String, Tensor> = BTreeMap::new();
        for (name, tensor) in tensors {
            if name.ends_with(".attention.mask") {
                causal(name, tensor)?;
                continue;
            }
            let Some(ours) = our_name(name) else {
                let known = "names of robomimic's networks: policy.nets.*".to_string();
                return Err(ModelError::ExtraTensor { name: name.clone(), known });
            };
            // the first layer takes robomimic's observation, and is to take ours
            let tensor = match ours.as_str() {
                "rnn.weight_ih_l0" | "embed_encoder.weight" => self.reordered(name, tensor)?,
                _ => tensor.clone(),
            };
            // the head of an LSTM stands there twice, by both of its owners
            if let Some(twin) = weights.get(&ours)
                && !same(twin, &tensor)?
            {
                let (object, found) = ("tensor", format!("{name}, which differs from its copy"));
                let expected = "the same numbers by both names".to_string();
                return Err(ModelError::Input { operation: "load robomimic bc", object, found, expected });
            }
            weights.insert(ours, tensor);
        }
        self.check_sizes(&weights)?;
        Ok(weights)
    }

    /// Fails where the options say another size than the weights have: before a model of that size is built.
    fn check_sizes(&self, weights: &BTreeMap<String, Tensor>) -> Result<()> {
        let (modes, timesteps) = match &self.policy {
            PolicyConfig::BcRnn(config) => (config.n_modes, None),
            PolicyConfig::BcTransformer(config) => (config.n_modes, Some(config.dim_model)),
            _ => return Ok(()),
        };
        let means = modes.saturating_mul(self.signature.action_dim);
        let mut expected = vec![("decoder.logits.bias", vec![modes]), ("decoder.mean.bias", vec![means])];
        if let Some(dim) = timesteps {
            expected.push(("embed_timestep", vec![1, self.signature.n_obs_steps, dim]));
        }
        for (name, expected) in expected {
            let given = some_names(weights.keys());
            let tensor =
                weights.get(name).ok_or_else(|| ModelError::MissingTensor { name: name.to_string(), given })?;
            if tensor.dims() != expected {
                let found = tensor.dims().to_vec();
                return Err(ModelError::MisshapenTensor { name: name.to_string(), expected, found });
            }
        }
        self.policy.check_size(weights)
    }

    fn reordered(&self, name: &str, tensor: &Tensor) -> Result<Tensor> {
        let found = tensor.dims().to_vec();
        if found.len() != 2 || found[1] != self.places.len() {
            let expected = vec![found.first().copied().unwrap_or(0), self.places.len()];
            return Err(ModelError::MisshapenTensor { name: name.to_string(), expected, found });
        }
        let places: Vec<u32> = self.places.iter().map(|&place| place as u32).collect();
        Ok(tensor.index_select(&Tensor::new(places, &Device::Cpu)?, 1)?)
    }
}

fn same(one: &Tensor, other: &Tensor) -> Result<bool> {
    let bits = |t: &Tensor| -> Result<Vec<u64>> {
        Ok(t.to_dtype(candle_core::DType::F64)?.flatten_all()?.to_vec1::<f64>()?.iter().map(|x| x.to_bits()).collect())
    };
    Ok(one.dims() == other.dims() && bits(one)? == bits(other)?)
}

/// robomimic saves the mask with the weights: ones where a step may look, up to itself.
fn causal(name: &str, mask: &Tensor) -> Result<()> {
    let refuse = |found: String| ModelError::Input {
        operation: "load robomimic bc",
        object: "mask",
        found: format!("{name} {found}"),
        expected: "1 up to each step's own place and 0 after it".to_string(),
    };
    let &[1, 1, steps, others] = mask.dims() else { return Err(refuse(format!("of shape {:?}", mask.dims()))) };
    let rows = mask.to_dtype(candle_core::DType::F32)?.reshape((steps, others))?.to_vec2::<f32>()?;
    let right = |(row, values): (usize, &Vec<f32>)| {
        values.iter().enumerate().all(|(column, value)| *value == f32::from(u8::from(column <= row)))
    };
    if steps == others && rows.iter().enumerate().all(right) {
        return Ok(());
    }
    Err(refuse("with other numbers".to_string()))
}
