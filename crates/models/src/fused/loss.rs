//! The losses that ACT and ACTRM share: value and gradient in one go.

/// A chunk's absolute error over steps that are not padding.
pub(crate) struct AbsoluteError {
    /// of each row, summed
    pub(crate) rows: Vec<f64>,
}

impl AbsoluteError {
    /// got, want: (b, H, A), is_pad: (b, H). Writes `scale` times the gradient of the sum into `grad`, if there is one;
    /// at a difference of 0 it is 0, as torch's.
    pub(crate) fn of(got: &[f32], want: &[f32], is_pad: &[f32], rows: usize, grad: Option<(&mut [f32], f32)>) -> Self {
        let (per_row, action) = (is_pad.len() / rows, got.len() / is_pad.len());
        let mut sums = vec![0.0f64; rows];
        for (t, ((got, want), pad)) in got.chunks_exact(action).zip(want.chunks_exact(action)).zip(is_pad).enumerate() {
            if *pad <= 0.0 {
                let error: f64 = got.iter().zip(want).map(|(got, want)| f64::from((got - want).abs())).sum();
                sums[t / per_row] += error;
            }
        }
        if let Some((grad, scale)) = grad {
            let steps = got.chunks_exact(action).zip(want.chunks_exact(action)).zip(grad.chunks_exact_mut(action));
            for (((got, want), grad), pad) in steps.zip(is_pad) {
                for ((got, want), grad) in got.iter().zip(want).zip(grad) {
                    let difference = got - want;
                    *grad = if *pad > 0.0 || difference == 0.0 { 0.0 } else { scale * difference.signum() };
                }
            }
        }
        Self { rows: sums }
    }

    pub(crate) fn total(&self) -> f64 {
        self.rows.iter().sum()
    }
}
