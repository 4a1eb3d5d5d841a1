//! BC-Transformer's training step on slices: the maths of `bc_transformer/mod.rs`, written out forwards and backwards.

use super::BcTransformer;
use crate::batch::Batch;
use crate::fused::{Grads, Norm, Pass, Wanted, Workspace, likelihood, slot, weight_gradient, with_weights};
use crate::layers::{Activation, DropoutMask, Shape};
use crate::model::PolicyModel;
use nn::Gradients;
use nn::LossValues;
use nn::Result;
use nn::Rng;
use nn::kernels::{
    Heads, Mat, Start, activate, activate_backward, add, attend, attend_backward, column_sums, drop_scale, product,
};
use nn::simd::vectorised;
use nn::values::with_values;
use std::collections::BTreeMap;

/// A dropout of a whole tensor, in place.
fn drop_all(x: &mut [f32], mask: Option<DropoutMask>) {
    vectorised(
        #[inline(always)]
        || drop_scale(x, mask, 0),
    );
}

/// The last `computed` rows of every `steps`.
fn last(pass: &mut Pass<'_>, x: &[f32], (steps, computed): (usize, usize)) -> Vec<f32> {
    let dim = pass.shape.dim;
    let mut out = pass.take(x.len() / steps * computed);
    for (out, x) in out.chunks_exact_mut(computed * dim).zip(x.chunks_exact(steps * dim)) {
        out.copy_from_slice(&x[(steps - computed) * dim..]);
    }
    out
}

/// `x += grad` on the last `computed` rows of every `steps`.
fn add_last(x: &mut [f32], grad: &[f32], (steps, computed): (usize, usize), dim: usize) {
    for (x, grad) in x.chunks_exact_mut(steps * dim).zip(grad.chunks_exact(computed * dim)) {
        add(&mut x[(steps - computed) * dim..], grad);
    }
}

/// What a block's backward pass needs.
struct Block {
    prefix: String,
    heads: Heads,
    norms: [Norm; 2],
    /// of attention weights, its output, the dense layers' output
    masks: [Option<DropoutMask>; 3],
    /// after the first norm, (b*T, D)
    y: Vec<f32>,
    /// the rows that queries are made of, (b*computed, D)
    of_queries: Vec<f32>,
    q: Vec<f32>,
    kv: Vec<f32>,
    weights: Vec<f32>,
    mixed: Vec<f32>,
    /// after the second norm
    z: Vec<f32>,
    /// between the dense layers, before and after the activation
    inner: [Vec<f32>; 2],
}

impl Block {
    /// x: (b*T, D) -> (b*computed, D)
    fn forward(pass: &mut Pass<'_>, prefix: String, heads: Heads, x: Vec<f32>) -> (Vec<f32>, Self) {
        let (dim, steps) = (heads.dim, (heads.keys, heads.queries));
        let (y, first) = Norm::forward(pass, &format!("{prefix}.ln1"), &x);
        let of_queries = last(pass, &y, steps);
        let w = pass.weight(&prefix, ".attention.nets.qkv.weight");
        let q = pass.times(&of_queries, &w[..dim * dim], Start::Zero, |_, _, _| ());
        let kv = pass.times(&y, &w[dim * dim..], Start::Zero, |_, _, _| ());
        let of_weights = pass.mask();
        let (mut weights, mut mixed) = (pass.take(heads.weights()), pass.take(q.len()));
        let Workspace { pool, pack } = &mut *pass.space;
        attend(heads, &q, &kv, None, of_weights, &mut weights, &mut mixed, pool, pack);
        let mut branch = pass.linear(&format!("{prefix}.attention.nets.output"), &mixed);
        let of_branch = pass.mask();
        drop_all(&mut branch, of_branch);
        let mut out = last(pass, &x, steps);
        add(&mut out, &branch);
        pass.give(branch);
        pass.give(x);
        let (z, second) = Norm::forward(pass, &format!("{prefix}.ln2"), &out);
        let before = pass.linear(&format!("{prefix}.mlp.0"), &z);
        let mut after = pass.space.pool.copy(&before);
        vectorised(
            #[inline(always)]
            || activate(&mut after, Activation::Gelu, None, 0),
        );
        let mut branch = pass.linear(&format!("{prefix}.mlp.2"), &after);
        let of_outer = pass.mask();
        drop_all(&mut branch, of_outer);
        add(&mut out, &branch);
        pass.give(branch);
        let (norms, masks) = ([first, second], [of_weights, of_branch, of_outer]);
        (out, Self { prefix, heads, norms, masks, y, of_queries, q, kv, weights, mixed, z, inner: [before, after] })
    }

    /// grad: that of the output -> that of x
    fn backward(self, pass: &mut Pass<'_>, mut grad: Vec<f32>, grads: &mut Grads<'_>) -> Vec<f32> {
        let Self { prefix, heads, norms, masks, y, of_queries, q, kv, weights, mixed, z, inner } = self;
        let (dim, steps) = (heads.dim, (heads.keys, heads.queries));
        let ([first, second], [of_weights, of_branch, of_outer], [before, after]) = (norms, masks, inner);
        let name = |last: &str| format!("{prefix}.{last}");

        let mut branch = pass.space.pool.copy(&grad);
        drop_all(&mut branch, of_outer);
        pass.linear_backward(&name("mlp.2"), &after, &branch, 4 * dim, grads);
        let mut of_inner = pass.linear_input(&name("mlp.2"), &branch, 4 * dim);
        vectorised(
            #[inline(always)]
            || activate_backward(&mut of_inner, &before, Activation::Gelu, None, 0),
        );
        pass.linear_backward(&name("mlp.0"), &z, &of_inner, dim, grads);
        let mut of_z = pass.linear_input(&name("mlp.0"), &of_inner, dim);
        second.backward(pass, &name("ln2"), &mut of_z, grads);
        add(&mut grad, &of_z);
        pass.give(of_z);
        pass.give(of_inner);

        branch.copy_from_slice(&grad);
        drop_all(&mut branch, of_branch);
        let output = name("attention.nets.output");
        pass.linear_backward(&output, &mixed, &branch, dim, grads);
        let of_mixed = pass.linear_input(&output, &branch, dim);
        let (mut dq, mut dkv) = (pass.space.pool.zeros(q.len()), pass.space.pool.zeros(kv.len()));
        let Workspace { pool, pack } = &mut *pass.space;
        attend_backward(heads, &q, &kv, of_weights, &weights, &of_mixed, &mut dq, &mut dkv, pool, pack);
        let w = pass.weight(&prefix, ".attention.nets.qkv.weight");
        let (of_q, of_kv) = slot(grads, &prefix, ".attention.nets.qkv.weight").split_at_mut(dim * dim);
        weight_gradient((dim, dim), &dq, dim, &of_queries, of_q, &mut pass.space.pack);
        weight_gradient((2 * dim, dim), &dkv, 2 * dim, &y, of_kv, &mut pass.space.pack);
        let mut of_y = pass.take(y.len());
        let (a, b) = (Mat::rows(&dkv, 2 * dim), Mat::rows(&w[dim * dim..], dim));
        product((y.len() / dim, dim, 2 * dim), a, b, Start::Zero, &mut of_y, &mut pass.space.pack);
        let mut through = pass.take(q.len());
        let (a, b) = (Mat::rows(&dq, dim), Mat::rows(&w[..dim * dim], dim));
        product((q.len() / dim, dim, dim), a, b, Start::Zero, &mut through, &mut pass.space.pack);
        add_last(&mut of_y, &through, steps, dim);
        first.backward(pass, &name("ln1"), &mut of_y, grads);
        add_last(&mut of_y, &grad, steps, dim);
        for buffer in [grad, branch, of_mixed, dq, dkv, through, y, of_queries, q, kv, weights, mixed, z, before, after]
        {
            pass.give(buffer);
        }
        of_y
    }
}

impl BcTransformer {
    /// Loss of a batch whose pictures were looked at, and its gradients added to `into`.
    pub(super) fn fused_gradients(&self, batch: &Batch, rng: &mut Rng, into: &mut Gradients) -> Result<LossValues> {
        let (config, rows) = (&self.config, batch.rows());
        let (dim, steps) = (config.dim_model, self.signature.n_obs_steps);
        let numbers = with_values(&self.steps.numbers(rows, &batch.observation)?, <[f32]>::to_vec)?;
        let pictures = self.steps.pictures(&batch.observation)?;
        let actions = with_values(&batch.actions, <[f32]>::to_vec)?;
        let shape = Shape {
            dim,
            heads: config.n_heads,
            hidden: 4 * dim,
            activation: Activation::Gelu,
            dropout: config.dropout,
            pre_norm: true,
        };
        self.workspaces.with(|space| {
            with_weights(self.params(), |weights| {
                let pass = &mut Pass { weights, shape, space, rng: Some(rng), packed: None, on_seen: None };
                let grads = &mut into.views();
                let (seen, looked) = self.steps.see(pass, rows, &numbers, pictures.as_deref());
                let mut embedded = pass.linear("embed_encoder", &seen);
                let positions = pass.weight("embed_timestep", "");
                embedded.chunks_exact_mut(steps * dim).for_each(|x| add(x, positions));
                let (mut x, embed_ln) = Norm::forward(pass, "embed_ln", &embedded);
                pass.give(embedded);
                let of_tokens = pass.mask();
                drop_all(&mut x, of_tokens);
                let mut blocks = Vec::with_capacity(config.n_layers);
                for i in 0..config.n_layers {
                    let all = i + 1 < config.n_layers;
                    let queries = if all { steps } else { 1 };
                    let heads = Heads {
                        batch: rows,
                        heads: config.n_heads,
                        queries,
                        all_queries: queries,
                        keys: steps,
                        dim,
                        shared_queries: false,
                        shared_keys: false,
                        causal: all,
                    };
                    let (out, block) = Block::forward(pass, format!("transformer.{i}"), heads, x);
                    blocks.push(block);
                    x = out;
                }
                let (read, output_ln) = Norm::forward(pass, "output_ln", &x);
                pass.give(x);
                let real = vec![1.0; rows];
                let wanted = Wanted { actions: &actions, real: &real, total: batch.total_rows };
                let modes = (config.n_modes, config.min_std);
                let (loss, mut grad) = likelihood(pass, "decoder", modes, &read, &wanted, grads);
                pass.give(read);
                output_ln.backward(pass, "output_ln", &mut grad, grads);
                while let Some(block) = blocks.pop() {
                    grad = block.backward(pass, grad, grads);
                }
                drop_all(&mut grad, of_tokens);
                embed_ln.backward(pass, "embed_ln", &mut grad, grads);
                column_sums(slot(grads, "embed_timestep", ""), &grad);
                let width = self.steps.width();
                pass.linear_backward("embed_encoder", &seen, &grad, width, grads);
                if self.steps.learns() {
                    let of_seen = pass.linear_input("embed_encoder", &grad, width);
                    self.steps.learn(pass, looked, &of_seen, grads);
                    pass.give(of_seen);
                }
                pass.give(seen);
                pass.give(grad);
                let parts = [("nll", loss.nll), ("l1_loss", loss.l1)];
                let parts = parts.map(|(name, value)| (name.to_string(), value as f32));
                LossValues { total: loss.nll as f32, parts: BTreeMap::from(parts) }
            })
        })
    }
}
