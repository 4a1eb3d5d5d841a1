//! ACTRM: an action-chunking policy that thinks, with three designs behind one configuration.
//!
//! Origins: ACT (arXiv 2304.13705) for observations, latent and loss; the Tiny Recursive Model
//! (Jolicoeur-Martineau, 2025) for the recursion; the original ACTRM (jshyunbin/R3PL) for putting
//! the two together.
//!
//! **`reasoning.over = "actions"`** (default, our own): `y`, one token per action of the chunk,
//! is the answer; `z`, a few latent tokens, is the reasoning. The memory (latent, robot state,
//! environment state, entities, pictures) is encoded once per observation. One small block, shared by everything,
//! updates `z` (`l_cycles` times) and then `y`, each by attending to `[z, y, memory]`. A
//! supervision step is `h_cycles` such rounds; after it `y` is decoded into a chunk by one dense
//! layer, so every depth has an answer and the policy can stop at any of them.
//!
//! **`reasoning.over = "memory"`**, the original's: the observation encoder is replaced by a
//! recursion of encoder layers over the observation tokens, with states `z_h` and `z_l` from
//! fixed values, `h_cycles x l_cycles` per supervision step; ACT's decoder reads `z_h`. The carry
//! goes on detached, and the number of supervision steps is drawn per batch.
//!
//! **`reasoning.over = "tokens"`**, ours: the observation's tokens are the states. A supervision step sends all of them
//! through the same pre-norm encoder layers (`l_cycles` times); what it leaves goes on to the next step with its graph. After
//! every step ACT's decoder reads them under a norm. With `pointer` they are asked which entity is meant, the decoder reads that
//! entity's token as one more, and each step's answer has a loss of its own: that is how a step learns to follow
//! a relation from thing to thing, which the loss on actions alone did not teach (docs/study_plan.md).
//!
//! With `grid` the states are the cells of a grid alone: a convolution takes the place of attention, so that what a cell knows
//! goes on to its neighbours, and as in TRM every step begins from the states under a norm, with what is observed added
//! again. `way` asks each cell after every step whether the demonstration still comes by it.
//!
//! In the other two only the last round of a supervision step keeps a graph. The recursion has no dropout,
//! and the latent is drawn once per batch (the original draws it anew for every step).
//! Validation and inference run at latent zero, as ACT's do (the original validates with the
//! posterior of the true actions, which flatters it).
//!
//! Variants for comparison (`over = "actions"` and `"tokens"`): `reasoning.untied` gives every supervision step a block of its own,
//! `start_noise` begins thoughts with noise in training, `deep_supervision = false` leaves only the last step its loss.
//!
//! `auxiliary` asks the encoded memory in training for numbers that are not seen, as in ACT (`over = "actions"`).
//!
//! Halting: a head reads the reasoning after each step and is trained on whether one more step
//! would still lower this sample's chunk error. For the last step's target one more step runs
//! without gradient.
//!
//! This file is the model as one reads it, on candle's autograd. Training steps and thoughts run the same maths with
//! hand-written backward passes (`fused/`); tests hold the two together.

mod config;
mod examine;
mod fused;
mod reasoning;
#[cfg(test)]
mod tests;

pub use config::{Config, Over, ReasoningConfig, WarmStart};
pub use examine::{DisturbedPolicy, ExaminedStep, Intervention, Thinking};
pub use reasoning::{Reasoning, ReasoningPolicy, ReasoningStep};

use crate::batch::Batch;
use crate::checks::{check_batch, check_observation, check_signature};
use crate::classification::binary_cross_entropy;
use crate::encoders::VisionConfig;
use crate::features::{FeatureKind, Features, Signature};
use crate::flops;
use crate::fused::Workspaces;
use crate::layers::{
    Answers, Asked, Auxiliary, Cells, Decoder, DecoderLayer, Embedding, Encoder, EncoderLayer, FeedForward, GridLayer,
    InputTokens, LayerInit, LayerNorm, Linear, Mode, MultiHeadAttention, NEIGHBOURS, Pointer, Shape, TokenLayout, Vae,
    Visited, environment_state, kl_divergence, sample, sinusoid_table,
};
use crate::model::{PolicyModel, autograd, not_by_hand};
use crate::policy::{Clock, Policy};
use crate::preprocess::Preprocess;
use candle_core::{DType, Tensor};
use nn::Gradients;
use nn::Result;
use nn::Rng;
use nn::losses::absolute;
use nn::{Init, Params};
use nn::{LossParts, LossValues};
use std::collections::BTreeMap;
use std::sync::Arc;

/// The kinds of features that it reads.
pub const READS: &[FeatureKind] =
    &[FeatureKind::State, FeatureKind::EnvironmentState, FeatureKind::Entity, FeatureKind::Image];

/// The shared layer of `over = "actions"`: attention to a context, then a dense part.
#[derive(Debug)]
struct BlockLayer {
    attn: MultiHeadAttention,
    ff: FeedForward,
    norm1: LayerNorm,
    norm2: LayerNorm,
}

impl BlockLayer {
    fn new(params: &mut Params, prefix: &str, config: &Config, rng: &mut Rng) -> Result<Self> {
        let dim = config.dim_model;
        let init = LayerInit::Xavier.weight();
        let hidden = (dim, config.block_feedforward());
        let act = config.feedforward_activation;
        Ok(Self {
            attn: MultiHeadAttention::new(params, &format!("{prefix}.attn"), dim, config.n_heads, 0.0, init, rng)?,
            ff: FeedForward::new(params, &format!("{prefix}."), hidden, act, 0.0, init, rng)?,
            norm1: LayerNorm::new(params, &format!("{prefix}.norm1"), dim, rng)?,
            norm2: LayerNorm::new(params, &format!("{prefix}.norm2"), dim, rng)?,
        })
    }

    /// x: (b, t, D), context: (b, s, D) -> (b, t, D)
    fn forward(&self, x: &Tensor, context: &Tensor) -> Result<Tensor> {
        let mode = &mut Mode::Eval;
        let seen = self.attn.forward(x, context, context, None, mode)?;
        let x = self.norm1.forward(&(x + seen)?)?;
        self.norm2.forward(&(&x + self.ff.forward(&x, mode)?)?)
    }
}

/// The recursion over actions.
#[derive(Debug)]
struct OverActions {
    memory_encoder: Option<Encoder>,
    /// (R, D), added to z before every update
    latent_pos: Embedding,
    /// (H, D), added to y before every update
    action_pos: Embedding,
    /// of the shared block, or of every supervision step's block one after the other
    layers: Vec<BlockLayer>,
}

/// The recursion over the memory, and ACT's decoder.
#[derive(Debug)]
struct OverMemory {
    block: Encoder,
    z_init: [Vec<f32>; 2],
    decoder: Decoder,
}

/// The recursion over the observation's tokens, and ACT's decoder.
#[derive(Debug)]
struct OverTokens {
    /// of the tokens before the first step
    first_norm: LayerNorm,
    layers: TokenLayers,
    /// before tokens are read
    norm: LayerNorm,
    decoder: Decoder,
    pointer: Option<Pointer>,
}

/// Pre-norm; of the shared block, or of every supervision step's block one after the other.
#[derive(Debug)]
enum TokenLayers {
    /// among all tokens
    Attention(Vec<EncoderLayer>),
    /// from cell to cell of a grid
    Grid(Cells, Vec<GridLayer>),
}

#[derive(Debug)]
enum Design {
    Actions(OverActions),
    Memory(OverMemory),
    Tokens(OverTokens),
}

/// The recursion's states: `(y, z)` over actions, `(z_h, z_l)` over the memory, the tokens twice over tokens.
#[derive(Debug, Clone)]
struct Carry {
    answer: Tensor,
    reasoning: Tensor,
}

impl Carry {
    fn detach(&self) -> Self {
        Self { answer: self.answer.detach(), reasoning: self.reasoning.detach() }
    }
}

/// What a supervision step is asked beside the actions.
#[derive(Debug)]
enum Question {
    /// which entity a demonstration took
    Taken(Asked),
    /// which cells it still comes by
    Visited(Visited),
}

impl Question {
    /// What its parts of the loss begin with.
    fn name(&self) -> &'static str {
        match self {
            Self::Taken(_) => "pointer",
            Self::Visited(_) => "way",
        }
    }

    fn loss(&self, scores: &Tensor) -> Result<Tensor> {
        match self {
            Self::Taken(asked) => asked.loss(scores),
            Self::Visited(visited) => visited.loss(scores),
        }
    }

    /// The loss on a slice, and `weight` times its gradient.
    fn answers(&self, scores: &[f32], grad: Option<(&mut [f32], f64)>) -> Answers {
        match self {
            Self::Taken(asked) => asked.answers(scores, grad),
            Self::Visited(visited) => visited.answers(scores, grad),
        }
    }

    /// Rows that are answered rightly, a share of all rows of the batch that are asked.
    fn right(&self, scores: &Tensor) -> Result<Tensor> {
        let values = scores.detach().flatten_all()?.to_vec1::<f32>()?;
        Ok(Tensor::new(self.answers(&values, None).right, scores.device())?)
    }
}

/// What a supervision step gives.
struct Step {
    carry: Carry,
    /// (b, H, A)
    chunk: Tensor,
    /// (b,)
    halt_logit: Tensor,
    /// what the chunk is read from, (b, H, D)
    decoded: Tensor,
    /// of every candidate whether it is the entity that is meant, or of every cell whether the way goes there, if that is asked
    scores: Option<Tensor>,
}

/// The model.
#[derive(Debug)]
pub struct Actrm {
    config: Config,
    signature: Signature,
    params: Params,
    vae: Option<Vae>,
    /// (1, H + 2, D), fixed
    vae_pos_enc: Tensor,
    /// the same as a slice
    vae_positions: Vec<f32>,
    tokens: InputTokens,
    design: Design,
    action_head: Linear,
    halt_head: Linear,
    auxiliary: Option<Auxiliary>,
    workspaces: Workspaces,
}

impl Actrm {
    /// Initial weights as ACT's: xavier-uniform matrices in the layers, torch's defaults elsewhere.
    ///
    /// # Errors
    /// A configuration or a signature that describes no possible model.
    pub fn new(config: &Config, signature: &Signature, seed: u64) -> Result<Self> {
        config.validate()?;
        check_signature("actrm", signature, READS)?;
        let layout = TokenLayout::new(signature, config.vision.as_ref(), config.dim_model)?;
        let rng = &mut Rng::new(seed, "init");
        let mut p = Params::new();
        let (dim, shape, r) = (config.dim_model, config.shape(), &config.reasoning);
        let vae = match config.use_vae {
            true => {
                let (of_vae, io) = ((config.n_vae_encoder_layers, config.latent_dim), (&layout, signature.action_dim));
                Some(Vae::new(&mut p, shape, of_vae, io, rng)?)
            }
            false => None,
        };
        let env_state = environment_state(&mut p, &layout, dim, rng)?;
        let positions = sinusoid_table(config.action_horizon + 2, dim)?;
        let design = match r.over {
            Over::Actions => Design::Actions(OverActions {
                memory_encoder: match config.n_memory_layers {
                    0 => None,
                    n => Some(Encoder::new(&mut p, "encoder", n, shape, LayerInit::Xavier, rng)?),
                },
                latent_pos: Embedding::new(&mut p, "reasoning.latent_pos_embed", r.tokens, dim, rng)?,
                action_pos: Embedding::new(&mut p, "reasoning.action_pos_embed", config.action_horizon, dim, rng)?,
                layers: (0..r.blocks() * r.n_layers)
                    .map(|i| BlockLayer::new(&mut p, &format!("reasoning.layers.{i}"), config, rng))
                    .collect::<Result<_>>()?,
            }),
            Over::Memory => {
                // no dropout inside the recursion
                let quiet = Shape { dropout: 0.0, ..shape };
                Design::Memory(OverMemory {
                    block: Encoder::new(&mut p, "reasoning", r.n_layers, quiet, LayerInit::Xavier, rng)?,
                    z_init: fixed_values(dim),
                    decoder: decoder(&mut p, config, rng)?,
                })
            }
            Over::Tokens => {
                let block = config.block_shape();
                let layer = |i: usize| format!("reasoning.layers.{i}");
                let blocks = 0..r.blocks() * r.n_layers;
                Design::Tokens(OverTokens {
                    first_norm: LayerNorm::new(&mut p, "reasoning.first_norm", dim, rng)?,
                    // a step begins as a small change of what tokens say: after six large ones nothing of it was left
                    layers: match &r.grid {
                        None => TokenLayers::Attention(
                            blocks
                                .map(|i| EncoderLayer::new(&mut p, &layer(i), block, LayerInit::Recursive, rng))
                                .collect::<Result<_>>()?,
                        ),
                        Some(grid) => TokenLayers::Grid(
                            Cells::new(&mut p, grid, ("actrm", &layout), dim, rng)?,
                            blocks.map(|i| GridLayer::new(&mut p, &layer(i), block, rng)).collect::<Result<_>>()?,
                        ),
                    },
                    norm: LayerNorm::new(&mut p, "reasoning.norm", dim, rng)?,
                    decoder: decoder(&mut p, config, rng)?,
                    pointer: match &config.pointer {
                        Some(pointer) => Some(Pointer::new(&mut p, pointer, ("actrm", signature, &layout), dim, rng)?),
                        None => None,
                    },
                })
            }
        };
        Ok(Self {
            vae,
            vae_positions: positions.flatten_all()?.to_vec1()?,
            vae_pos_enc: positions,
            tokens: InputTokens::new(&mut p, layout, config.latent_dim, dim, env_state, rng)?,
            design,
            action_head: Linear::new(&mut p, "action_head", dim, signature.action_dim, rng)?,
            halt_head: Linear::new(&mut p, "halt_head", dim, 1, rng)?,
            auxiliary: match &config.auxiliary {
                Some(asked) => Some(Auxiliary::new(&mut p, asked, ("actrm", signature), dim, rng)?),
                None => None,
            },
            workspaces: Workspaces::default(),
            params: p,
            config: config.clone(),
            signature: signature.clone(),
        })
    }

    /// Its configuration.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// What the recursion reads, made once per observation: (b, M, D).
    fn memory(&self, latent: &Tensor, observation: &Features<Tensor>, mode: &mut Mode<'_>) -> Result<Tensor> {
        let tokens = self.tokens.forward(latent, observation)?;
        let pos = self.tokens.positions()?;
        match &self.design {
            Design::Actions(OverActions { memory_encoder: Some(encoder), .. }) => {
                let memory = encoder.forward(&tokens, &pos, None, mode)?;
                Ok(memory.broadcast_add(&pos)?)
            }
            Design::Actions(_) => Ok(tokens.broadcast_add(&pos)?),
            Design::Tokens(design) => design.first_norm.forward(&tokens.broadcast_add(&pos)?),
            Design::Memory(_) => Ok(tokens),
        }
    }

    /// The states before the first step.
    fn start(&self, batch: usize, memory: &Tensor) -> Result<Carry> {
        let dim = self.config.dim_model;
        let zeros = |n: usize| Tensor::zeros((batch, n, dim), DType::F32, memory.device());
        Ok(match &self.design {
            Design::Actions(_) => {
                Carry { answer: zeros(self.config.action_horizon)?, reasoning: zeros(self.config.reasoning.tokens)? }
            }
            Design::Memory(design) => {
                let [h, l] = &design.z_init;
                let all = |z: &[f32]| Tensor::from_slice(z, z.len(), memory.device())?.broadcast_as(memory.shape());
                Carry { answer: all(h)?.contiguous()?, reasoning: all(l)?.contiguous()? }
            }
            Design::Tokens(_) => Carry { answer: memory.clone(), reasoning: memory.clone() },
        })
    }

    /// Supervision step number `at`, from 0. Earlier rounds than the last are detached call by call, so that their graphs
    /// are freed as they go.
    fn step(&self, memory: &Tensor, carry: &Carry, at: usize, mode: &mut Mode<'_>) -> Result<Step> {
        let mut carry = carry.clone();
        for round in 1..=self.config.reasoning.h_cycles {
            carry = match round == self.config.reasoning.h_cycles {
                true => self.round(memory, &carry, at, false)?,
                false => self.round(&memory.detach(), &carry.detach(), at, true)?,
            };
        }
        self.answer(memory, carry, mode)
    }

    /// What a carry says.
    fn answer(&self, memory: &Tensor, carry: Carry, mode: &mut Mode<'_>) -> Result<Step> {
        let (mut scores, mut read, mut carry) = (None, carry.answer.clone(), carry);
        let decoded = match &self.design {
            Design::Actions(_) => {
                read = carry.reasoning.clone();
                carry.answer.clone()
            }
            Design::Memory(design) => {
                let pos = self.tokens.positions()?;
                design.decoder.forward(&carry.answer, &pos, mode)?
            }
            Design::Tokens(design) => {
                read = design.norm.forward(&carry.answer)?;
                if let TokenLayers::Grid(cells, _) = &design.layers {
                    scores = cells.way(&read)?;
                    carry = Carry { answer: read.clone(), reasoning: read.clone() };
                }
                // tokens have brought their positions along
                let nowhere = self.tokens.positions()?.zeros_like()?;
                match &design.pointer {
                    Some(pointer) => {
                        let which = pointer.forward(&read, memory)?;
                        let (beside, pos) = pointer.beside(&read, &nowhere, &which)?;
                        scores = Some(which.scores);
                        design.decoder.forward(&beside, &pos, mode)?
                    }
                    None => design.decoder.forward(&read, &nowhere, mode)?,
                }
            }
        };
        let chunk = self.action_head.forward(&decoded)?;
        // the head judges the reasoning and must not bend it
        let halt_logit = self.halt_head.forward(&read.detach().mean(1)?)?.squeeze(1)?;
        Ok(Step { carry, chunk, halt_logit, decoded, scores })
    }

    /// `l_cycles` updates of the reasoning, one of the answer.
    fn round(&self, memory: &Tensor, carry: &Carry, at: usize, quiet: bool) -> Result<Carry> {
        let Carry { mut answer, mut reasoning } = carry.clone();
        let settle = |x: Tensor| if quiet { x.detach() } else { x };
        match &self.design {
            Design::Actions(design) => {
                let layers = &design.layers[self.config.reasoning.layers_of(at)];
                let y = positioned(&answer, &design.action_pos)?;
                for _ in 0..self.config.reasoning.l_cycles {
                    let z = positioned(&reasoning, &design.latent_pos)?;
                    reasoning = settle(update(layers, &z, &[&z, &y, memory])?);
                }
                let z = positioned(&reasoning, &design.latent_pos)?;
                answer = settle(update(layers, &y, &[&z, &y, memory])?);
            }
            Design::Memory(design) => {
                let pos = self.tokens.positions()?;
                let update = |x: &Tensor| design.block.forward(x, &pos, None, &mut Mode::Eval);
                let injected = (&answer + memory)?;
                for _ in 0..self.config.reasoning.l_cycles {
                    reasoning = settle(update(&(&reasoning + &injected)?)?);
                }
                answer = settle(update(&(&answer + &reasoning)?)?);
            }
            Design::Tokens(design) => {
                let of_step = self.config.reasoning.layers_of(at);
                match &design.layers {
                    TokenLayers::Attention(layers) => {
                        let nowhere = self.tokens.positions()?.zeros_like()?;
                        for layer in (0..self.config.reasoning.l_cycles).flat_map(|_| &layers[of_step.clone()]) {
                            answer = layer.forward(&answer, &nowhere, None, &mut Mode::Eval)?;
                        }
                    }
                    TokenLayers::Grid(cells, layers) => {
                        if at > 0 {
                            answer = (answer + memory)?;
                        }
                        let mut x = cells.of(&answer)?;
                        for layer in (0..self.config.reasoning.l_cycles).flat_map(|_| &layers[of_step.clone()]) {
                            x = layer.forward(cells.grid, &x)?;
                        }
                        answer = cells.put(&answer, &x)?;
                    }
                }
                reasoning = answer.clone();
            }
        }
        Ok(Carry { answer, reasoning })
    }

    /// Supervision steps for this batch.
    fn steps_of(&self, batch: &Batch) -> usize {
        let most = self.config.reasoning.supervision_steps;
        match self.config.reasoning.over {
            Over::Actions | Over::Tokens => most,
            // the same for all shards of a batch
            Over::Memory => 1 + Rng::new(batch.seed, "supervision steps").below(most as u64) as usize,
        }
    }

    /// Weights of the supervision steps, which sum to 1: growing with depth (late steps
    /// are what is executed), equal over the memory (the original's); all the last one's without deep supervision.
    fn step_weights(&self, steps: usize) -> Vec<f64> {
        let weight = |i: usize| match self.config.reasoning.over {
            _ if !self.config.reasoning.deep_supervision => f64::from(u8::from(i + 1 == steps)),
            Over::Actions | Over::Tokens => (i + 1) as f64,
            Over::Memory => 1.0,
        };
        let total: f64 = (0..steps).map(weight).sum();
        (0..steps).map(|i| weight(i) / total).collect()
    }

    /// What is asked of a batch beside the actions, and the weight of the loss on it.
    fn question(&self, batch: &Batch) -> Result<Option<(Question, f64)>> {
        let Design::Tokens(design) = &self.design else { return Ok(None) };
        Ok(match (&design.pointer, &design.layers) {
            (Some(pointer), _) => Some((Question::Taken(pointer.asked("actrm", batch)?), pointer.weight)),
            (None, TokenLayers::Grid(cells, _)) => {
                cells.asked("actrm", batch)?.map(|visited| (Question::Visited(visited), cells.weight))
            }
            _ => None,
        })
    }

    fn check_inputs(&self, observation: &Features<Tensor>) -> Result<usize> {
        check_observation("actrm", &self.signature, observation)
    }

    fn check_batch(&self, batch: &Batch) -> Result<()> {
        check_batch("actrm", &self.signature, self.config.action_horizon, batch)
    }

    /// The batch with pictures as the network reads them in training.
    fn looked_at(&self, batch: &Batch, rng: &mut Rng) -> Result<Batch> {
        self.check_batch(batch)?;
        Ok(Batch { observation: self.tokens.look(&batch.observation, Some(rng))?, ..batch.clone() })
    }

    /// With warm starts in use, the answer that half of the rows begin with: the model's own, to
    /// the same observation under noise.
    fn warm_answers(&self, batch: &Batch, warm: WarmStart, carry: &Carry, rng: &mut Rng) -> Result<Tensor> {
        let mut noisy = |x: &Tensor| -> Result<Tensor> {
            let noise = Tensor::from_vec(rng.normals(x.elem_count()), x.shape(), x.device())?;
            Ok((x + (noise * warm.noise)?)?)
        };
        let mut observation = Features::new();
        for token in &self.tokens.layout().tokens {
            observation.insert(&token.feature, noisy(batch.observation.require("warm start", &token.feature)?)?);
        }
        for camera in self.tokens.layout().cameras.iter().flat_map(|cameras| &cameras.features) {
            observation.insert(camera, batch.observation.require("warm start", camera)?.clone());
        }
        let latent = Tensor::zeros((batch.rows(), self.config.latent_dim), DType::F32, batch.device())?;
        let memory = self.memory(&latent, &observation, &mut Mode::Eval)?.detach();
        let mut thought = carry.clone();
        for at in 0..self.config.reasoning.supervision_steps {
            thought = self.step(&memory, &thought, at, &mut Mode::Eval)?.carry.detach();
        }
        let warm: Vec<f32> = (0..batch.rows()).map(|_| if rng.uniform() < 0.5 { 1.0 } else { 0.0 }).collect();
        let warm = Tensor::from_vec(warm, (batch.rows(), 1, 1), batch.device())?;
        Ok(thought.answer.broadcast_mul(&warm)?)
    }
}

/// ACT's decoder, which reads the states.
fn decoder(p: &mut Params, config: &Config, rng: &mut Rng) -> Result<Decoder> {
    let (dim, shape) = (config.dim_model, config.shape());
    Ok(Decoder {
        layers: (0..config.n_decoder_layers)
            .map(|i| DecoderLayer::new(p, &format!("decoder.layers.{i}"), shape, rng))
            .collect::<Result<_>>()?,
        norm: LayerNorm::new(p, "decoder.norm", dim, rng)?,
        pos_embed: Embedding::new(p, "decoder_pos_embed", config.action_horizon, dim, rng)?,
    })
}

/// x: (b, t, D), positions of the t tokens -> their sum
fn positioned(x: &Tensor, positions: &Embedding) -> Result<Tensor> {
    Ok(x.broadcast_add(&positions.weight.unsqueeze(0)?)?)
}

/// A block's layers on x: (b, t, D), context: tokens to attend to -> (b, t, D)
fn update(layers: &[BlockLayer], x: &Tensor, context: &[&Tensor]) -> Result<Tensor> {
    let context = Tensor::cat(context, 1)?;
    let mut x = x.clone();
    for layer in layers {
        x = layer.forward(&x, &context)?;
    }
    Ok(x)
}

/// The fixed values that `z_h` and `z_l` begin with, (D) each: a pure function of the width, so that nothing untrained
/// needs storing.
fn fixed_values(dim: usize) -> [Vec<f32>; 2] {
    let init = Init::TruncatedNormal { std: 1.0 };
    ["actrm z_h", "actrm z_l"].map(|name| init.values(&[dim], &mut Rng::new(0, name)))
}

impl PolicyModel for Actrm {
    fn params(&self) -> &Params {
        &self.params
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn composed_because(&self) -> Option<String> {
        not_by_hand(&self.signature)
    }

    fn loss(&self, batch: &Batch, rng: &mut Rng) -> Result<LossParts> {
        let batch = &self.looked_at(batch, rng)?;
        let rows = batch.rows();
        let shape = (rows, self.config.latent_dim);
        let latent = match &self.vae {
            Some(vae) => Some(vae.encode(batch, &self.vae_pos_enc, &mut Mode::Train(rng))?),
            None => None,
        };
        let sample = match &latent {
            Some(latent) => {
                let eps = Tensor::from_vec(rng.normals(shape.0 * shape.1), shape, batch.device())?;
                sample(latent, &eps)?
            }
            None => Tensor::zeros(shape, DType::F32, batch.device())?,
        };
        let memory = self.memory(&sample, &batch.observation, &mut Mode::Train(rng))?;
        let mut carry = self.start(rows, &memory)?;
        if let Some(warm) = self.config.reasoning.warm_start {
            carry.answer = self.warm_answers(batch, warm, &carry, rng)?;
        }
        let noise = self.config.reasoning.start_noise;
        if noise > 0.0 {
            for state in [&mut carry.answer, &mut carry.reasoning] {
                let drawn = Tensor::from_vec(rng.normals(state.elem_count()), state.shape(), batch.device())?;
                *state = match self.config.reasoning.over {
                    Over::Tokens => (&*state + (drawn * noise)?)?,
                    _ => (drawn * noise)?,
                };
            }
        }

        let steps = self.steps_of(batch);
        let (mut chunks, mut halts, mut scores) = (Vec::new(), Vec::new(), Vec::new());
        for at in 0..steps {
            let step = self.step(&memory, &carry, at, &mut Mode::Train(rng))?;
            carry = match self.config.reasoning.over {
                Over::Actions | Over::Tokens => step.carry,
                Over::Memory => step.carry.detach(),
            };
            chunks.push(step.chunk);
            halts.push(step.halt_logit);
            scores.extend(step.scores);
        }
        // one step more, so that the last depth has a halting target as well
        let beyond = self.step(&memory.detach(), &carry.detach(), steps, &mut Mode::Eval)?.chunk.detach();

        let (b, c, a) = batch.actions.dims3()?;
        let valid = (1.0 - batch.is_pad.reshape((b, c, 1))?)?;
        let errors =
            |chunk: &Tensor| -> Result<Tensor> { Ok(absolute(&(chunk - &batch.actions)?)?.broadcast_mul(&valid)?) };
        let entries = (batch.total_valid_steps * a).max(1) as f64;
        let mut parts = BTreeMap::new();
        let mut total = Tensor::zeros((), DType::F32, batch.device())?;
        let mut row_errors = Vec::with_capacity(steps + 1);
        for (chunk, weight) in chunks.iter().zip(self.step_weights(steps)) {
            let error = errors(chunk)?;
            let l1 = (error.sum_all()? / entries)?;
            // the last step's is the one comparable with ACT's
            parts.insert("l1_loss".to_string(), l1.detach());
            parts.entry("l1_loss_first".to_string()).or_insert_with(|| l1.detach());
            row_errors.push(error.detach().sum((1, 2))?);
            total = (total + (l1 * weight)?)?;
        }
        row_errors.push(errors(&beyond)?.sum((1, 2))?);

        if let Some((question, share)) = self.question(batch)? {
            let name = question.name();
            for (scores, weight) in scores.iter().zip(self.step_weights(steps)) {
                let (loss, right) = (question.loss(scores)?, question.right(scores)?);
                parts.insert(format!("{name}_loss"), loss.detach());
                parts.entry(format!("{name}_right_first")).or_insert_with(|| right.clone());
                parts.insert(format!("{name}_right"), right);
                total = (total + (loss * (weight * share))?)?;
            }
        }

        if let Some(asked) = &self.auxiliary {
            let loss = asked.told("actrm", batch)?.loss(&asked.forward(&memory)?)?;
            parts.insert("auxiliary_loss".to_string(), loss.detach());
            total = (total + (loss * asked.weight)?)?;
        }
        let mut halt = Tensor::zeros((), DType::F32, batch.device())?;
        let still = 1.0 - self.config.reasoning.halt_margin;
        for (i, logit) in halts.iter().enumerate() {
            let target = row_errors[i + 1].ge(&(&row_errors[i] * still)?)?.to_dtype(DType::F32)?;
            halt = (halt + binary_cross_entropy(logit, &target)?.sum_all()?)?;
        }
        let halt = (halt / (batch.total_rows.max(1) * steps) as f64)?;
        parts.insert("halt_loss".to_string(), halt.detach());
        total = (total + (halt * self.config.reasoning.halt_weight)?)?;
        if let Some((mu, log_variance)) = &latent {
            let kld = kl_divergence(mu, log_variance, batch.total_rows)?;
            parts.insert("kld_loss".to_string(), kld.detach());
            total = (total + (kld * self.config.kl_weight)?)?;
        }
        Ok(LossParts { total, parts })
    }

    fn accumulate_gradients(&self, batch: &Batch, rng: &mut Rng, into: &mut Gradients) -> Result<LossValues> {
        match self.composed_because() {
            Some(_) => autograd(self, batch, rng, into),
            None => self.fused_gradients(batch, rng, into),
        }
    }

    fn predict(&self, observation: &Features<Tensor>) -> Result<Tensor> {
        Ok(self.reason(observation, None, &mut |_| false)?.chunk)
    }

    fn policy(self: Arc<Self>, preprocess: Arc<Preprocess>, clock: Box<dyn Clock>) -> Box<dyn Policy> {
        Box::new(ReasoningPolicy::new(self, preprocess, clock))
    }

    fn depends_on_time(&self) -> bool {
        self.config.reasoning.budget_ms.is_some()
    }

    fn query_flops(&self) -> Option<f64> {
        let (config, r, layout) = (&self.config, &self.config.reasoning, self.tokens.layout());
        if r.over == Over::Memory || layout.cameras.is_some() {
            return None;
        }
        let (dim, memory, horizon) = (config.dim_model, layout.len(), config.action_horizon);
        let block = Shape { hidden: config.block_feedforward(), ..config.shape() };
        if let Design::Tokens(design) = &self.design {
            let read = memory + usize::from(config.pointer.is_some());
            let layer = match &design.layers {
                TokenLayers::Attention(_) => flops::encoder_layer(block, memory),
                TokenLayers::Grid(cells, _) => {
                    let cells = cells.grid.cells();
                    flops::linear(cells, NEIGHBOURS * dim, dim) + flops::dense(block, cells)
                }
            };
            let layers = layer * (r.l_cycles * r.n_layers) as f64;
            let decoder = flops::decoder_layer(config.shape(), horizon, read) * config.n_decoder_layers as f64;
            let step = layers + decoder + flops::linear(horizon, dim, self.signature.action_dim);
            return Some(flops::tokens(layout, config.latent_dim, dim) + step * r.max_steps() as f64);
        }
        let context = r.tokens + horizon + memory;
        let keys_and_values = |tokens: usize| flops::linear(tokens, dim, 2 * dim);
        // queries and what they take home, the context's keys and values beside those that serve several updates
        let update = |tokens: usize| {
            let attention = flops::linear(tokens, dim, 2 * dim) + flops::mixing(tokens, context, dim);
            keys_and_values(r.tokens) + attention + flops::dense(block, tokens)
        };
        let round = keys_and_values(horizon) + update(r.tokens) * r.l_cycles as f64 + update(horizon);
        let step = round * (r.h_cycles * r.n_layers) as f64 + flops::linear(horizon, dim, self.signature.action_dim);
        let once = flops::encoder_layer(config.shape(), memory) * config.n_memory_layers as f64
            + keys_and_values(memory) * (r.blocks() * r.n_layers) as f64;
        Some(flops::tokens(layout, config.latent_dim, dim) + once + step * r.max_steps() as f64)
    }

    fn action_horizon(&self) -> usize {
        self.config.action_horizon
    }

    fn vision(&self) -> Option<&VisionConfig> {
        self.tokens.vision()
    }
}
