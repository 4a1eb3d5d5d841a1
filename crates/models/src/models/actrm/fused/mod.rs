//! ACTRM's training step and thought on `fused` layers: the maths of `actrm/mod.rs`, written out forwards and backwards.
//!
//! Random numbers are drawn in the order in which the composed model draws them, so both see the same noise.

mod over_actions;
mod over_memory;
mod over_tokens;
#[cfg(test)]
mod tests;

use super::{Actrm, Over, Question, WarmStart};
use crate::batch::Batch;
use crate::features::Features;
use crate::fused::{AbsoluteError, Data, Grads, Inputs, Pass, Tokens, Vae, inputs, with_weights};
use crate::layers::{Shape, Told};
use crate::model::PolicyModel;
use candle_core::{Device, Tensor};
use nn::Gradients;
use nn::LossValues;
use nn::Result;
use nn::Rng;
use nn::values::with_values;
use over_actions::OverActions;
use over_memory::OverMemory;
use over_tokens::OverTokens;

/// The recursion's states, or their gradients; `None` is the state that a thought begins with, the same in every row.
#[derive(Debug, Default)]
struct Carry {
    answer: Option<Vec<f32>>,
    reasoning: Option<Vec<f32>>,
}

impl Carry {
    fn free(self, pass: &mut Pass<'_>) {
        self.answer.into_iter().chain(self.reasoning).for_each(|buffer| pass.give(buffer));
    }
}

/// What a supervision step gives.
struct Step<T> {
    carry: Carry,
    /// (b, H, A)
    chunk: Vec<f32>,
    /// what the halting head reads, (b, D)
    read: Vec<f32>,
    /// what its backward pass needs
    trace: T,
}

impl<T> Step<T> {
    /// (b,)
    fn halt_logits(&self, pass: &mut Pass<'_>) -> Vec<f32> {
        pass.linear("halt_head", &self.read)
    }
}

/// The gradient of what a supervision step answers.
struct AnswerGrad {
    /// (b, H, A)
    chunk: Vec<f32>,
    /// of the scores of what is asked beside the actions, (b, candidates or cells)
    scores: Option<Vec<f32>>,
}

/// What a shard is asked beside the actions, with its weight.
struct Beside<'a> {
    /// after every step
    asked: Option<&'a (Question, f64)>,
    /// once, of what was observed
    told: Option<(&'a Told, f64)>,
}

/// One of the designs, about one shard of observations.
trait Recursion<'m>: Sized {
    type Trace;

    /// Reads the observations.
    fn observe(model: &'m Actrm, pass: &mut Pass<'_>, tokens: &Tokens<'_>, rows: usize) -> Self;

    /// Supervision step number `at`, from 0.
    fn step(&self, pass: &mut Pass<'_>, carry: &Carry, at: usize) -> Step<Self::Trace>;

    /// What a step says to what is asked beside the actions, (b, candidates or cells).
    fn scores(_: &Step<Self::Trace>) -> Option<&[f32]> {
        None
    }

    /// Asks what was observed for what a shard tells, and keeps the gradient for the end; the loss, if this design is asked.
    fn ask(&mut self, _: &mut Pass<'_>, _: (&Told, f64), _: &mut Grads<'_>) -> Option<f64> {
        None
    }

    /// Takes the gradient of the step's answer and of the carry that it left, if that flows; returns that of
    /// the carry it began with, if it does.
    fn backward(
        &mut self,
        pass: &mut Pass<'_>,
        step: Step<Self::Trace>,
        answer_grad: &AnswerGrad,
        carry_grad: Carry,
        grads: &mut Grads<'_>,
    ) -> Carry;

    /// Gives the buffers of a step back without a backward pass; the carry stays.
    fn forget(pass: &mut Pass<'_>, step: Step<Self::Trace>) -> Carry;

    /// After all steps' backward passes: the gradient of the latent, (b, L).
    fn finish(self, pass: &mut Pass<'_>, tokens: &Tokens<'_>, grads: &mut Grads<'_>) -> Vec<f32>;

    /// Gives the buffers back without a backward pass.
    fn free(self, pass: &mut Pass<'_>);
}

/// Calls `f` with dropout off.
fn quietly<R>(pass: &mut Pass<'_>, f: impl FnOnce(&mut Pass<'_>) -> R) -> R {
    let rng = pass.rng.take();
    let result = f(pass);
    pass.rng = rng;
    result
}

/// Calls `f` with the layers' shape changed.
fn shaped<R>(pass: &mut Pass<'_>, shape: Shape, f: impl FnOnce(&mut Pass<'_>) -> R) -> R {
    let outer = std::mem::replace(&mut pass.shape, shape);
    let result = f(pass);
    pass.shape = outer;
    result
}

/// x: (b, t, D) -> the mean over t, (b, D)
fn mean_over_tokens(pass: &mut Pass<'_>, x: &[f32], rows: usize) -> Vec<f32> {
    let dim = pass.shape.dim;
    let tokens = x.len() / (rows * dim);
    let mut mean = pass.space.pool.zeros(rows * dim);
    for (mean, x) in mean.chunks_exact_mut(dim).zip(x.chunks_exact(tokens * dim)) {
        for token in x.chunks_exact(dim) {
            mean.iter_mut().zip(token).for_each(|(m, x)| *m += x);
        }
        mean.iter_mut().for_each(|m| *m /= tokens as f32);
    }
    mean
}

impl Actrm {
    /// Loss of a training forward pass, and its gradients added to `into`.
    pub(super) fn fused_gradients(&self, batch: &Batch, rng: &mut Rng, into: &mut Gradients) -> Result<LossValues> {
        let batch = &self.looked_at(batch, rng)?;
        let data = Data::of(batch, self.tokens.layout())?;
        let steps = self.steps_of(batch);
        let asked = self.question(batch)?;
        let told = self.auxiliary.as_ref().map(|asked| asked.told("actrm", batch).map(|told| (told, asked.weight)));
        let (asked, told) = (asked.as_ref(), told.transpose()?);
        let asked = Beside { asked, told: told.as_ref().map(|(told, weight)| (told, *weight)) };
        self.workspaces.with(|space| {
            with_weights(self.params(), |weights| {
                let pass = &mut Pass {
                    weights,
                    shape: self.config.shape(),
                    space,
                    rng: Some(rng),
                    packed: None,
                    on_seen: None,
                };
                let grads = &mut into.views();
                match self.config.reasoning.over {
                    Over::Actions => self.supervise::<OverActions<'_>>(pass, &data, asked, steps, grads),
                    Over::Memory => self.supervise::<OverMemory<'_>>(pass, &data, asked, steps, grads),
                    Over::Tokens => self.supervise::<OverTokens<'_>>(pass, &data, asked, steps, grads),
                }
            })
        })
    }

    /// One shard, forwards and backwards; what is asked beside the actions.
    fn supervise<'m, R: Recursion<'m>>(
        &'m self,
        pass: &mut Pass<'_>,
        data: &Data,
        Beside { asked, told }: Beside<'_>,
        steps: usize,
        grads: &mut Grads<'_>,
    ) -> LossValues {
        let (config, rows) = (&self.config, data.rows);
        let vae = Vae {
            n_layers: config.n_vae_encoder_layers,
            latent_dim: config.latent_dim,
            positions: &self.vae_positions,
        };
        let (latent, encoded) = match config.use_vae {
            true => {
                let draw = |pass: &mut Pass<'_>| {
                    let rng = pass.rng.as_mut().expect("a training step has a generator");
                    rng.normals(rows * config.latent_dim)
                };
                let (latent, encoded) = vae.forward(pass, data, draw);
                (latent, Some(encoded))
            }
            false => (pass.space.pool.zeros(rows * config.latent_dim), None),
        };
        let tokens = Tokens::new(self.tokens.layout(), (&latent, config.latent_dim), &data.inputs);
        let mut recursion = R::observe(self, pass, &tokens, rows);
        let answer = config.reasoning.warm_start.map(|warm| self.warm_answers_fused::<R>(pass, data, warm));
        // over tokens the noise is the recursion's own: it is added to what is observed
        let start = match config.reasoning.start_noise > 0.0 && config.reasoning.over == Over::Actions {
            true => self.noisy_start(pass, rows),
            false => Carry { answer, reasoning: None },
        };
        let mut done: Vec<Step<R::Trace>> = Vec::with_capacity(steps);
        for at in 0..steps {
            let carry = done.last().map_or(&start, |step| &step.carry);
            done.push(recursion.step(pass, carry, at));
        }
        // one step more, so that the last depth has a halting target as well
        let carry = done.last().map_or(&start, |step| &step.carry);
        let beyond = quietly(pass, |pass| recursion.step(pass, carry, steps));

        let entries = data.total_entries as f64;
        let mut loss = LossValues::default();
        let (mut errors, mut answer_grads) = (Vec::with_capacity(steps + 1), Vec::with_capacity(steps));
        for (step, weight) in done.iter().zip(self.step_weights(steps)) {
            let mut grad = pass.take(step.chunk.len());
            let into = Some((&mut grad[..], (weight / entries) as f32));
            let error = AbsoluteError::of(&step.chunk, &data.actions, &data.is_pad, rows, into);
            let l1 = (error.total() / entries) as f32;
            loss.total += l1 * weight as f32;
            // the last step's is the one comparable with ACT's
            loss.parts.insert("l1_loss".to_string(), l1);
            loss.parts.entry("l1_loss_first".to_string()).or_insert(l1);
            errors.push(error);
            let scores = asked.zip(R::scores(step)).map(|((question, share), scores)| {
                let (mut grad, share) = (pass.take(scores.len()), weight * share);
                let answers = question.answers(scores, Some((&mut grad, share)));
                let name = question.name();
                loss.total += (answers.loss * share) as f32;
                loss.parts.insert(format!("{name}_loss"), answers.loss as f32);
                loss.parts.entry(format!("{name}_right_first")).or_insert(answers.right);
                loss.parts.insert(format!("{name}_right"), answers.right);
                grad
            });
            answer_grads.push(AnswerGrad { chunk: grad, scores });
        }
        errors.push(AbsoluteError::of(&beyond.chunk, &data.actions, &data.is_pad, rows, None));
        R::forget(pass, beyond).free(pass);

        let (mut halt, still) = (0.0f64, 1.0 - config.reasoning.halt_margin);
        let share = 1.0 / (data.total_rows * steps) as f64;
        for (i, step) in done.iter().enumerate() {
            let mut logits = step.halt_logits(pass);
            for (row, logit) in logits.iter_mut().enumerate() {
                let halted = errors[i + 1].rows[row] >= errors[i].rows[row] * still;
                let (x, target) = (f64::from(*logit), if halted { 1.0 } else { 0.0 });
                halt += (x.max(0.0) - x * target + (-x.abs()).exp().ln_1p()) * share;
                *logit = ((1.0 / (1.0 + (-x).exp()) - target) * share * config.reasoning.halt_weight) as f32;
            }
            let dim = pass.shape.dim;
            pass.linear_backward("halt_head", &step.read, &logits, dim, grads);
            pass.give(logits);
        }
        loss.parts.insert("halt_loss".to_string(), halt as f32);
        loss.total += (halt * config.reasoning.halt_weight) as f32;

        if let Some((told, weight)) = told
            && let Some(error) = recursion.ask(pass, (told, weight), grads)
        {
            loss.parts.insert("auxiliary_loss".to_string(), error as f32);
            loss.total += (error * weight) as f32;
        }
        let mut carry_grad = Carry::default();
        for (step, grad) in done.into_iter().zip(answer_grads).rev() {
            carry_grad = recursion.backward(pass, step, &grad, carry_grad, grads);
            [grad.chunk].into_iter().chain(grad.scores).for_each(|buffer| pass.give(buffer));
        }
        carry_grad.free(pass);
        start.free(pass);
        let latent_grad = recursion.finish(pass, &tokens, grads);
        if let Some(encoded) = encoded {
            let kld = vae.backward(pass, data, encoded, &latent_grad, config.kl_weight, grads);
            loss.parts.insert("kld_loss".to_string(), kld);
            loss.total += config.kl_weight as f32 * kld;
        }
        pass.give(latent);
        pass.give(latent_grad);
        loss
    }

    /// Both states of a thought, drawn as the composed model draws them (`over = "actions"`).
    fn noisy_start(&self, pass: &mut Pass<'_>, rows: usize) -> Carry {
        let mut draw = |tokens: usize| {
            let mut state = pass.take(rows * tokens * self.config.dim_model);
            let rng = pass.rng.as_mut().expect("a training step has a generator");
            let noise = rng.normals(state.len());
            let scale = self.config.reasoning.start_noise as f32;
            state.iter_mut().zip(noise).for_each(|(x, noise)| *x = noise * scale);
            state
        };
        let answer = Some(draw(self.config.action_horizon));
        Carry { answer, reasoning: Some(draw(self.config.reasoning.tokens)) }
    }

    /// `warm_answers` of the composed model.
    fn warm_answers_fused<'m, R: Recursion<'m>>(
        &'m self,
        pass: &mut Pass<'_>,
        data: &Data,
        warm: WarmStart,
    ) -> Vec<f32> {
        let mut noisy = |x: &[f32]| -> Vec<f32> {
            let rng = pass.rng.as_mut().expect("a training step has a generator");
            x.iter().zip(rng.normals(x.len())).map(|(x, noise)| x + noise * warm.noise as f32).collect()
        };
        let vectors = data.inputs.vectors.iter().map(|values| noisy(values)).collect();
        let inputs = Inputs { vectors, pictures: data.inputs.pictures.clone() };
        let latent = vec![0.0; data.rows * self.config.latent_dim];
        let tokens = Tokens::new(self.tokens.layout(), (&latent, self.config.latent_dim), &inputs);
        let mut answer = quietly(pass, |pass| {
            let recursion = R::observe(self, pass, &tokens, data.rows);
            let mut carry = Carry::default();
            for at in 0..self.config.reasoning.supervision_steps {
                let step = recursion.step(pass, &carry, at);
                let next = R::forget(pass, step);
                std::mem::replace(&mut carry, next).free(pass);
            }
            recursion.free(pass);
            carry.reasoning.into_iter().for_each(|buffer| pass.give(buffer));
            carry.answer.expect("a step leaves an answer")
        });
        let rng = pass.rng.as_mut().expect("a training step has a generator");
        let per_row = answer.len() / data.rows;
        for row in answer.chunks_exact_mut(per_row) {
            if rng.uniform() >= 0.5 {
                row.fill(0.0);
            }
        }
        answer
    }

    /// Thinks about observations from the answer state `start`, (b, t, D), until `on_step`, which gets each step's
    /// chunk, (b, H, A), and halting logits, returns true; returns the last answer state. `on_seen` is called when pictures
    /// have become tokens.
    pub(super) fn think(
        &self,
        observation: &Features<Tensor>,
        rows: usize,
        start: Option<&Tensor>,
        on_seen: &mut dyn FnMut(),
        on_step: &mut dyn FnMut(Tensor, Vec<f32>) -> Result<bool>,
    ) -> Result<Tensor> {
        let inputs = inputs(self.tokens.layout(), &self.tokens.look(observation, None)?)?;
        let start = start.map(|start| with_values(start, <[f32]>::to_vec)).transpose()?;
        let packed = self.workspaces.packed(self.params());
        self.workspaces.with(|space| {
            with_weights(self.params(), |weights| {
                let (shape, packed) = (self.config.shape(), Some(&*packed));
                let pass = &mut Pass { weights, shape, space, rng: None, packed, on_seen: Some(&mut *on_seen) };
                match self.config.reasoning.over {
                    Over::Actions => self.think_with::<OverActions<'_>>(pass, (&inputs, rows), start, on_step),
                    Over::Memory => self.think_with::<OverMemory<'_>>(pass, (&inputs, rows), start, on_step),
                    Over::Tokens => self.think_with::<OverTokens<'_>>(pass, (&inputs, rows), start, on_step),
                }
            })
        })?
    }

    fn think_with<'m, R: Recursion<'m>>(
        &'m self,
        pass: &mut Pass<'_>,
        (inputs, rows): (&Inputs, usize),
        start: Option<Vec<f32>>,
        on_step: &mut dyn FnMut(Tensor, Vec<f32>) -> Result<bool>,
    ) -> Result<Tensor> {
        let latent = pass.space.pool.zeros(rows * self.config.latent_dim);
        let tokens = Tokens::new(self.tokens.layout(), (&latent, self.config.latent_dim), inputs);
        let recursion = R::observe(self, pass, &tokens, rows);
        let mut carry = Carry { answer: start, reasoning: None };
        let shape = (rows, self.config.action_horizon, self.signature.action_dim);
        for at in 0.. {
            let step = recursion.step(pass, &carry, at);
            let logits = step.halt_logits(pass);
            let chunk = Tensor::from_slice(&step.chunk, shape, &Device::Cpu)?;
            let halted = on_step(chunk, logits.clone())?;
            pass.give(logits);
            let next = R::forget(pass, step);
            std::mem::replace(&mut carry, next).free(pass);
            if halted {
                break;
            }
        }
        recursion.free(pass);
        pass.give(latent);
        let answer = carry.answer.as_ref().expect("a step leaves an answer");
        let tokens = answer.len() / (rows * self.config.dim_model);
        let answer = Tensor::from_slice(answer, (rows, tokens, self.config.dim_model), &Device::Cpu)?;
        carry.free(pass);
        Ok(answer)
    }
}
