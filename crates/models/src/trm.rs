//! The Tiny Recursive Model.
//!
//! Paper: Jolicoeur-Martineau, "Less is More: Recursive Reasoning with Tiny Networks" (2025).
//! Reference implementation: SamsungSAILMontreal/TinyRecursiveModels,
//! `models/recursive_reasoning/trm.py`; tensors carry its names.
//!
//! One small network updates two states: `z_h`, the answer, and `z_l`, the reasoning. A
//! supervision step runs `h_cycles` rounds of `l_cycles` updates of `z_l` and one of `z_h`; only
//! the last round keeps a graph, so memory does not grow with the number of rounds. The states
//! then go, detached, to the next supervision step: see [`Carry`].
//!
//! This file is the model as one reads it, on candle's autograd. Supervision steps run the same
//! maths in `trm/kernel.rs`, forward and backward by hand; tests hold the two together.
//!
//! Deviations from the reference:
//! - everything is f32 (the reference trains in bf16 with f32 master weights);
//! - [`Mixing::Conv`], a 3x3 convolution over a grid in place of attention, is ours;
//! - `classes`, `inner_size` and [`Pooling::Mean`] let the small models of the maze study be
//!   written in the same file; unset they give the reference;
//! - initial states and weights come from our own generator, so equal seeds do not give the
//!   reference's numbers.

mod carry;
mod elementwise;
mod fused;
mod gemm;
mod kernel;
mod official;
#[cfg(test)]
mod tests;
mod train;

pub use carry::{Carry, Example, Release};
pub use train::{PuzzleConfig, StepReport, Trainer};

use crate::error::{ModelError, Result, some_names};
use crate::params::{Init, Params};
use crate::rng::Rng;
use candle_core::{D, DType, Device, IndexOp, Tensor};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// How a layer lets positions see each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Mixing {
    /// Multi-head self attention without a mask.
    #[default]
    Attention,
    /// A SwiGLU over the sequence axis, the same for every channel.
    MlpT,
    /// A zero-padded 3x3 convolution over `grid`.
    Conv,
}

/// How positions are told apart.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Positions {
    /// Rotary embeddings of queries and keys (attention only).
    #[default]
    Rope,
    /// A learned vector per position, added to the input embedding.
    Learned,
    /// Not at all: the mixing knows them.
    None,
}

/// What the halting head reads of `z_h`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Pooling {
    /// The first position (the reference's).
    #[default]
    First,
    /// The mean over positions.
    Mean,
}

/// Sizes and choices of a TRM.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Number of input tokens.
    pub vocab_size: usize,
    /// Number of output classes; the vocabulary's size when absent.
    #[serde(default)]
    pub classes: Option<usize>,
    /// Tokens per puzzle.
    pub seq_len: usize,
    /// Channels.
    pub hidden_size: usize,
    /// Attention heads; must divide `hidden_size`.
    #[serde(default = "default_heads")]
    pub num_heads: usize,
    /// Layers of the one network.
    #[serde(default = "default_layers")]
    pub layers: usize,
    /// Rounds per supervision step; only the last has gradients.
    #[serde(default = "default_h_cycles")]
    pub h_cycles: usize,
    /// Updates of `z_l` per round.
    #[serde(default = "default_l_cycles")]
    pub l_cycles: usize,
    /// How positions see each other.
    #[serde(default)]
    pub mixing: Mixing,
    /// Height and width, needed by [`Mixing::Conv`]; their product is `seq_len`.
    #[serde(default)]
    pub grid: Option<[usize; 2]>,
    /// How positions are told apart.
    #[serde(default)]
    pub positions: Positions,
    /// Base of the rotary angles.
    #[serde(default = "default_rope_theta")]
    pub rope_theta: f64,
    /// Added to the mean square before its root.
    #[serde(default = "default_eps")]
    pub rms_norm_eps: f64,
    /// SwiGLU's width as a multiple of its input, before the 2/3 and the rounding up to 256.
    #[serde(default = "default_expansion")]
    pub expansion: f64,
    /// SwiGLU's width as it is, instead of through `expansion`.
    #[serde(default)]
    pub inner_size: Option<usize>,
    /// What the halting head reads.
    #[serde(default)]
    pub pooling: Pooling,
    /// Outputs of the halting head; the reference has 2 and uses the first.
    #[serde(default = "default_q_outputs")]
    pub q_outputs: usize,
    /// Length of a puzzle's own embedding; 0 for none.
    #[serde(default)]
    pub puzzle_emb_ndim: usize,
    /// Rows of the puzzle embedding's table.
    #[serde(default)]
    pub num_puzzle_identifiers: usize,
    /// Positions that the puzzle embedding takes; 0 for as many as it fills.
    #[serde(default)]
    pub puzzle_emb_len: usize,
    /// Supervision steps after which a puzzle is given up.
    #[serde(default = "default_halt_max_steps")]
    pub halt_max_steps: usize,
    /// Share of puzzles that must take a random minimum of steps.
    #[serde(default = "default_exploration")]
    pub halt_exploration_prob: f64,
}

fn default_heads() -> usize {
    1
}
fn default_layers() -> usize {
    2
}
fn default_h_cycles() -> usize {
    3
}
fn default_l_cycles() -> usize {
    6
}
fn default_rope_theta() -> f64 {
    1e4
}
fn default_eps() -> f64 {
    1e-5
}
fn default_expansion() -> f64 {
    4.0
}
fn default_q_outputs() -> usize {
    2
}
fn default_halt_max_steps() -> usize {
    16
}
fn default_exploration() -> f64 {
    0.1
}

impl Config {
    /// A configuration of the reference's defaults for the given sizes.
    pub fn new(vocab_size: usize, seq_len: usize, hidden_size: usize) -> Self {
        Self {
            vocab_size,
            classes: None,
            seq_len,
            hidden_size,
            num_heads: default_heads(),
            layers: default_layers(),
            h_cycles: default_h_cycles(),
            l_cycles: default_l_cycles(),
            mixing: Mixing::default(),
            grid: None,
            positions: Positions::default(),
            rope_theta: default_rope_theta(),
            rms_norm_eps: default_eps(),
            expansion: default_expansion(),
            inner_size: None,
            pooling: Pooling::default(),
            q_outputs: default_q_outputs(),
            puzzle_emb_ndim: 0,
            num_puzzle_identifiers: 0,
            puzzle_emb_len: 0,
            halt_max_steps: default_halt_max_steps(),
            halt_exploration_prob: default_exploration(),
        }
    }

    /// Number of output classes.
    pub fn classes(&self) -> usize {
        self.classes.unwrap_or(self.vocab_size)
    }

    /// Positions before the puzzle's tokens that hold its embedding.
    pub fn prefix_len(&self) -> usize {
        match (self.puzzle_emb_ndim, self.puzzle_emb_len) {
            (0, _) => 0,
            (n, 0) => n.div_ceil(self.hidden_size),
            (_, len) => len,
        }
    }

    /// Positions of the states.
    pub fn positions_len(&self) -> usize {
        self.prefix_len() + self.seq_len
    }

    /// SwiGLU's width over `n` inputs.
    pub fn inner(&self, n: usize) -> usize {
        self.inner_size.unwrap_or_else(|| {
            let wanted = (self.expansion * n as f64 * 2.0 / 3.0).round_ties_even() as usize;
            wanted.div_ceil(256) * 256
        })
    }

    /// Refuses what cannot work, naming the field.
    ///
    /// # Errors
    /// [`ModelError::Config`] with the field, what it is and what it should be.
    pub fn check(&self) -> Result<()> {
        fn refuse(field: &'static str, found: impl ToString, expected: impl Into<String>) -> Result<()> {
            Err(ModelError::Config { model: "trm", field, found: found.to_string(), expected: expected.into() })
        }
        for (field, value) in [
            ("vocab_size", self.vocab_size),
            ("classes", self.classes()),
            ("seq_len", self.seq_len),
            ("hidden_size", self.hidden_size),
            ("num_heads", self.num_heads),
            ("layers", self.layers),
            ("h_cycles", self.h_cycles),
            ("l_cycles", self.l_cycles),
            ("inner_size", self.inner_size.unwrap_or(1)),
            ("q_outputs", self.q_outputs),
            ("halt_max_steps", self.halt_max_steps),
        ] {
            if value == 0 {
                return refuse(field, value, "at least 1");
            }
        }
        let (d, heads) = (self.hidden_size, self.num_heads);
        match self.mixing {
            Mixing::Attention if !d.is_multiple_of(heads) => {
                return refuse("num_heads", heads, format!("a divisor of hidden_size {d}"));
            }
            Mixing::Attention if self.positions == Positions::Rope && !(d / heads).is_multiple_of(2) => {
                return refuse("num_heads", heads, "an even size per head for rotary positions");
            }
            Mixing::Conv if self.prefix_len() > 0 => {
                return refuse("puzzle_emb_ndim", self.puzzle_emb_ndim, "0 with mixing conv");
            }
            Mixing::Conv => match self.grid {
                Some([h, w]) if h * w == self.seq_len => {}
                Some([h, w]) => {
                    return refuse("grid", format!("{h}x{w}"), format!("{} cells", self.seq_len));
                }
                None => return refuse("grid", "absent", "height and width with mixing conv"),
            },
            Mixing::Attention | Mixing::MlpT => {}
        }
        if self.puzzle_emb_ndim > 0 {
            if self.num_puzzle_identifiers == 0 {
                return refuse("num_puzzle_identifiers", 0, "at least 1 with puzzle embeddings");
            }
            if self.prefix_len() * d < self.puzzle_emb_ndim {
                let least = self.puzzle_emb_ndim.div_ceil(d);
                return refuse("puzzle_emb_len", self.puzzle_emb_len, format!("at least {least}"));
            }
        }
        if !(0.0..=1.0).contains(&self.halt_exploration_prob) {
            return refuse("halt_exploration_prob", self.halt_exploration_prob, "0 to 1");
        }
        Ok(())
    }
}

/// The two states of the recursion, each `(batch, positions, hidden)`.
#[derive(Debug, Clone)]
pub struct States {
    /// The answer.
    pub z_h: Tensor,
    /// The reasoning.
    pub z_l: Tensor,
}

impl States {
    fn detach(&self) -> Self {
        Self { z_h: self.z_h.detach(), z_l: self.z_l.detach() }
    }
}

/// What a supervision step gives.
#[derive(Debug, Clone)]
pub struct StepOutput {
    /// `(batch, seq_len, classes)`.
    pub logits: Tensor,
    /// `(batch,)`: positive to halt.
    pub q_halt: Tensor,
    /// The states for the next step, detached.
    pub states: States,
}

/// The weights of one layer's mixing.
#[derive(Debug, Clone)]
enum Mix {
    Attention { qkv: Tensor, out: Tensor },
    MlpT { gate_up: Tensor, down: Tensor },
    Conv { kernel: Tensor },
}

#[derive(Debug, Clone)]
struct Layer {
    mix: Mix,
    gate_up: Tensor,
    down: Tensor,
}

/// Every weight as a tensor: once tracked, once detached from the variables (the storage is
/// shared, so both see each update).
#[derive(Debug, Clone)]
struct Weights {
    embed: Tensor,
    positions: Option<Tensor>,
    puzzles: Option<Tensor>,
    layers: Vec<Layer>,
    lm_head: Tensor,
    q_weight: Tensor,
    q_bias: Tensor,
}

/// Whether a step keeps a graph.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Gradient {
    /// The last round keeps one.
    On,
    /// Nothing does.
    Off,
}

/// A Tiny Recursive Model.
#[derive(Debug)]
pub struct Trm {
    config: Config,
    params: Params,
    tracked: Weights,
    frozen: Weights,
    h_init: Tensor,
    l_init: Tensor,
    rope: Option<(Tensor, Tensor)>,
    fused: fused::Fused,
}

const H_INIT: &str = "inner.H_init";
const L_INIT: &str = "inner.L_init";
const PUZZLES: &str = "inner.puzzle_emb.weights";

/// Standard deviation of a unit normal cut at two deviations: the reference divides by it.
const TRUNCATED_DEVIATION: f64 = 0.879_625_661_034_239_8;

fn misfit(object: &'static str, expected: &[usize], found: &[usize]) -> ModelError {
    ModelError::Shape { operation: "trm step", object, expected: expected.to_vec(), found: found.to_vec() }
}

/// `x (.., n) -> (.., m)` with `weight (m, n)`.
fn linear(x: &Tensor, weight: &Tensor) -> Result<Tensor> {
    let mut dims = x.dims().to_vec();
    let n = weight.dim(1)?;
    let rows = x.elem_count() / n;
    let y = x.reshape((rows, n))?.matmul(&weight.t()?)?;
    *dims.last_mut().expect("a tensor with at least one axis") = weight.dim(0)?;
    Ok(y.reshape(dims)?)
}

/// Root-mean-square norm over the last axis, without a gain.
fn rms_norm(x: &Tensor, eps: f64) -> Result<Tensor> {
    let mean_square = x.sqr()?.mean_keepdim(D::Minus1)?;
    Ok(x.broadcast_div(&(mean_square + eps)?.sqrt()?)?)
}

fn swiglu(x: &Tensor, gate_up: &Tensor, down: &Tensor) -> Result<Tensor> {
    let both = linear(x, gate_up)?;
    let inner = gate_up.dim(0)? / 2;
    let gate = both.narrow(D::Minus1, 0, inner)?.contiguous()?.silu()?;
    let up = both.narrow(D::Minus1, inner, inner)?.contiguous()?;
    linear(&(gate * up)?, down)
}

/// Rotates `x (batch, heads, positions, size)` by half-split rotary angles.
fn rotate(x: &Tensor, cos: &Tensor, sin: &Tensor) -> Result<Tensor> {
    let half = x.dim(D::Minus1)? / 2;
    let a = x.narrow(D::Minus1, 0, half)?;
    let b = x.narrow(D::Minus1, half, half)?;
    let turned = Tensor::cat(&[&b.neg()?, &a], D::Minus1)?;
    Ok((x.broadcast_mul(cos)? + turned.broadcast_mul(sin)?)?)
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

impl Weights {
    /// The same weights, each through `f`.
    fn map(&self, f: &dyn Fn(&Tensor) -> Result<Tensor>) -> Result<Self> {
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
    fn flat(&self) -> Result<Tensor> {
        let parts = self.layers.iter().flat_map(Layer::tensors).map(Tensor::flatten_all);
        let parts: Vec<Tensor> = parts.collect::<candle_core::Result<_>>()?;
        Ok(Tensor::cat(&parts, 0)?)
    }
}

impl Trm {
    /// A model with weights drawn from `seed`.
    ///
    /// # Errors
    /// When the configuration cannot work.
    pub fn new(config: Config, seed: u64) -> Result<Self> {
        config.check()?;
        let mut rng = Rng::new(seed, "trm");
        let mut params = Params::new();
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
            let mut draw = Params::new();
            let std = 1.0 / TRUNCATED_DEVIATION;
            Ok(draw.create("state", &[d], Init::TruncatedNormal { std }, &mut rng)?.detach())
        };
        let (h_init, l_init) = (initial()?, initial()?);
        Self::from_params(config, params, h_init, l_init)
    }
}

impl Trm {
    fn from_params(config: Config, params: Params, h_init: Tensor, l_init: Tensor) -> Result<Self> {
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
            fused: fused::Fused::new(&config, rope.as_ref())?,
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

    /// The states of `batch` puzzles that have not been thought about.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn initial_states(&self, batch: usize) -> Result<States> {
        let shape = (batch, self.config.positions_len(), self.config.hidden_size);
        Ok(States {
            z_h: self.h_init.broadcast_as(shape)?.contiguous()?,
            z_l: self.l_init.broadcast_as(shape)?.contiguous()?,
        })
    }

    /// One supervision step on `inputs (batch, seq_len)` of tokens (u32), with a row of the
    /// puzzle table for each puzzle if the model has one.
    ///
    /// # Errors
    /// When shapes do not fit, a token lies outside the vocabulary or puzzle identifiers are
    /// missing.
    pub fn supervision_step(
        &self,
        states: &States,
        inputs: &Tensor,
        identifiers: Option<&Tensor>,
        gradient: Gradient,
    ) -> Result<StepOutput> {
        self.check_step(states, inputs)?;
        let weights = self.weights(gradient);
        let embedded = self.embed(weights, inputs, identifiers)?;
        let cycles = (self.config.h_cycles, self.config.l_cycles);
        let now = self.fused.step(&weights.flat()?, states, &embedded, cycles, gradient)?;
        self.read_out(weights, now)
    }

    /// [`Self::supervision_step`] on candle's autograd: slower, and what it is checked against.
    ///
    /// # Errors
    /// The same.
    pub fn supervision_step_composed(
        &self,
        states: &States,
        inputs: &Tensor,
        identifiers: Option<&Tensor>,
        gradient: Gradient,
    ) -> Result<StepOutput> {
        self.composed((self.weights(gradient), &self.frozen), states, inputs, identifiers)
    }

    /// A supervision step without gradient in f64. The recursion amplifies rounding, so two
    /// implementations in f32 drift apart; this one says how far the drift is rounding alone.
    ///
    /// # Errors
    /// The same.
    pub fn supervision_step_exact(
        &self,
        states: &States,
        inputs: &Tensor,
        identifiers: Option<&Tensor>,
    ) -> Result<StepOutput> {
        let weights = self.frozen.map(&|t| Ok(t.to_dtype(DType::F64)?))?;
        let states = States { z_h: states.z_h.to_dtype(DType::F64)?, z_l: states.z_l.to_dtype(DType::F64)? };
        self.composed((&weights, &weights), &states, inputs, identifiers)
    }

    /// One supervision step, its last round with the first weights, earlier ones with the second.
    fn composed(
        &self,
        (weights, quiet_weights): (&Weights, &Weights),
        states: &States,
        inputs: &Tensor,
        identifiers: Option<&Tensor>,
    ) -> Result<StepOutput> {
        self.check_step(states, inputs)?;
        let embedded = self.embed(weights, inputs, identifiers)?;
        let mut now = states.detach();
        let quiet = embedded.detach();
        for _ in 1..self.config.h_cycles {
            now = self.round(quiet_weights, &now, &quiet)?;
        }
        let now = self.round(weights, &now, &embedded)?;
        self.read_out(weights, now)
    }

    fn weights(&self, gradient: Gradient) -> &Weights {
        match gradient {
            Gradient::On => &self.tracked,
            Gradient::Off => &self.frozen,
        }
    }

    fn check_step(&self, states: &States, inputs: &Tensor) -> Result<()> {
        let (batch, len) = inputs.dims2()?;
        if len != self.config.seq_len {
            return Err(misfit("inputs", &[batch, self.config.seq_len], inputs.dims()));
        }
        let expected = [batch, self.config.positions_len(), self.config.hidden_size];
        for (name, state) in [("z_h", &states.z_h), ("z_l", &states.z_l)] {
            if state.dims() != expected {
                return Err(misfit(name, &expected, state.dims()));
            }
        }
        Ok(())
    }

    /// Answers and halting logits of the states after the last round.
    fn read_out(&self, weights: &Weights, now: States) -> Result<StepOutput> {
        let answer = now.z_h.narrow(1, self.config.prefix_len(), self.config.seq_len)?;
        let pooled = match self.config.pooling {
            Pooling::First => now.z_h.i((.., 0, ..))?.contiguous()?,
            Pooling::Mean => now.z_h.mean(1)?,
        };
        let q = linear(&pooled, &weights.q_weight)?.broadcast_add(&weights.q_bias)?;
        Ok(StepOutput {
            logits: linear(&answer.contiguous()?, &weights.lm_head)?,
            q_halt: q.i((.., 0))?,
            states: now.detach(),
        })
    }

    /// `(batch, seq_len)` tokens `-> (batch, positions, hidden)`.
    fn embed(&self, weights: &Weights, inputs: &Tensor, identifiers: Option<&Tensor>) -> Result<Tensor> {
        let (batch, len) = inputs.dims2()?;
        let d = self.config.hidden_size;
        let tokens = inputs.flatten_all()?;
        let mut x = weights.embed.index_select(&tokens, 0)?.reshape((batch, len, d))?;
        if let Some(table) = &weights.puzzles {
            let Some(identifiers) = identifiers else {
                return Err(ModelError::Input {
                    operation: "trm step",
                    object: "puzzle identifiers",
                    found: "absent".into(),
                    expected: "one per puzzle".into(),
                });
            };
            let prefix = self.config.prefix_len();
            let rows = table.index_select(identifiers, 0)?;
            let rows = rows.pad_with_zeros(1, 0, prefix * d - self.config.puzzle_emb_ndim)?;
            x = Tensor::cat(&[&rows.reshape((batch, prefix, d))?, &x], 1)?;
        }
        if let Some(positions) = &weights.positions {
            // two unit-variance terms: the sum is scaled back by 1 / sqrt(2)
            x = (x.broadcast_add(positions)? * std::f64::consts::FRAC_1_SQRT_2)?;
        }
        Ok((x * (d as f64).sqrt())?)
    }

    /// One round: `l_cycles` updates of `z_l`, one of `z_h`.
    fn round(&self, weights: &Weights, states: &States, embedded: &Tensor) -> Result<States> {
        let States { z_h, z_l } = states;
        let injected = (z_h + embedded)?;
        let mut z_l = z_l.clone();
        for _ in 0..self.config.l_cycles {
            z_l = self.network(weights, &z_l, &injected)?;
        }
        let z_h = self.network(weights, z_h, &z_l)?;
        Ok(States { z_h, z_l })
    }

    /// The one network, on `state + injected`.
    fn network(&self, weights: &Weights, state: &Tensor, injected: &Tensor) -> Result<Tensor> {
        let eps = self.config.rms_norm_eps;
        let mut x = (state + injected)?;
        for layer in &weights.layers {
            x = self.mix(&layer.mix, &x)?;
            x = rms_norm(&(&x + swiglu(&x, &layer.gate_up, &layer.down)?)?, eps)?;
        }
        Ok(x)
    }

    /// `norm(x + mixing(x))`.
    fn mix(&self, mix: &Mix, x: &Tensor) -> Result<Tensor> {
        let eps = self.config.rms_norm_eps;
        match mix {
            Mix::Attention { qkv, out } => rms_norm(&(x + self.attention(x, qkv, out)?)?, eps),
            Mix::MlpT { gate_up, down } => {
                let across = x.transpose(1, 2)?.contiguous()?;
                let mixed = (&across + swiglu(&across, gate_up, down)?)?;
                Ok(rms_norm(&mixed, eps)?.transpose(1, 2)?.contiguous()?)
            }
            Mix::Conv { kernel } => rms_norm(&(x + self.convolution(x, kernel)?)?, eps),
        }
    }

    fn attention(&self, x: &Tensor, qkv: &Tensor, out: &Tensor) -> Result<Tensor> {
        let (batch, len, d) = x.dims3()?;
        let heads = self.config.num_heads;
        let size = d / heads;
        let qkv = linear(x, qkv)?.reshape((batch, len, 3, heads, size))?;
        let part = |i: usize| -> Result<Tensor> { Ok(qkv.i((.., .., i))?.transpose(1, 2)?.contiguous()?) };
        let (mut q, mut k, v) = (part(0)?, part(1)?, part(2)?);
        if let Some((cos, sin)) = &self.rope {
            let (cos, sin) = (cos.to_dtype(x.dtype())?, sin.to_dtype(x.dtype())?);
            q = rotate(&q, &cos, &sin)?;
            k = rotate(&k, &cos, &sin)?;
        }
        let scores = (q.matmul(&k.t()?)? * (1.0 / (size as f64).sqrt()))?;
        // candle's softmax_last_dim has no backward; this one is composed
        let weights = candle_nn::ops::softmax(&scores, D::Minus1)?;
        let mixed = weights.matmul(&v)?.transpose(1, 2)?.reshape((batch, len, d))?;
        linear(&mixed, out)
    }

    /// A zero-padded 3x3 convolution as one product over the nine neighbours' channels.
    fn convolution(&self, x: &Tensor, kernel: &Tensor) -> Result<Tensor> {
        let (batch, len, d) = x.dims3()?;
        let [h, w] = self.config.grid.expect("checked: convolution has a grid");
        let padded = x.reshape((batch, h, w, d))?.pad_with_zeros(1, 1, 1)?.pad_with_zeros(2, 1, 1)?;
        let mut neighbours = Vec::with_capacity(9);
        for row in 0..3 {
            for column in 0..3 {
                neighbours.push(padded.narrow(1, row, h)?.narrow(2, column, w)?);
            }
        }
        let neighbours = Tensor::cat(&neighbours, 3)?.reshape((batch, len, 9 * d))?;
        linear(&neighbours, &kernel.reshape((d, 9 * d))?)
    }
}
