//! A TRM's weights: their names and initial values, loading and storing them, and the views that a step reads.

use super::fused::Recursion;
use super::{Config, Mixing, Positions, Trm};
use candle_core::{DType, Device, Tensor};
use nn::Backend;
use nn::Rng;
use nn::{Init, Params};
use nn::{ModelError, Result, some_names};
use std::collections::BTreeMap;

const H_INIT: &str = "inner.H_init";
const L_INIT: &str = "inner.L_init";
pub(super) const PUZZLES: &str = "inner.puzzle_emb.weights";

/// Standard deviation of a unit normal cut at two deviations: the reference divides by it.
const TRUNCATED_DEVIATION: f64 = 0.879_625_661_034_239_8;

/// The weights of one layer's mixing.
#[derive(Debug, Clone)]
pub(super) enum Mix {
    Attention { qkv: Tensor, out: Tensor },
    MlpT { gate_up: Tensor, down: Tensor },
    Conv { kernel: Tensor },
}

#[derive(Debug, Clone)]
pub(super) struct Layer {
    pub(super) mix: Mix,
    pub(super) gate_up: Tensor,
    pub(super) down: Tensor,
}

/// Every weight as a tensor: once tracked, once detached from the variables (the storage is
/// shared, so both see each update).
#[derive(Debug, Clone)]
pub(super) struct Weights {
    pub(super) embed: Tensor,
    pub(super) positions: Option<Tensor>,
    pub(super) puzzles: Option<Tensor>,
    pub(super) layers: Vec<Layer>,
    pub(super) lm_head: Tensor,
    pub(super) q_weight: Tensor,
    pub(super) q_bias: Tensor,
}

impl Weights {
    /// The same weights, each through `f`.
    pub(super) fn map(&self, f: &dyn Fn(&Tensor) -> Result<Tensor>) -> Result<Self> {
        let optional = |t: &Option<Tensor>| t.as_ref().map(f).transpose();
        let layer = |layer: &Layer| {
            let mix = match &layer.mix {
                Mix::Attention { qkv, out } => Mix::Attention { qkv: f(qkv)?, out: f(out)? },
                Mix::MlpT { gate_up, down } => Mix::MlpT { gate_up: f(gate_up)?, down: f(down)? },
                Mix::Conv { kernel } => Mix::Conv { kernel: f(kernel)? },
            };
            Ok(Layer { mix, gate_up: f(&layer.gate_up)?, down: f(&layer.down)? })
        };
        Ok(Self {
            embed: f(&self.embed)?,
            positions: optional(&self.positions)?,
            puzzles: optional(&self.puzzles)?,
            layers: self.layers.iter().map(layer).collect::<Result<_>>()?,
            lm_head: f(&self.lm_head)?,
            q_weight: f(&self.q_weight)?,
            q_bias: f(&self.q_bias)?,
        })
    }
}

impl Layer {
    /// In the order in which the kernel expects them.
    fn tensors(&self) -> Vec<&Tensor> {
        let mut tensors = match &self.mix {
            Mix::Attention { qkv, out } => vec![qkv, out],
            Mix::MlpT { gate_up, down } => vec![gate_up, down],
            Mix::Conv { kernel } => vec![kernel],
        };
        tensors.extend([&self.gate_up, &self.down]);
        tensors
    }
}

impl Weights {
    /// The network's weights one after the other, as the kernel reads them.
    pub(super) fn flat(&self) -> Result<Tensor> {
        let parts = self.layers.iter().flat_map(Layer::tensors).map(Tensor::flatten_all);
        let parts: Vec<Tensor> = parts.collect::<candle_core::Result<_>>()?;
        Ok(Tensor::cat(&parts, 0)?)
    }
}

/// Angles of rotary positions: `cos` and `sin`, each `(positions, size)`.
fn rotary_table(positions: usize, size: usize, theta: f64) -> Result<(Tensor, Tensor)> {
    let mut angles = Vec::with_capacity(positions * size);
    for position in 0..positions {
        for i in 0..size {
            // in f32 from the start, as the reference does: its numbers are what checkpoints know
            let exponent = (2 * (i % (size / 2))) as f32 / size as f32;
            angles.push(position as f32 * (1.0 / (theta as f32).powf(exponent)));
        }
    }
    let angles = Tensor::from_vec(angles, (positions, size), &Device::Cpu)?;
    Ok((angles.cos()?, angles.sin()?))
}

impl Trm {
    /// A model with weights drawn from `seed`.
    ///
    /// # Errors
    /// When the configuration cannot work.
    pub fn new(config: Config, seed: u64) -> Result<Self> {
        config.check()?;
        let mut rng = Rng::new(seed, "trm");
        let mut params = Params::new(&Backend::CPU);
        let d = config.hidden_size;
        let mut matrix = |name: &str, shape: &[usize], fan_in: usize| {
            let std = 1.0 / (fan_in as f64).sqrt() / TRUNCATED_DEVIATION;
            params.create(name, shape, Init::TruncatedNormal { std }, &mut rng).map(|_| ())
        };
        matrix("inner.embed_tokens.embedding_weight", &[config.vocab_size, d], d)?;
        if config.positions == Positions::Learned {
            let shape = [config.positions_len(), d];
            matrix("inner.embed_pos.embedding_weight", &shape, d)?;
        }
        for i in 0..config.layers {
            let at = |name: &str| format!("inner.L_level.layers.{i}.{name}.weight");
            match config.mixing {
                Mixing::Attention => {
                    matrix(&at("self_attn.qkv_proj"), &[3 * d, d], d)?;
                    matrix(&at("self_attn.o_proj"), &[d, d], d)?;
                }
                Mixing::MlpT => {
                    let len = config.positions_len();
                    let inner = config.inner(len);
                    matrix(&at("mlp_t.gate_up_proj"), &[2 * inner, len], len)?;
                    matrix(&at("mlp_t.down_proj"), &[len, inner], inner)?;
                }
                Mixing::Conv => matrix(&at("conv"), &[d, 3, 3, d], 9 * d)?,
            }
            let inner = config.inner(d);
            matrix(&at("mlp.gate_up_proj"), &[2 * inner, d], d)?;
            matrix(&at("mlp.down_proj"), &[d, inner], inner)?;
        }
        matrix("inner.lm_head.weight", &[config.classes(), d], d)?;
        let q = config.q_outputs;
        params.create("inner.q_head.weight", &[q, d], Init::Zeros, &mut rng)?;
        // near-certain "do not halt" at first, as in the reference
        params.insert("inner.q_head.bias", Tensor::full(-5f32, q, &Device::Cpu)?)?;
        if config.puzzle_emb_ndim > 0 {
            let shape = [config.num_puzzle_identifiers, config.puzzle_emb_ndim];
            params.create(PUZZLES, &shape, Init::Zeros, &mut rng)?;
        }
        let mut initial = || -> Result<Tensor> {
            let mut draw = Params::new(&Backend::CPU);
            let std = 1.0 / TRUNCATED_DEVIATION;
            Ok(draw.create("state", &[d], Init::TruncatedNormal { std }, &mut rng)?.detach())
        };
        let (h_init, l_init) = (initial()?, initial()?);
        Self::from_params(config, params, h_init, l_init)
    }
}

impl Trm {
    fn from_params(config: Config, params: Params, h_init: Tensor, l_init: Tensor) -> Result<Self> {
        params.backend().require_cpu("trm")?;
        let get = |name: &str| {
            let var = params.get(name).expect("created above for this configuration");
            Ok::<_, ModelError>(var.as_tensor().clone())
        };
        let layers = (0..config.layers)
            .map(|i| {
                let at = |name: &str| get(&format!("inner.L_level.layers.{i}.{name}.weight"));
                let mix = match config.mixing {
                    Mixing::Attention => {
                        Mix::Attention { qkv: at("self_attn.qkv_proj")?, out: at("self_attn.o_proj")? }
                    }
                    Mixing::MlpT => Mix::MlpT { gate_up: at("mlp_t.gate_up_proj")?, down: at("mlp_t.down_proj")? },
                    Mixing::Conv => Mix::Conv { kernel: at("conv")? },
                };
                Ok(Layer { mix, gate_up: at("mlp.gate_up_proj")?, down: at("mlp.down_proj")? })
            })
            .collect::<Result<_>>()?;
        let optional = |wanted: bool, name: &str| wanted.then(|| get(name)).transpose();
        let tracked = Weights {
            embed: get("inner.embed_tokens.embedding_weight")?,
            positions: optional(config.positions == Positions::Learned, "inner.embed_pos.embedding_weight")?,
            puzzles: optional(config.puzzle_emb_ndim > 0, PUZZLES)?,
            layers,
            lm_head: get("inner.lm_head.weight")?,
            q_weight: get("inner.q_head.weight")?,
            q_bias: get("inner.q_head.bias")?,
        };
        let rope = match (config.mixing, config.positions) {
            (Mixing::Attention, Positions::Rope) => {
                Some(rotary_table(config.positions_len(), config.hidden_size / config.num_heads, config.rope_theta)?)
            }
            _ => None,
        };
        Ok(Self {
            fused: Recursion::new(&config, rope.as_ref())?,
            frozen: tracked.map(&|t| Ok(t.detach()))?,
            h_init,
            l_init,
            config,
            tracked,
            params,
            rope,
        })
    }

    /// The configuration it was made from.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// Its trained weights, by the reference's names. The initial states are not among them.
    pub fn params(&self) -> &Params {
        &self.params
    }

    /// Everything that must be stored: the weights and the two fixed initial states.
    pub fn tensors(&self) -> BTreeMap<String, Tensor> {
        let mut tensors = self.params.tensors();
        tensors.insert(H_INIT.into(), self.h_init.clone());
        tensors.insert(L_INIT.into(), self.l_init.clone());
        tensors
    }

    /// Takes what [`Self::tensors`] gave; names and shapes must be exactly the model's. Prefixes
    /// that the reference's wrappers add before `inner.` are left out.
    ///
    /// # Errors
    /// The first tensor that is missing, extra or misshapen.
    pub fn load(&mut self, tensors: &BTreeMap<String, Tensor>) -> Result<()> {
        let mut own: BTreeMap<String, Tensor> = tensors
            .iter()
            .map(|(name, tensor)| {
                let from = name.find("inner.").unwrap_or(0);
                (name[from..].to_string(), tensor.clone())
            })
            .collect();
        let mut initial = |name: &str| -> Result<Tensor> {
            let Some(tensor) = own.remove(name) else {
                return Err(ModelError::MissingTensor { name: name.into(), given: some_names(tensors.keys()) });
            };
            let expected = vec![self.config.hidden_size];
            if tensor.dims() != expected {
                let found = tensor.dims().to_vec();
                return Err(ModelError::MisshapenTensor { name: name.into(), expected, found });
            }
            Ok(tensor.to_dtype(DType::F32)?.detach())
        };
        let (h_init, l_init) = (initial(H_INIT)?, initial(L_INIT)?);
        self.params.load(&own)?;
        (self.h_init, self.l_init) = (h_init, l_init);
        Ok(())
    }
}
