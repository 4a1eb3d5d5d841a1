//! The loss of a mixture of Gaussians and its gradient: the maths of `layers/mixture.rs` in one go.

use super::{Grads, Pass};
use nn::kernels::add;

/// What is to be likely: actions, and how much each counts.
pub(crate) struct Wanted<'a> {
    /// (n, A)
    pub(crate) actions: &'a [f32],
    /// (n): 1 or 0
    pub(crate) real: &'a [f32],
    /// rows of the whole batch that count
    pub(crate) total: usize,
}

/// The loss, a share of the mean over all rows of the batch that count.
#[derive(Debug)]
pub(crate) struct Likelihood {
    /// minus the log-likelihood
    pub(crate) nll: f64,
    /// absolute error of the likeliest Gaussian's mean
    pub(crate) l1: f64,
}

/// ln(1 + e^x), which cannot overflow so
fn softplus(x: f64) -> f64 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

/// x: (n, in), through `{prefix}.mean`, `.scale` and `.logits` -> the loss, and the gradient of x
pub(crate) fn likelihood(
    pass: &mut Pass<'_>,
    prefix: &str,
    (n_modes, min_std): (usize, f64),
    x: &[f32],
    wanted: &Wanted<'_>,
    grads: &mut Grads<'_>,
) -> (Likelihood, Vec<f32>) {
    let parts = ["mean", "scale", "logits"].map(|part| format!("{prefix}.{part}"));
    let [mut means, mut scales, mut logits] = parts.each_ref().map(|part| pass.linear(part, x));
    let (rows, width) = (wanted.real.len(), wanted.actions.len() / wanted.real.len());
    let (mut nll, mut l1, share) = (0.0, 0.0, 1.0 / wanted.total.max(1) as f64);
    let mut of_mode = vec![0.0; n_modes];
    let each = means.chunks_exact_mut(n_modes * width).zip(scales.chunks_exact_mut(n_modes * width));
    let each = each.zip(logits.chunks_exact_mut(n_modes)).zip(wanted.actions.chunks_exact(width).zip(wanted.real));
    for (((means, scales), logits), (action, real)) in each {
        let best = (0..n_modes).fold(0, |best, m| if logits[m] > logits[best] { m } else { best });
        let max = f64::from(logits[best]);
        let sum: f64 = logits.iter().map(|&x| (f64::from(x) - max).exp()).sum();
        // ln of a mode's weight times its density
        for (m, of_mode) in of_mode.iter_mut().enumerate() {
            let mut log = f64::from(logits[m]) - max - sum.ln() - 0.5 * width as f64 * std::f64::consts::TAU.ln();
            for ((mean, scale), action) in means[m * width..].iter().zip(&scales[m * width..]).zip(action) {
                let (mean, scale) = (f64::from(*mean).tanh(), softplus(f64::from(*scale)) + min_std);
                log -= 0.5 * ((f64::from(*action) - mean) / scale).powi(2) + scale.ln();
                if m == best {
                    l1 += f64::from(*real) * (f64::from(*action) - mean).abs();
                }
            }
            *of_mode = log;
        }
        let highest = of_mode.iter().fold(f64::NEG_INFINITY, |max, x| max.max(*x));
        let whole = highest + of_mode.iter().map(|x| (x - highest).exp()).sum::<f64>().ln();
        nll -= f64::from(*real) * whole;
        let share = share * f64::from(*real);
        for (m, of_mode) in of_mode.iter().enumerate() {
            let responsible = (of_mode - whole).exp();
            for ((mean, scale), action) in means[m * width..].iter_mut().zip(&mut scales[m * width..]).zip(action) {
                let (raw, tanh) = (f64::from(*scale), f64::from(*mean).tanh());
                let scale_here = softplus(raw) + min_std;
                let away = (f64::from(*action) - tanh) / scale_here;
                let slope = 1.0 / (1.0 + (-raw).exp());
                *mean = (-share * responsible * away / scale_here * (1.0 - tanh * tanh)) as f32;
                *scale = (-share * responsible * (away * away - 1.0) / scale_here * slope) as f32;
            }
            let weight = (f64::from(logits[m]) - max).exp() / sum;
            logits[m] = (share * (weight - responsible)) as f32;
        }
    }
    let input = x.len() / rows;
    let mut grad = pass.space.pool.zeros(x.len());
    for (part, of_part) in parts.iter().zip([means, scales, logits]) {
        pass.linear_backward(part, x, &of_part, input, grads);
        let through = pass.linear_input(part, &of_part, input);
        add(&mut grad, &through);
        pass.give(through);
        pass.give(of_part);
    }
    (Likelihood { nll: nll * share, l1: l1 * share / width as f64 }, grad)
}
