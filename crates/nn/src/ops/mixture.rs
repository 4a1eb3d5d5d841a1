//! The likelihood of actions under mixtures of Gaussians.

use crate::context::{Context, read};
use crate::error::{ModelError, Result};
use crate::layers::MixtureParts;
use crate::loss::Term;
use crate::losses::absolute;
use crate::number::Number;
use candle_core::Tensor;

/// ln(1 + e^x), which cannot overflow so
fn softplus(x: f64) -> f64 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

/// Minus the log-likelihood of actions, (n, A), under n mixtures, each counted `real` times, (n), of 0 and 1, divided by `total`;
/// and the absolute error of the likeliest Gaussian's mean, likewise, beside what other policies report.
///
/// # Errors
/// Shapes that do not go together.
pub fn mixture_likelihood(
    cx: &mut Context<'_>,
    parts: &MixtureParts,
    (actions, real): (&Tensor, &Tensor),
    total: usize,
) -> Result<(Term, Number)> {
    let [n, modes] = super::sizes("likelihood", &parts.logits.tensor)?;
    let (width, total) = (parts.action_dim, total.max(1));
    super::check_shape("likelihood", "actions", actions, &[n, width])?;
    super::check_shape("likelihood", "rows that count", real, &[n])?;
    for of in [&parts.means, &parts.scales] {
        if of.dims() != [n, modes * width] {
            let (expected, found) = (vec![n, modes * width], of.dims().to_vec());
            return Err(ModelError::Shape { operation: "likelihood", object: "Gaussians", expected, found });
        }
    }
    let min_std = parts.min_std;
    let tensors = [&parts.means.tensor, &parts.scales.tensor, &parts.logits.tensor, actions, real];
    if cx.composed("likelihood", tensors)? {
        let mixtures = parts.mixture()?;
        let nll = ((mixtures.log_prob(actions)?.mul(real)?.sum_all()? / total as f64)? * -1.0)?;
        let away = absolute(&(mixtures.likeliest()?.detach() - actions)?)?.broadcast_mul(&real.unsqueeze(1)?)?;
        let l1 = Number::There((away.sum_all()? / (total * width) as f64)?.detach());
        return Ok((Term::composed(nll), l1));
    }
    let (mut nll, mut l1, share) = (0.0, 0.0, 1.0 / total as f64);
    let pool = &mut cx.space.pool;
    let mut grads = [pool.take(n * modes * width), pool.take(n * modes * width), pool.take(n * modes)];
    read("likelihood", tensors, |[means, scales, logits, actions, real]| {
        let mut of_mode = vec![0.0; modes];
        let [of_means, of_scales, of_logits] = &mut grads;
        for (row, (action, &real)) in actions.chunks_exact(width).zip(real).enumerate() {
            let (wide, narrow) = (row * modes * width..(row + 1) * modes * width, row * modes..(row + 1) * modes);
            let (means, scales, logits) = (&means[wide.clone()], &scales[wide.clone()], &logits[narrow.clone()]);
            let best = (0..modes).fold(0, |best, m| if logits[m] > logits[best] { m } else { best });
            let max = f64::from(logits[best]);
            let sum: f64 = logits.iter().map(|&x| (f64::from(x) - max).exp()).sum();
            // ln of a mode's weight times its density
            for (m, of_mode) in of_mode.iter_mut().enumerate() {
                let mut log = f64::from(logits[m]) - max - sum.ln() - 0.5 * width as f64 * std::f64::consts::TAU.ln();
                for ((mean, scale), action) in means[m * width..].iter().zip(&scales[m * width..]).zip(action) {
                    let (mean, scale) = (f64::from(*mean).tanh(), softplus(f64::from(*scale)) + min_std);
                    log -= 0.5 * ((f64::from(*action) - mean) / scale).powi(2) + scale.ln();
                    if m == best {
                        l1 += f64::from(real) * (f64::from(*action) - mean).abs();
                    }
                }
                *of_mode = log;
            }
            let highest = of_mode.iter().fold(f64::NEG_INFINITY, |max, x| max.max(*x));
            let whole = highest + of_mode.iter().map(|x| (x - highest).exp()).sum::<f64>().ln();
            nll -= f64::from(real) * whole;
            let share = share * f64::from(real);
            let (of_means, of_scales) = (&mut of_means[wide.clone()], &mut of_scales[wide]);
            for (m, of_mode) in of_mode.iter().enumerate() {
                let responsible = (of_mode - whole).exp();
                for (j, action) in action.iter().enumerate() {
                    let at = m * width + j;
                    let (raw, tanh) = (f64::from(scales[at]), f64::from(means[at]).tanh());
                    let scale = softplus(raw) + min_std;
                    let away = (f64::from(*action) - tanh) / scale;
                    let slope = 1.0 / (1.0 + (-raw).exp());
                    of_means[at] = (-share * responsible * away / scale * (1.0 - tanh * tanh)) as f32;
                    of_scales[at] = (-share * responsible * (away * away - 1.0) / scale * slope) as f32;
                }
                let weight = (f64::from(logits[m]) - max).exp() / sum;
                of_logits[narrow.start + m] = (share * (weight - responsible)) as f32;
            }
        }
        Ok(())
    })?;
    let nodes = [parts.means.node, parts.scales.node, parts.logits.node];
    if !cx.records() {
        grads.into_iter().for_each(|buffer| cx.space.pool.give(buffer));
        return Ok((cx.term(nll * share, false, |_, _| Ok(())), ((l1 * share / width as f64) as f32).into()));
    }
    let has_gradient = nodes.iter().any(Option::is_some);
    let term = cx.term(nll * share, has_gradient, move |weight, back| {
        for (node, mut of) in nodes.into_iter().zip(grads) {
            if weight != 1.0 {
                of.iter_mut().for_each(|x| *x = (f64::from(*x) * weight) as f32);
            }
            back.add(node, of);
        }
        Ok(())
    });
    Ok((term, ((l1 * share / width as f64) as f32).into()))
}
