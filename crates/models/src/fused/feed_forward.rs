//! The feed-forward branch.

use super::{Grads, Pass, Rows};
use crate::layers::{Activation, DropoutMask, Shape};
use nn::kernels::{Mat, Start, activate, activate_backward, gemm_with};
use nn::simd::vectorised;

/// What the feed-forward branch's backward pass needs.
#[derive(Debug)]
pub(super) struct FeedForward {
    mask: Option<DropoutMask>,
    rows: Rows,
    /// before the activation; `None` if the output tells (ReLU)
    before: Option<Vec<f32>>,
    hidden: Vec<f32>,
}

impl FeedForward {
    /// x: (rows, D) -> (rows, D)
    pub(super) fn forward(pass: &mut Pass<'_>, prefix: &str, x: &[f32], rows: Rows) -> (Vec<f32>, Self) {
        let Shape { hidden: width, activation, .. } = pass.shape;
        let mask = pass.mask();
        let (w, bias) = (pass.weight(prefix, ".linear1.weight"), pass.weight(prefix, ".linear1.bias"));
        let mut before = None;
        let hidden = if activation == Activation::Relu {
            let epilogue =
                |i: usize, j: usize, row: &mut [f32]| activate(row, activation, mask, rows.full(i) * width + j);
            pass.times(x, w, Start::Bias(bias), epilogue)
        } else {
            let linear = pass.times(x, w, Start::Bias(bias), |_, _, _| ());
            let mut hidden = pass.space.pool.copy(&linear);
            vectorised(
                #[inline(always)]
                || {
                    for (i, row) in hidden.chunks_exact_mut(width).enumerate() {
                        activate(row, activation, mask, rows.full(i) * width);
                    }
                },
            );
            before = Some(linear);
            hidden
        };
        let branch = pass.linear(&format!("{prefix}.linear2"), &hidden);
        (branch, Self { mask, rows, before, hidden })
    }

    /// Returns the gradient of x.
    pub(super) fn backward(
        self,
        pass: &mut Pass<'_>,
        prefix: &str,
        branch_grad: &[f32],
        x: &[f32],
        grads: &mut Grads<'_>,
    ) -> Vec<f32> {
        let Shape { dim, hidden: width, activation, .. } = pass.shape;
        let (first, second) = (format!("{prefix}.linear1"), format!("{prefix}.linear2"));
        pass.linear_backward(&second, &self.hidden, branch_grad, width, grads);
        let n = x.len() / dim;
        let mut grad = pass.take(n * width);
        let before = self.before.as_ref().unwrap_or(&self.hidden);
        let (g, w) = (Mat::rows(branch_grad, dim), Mat::rows(pass.weight(&second, ".weight"), width));
        let epilogue = |i: usize, j: usize, row: &mut [f32]| {
            let before = &before[i * width + j..][..row.len()];
            activate_backward(row, before, activation, self.mask, self.rows.full(i) * width + j);
        };
        gemm_with((n, width, dim), g, (w, None), Start::Zero, &mut grad, width, &mut pass.space.pack, epilogue);
        pass.linear_backward(&first, x, &grad, dim, grads);
        let x_grad = pass.linear_input(&first, &grad, dim);
        pass.give(grad);
        self.free(pass);
        x_grad
    }

    pub(super) fn free(self, pass: &mut Pass<'_>) {
        pass.give(self.hidden);
        if let Some(before) = self.before {
            pass.give(before);
        }
    }
}
