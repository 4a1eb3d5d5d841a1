//! Transformer layers with hand-written backward passes, on slices.
//!
//! The same layers as `layers` builds from candle operations, for training steps and predictions that must be
//! fast. A layer's forward pass consumes its input and returns what its backward pass needs; gradients are added into
//! buffers found by the parameter's name. Position embeddings are added to queries and keys only, so their projections
//! are computed once for the batch: `(x + pos) Wᵀ = x Wᵀ + pos Wᵀ`.

mod attention;
mod block;
mod convolution;
mod decoder;
mod feed_forward;
mod keypoints;
#[cfg(test)]
pub(crate) mod testing;
mod vision;

pub(crate) use block::{Part, gather, scatter};
pub(crate) use convolution::{convolve, framed, input_gradient, weight_gradient as convolution_gradient};
pub(crate) use decoder::{DecoderGrads, DecoderLayers, Memory, Own};
pub(crate) use vision::{Eyes, Looked};

use nn::{ModelError, Result};

use crate::layers::{DropoutMask, Shape};
use candle_core::Storage;
use nn::Params;
use nn::Rng;
use nn::kernels::{
    Mat, Pack, Packed, Pool, Start, add, column_sums, drop_scale, gemm_with, layer_norm, layer_norm_backward, product,
};
use nn::simd::vectorised;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

/// Parameters by name.
pub(crate) type Weights<'a> = BTreeMap<&'a str, &'a [f32]>;
/// Gradients by name.
pub(crate) type Grads<'a> = BTreeMap<&'a str, &'a mut [f32]>;

/// Buffers of one shard, reused from step to step.
#[derive(Debug, Default)]
pub(crate) struct Workspace {
    pub(crate) pool: Pool,
    pub(crate) pack: Pack,
}

/// Workspaces of shards that ran before, and packed weights.
#[derive(Debug, Default)]
pub(crate) struct Workspaces {
    free: Mutex<Vec<Workspace>>,
    packed: Mutex<Arc<PackedWeights>>,
}

impl Workspaces {
    /// Calls `f` with a workspace that no other thread has.
    pub(crate) fn with<R>(&self, f: impl FnOnce(&mut Workspace) -> R) -> R {
        let taken = self.free.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let mut space = taken.unwrap_or_default();
        let result = f(&mut space);
        self.free.lock().unwrap_or_else(PoisonError::into_inner).push(space);
        result
    }

    /// Packed weights of `params` as they are now.
    pub(crate) fn packed(&self, params: &Params) -> Arc<PackedWeights> {
        let mut packed = self.packed.lock().unwrap_or_else(PoisonError::into_inner);
        if packed.version != params.version() {
            *packed = Arc::new(PackedWeights { version: params.version(), ..PackedWeights::default() });
        }
        packed.clone()
    }
}

/// Weights in the panels that products read, each made when it is first used, and what else depends on the weights
/// alone: for predictions, which use the same weights again and again.
#[derive(Debug, Default)]
pub(crate) struct PackedWeights {
    version: u64,
    /// by the place in memory, which a parameter keeps, and the number of rows
    panels: Mutex<BTreeMap<(usize, usize), Arc<Packed>>>,
    /// what layers make of inputs that are parameters themselves
    fixed: Mutex<BTreeMap<String, Arc<Vec<f32>>>>,
}

impl PackedWeights {
    /// w: (out, in), whole rows of a parameter; its transpose in panels
    fn get(&self, w: &[f32], (out, input): (usize, usize)) -> Arc<Packed> {
        let mut panels = self.panels.lock().unwrap_or_else(PoisonError::into_inner);
        let make = || Arc::new(Packed::new(Mat::rows(w, input).t(), (out, input)));
        panels.entry((w.as_ptr().addr(), out)).or_insert_with(make).clone()
    }

    /// What was kept under this name.
    fn kept(&self, name: &str) -> Option<Arc<Vec<f32>>> {
        self.fixed.lock().unwrap_or_else(PoisonError::into_inner).get(name).cloned()
    }

    /// What `make` makes of the weights alone, made once; not copied.
    fn made_once(&self, name: &str, make: impl FnOnce() -> Vec<f32>) -> Arc<Vec<f32>> {
        if let Some(kept) = self.kept(name) {
            return kept;
        }
        let values = Arc::new(make());
        self.fixed.lock().unwrap_or_else(PoisonError::into_inner).insert(name.to_string(), values.clone());
        values
    }
}

/// Rows up to which a product reads the weights as they are.
const UNPACKED_ROWS: usize = 4;

/// Calls `f` with all parameters and buffers as slices.
pub(crate) fn with_weights<R>(params: &Params, f: impl FnOnce(&Weights<'_>) -> R) -> Result<R> {
    let guards: Vec<_> = params.all().map(|(name, var)| (name, var.as_tensor().storage_and_layout())).collect();
    let mut weights = BTreeMap::new();
    for (name, (storage, layout)) in &guards {
        let Storage::Cpu(storage) = &**storage else {
            let (found, expected) = ("on another device".to_string(), "on the CPU".to_string());
            return Err(ModelError::Input { operation: "read", object: "parameter", found, expected });
        };
        let from = layout.start_offset();
        weights.insert(*name, &storage.as_slice::<f32>()?[from..from + layout.shape().elem_count()]);
    }
    Ok(f(&weights))
}

/// Parameters, shape and workspace of one pass.
pub(crate) struct Pass<'a> {
    pub(crate) weights: &'a Weights<'a>,
    pub(crate) shape: Shape,
    pub(crate) space: &'a mut Workspace,
    /// draws dropout masks, in the order in which the composed layers draw them; `None` for no dropout
    pub(crate) rng: Option<&'a mut Rng>,
    /// for predictions
    pub(crate) packed: Option<&'a PackedWeights>,
    /// called once, when pictures have become tokens
    pub(crate) on_seen: Option<&'a mut dyn FnMut()>,
}

/// Row `r` of a computed tensor is row `r / computed * all + r % computed` of the whole one.
#[derive(Debug, Clone, Copy)]
struct Rows {
    computed: usize,
    all: usize,
}

impl Rows {
    #[inline(always)]
    fn full(self, r: usize) -> usize {
        if self.computed == self.all { r } else { r / self.computed * self.all + r % self.computed }
    }
}

impl<'a> Pass<'a> {
    pub(crate) fn weight(&self, prefix: &str, name: &str) -> &'a [f32] {
        let name = format!("{prefix}{name}");
        self.weights.get(name.as_str()).copied().expect("the model was built with this parameter")
    }

    pub(crate) fn mask(&mut self) -> Option<DropoutMask> {
        match &mut self.rng {
            Some(rng) if self.shape.dropout > 0.0 => Some(DropoutMask::draw(self.shape.dropout, rng)),
            _ => None,
        }
    }

    pub(crate) fn take(&mut self, len: usize) -> Vec<f32> {
        self.space.pool.take(len)
    }

    pub(crate) fn give(&mut self, buffer: Vec<f32>) {
        self.space.pool.give(buffer);
    }

    /// x: (rows, in) -> (rows, out), `y = x Wᵀ + b`
    pub(crate) fn linear(&mut self, prefix: &str, x: &[f32]) -> Vec<f32> {
        let (w, b) = (self.weight(prefix, ".weight"), self.weight(prefix, ".bias"));
        self.times(x, w, Start::Bias(b), |_, _, _| ())
    }

    /// Rows side by side: (rows, …) and (rows, …) -> (rows, both)
    pub(crate) fn beside(&mut self, rows: usize, first: &[f32], second: &[f32]) -> Vec<f32> {
        let (a, b) = (first.len() / rows, second.len() / rows);
        let mut out = self.take(rows * (a + b));
        for (n, out) in out.chunks_exact_mut(a + b).enumerate() {
            out[..a].copy_from_slice(&first[n * a..][..a]);
            out[a..].copy_from_slice(&second[n * b..][..b]);
        }
        out
    }

    /// x: (rows, in), w: (out, in), whole rows of a parameter -> `start + x wᵀ`, (rows, out), then `epilogue` as in
    /// `gemm_with`
    pub(crate) fn times(
        &mut self,
        x: &[f32],
        w: &[f32],
        start: Start<'_>,
        epilogue: impl Fn(usize, usize, &mut [f32]),
    ) -> Vec<f32> {
        let input = match start {
            Start::Bias(bias) => w.len() / bias.len(),
            Start::Zero | Start::Add => self.shape.dim,
        };
        let (rows, out) = (x.len() / input, w.len() / input);
        let mut y = self.take(rows * out);
        let packed = self.packed.filter(|_| rows > UNPACKED_ROWS).map(|packed| packed.get(w, (out, input)));
        let b = (Mat::rows(w, input).t(), packed.as_deref());
        gemm_with((rows, out, input), Mat::rows(x, input), b, start, &mut y, out, &mut self.space.pack, epilogue);
        y
    }

    /// Adds the gradients of weight and bias.
    pub(crate) fn linear_backward(
        &mut self,
        prefix: &str,
        x: &[f32],
        grad: &[f32],
        input: usize,
        grads: &mut Grads<'_>,
    ) {
        let output = self.weight(prefix, ".bias").len();
        weight_gradient((output, input), grad, output, x, slot(grads, prefix, ".weight"), &mut self.space.pack);
        column_sums(slot(grads, prefix, ".bias"), grad);
    }

    /// The gradient of a linear layer's input.
    pub(crate) fn linear_input(&mut self, prefix: &str, grad: &[f32], input: usize) -> Vec<f32> {
        let output = self.weight(prefix, ".bias").len();
        let rows = grad.len() / output;
        let mut into = self.take(rows * input);
        let (g, w) = (Mat::rows(grad, output), Mat::rows(self.weight(prefix, ".weight"), input));
        product((rows, input, output), g, w, Start::Zero, &mut into, &mut self.space.pack);
        into
    }
}

/// The gradient buffer of a parameter.
pub(crate) fn slot<'g>(grads: &'g mut Grads<'_>, prefix: &str, name: &str) -> &'g mut [f32] {
    grads.get_mut(format!("{prefix}{name}").as_str()).expect("gradients have the model's layout")
}

/// `into (out, in) += gradᵀ (out, rows) x (rows, in)`; rows of `grad` are `stride` apart.
pub(crate) fn weight_gradient(
    (out, input): (usize, usize),
    grad: &[f32],
    stride: usize,
    x: &[f32],
    into: &mut [f32],
    pack: &mut Pack,
) {
    let rows = x.len() / input;
    let (g, x) = (Mat::rows(grad, stride).t(), Mat::rows(x, input));
    product((out, input, rows), g, x, Start::Add, into, pack);
}

/// What a norm's backward pass needs.
#[derive(Debug)]
pub(crate) struct Norm {
    normed: Vec<f32>,
    inverse: Vec<f32>,
}

impl Norm {
    /// x: (rows, D) -> (rows, D)
    pub(crate) fn forward(pass: &mut Pass<'_>, prefix: &str, x: &[f32]) -> (Vec<f32>, Self) {
        let normed = pass.take(x.len());
        Self::of_sum(pass, prefix, x, normed, None)
    }

    /// The norm of `x + mask * branch`.
    fn of_sum(
        pass: &mut Pass<'_>,
        prefix: &str,
        x: &[f32],
        mut branch: Vec<f32>,
        mask: Option<(Option<DropoutMask>, Rows)>,
    ) -> (Vec<f32>, Self) {
        let (w, b) = (pass.weight(prefix, ".weight"), pass.weight(prefix, ".bias"));
        let (mut out, mut inverse) = (pass.take(branch.len()), pass.take(branch.len() / w.len()));
        let full = |r: usize| mask.map_or(r, |(_, rows)| rows.full(r));
        let mask = mask.map(|(mask, _)| (mask, &full as &dyn Fn(usize) -> usize));
        layer_norm(x, &mut branch, mask, w, b, &mut out, &mut inverse);
        (out, Self { normed: branch, inverse })
    }

    /// Turns the gradient of the output into that of the input.
    pub(crate) fn backward(self, pass: &mut Pass<'_>, prefix: &str, grad: &mut [f32], grads: &mut Grads<'_>) {
        let w = pass.weight(prefix, ".weight");
        // two buffers of the same map at once: the small one goes through the pool
        let mut bias = pass.space.pool.zeros(w.len());
        layer_norm_backward(grad, &self.normed, &self.inverse, w, slot(grads, prefix, ".weight"), &mut bias);
        add(slot(grads, prefix, ".bias"), &bias);
        pass.give(bias);
        self.free(pass);
    }

    pub(crate) fn free(self, pass: &mut Pass<'_>) {
        pass.give(self.normed);
        pass.give(self.inverse);
    }
}

/// A branch around which the input is added again, with the norm before the branch or after the sum.
#[derive(Debug)]
struct Residual {
    norm: Norm,
    mask: Option<DropoutMask>,
    rows: Rows,
}

/// What a residual branch reads: with the norm first, `y = norm(x)` and x is kept for the sum; otherwise y is x.
struct Entry {
    y: Vec<f32>,
    x: Option<Vec<f32>>,
    norm: Option<Norm>,
}

fn enter(pass: &mut Pass<'_>, norm: &str, x: Vec<f32>) -> Entry {
    if !pass.shape.pre_norm {
        return Entry { y: x, x: None, norm: None };
    }
    let (y, norm) = Norm::forward(pass, norm, &x);
    Entry { y, x: Some(x), norm: Some(norm) }
}

impl Residual {
    /// `x`: (rows or one sequence, D) and `branch`: (rows, D) -> (rows, D)
    fn leave(
        pass: &mut Pass<'_>,
        norm: &str,
        before: Option<Norm>,
        x: &[f32],
        mut branch: Vec<f32>,
        rows: Rows,
    ) -> (Vec<f32>, Self) {
        let mask = pass.mask();
        match before {
            None => {
                let (out, norm) = Norm::of_sum(pass, norm, x, branch, Some((mask, rows)));
                (out, Self { norm, mask, rows })
            }
            Some(norm) => {
                let width = pass.shape.dim;
                vectorised(
                    #[inline(always)]
                    || {
                        let sums = branch.chunks_exact_mut(width).zip(x.chunks_exact(width).cycle());
                        for (r, (z, x)) in sums.enumerate() {
                            drop_scale(z, mask, rows.full(r) * width);
                            z.iter_mut().zip(x).for_each(|(z, x)| *z += x);
                        }
                    },
                );
                (branch, Self { norm, mask, rows })
            }
        }
    }

    /// Turns the gradient of the output into that of x through the sum, and returns that of the branch's output, and
    /// the norm if it still has to be passed (`Entry`'s).
    fn leave_backward(
        self,
        pass: &mut Pass<'_>,
        prefix: &str,
        grad: &mut [f32],
        grads: &mut Grads<'_>,
    ) -> (Vec<f32>, Option<Norm>) {
        let Self { norm, mask, rows } = self;
        let norm = if pass.shape.pre_norm {
            Some(norm)
        } else {
            norm.backward(pass, prefix, grad, grads);
            None
        };
        let width = pass.shape.dim;
        let mut branch = pass.space.pool.copy(grad);
        vectorised(
            #[inline(always)]
            || {
                for (r, row) in branch.chunks_exact_mut(width).enumerate() {
                    drop_scale(row, mask, rows.full(r) * width);
                }
            },
        );
        (branch, norm)
    }
}

/// Passes the gradient of the branch's input through the norm before it, if there is one.
fn enter_backward(pass: &mut Pass<'_>, prefix: &str, norm: Option<Norm>, y_grad: &mut [f32], grads: &mut Grads<'_>) {
    if let Some(norm) = norm {
        norm.backward(pass, prefix, y_grad, grads);
    }
}
