//! Losses over class scores: cross-entropy under stablemax (the official TRM's) or softmax, and
//! binary cross-entropy on a logit.
//!
//! Cross-entropy is one operation with its own backward, computed in f64 whatever the logits'
//! type: stablemax's sums lose too much in f32 once one class dominates, and the official code
//! casts to f64 for the same reason.

use candle_core::{CpuStorage, CustomOp1, DType, Device, Layout, Result as CandleResult, Shape, Tensor};

/// A label that takes no part in the loss.
pub const IGNORE_LABEL: i64 = -100;

/// What turns class scores into probabilities.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ClassProbability {
    /// `s(x) = x + 1` for `x >= 0`, else `1 / (1 - x)`; `p = s / sum s` (the official TRM's).
    #[default]
    Stablemax,
    /// `p = exp(x) / sum exp(x)`.
    Softmax,
}

fn stable(x: f64) -> f64 {
    if x >= 0.0 { x + 1.0 } else { 1.0 / (1.0 - x) }
}

fn stable_slope(x: f64) -> f64 {
    if x >= 0.0 { 1.0 } else { (1.0 - x).powi(-2) }
}

impl ClassProbability {
    /// The negative log-probability of `label`.
    pub(crate) fn loss(self, scores: &[f32], label: usize) -> f64 {
        match self {
            Self::Stablemax => {
                let sum: f64 = scores.iter().map(|&x| stable(f64::from(x))).sum();
                sum.ln() - stable(f64::from(scores[label])).ln()
            }
            Self::Softmax => {
                let (max, sum) = log_sum_exp(scores);
                max + sum.ln() - f64::from(scores[label])
            }
        }
    }

    /// Writes `weight` times the gradient of [`Self::loss`] into `out`.
    pub(crate) fn gradient(self, scores: &[f32], label: usize, weight: f64, out: &mut [f32]) {
        match self {
            Self::Stablemax => {
                let sum: f64 = scores.iter().map(|&x| stable(f64::from(x))).sum();
                for (j, (o, &x)) in out.iter_mut().zip(scores).enumerate() {
                    let x = f64::from(x);
                    let mut g = stable_slope(x) / sum;
                    if j == label {
                        g -= stable_slope(x) / stable(x);
                    }
                    *o = (weight * g) as f32;
                }
            }
            Self::Softmax => {
                let (max, sum) = log_sum_exp(scores);
                for (j, (o, &x)) in out.iter_mut().zip(scores).enumerate() {
                    let mut g = (f64::from(x) - max).exp() / sum;
                    if j == label {
                        g -= 1.0;
                    }
                    *o = (weight * g) as f32;
                }
            }
        }
    }
}

/// `(max, sum exp(x - max))`.
fn log_sum_exp(scores: &[f32]) -> (f64, f64) {
    let max = scores.iter().fold(f64::NEG_INFINITY, |m, &x| m.max(f64::from(x)));
    let sum = scores.iter().map(|&x| (f64::from(x) - max).exp()).sum();
    (max, sum)
}

struct CrossEntropy {
    labels: Vec<i64>,
    probability: ClassProbability,
}

fn rows<'a>(storage: &'a CpuStorage, layout: &Layout) -> CandleResult<(&'a [f32], usize)> {
    let (_, classes) = layout.shape().dims2()?;
    let Some((from, to)) = layout.contiguous_offsets() else {
        candle_core::bail!("cross-entropy: the logits are not contiguous");
    };
    Ok((&storage.as_slice::<f32>()?[from..to], classes))
}

impl CustomOp1 for CrossEntropy {
    fn name(&self) -> &'static str {
        "cross-entropy"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> CandleResult<(CpuStorage, Shape)> {
        let (logits, classes) = rows(storage, layout)?;
        let losses: Vec<f64> = logits
            .chunks_exact(classes)
            .zip(&self.labels)
            .map(|(row, &label)| match usize::try_from(label) {
                Ok(label) => self.probability.loss(row, label),
                Err(_ignored) => 0.0,
            })
            .collect();
        let shape = Shape::from(losses.len());
        Ok((CpuStorage::F64(losses), shape))
    }

    fn bwd(&self, arg: &Tensor, _: &Tensor, grad: &Tensor) -> CandleResult<Option<Tensor>> {
        let (_, classes) = arg.dims2()?;
        let logits = arg.flatten_all()?.to_vec1::<f32>()?;
        let grad = grad.to_vec1::<f64>()?;
        let mut out = vec![0f32; logits.len()];
        for (((row, out), &label), &weight) in
            logits.chunks_exact(classes).zip(out.chunks_exact_mut(classes)).zip(&self.labels).zip(&grad)
        {
            if let Ok(label) = usize::try_from(label) {
                self.probability.gradient(row, label, weight, out);
            }
        }
        Ok(Some(Tensor::from_vec(out, arg.shape(), arg.device())?))
    }
}

/// Cross-entropy per row: `logits: (n, classes)` f32 -> `(n,)` f64, zero where the label is
/// [`IGNORE_LABEL`].
///
/// # Errors
/// When the shapes do not fit or a label is neither a class nor [`IGNORE_LABEL`].
pub fn cross_entropy(logits: &Tensor, labels: &[i64], probability: ClassProbability) -> CandleResult<Tensor> {
    let (n, classes) = logits.dims2()?;
    if labels.len() != n {
        candle_core::bail!("cross-entropy: {n} rows of logits and {} labels", labels.len());
    }
    for &label in labels {
        if label != IGNORE_LABEL && !(0..classes as i64).contains(&label) {
            candle_core::bail!("cross-entropy: label {label} among {classes} classes");
        }
    }
    let logits = logits.to_dtype(DType::F32)?.contiguous()?;
    match (logits.device(), probability) {
        (Device::Cpu, _) => logits.apply_op1(CrossEntropy { labels: labels.to_vec(), probability }),
        (_, ClassProbability::Softmax) => composed(&logits, labels),
        (_, ClassProbability::Stablemax) => candle_core::bail!("cross-entropy of stablemax: on the CPU only"),
    }
}

/// [`cross_entropy`] of a softmax, of candle's operations.
fn composed(logits: &Tensor, labels: &[i64]) -> CandleResult<Tensor> {
    let (device, n) = (logits.device(), labels.len());
    let counts = labels.iter().map(|label| f64::from(u8::from(*label != IGNORE_LABEL)));
    let counts = Tensor::from_vec(counts.collect::<Vec<_>>(), n, device)?;
    let labels =
        Tensor::from_vec(labels.iter().map(|label| (*label).max(0) as u32).collect::<Vec<_>>(), (n, 1), device)?;
    let shifted = logits.broadcast_sub(&logits.detach().max_keepdim(1)?)?.to_dtype(DType::F64)?;
    let taken = shifted.gather(&labels, 1)?.squeeze(1)?;
    (shifted.exp()?.sum(1)?.log()? - taken)? * counts
}

/// Binary cross-entropy of `logits` against `targets` of the same shape, element by element,
/// in the form that does not overflow: `max(x, 0) - x t + ln(1 + exp(-|x|))`.
///
/// # Errors
/// When the shapes differ.
pub fn binary_cross_entropy(logits: &Tensor, targets: &Tensor) -> CandleResult<Tensor> {
    let tail = (logits.abs()?.neg()?.exp()? + 1.0)?.log()?;
    (logits.relu()? - logits.mul(targets)?)? + tail
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use candle_core::{Device, Var};

    fn logits() -> Vec<f32> {
        vec![0.3, -2.0, 4.0, -0.1, 0.0, 12.0, -7.5, 1.5, 0.2, -0.4, 0.9, -30.0]
    }

    #[test]
    fn stablemax_matches_its_definition() {
        let x = Tensor::from_vec(logits(), (3, 4), &Device::Cpu).unwrap();
        let got =
            cross_entropy(&x, &[2, IGNORE_LABEL, 3], ClassProbability::Stablemax).unwrap().to_vec1::<f64>().unwrap();
        let s = |x: f32| {
            let x = f64::from(x);
            if x < 0.0 { 1.0 / (1.0 - x) } else { x + 1.0 }
        };
        for (row, label) in [(0usize, 2usize), (2, 3)] {
            let scores = &logits()[row * 4..row * 4 + 4];
            let sum: f64 = scores.iter().map(|&x| s(x)).sum();
            assert!((got[row] + (s(scores[label]) / sum).ln()).abs() < 1e-12);
        }
        assert_eq!(got[1], 0.0);
    }

    #[test]
    fn gradients_match_finite_differences() {
        for probability in [ClassProbability::Stablemax, ClassProbability::Softmax] {
            let labels = [2, IGNORE_LABEL, 0];
            let weights = Tensor::new(&[0.5f64, 2.0, 1.5], &Device::Cpu).unwrap();
            let value =
                |x: &Tensor| (cross_entropy(x, &labels, probability).unwrap() * &weights).unwrap().sum_all().unwrap();
            let var = Var::from_vec(logits(), (3, 4), &Device::Cpu).unwrap();
            let grads = value(var.as_tensor()).backward().unwrap();
            let grad = grads.get(&var).unwrap().flatten_all().unwrap();
            let grad = grad.to_vec1::<f32>().unwrap();
            for i in 0..12 {
                if logits()[i] == 0.0 {
                    continue; // stablemax has a corner there
                }
                let h = 1e-2f32 * logits()[i].abs().max(0.05);
                let at = |d: f32| {
                    let mut v = logits();
                    v[i] += d;
                    let x = Tensor::from_vec(v, (3, 4), &Device::Cpu).unwrap();
                    value(&x).to_scalar::<f64>().unwrap()
                };
                let numeric = (at(h) - at(-h)) / f64::from(2.0 * h);
                assert!(
                    (numeric - f64::from(grad[i])).abs() < 2e-3 * numeric.abs().max(1.0),
                    "{probability:?} element {i}: {numeric} against {}",
                    grad[i]
                );
            }
        }
    }

    #[test]
    fn the_composition_is_the_operation() {
        let labels = [2, IGNORE_LABEL, 3];
        let [direct, of_candle] = [false, true].map(|composition| {
            let var = candle_core::Var::from_vec(logits(), (3, 4), &Device::Cpu).unwrap();
            let losses = match composition {
                false => cross_entropy(&var, &labels, ClassProbability::Softmax).unwrap(),
                true => composed(&var, &labels).unwrap(),
            };
            let weights = Tensor::new(&[0.5f64, 2.0, 1.5], &Device::Cpu).unwrap();
            let grads = losses.mul(&weights).unwrap().sum_all().unwrap().backward().unwrap();
            let grads = grads.get(&var).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
            losses.to_vec1::<f64>().unwrap().into_iter().chain(grads.into_iter().map(f64::from)).collect::<Vec<_>>()
        });
        for (a, b) in direct.iter().zip(&of_candle) {
            assert!((a - b).abs() < 1e-6, "{direct:?} and {of_candle:?}");
        }
    }

    #[test]
    fn a_label_outside_the_classes_is_refused() {
        let x = Tensor::from_vec(logits(), (3, 4), &Device::Cpu).unwrap();
        let error = cross_entropy(&x, &[0, 4, 1], ClassProbability::Softmax).unwrap_err();
        assert!(error.to_string().contains("label 4 among 4 classes"));
    }

    #[test]
    fn binary_cross_entropy_stays_finite() {
        let x = Tensor::new(&[-200f32, -1.0, 0.0, 3.0, 200.0], &Device::Cpu).unwrap();
        let t = Tensor::new(&[1f32, 0.0, 1.0, 1.0, 1.0], &Device::Cpu).unwrap();
        let loss = binary_cross_entropy(&x, &t).unwrap();
        let loss = loss.to_vec1::<f32>().unwrap();
        let expected = [200.0, (1f64 + (-1f64).exp()).ln(), 2f64.ln(), (1f64 + (-3f64).exp()).ln(), 0.0];
        for (a, b) in loss.iter().zip(expected) {
            assert!((f64::from(*a) - b).abs() < 1e-5, "{a} against {b}");
        }
    }
}
