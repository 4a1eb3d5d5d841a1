//! A latent's sample and its KL term. Mean and log-variance lie side by side: (…, 2L).

use crate::context::{Context, read};
use crate::error::Result;
use crate::loss::Term;
use crate::value::Value;
use candle_core::{D, Tensor};

fn parts(latent: &Tensor) -> Result<(Tensor, Tensor)> {
    let width = latent.dim(D::Minus1)? / 2;
    Ok((latent.narrow(D::Minus1, 0, width)?, latent.narrow(D::Minus1, width, width)?))
}

/// The reparametrised sample `mean + exp(log_variance / 2) * noise`; noise: (b, L) -> (b, L)
///
/// # Errors
/// Noise of another shape.
pub fn sample_latent(cx: &mut Context<'_>, latent: &Value, noise: &Value) -> Result<Value> {
    let width = noise.width();
    super::check_width("sample", latent, 2 * width)?;
    super::check_shape(
        "sample",
        "noise",
        &noise.tensor,
        &[&latent.dims()[..latent.dims().len() - 1], &[width]].concat(),
    )?;
    if cx.composed("sample", [&latent.tensor, &noise.tensor])? {
        let (mean, log_variance) = parts(&latent.tensor)?;
        let spread = (log_variance / 2.0)?.exp()?.mul(&noise.tensor)?;
        return Ok(Value::constant((mean + spread)?));
    }
    let mut out = Vec::with_capacity(noise.len());
    read("sample", [&latent.tensor, &noise.tensor], |[latent, noise]| {
        for (latent, noise) in latent.chunks_exact(2 * width).zip(noise.chunks_exact(width)) {
            let (mean, log_variance) = latent.split_at(width);
            out.extend(mean.iter().zip(log_variance).zip(noise).map(|((mean, lv), e)| mean + (lv / 2.0).exp() * e));
        }
        Ok(())
    })?;
    let shape = noise.dims().to_vec();
    let (node, latent, noise) = (latent.node, latent.tensor.clone(), noise.tensor.clone());
    cx.result(out, &shape, node.is_some(), move |grad, back| {
        let mut of = back.space.pool.take(2 * grad.len());
        read("sample", [&latent, &noise], |[latent, noise]| {
            let rows = latent.chunks_exact(2 * width).zip(noise.chunks_exact(width)).zip(grad.chunks_exact(width));
            for (((latent, noise), grad), of) in rows.zip(of.chunks_exact_mut(2 * width)) {
                let (of_mean, of_variance) = of.split_at_mut(width);
                of_mean.copy_from_slice(grad);
                let terms = latent[width..].iter().zip(noise).zip(grad);
                for (of, ((lv, e), grad)) in of_variance.iter_mut().zip(terms) {
                    *of = grad * e * 0.5 * (lv / 2.0).exp();
                }
            }
            Ok(())
        })?;
        back.space.pool.give(grad);
        back.add(node, of);
        Ok(())
    })
}

/// KL(latent ‖ N(0, 1)), summed over the latent and averaged over `total_rows`.
///
/// # Errors
/// If the tensor library fails.
pub fn kl_divergence(cx: &mut Context<'_>, latent: &Value, total_rows: usize) -> Result<Term> {
    let total = total_rows.max(1);
    super::check_width("KL divergence", latent, latent.width() / 2 * 2)?;
    if cx.composed("KL divergence", [&latent.tensor])? {
        let (mean, log_variance) = parts(&latent.tensor)?;
        let terms = ((&log_variance + 1.0)? - mean.sqr()? - log_variance.exp()?)?;
        return Ok(Term::composed((terms.sum_all()? * (-0.5 / total as f64))?));
    }
    let (width, rows) = (latent.width() / 2, total as f32);
    let mut sum = 0.0f64;
    read("KL divergence", [&latent.tensor], |[latent]| {
        for latent in latent.chunks_exact(2 * width) {
            let (mean, log_variance) = latent.split_at(width);
            for (mean, lv) in mean.iter().zip(log_variance) {
                sum -= 0.5 * f64::from(1.0 + lv - mean * mean - lv.exp());
            }
        }
        Ok(())
    })?;
    let (node, latent) = (latent.node, latent.tensor.clone());
    Ok(cx.term(sum / f64::from(rows), node.is_some(), move |weight, back| {
        let weight = weight as f32;
        let mut of = back.space.pool.take(latent.elem_count());
        read("KL divergence", [&latent], |[latent]| {
            for (latent, of) in latent.chunks_exact(2 * width).zip(of.chunks_exact_mut(2 * width)) {
                let ((mean, log_variance), (of_mean, of_variance)) = (latent.split_at(width), of.split_at_mut(width));
                of_mean.iter_mut().zip(mean).for_each(|(of, mean)| *of = weight * mean / rows);
                for (of, lv) in of_variance.iter_mut().zip(log_variance) {
                    *of = weight * 0.5 * (lv.exp() - 1.0) / rows;
                }
            }
            Ok(())
        })?;
        back.add(node, of);
        Ok(())
    }))
}
