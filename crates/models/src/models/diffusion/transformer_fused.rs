//! The transformer on slices, forwards and backwards: the maths of `transformer.rs`.

use super::fused::{Asked, Wanted};
use super::transformer::{Around, PREFIX, TransformerConfig};
use super::unet::embedding;
use super::values;
use crate::fused::{
    DecoderGrads, DecoderLayers, Grads, Memory, Norm, Own, Part, Pass, Workspaces, gather, scatter, slot, with_weights,
};
use candle_core::Tensor;
use nn::Gradients;
use nn::Params;
use nn::Result;
use nn::Rng;
use nn::device::HERE;
use nn::kernels::{add, column_sums, mish, mish_backward};

/// What the network is apart from its weights, and the buffers of its passes.
#[derive(Debug)]
pub(super) struct FusedTransformer {
    config: TransformerConfig,
    around: Around,
    workspaces: Workspaces,
}

/// What the backward pass needs.
struct Seen {
    /// steps and observations with their positions, (n, 1 + observations, D)
    told: Vec<f32>,
    /// between the layers of what reads them, before and after the activation
    hidden: [Vec<f32>; 2],
    memory: Vec<f32>,
    layers: DecoderLayers,
    norm: Norm,
    /// what the head read
    read: Vec<f32>,
}

fn name(last: &str) -> String {
    format!("{PREFIX}.{last}")
}

impl FusedTransformer {
    pub(super) fn new(config: &TransformerConfig, around: Around) -> Self {
        Self { config: config.clone(), around, workspaces: Workspaces::default() }
    }

    fn pass<R>(
        &self,
        params: &Params,
        packed: bool,
        rng: Option<&mut Rng>,
        run: impl FnOnce(&mut Pass<'_>) -> R,
    ) -> Result<R> {
        let panels = packed.then(|| self.workspaces.packed(params));
        self.workspaces.with(|space| {
            with_weights(params, |weights| {
                let (shape, packed) = (self.config.shape(), panels.as_deref());
                run(&mut Pass { weights, shape, space, rng, packed, on_seen: None })
            })
        })
    }

    /// The network's answer without a gradient, (n, T, A) -> (n, T, A)
    ///
    /// # Errors
    /// Weights that are not on the CPU.
    pub(super) fn answered(&self, params: &Params, x: &Tensor, steps: &[f32], cond: &[f32]) -> Result<Tensor> {
        let numbers = values(x)?;
        let answer = self.pass(params, true, None, |pass| {
            let (out, seen) = self.forward(pass, Asked { x: &numbers, steps, cond });
            seen.free(pass);
            // the workspace keeps its buffers
            let answer = out.clone();
            pass.give(out);
            answer
        })?;
        Ok(Tensor::from_vec(answer, x.shape(), &HERE)?)
    }

    /// The mean squared error of the answer, whose gradients are added to `into`; dropout is drawn from `rng`.
    ///
    /// # Errors
    /// Weights that are not on the CPU.
    pub(super) fn squared_error(
        &self,
        params: &Params,
        asked: Asked<'_>,
        wanted: &Wanted,
        rng: &mut Rng,
        into: &mut Gradients,
    ) -> Result<f64> {
        self.pass(params, false, Some(rng), |pass| {
            let (mut out, seen) = self.forward(pass, asked);
            let error = wanted.compare(&mut out, self.around.action_dim);
            self.backward(pass, asked, seen, &out, &mut into.views());
            pass.give(out);
            error
        })
    }

    /// Observations and the step before them.
    fn tokens(&self) -> usize {
        1 + self.around.n_obs_steps
    }

    fn forward(&self, pass: &mut Pass<'_>, asked: Asked<'_>) -> (Vec<f32>, Seen) {
        let (rows, dim, tokens) = (asked.steps.len(), self.config.dim_model, self.tokens());
        let observed = pass.linear(&name("cond_obs_emb"), asked.cond);
        let time = embedding(asked.steps, dim);
        let parts = [Part { values: &time, tokens: 1 }, Part { values: &observed, tokens: tokens - 1 }];
        let mut told = gather(pass, rows, dim, &parts);
        pass.give(observed);
        let positions = pass.weight(&name("cond_pos_emb"), "");
        told.chunks_exact_mut(tokens * dim).for_each(|told| add(told, positions));
        let before = pass.linear(&name("encoder.0"), &told);
        let mut after = pass.space.pool.copy(&before);
        mish(&mut after);
        let memory = pass.linear(&name("encoder.2"), &after);

        let mut x = pass.linear(&name("input_emb"), asked.x);
        let positions = pass.weight(&name("pos_emb"), "");
        x.chunks_exact_mut(self.around.horizon * dim).for_each(|x| add(x, positions));
        // positions are in the tokens already
        let (of_own, of_memory) = self.no_positions(pass);
        let own = Own { pos: &of_own, causal: self.config.causal };
        let beside = Memory { x: &memory, pos: &of_memory, batch: rows };
        let (out, layers) =
            DecoderLayers::forward(pass, (&name("decoder.layers"), self.config.n_layers), x, own, beside);
        pass.give(of_own);
        pass.give(of_memory);
        let (read, norm) = Norm::forward(pass, &name("ln_f"), &out);
        pass.give(out);
        let answer = pass.linear(&name("head"), &read);
        (answer, Seen { told, hidden: [before, after], memory, layers, norm, read })
    }

    fn no_positions(&self, pass: &mut Pass<'_>) -> (Vec<f32>, Vec<f32>) {
        let dim = self.config.dim_model;
        (pass.space.pool.zeros(self.around.horizon * dim), pass.space.pool.zeros(self.tokens() * dim))
    }

    /// grad: that of the answer, (n, T, A)
    fn backward(&self, pass: &mut Pass<'_>, asked: Asked<'_>, seen: Seen, grad: &[f32], grads: &mut Grads<'_>) {
        let Seen { told, hidden: [before, after], memory, layers, norm, read } = seen;
        let (dim, tokens) = (self.config.dim_model, self.tokens());
        pass.linear_backward(&name("head"), &read, grad, dim, grads);
        let mut of_x = pass.linear_input(&name("head"), grad, dim);
        norm.backward(pass, &name("ln_f"), &mut of_x, grads);
        let (of_own, of_memory_pos) = self.no_positions(pass);
        let own = Own { pos: &of_own, causal: self.config.causal };
        let beside = Memory { x: &memory, pos: &of_memory_pos, batch: asked.steps.len() };
        let mut of_memory = pass.space.pool.zeros(memory.len());
        let (mut unused, mut unused_too) = self.no_positions(pass);
        let mut into = DecoderGrads { memory: &mut of_memory, memory_pos: &mut unused_too, query_pos: &mut unused };
        let of_x = layers.backward(pass, of_x, own, beside, &mut into, grads);
        column_sums(slot(grads, &name("pos_emb"), ""), &of_x);
        pass.linear_backward(&name("input_emb"), asked.x, &of_x, self.around.action_dim, grads);

        pass.linear_backward(&name("encoder.2"), &after, &of_memory, 4 * dim, grads);
        let mut of_hidden = pass.linear_input(&name("encoder.2"), &of_memory, 4 * dim);
        mish_backward(&mut of_hidden, &before);
        pass.linear_backward(&name("encoder.0"), &told, &of_hidden, dim, grads);
        let of_told = pass.linear_input(&name("encoder.0"), &of_hidden, dim);
        column_sums(slot(grads, &name("cond_pos_emb"), ""), &of_told);
        let rows = asked.steps.len();
        let (mut of_time, mut of_observed) =
            (pass.space.pool.zeros(rows * dim), pass.space.pool.zeros(rows * (tokens - 1) * dim));
        scatter(&of_told, dim, &mut [(&mut of_time, 1), (&mut of_observed, tokens - 1)]);
        pass.linear_backward(&name("cond_obs_emb"), asked.cond, &of_observed, self.around.width, grads);
        let spent = [of_x, of_own, of_memory_pos, of_memory, unused, unused_too, of_hidden, of_told, of_time];
        for buffer in spent.into_iter().chain([of_observed, told, before, after, memory, read]) {
            pass.give(buffer);
        }
    }
}

impl Seen {
    /// Gives the buffers back without a backward pass.
    fn free(self, pass: &mut Pass<'_>) {
        let Self { told, hidden: [before, after], memory, layers, norm, read } = self;
        layers.free(pass);
        norm.free(pass);
        for buffer in [told, before, after, memory, read] {
            pass.give(buffer);
        }
    }
}
