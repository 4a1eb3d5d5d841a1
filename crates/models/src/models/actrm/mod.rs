//! ACTRM: an action-chunking policy that thinks, with three designs behind one configuration.
//!
//! Origins: ACT (arXiv 2304.13705) for observations, latent and loss; the Tiny Recursive Model
//! (Jolicoeur-Martineau, 2025) for the recursion; the original ACTRM (jshyunbin/R3PL) for putting
//! the two together.
//!
//! **`reasoning.over = "actions"`** (default, our own): `y`, one token per action of the chunk,
//! is the answer; `z`, a few latent tokens, is the reasoning. The memory (latent, robot state,
//! environment state, entities, images) is encoded once per observation. One small block, shared by everything,
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
//! a relation from thing to thing, which the loss on actions alone did not teach (docs/results/study_plan.md).
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

mod config;
mod examine;
#[cfg(test)]
mod kernel_tests;
mod over_actions;
mod over_memory;
mod over_tokens;
mod reasoning;
#[cfg(test)]
mod tests;

pub use config::{Config, Over, ReasoningConfig, WarmStart};
pub use examine::{DisturbedPolicy, ExaminedStep, Intervention, RestartedPolicy, Starts, Thinking};
pub use reasoning::{Reasoning, ReasoningPolicy, ReasoningStep};

use crate::batch::Batch;
use crate::checks::{check_batch, check_observation, check_signature};
use crate::classification::binary_cross_entropy;
use crate::encoders::VisionConfig;
use crate::features::{FeatureKind, Features, Signature};
use crate::flops;
use crate::layers::{
    Auxiliary, Decoder, DecoderLayer, Embedding, InputTokens, LayerNorm, Linear, NEIGHBOURS, Question, Shape,
    TokenLayout, Vae, ask, environment_state, sinusoid_table,
};
use crate::model::PolicyModel;
use crate::policy::{Clock, Policy};
use crate::preprocess::Preprocess;
use candle_core::{DType, Tensor};
use nn::ops::{
    Error, RowErrors, add, alias, cat_tokens, chunk_error, detached_mean, kl_divergence, linear, residual,
    sample_latent, term_of,
};
use nn::{Backend, Cache, Context, Loss, Params, Result, Rng, Term, Value};
use over_actions::{OverActions, Read};
use over_memory::OverMemory;
use over_tokens::{OverTokens, TokenLayers};
use reasoning::Start;
use std::sync::Arc;

/// The kinds of features that it reads.
pub const READS: &[FeatureKind] =
    &[FeatureKind::State, FeatureKind::EnvironmentState, FeatureKind::Entity, FeatureKind::Image];

#[derive(Debug)]
enum Design {
    Actions(OverActions),
    Memory(OverMemory),
    Tokens(OverTokens),
}

/// The recursion's states, `(y, z)` over actions, `(z_h, z_l)` over the memory, the tokens over tokens; `None` is what a thought
/// begins with.
#[derive(Debug, Clone, Default)]
struct Carry {
    answer: Option<Value>,
    reasoning: Option<Value>,
}

impl Carry {
    fn detach(&self) -> Self {
        let detached = |state: &Option<Value>| state.as_ref().map(Value::detach);
        Self { answer: detached(&self.answer), reasoning: detached(&self.reasoning) }
    }
}

/// What the recursion reads, made once per observation.
struct Observed {
    /// (b, M, D)
    memory: Value,
    /// what a thought over tokens begins with
    begun: Value,
    /// over actions
    read: Option<Read>,
}

/// What a supervision step gives.
struct Step {
    carry: Carry,
    /// (b, H, A)
    chunk: Value,
    /// what the halting head reads, (b, D)
    mean: Value,
    /// what the chunk is read from, (b, H, D)
    decoded: Value,
    /// of every candidate whether it is the entity that is meant, or of every cell whether the way goes there, if that is asked
    scores: Option<Value>,
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
    tokens: InputTokens,
    design: Design,
    action_head: Linear,
    halt_head: Linear,
    auxiliary: Option<Auxiliary>,
    cache: Cache,
}

impl Actrm {
    /// Initial weights as ACT's: xavier-uniform matrices in the layers, torch's defaults elsewhere.
    ///
    /// # Errors
    /// A configuration or a signature that describes no possible model.
    pub fn new(config: &Config, signature: &Signature, seed: u64, backend: &Backend) -> Result<Self> {
        config.validate()?;
        check_signature("actrm", signature, READS)?;
        let layout = TokenLayout::new(signature, config.vision.as_ref(), config.dim_model)?;
        let rng = &mut Rng::new(seed, "init");
        let mut p = Params::new(backend);
        let (dim, shape) = (config.dim_model, config.shape());
        let vae = match config.use_vae {
            true => {
                let (of_vae, io) = ((config.n_vae_encoder_layers, config.latent_dim), (&layout, signature.action_dim));
                Some(Vae::new(&mut p, shape, of_vae, io, rng)?)
            }
            false => None,
        };
        let env_state = environment_state(&mut p, &layout, dim, rng)?;
        let design = match config.reasoning.over {
            Over::Actions => Design::Actions(OverActions::new(&mut p, config, shape, rng)?),
            Over::Memory => Design::Memory(OverMemory::new(&mut p, config, shape, rng)?),
            Over::Tokens => Design::Tokens(OverTokens::new(&mut p, config, (signature, &layout), rng)?),
        };
        Ok(Self {
            vae,
            vae_pos_enc: sinusoid_table(config.action_horizon + 2, dim, backend.device())?,
            tokens: InputTokens::new(&mut p, layout, config.latent_dim, dim, env_state, rng)?,
            design,
            action_head: Linear::new(&mut p, "action_head", dim, signature.action_dim, rng)?,
            halt_head: Linear::new(&mut p, "halt_head", dim, 1, rng)?,
            auxiliary: match &config.auxiliary {
                Some(asked) => Some(Auxiliary::new(&mut p, asked, ("actrm", signature), dim, rng)?),
                None => None,
            },
            cache: Cache::default(),
            params: p,
            config: config.clone(),
            signature: signature.clone(),
        })
    }

    /// Its configuration.
    pub fn config(&self) -> &Config {
        &self.config
    }

    /// The observation encoded: latent: (b, L), images as the network reads them -> (b, M, D)
    fn memory(&self, cx: &mut Context<'_>, latent: &Value, observation: &Features<Tensor>) -> Result<Value> {
        let tokens = self.tokens.apply(cx, latent, observation)?;
        let all = tokens.dim(1)?;
        match &self.design {
            Design::Actions(design) => {
                let pos = self.tokens.apply_positions(cx)?;
                let memory = match &design.memory_encoder {
                    Some(encoder) => encoder.apply(cx, &tokens, &pos, None, all)?,
                    None => tokens,
                };
                add(cx, &pos, &memory)
            }
            Design::Tokens(design) => {
                let pos = self.tokens.apply_positions(cx)?;
                residual(cx, &pos, &tokens, (0.0, all), Some(&design.first_norm))
            }
            Design::Memory(_) => Ok(tokens),
        }
    }

    /// memory: (b, M, D)
    fn observe(&self, cx: &mut Context<'_>, memory: Value) -> Result<Observed> {
        let read = match &self.design {
            Design::Actions(design) => Some(design.read(cx, &memory)?),
            Design::Memory(_) | Design::Tokens(_) => None,
        };
        Ok(Observed { begun: alias(cx, &memory), memory, read })
    }

    /// Supervision step number `at`, from 0.
    fn step(&self, cx: &mut Context<'_>, observed: &Observed, carry: &Carry, at: usize) -> Result<Step> {
        // positions of what is observed, over the memory
        let pos = match &self.design {
            Design::Memory(_) => Some(self.tokens.apply_positions(cx)?),
            Design::Actions(_) | Design::Tokens(_) => None,
        };
        let carry = self.rounds(cx, observed, carry, (at, pos.as_ref()))?;
        self.answer(cx, observed, carry, pos.as_ref())
    }

    /// The rounds of a step; earlier ones than the last are without gradient.
    fn rounds(
        &self,
        cx: &mut Context<'_>,
        observed: &Observed,
        carry: &Carry,
        (at, pos): (usize, Option<&Value>),
    ) -> Result<Carry> {
        let round = |cx: &mut Context<'_>, carry: &Carry| match (&self.design, pos) {
            (Design::Actions(design), _) => design.round(cx, &self.config, observed, (carry, at), &mut |_| Ok(())),
            (Design::Memory(design), Some(pos)) => design.round(cx, &self.config, observed, carry, pos),
            (Design::Memory(design), None) => {
                let pos = self.tokens.apply_positions(cx)?;
                design.round(cx, &self.config, observed, carry, &pos)
            }
            (Design::Tokens(design), _) => design.round(cx, &self.config, observed, (carry, at)),
        };
        let mut carry = carry.clone();
        for _ in 1..self.config.reasoning.h_cycles {
            carry = cx.no_grad(|cx| round(cx, &carry))?.detach();
        }
        round(cx, &carry)
    }

    /// What a carry says; pos: (1, M, D) over the memory.
    fn answer(&self, cx: &mut Context<'_>, observed: &Observed, carry: Carry, pos: Option<&Value>) -> Result<Step> {
        let states = (carry.answer.clone(), carry.reasoning.clone());
        let (Some(answer), reasoning) = states else { unreachable!("a round leaves an answer") };
        let (carry, read, decoded, scores) = match (&self.design, reasoning, pos) {
            (Design::Actions(_), Some(reasoning), _) => (carry, reasoning, answer, None),
            (Design::Memory(design), _, Some(pos)) => {
                let decoded = design.decoder.apply(cx, &answer, pos)?;
                (carry, answer, decoded, None)
            }
            (Design::Tokens(design), ..) => {
                let (on, read, decoded, scores) = design.answer(cx, observed, &answer)?;
                (Carry { answer: Some(on), reasoning: None }, read, decoded, scores)
            }
            _ => unreachable!("a round over actions leaves a reasoning, a step over the memory has positions"),
        };
        // the head judges the reasoning and must not bend it
        let mean = detached_mean(cx, &read)?;
        Ok(Step { carry, chunk: linear(cx, &decoded, &self.action_head)?, mean, decoded, scores })
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

    /// What is asked of a batch beside the actions: its name in the loss, and its weight.
    #[allow(clippy::type_complexity)] // name, question, weight
    fn question(&self, batch: &Batch) -> Result<Option<(&'static str, Arc<dyn Question>, f64)>> {
        let Design::Tokens(design) = &self.design else { return Ok(None) };
        Ok(match (&design.pointer, &design.layers) {
            (Some(pointer), _) => Some(("pointer", pointer.asked("actrm", batch)?, pointer.weight)),
            (None, TokenLayers::Grid(cells, _)) => {
                cells.asked("actrm", batch)?.map(|visited| ("way", visited, cells.weight))
            }
            _ => None,
        })
    }

    fn check_inputs(&self, observation: &Features<Tensor>) -> Result<usize> {
        check_observation("actrm", &self.signature, observation)
    }

    /// What the first step begins with: with warm starts in use, the answer that half of the rows begin with, the model's own to the
    /// same observation under noise; with `start_noise` noise.
    fn start(&self, cx: &mut Context<'_>, batch: &Batch, observed: &mut Observed) -> Result<Carry> {
        let (rows, r) = (batch.rows(), &self.config.reasoning);
        if let Some(warm) = r.warm_start {
            return Ok(Carry { answer: Some(self.warm_answers(cx, batch, warm)?), reasoning: None });
        }
        if r.start_noise == 0.0 {
            return Ok(Carry::default());
        }
        let mut noise = |shape: &[usize]| -> Result<Value> {
            let drawn = cx.rng()?.normals(shape.iter().product());
            let drawn = drawn.into_iter().map(|noise| noise * r.start_noise as f32).collect();
            Value::of(drawn, shape, batch.device())
        };
        if r.over == Over::Tokens {
            let shape = observed.memory.dims().to_vec();
            let drawn = noise(&shape)?;
            // a second state's, which nothing reads
            noise(&shape)?;
            observed.begun = add(cx, &observed.memory, &drawn)?;
            return Ok(Carry::default());
        }
        let dim = self.config.dim_model;
        let answer = noise(&[rows, self.config.action_horizon, dim])?;
        Ok(Carry { answer: Some(answer), reasoning: Some(noise(&[rows, r.tokens, dim])?) })
    }

    fn warm_answers(&self, cx: &mut Context<'_>, batch: &Batch, warm: WarmStart) -> Result<Value> {
        let mut observation = Features::new();
        for token in &self.tokens.layout().tokens {
            let x = batch.observation.require("warm start", &token.feature)?;
            let noise = Tensor::from_vec(cx.rng()?.normals(x.elem_count()), x.shape(), x.device())?;
            observation.insert(&token.feature, (x + (noise * warm.noise)?)?);
        }
        for camera in self.tokens.layout().cameras.iter().flat_map(|cameras| &cameras.features) {
            observation.insert(camera, batch.observation.require("warm start", camera)?.clone());
        }
        let answer = cx.no_grad(|cx| {
            let latent = Value::zeros((batch.rows(), self.config.latent_dim), batch.device())?;
            let memory = self.memory(cx, &latent, &observation)?;
            let (observed, mut carry) = (self.observe(cx, memory)?, Carry::default());
            for at in 0..self.config.reasoning.supervision_steps {
                carry = self.rounds(cx, &observed, &carry, (at, None))?.detach();
            }
            Ok(carry.answer.expect("a round leaves an answer").detached())
        })?;
        let mut values = answer.flatten_all()?.to_vec1::<f32>()?;
        let per_row = values.len() / batch.rows();
        for row in values.chunks_exact_mut(per_row) {
            if cx.rng()?.uniform() >= 0.5 {
                row.fill(0.0);
            }
        }
        Value::of(values, answer.dims(), batch.device())
    }

    /// The halting head's loss: it is asked of each step, errors: (b), whether the next would lower them no more.
    fn halting(&self, cx: &mut Context<'_>, batch: &Batch, steps: &[Step], errors: &[RowErrors]) -> Result<Term> {
        let rows = batch.rows();
        // backwards, so that gradients are added in the order of the steps
        let logits = steps.iter().rev().map(|step| linear(cx, &step.mean, &self.halt_head)?.reshape((1, rows, 1)));
        let mut logits = logits.collect::<Result<Vec<_>>>()?;
        logits.reverse();
        let logits = cat_tokens(cx, 1, &logits.iter().collect::<Vec<_>>())?;
        let still = 1.0 - self.config.reasoning.halt_margin;
        let (mut targets, mut on_device) = (Vec::new(), Vec::new());
        for pair in errors.windows(2) {
            match (&pair[0], &pair[1]) {
                (RowErrors::Here(here), RowErrors::Here(next)) => {
                    targets
                        .extend(here.iter().zip(next).map(|(here, next)| f64::from(u8::from(*next >= here * still))));
                }
                (RowErrors::There(here), RowErrors::There(next)) => {
                    on_device.push(next.ge(&(here * still)?)?.to_dtype(DType::F32)?);
                }
                _ => unreachable!("the steps of a batch are computed in one place"),
            }
        }
        let total = (batch.total_rows.max(1) * steps.len()) as f64;
        let share = 1.0 / total;
        let on_slices = move |logits: &[f32], grad: Option<(&mut [f32], f64)>| {
            let each = || logits.iter().zip(&targets).map(|(logit, target)| (f64::from(*logit), *target));
            if let Some((grad, weight)) = grad {
                for (grad, (x, target)) in grad.iter_mut().zip(each()) {
                    *grad = ((1.0 / (1.0 + (-x).exp()) - target) * share * weight) as f32;
                }
            }
            each().fold(0.0, |sum, (x, target)| sum + (x.max(0.0) - x * target + (-x.abs()).exp().ln_1p()) * share)
        };
        term_of(cx, &logits, on_slices, |logits| {
            let targets = Tensor::cat(&on_device, 0)?.reshape(logits.shape())?;
            Ok((binary_cross_entropy(logits, &targets)?.sum_all()? / total)?)
        })
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

impl PolicyModel for Actrm {
    fn params(&self) -> &Params {
        &self.params
    }

    fn signature(&self) -> &Signature {
        &self.signature
    }

    fn cache(&self) -> Option<&Cache> {
        Some(&self.cache)
    }

    fn forward_loss(&self, cx: &mut Context<'_>, batch: &Batch) -> Result<Loss> {
        check_batch("actrm", &self.signature, self.config.action_horizon, batch)?;
        let observation = self.tokens.prepare(&batch.observation, Some(cx.rng()?))?;
        let batch = &Batch { observation, ..batch.clone() };
        let (rows, config) = (batch.rows(), &self.config);
        let latent = self.vae.as_ref().map(|vae| vae.apply(cx, batch, &self.vae_pos_enc)).transpose()?;
        let sample = match &latent {
            Some(latent) => {
                let noise = cx.normals(&[rows, config.latent_dim])?;
                sample_latent(cx, latent, &noise)?
            }
            None => Value::zeros((rows, config.latent_dim), batch.device())?,
        };
        let memory = self.memory(cx, &sample, &batch.observation)?;
        let auxiliary = match &self.auxiliary {
            Some(auxiliary) => Some((auxiliary.term(cx, &memory, ("actrm", batch))?, auxiliary.weight)),
            None => None,
        };
        let mut observed = self.observe(cx, memory)?;
        let mut carry = self.start(cx, batch, &mut observed)?;
        let mut steps: Vec<Step> = Vec::new();
        for at in 0..self.steps_of(batch) {
            let step = self.step(cx, &observed, &carry, at)?;
            carry = step.carry.clone();
            steps.push(step);
        }
        // one step more, so that the last depth has a halting target as well
        let beyond = cx.no_grad(|cx| self.step(cx, &observed, &carry, steps.len()))?.chunk.detach();

        let entries = batch.total_valid_steps * self.signature.action_dim;
        let error = |cx: &mut Context<'_>, chunk: &Value| {
            chunk_error(cx, (chunk, &batch.actions), &batch.is_pad, Error::Absolute, entries)
        };
        let (question, mut loss, mut errors) = (self.question(batch)?, Loss::default(), Vec::new());
        for (step, weight) in steps.iter().zip(self.step_weights(steps.len())) {
            let (l1, of_rows) = error(cx, &step.chunk)?;
            // the last step's is the one comparable with ACT's
            loss.report_first("l1_loss_first", l1.value());
            loss.add("l1_loss", l1, weight);
            errors.push(of_rows);
            if let (Some((name, question, share)), Some(scores)) = (&question, &step.scores) {
                let (term, right) = ask(cx, question, scores)?;
                loss.report_first(&format!("{name}_right_first"), right.clone());
                loss.report(&format!("{name}_right"), right);
                loss.add(&format!("{name}_loss"), term, weight * share);
            }
        }
        errors.push(error(cx, &beyond)?.1);
        loss.add("halt_loss", self.halting(cx, batch, &steps, &errors)?, config.reasoning.halt_weight);
        if let Some((term, weight)) = auxiliary {
            loss.add("auxiliary_loss", term, weight);
        }
        if let Some(latent) = &latent {
            loss.add("kld_loss", kl_divergence(cx, latent, batch.total_rows)?, config.kl_weight);
        }
        Ok(loss)
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
        if layout.cameras.is_some() {
            return None;
        }
        let (dim, memory, horizon) = (config.dim_model, layout.len(), config.action_horizon);
        if r.over == Over::Memory {
            let updates = (r.h_cycles * (r.l_cycles + 1) * r.n_layers) as f64;
            let decoder = flops::decoder_layer(config.shape(), horizon, memory) * config.n_decoder_layers as f64;
            let block = Shape { hidden: config.block_feedforward(), ..config.shape() };
            let step = flops::encoder_layer(block, memory) * updates + decoder;
            let head = flops::linear(horizon, dim, self.signature.action_dim);
            return Some(flops::tokens(layout, config.latent_dim, dim) + (step + head) * r.max_steps() as f64);
        }
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
