//! Convolutions over the steps of a sequence, whose channels come last, with torch's weights.
//!
//! candle's own have channels first and a slow gradient. Here the numbers under a kernel are laid side by side, and the
//! convolution is one product.

use super::Linear;
use crate::error::Result;
use crate::params::{Init, Params};
use crate::precision::Precision;
use crate::rng::Rng;
use candle_core::Tensor;

/// A convolution as `torch.nn.Conv1d`: weight (out, in, kernel), bias (out).
#[derive(Debug, Clone)]
pub struct Conv1d {
    /// (out, in, kernel)
    pub weight: Tensor,
    /// (out)
    pub bias: Tensor,
    pub(crate) stride: usize,
}

/// Both parameters uniform in ±1/sqrt(fan_in), as torch draws them.
fn parameters(
    params: &mut Params,
    prefix: &str,
    shape: [usize; 3],
    (fan_in, out): (usize, usize),
    rng: &mut Rng,
) -> Result<(Tensor, Tensor)> {
    let init = Init::Uniform { bound: 1.0 / (fan_in as f64).sqrt() };
    let weight = params.create(&format!("{prefix}.weight"), &shape, init, rng)?;
    Ok((weight, params.create(&format!("{prefix}.bias"), &[out], init, rng)?))
}

/// For every output step the input steps under the kernel, side by side, zeros beyond the ends.
///
/// x: (b, steps, channels) -> (b, outputs, taps*channels), tap k of output i being step `first + stride*i + k`
fn unfold(x: &Tensor, (first, stride): (i64, usize), taps: usize, outputs: usize) -> Result<Tensor> {
    let (b, steps, channels) = x.dims3()?;
    let before = (-first).max(0) as usize;
    let last = first + (stride * (outputs - 1) + taps) as i64;
    let after = (last - steps as i64).max(0) as usize;
    let padded = x.pad_with_zeros(1, before, after)?;
    let from = (first + before as i64) as usize;
    let index: Vec<u32> = (0..outputs).flat_map(|i| (0..taps).map(move |k| (from + stride * i + k) as u32)).collect();
    let index = Tensor::from_vec(index, outputs * taps, x.device())?;
    Ok(padded.contiguous()?.index_select(&index, 1)?.reshape((b, outputs, taps * channels))?)
}

impl Conv1d {
    /// Creates `{prefix}.weight` and `{prefix}.bias`. `shape` is (in, out, kernel); the kernel is odd, and so wide is the
    /// padding that a stride of 1 gives as many steps.
    pub fn new(
        params: &mut Params,
        prefix: &str,
        (input, output, kernel): (usize, usize, usize),
        stride: usize,
        rng: &mut Rng,
    ) -> Result<Self> {
        let shape = [output, input, kernel];
        let (weight, bias) = parameters(params, prefix, shape, (input * kernel, output), rng)?;
        Ok(Self { weight, bias, stride })
    }

    /// x: (b, steps, in) -> (b, steps / stride, out)
    pub fn forward(&self, x: &Tensor, precision: Precision) -> Result<Tensor> {
        let (output, input, kernel) = self.weight.dims3()?;
        let (outputs, padding) = (x.dim(1)?.div_ceil(self.stride), kernel / 2);
        // the weight as that of a dense layer over the numbers under the kernel
        let weight = self.weight.transpose(1, 2)?.contiguous()?.reshape((output, kernel * input))?;
        let layer = Linear { weight, bias: Some(self.bias.clone()) };
        layer.forward_in(&unfold(x, (-(padding as i64), self.stride), kernel, outputs)?, precision)
    }
}

/// Twice as many steps: `torch.nn.ConvTranspose1d` with a kernel of 4, a stride of 2 and a padding of 1; weight
/// (in, out, 4), bias (out).
#[derive(Debug, Clone)]
pub struct Upsample1d {
    /// (in, out, 4)
    pub weight: Tensor,
    /// (out)
    pub bias: Tensor,
}

impl Upsample1d {
    /// Creates `{prefix}.weight` and `{prefix}.bias`.
    pub fn new(params: &mut Params, prefix: &str, channels: usize, rng: &mut Rng) -> Result<Self> {
        // torch takes the second dimension for the fan in, here too
        let (weight, bias) = parameters(params, prefix, [channels, channels, 4], (channels * 4, channels), rng)?;
        Ok(Self { weight, bias })
    }

    /// x: (b, steps, in) -> (b, 2 steps, out)
    pub fn forward(&self, x: &Tensor, precision: Precision) -> Result<Tensor> {
        let (b, steps, _) = x.dims3()?;
        let (_, output, _) = self.weight.dims3()?;
        // output 2i sees steps i-1 and i through taps 3 and 1, output 2i+1 steps i and i+1 through taps 2 and 0
        let half = |first: i64, taps: [usize; 2]| -> Result<Tensor> {
            let taps = taps.map(|tap| self.weight.narrow(2, tap, 1).and_then(|w| w.squeeze(2)));
            let [one, other] = taps;
            let weight = Tensor::cat(&[one?, other?], 0)?.t()?;
            let layer = Linear { weight, bias: Some(self.bias.clone()) };
            layer.forward_in(&unfold(x, (first, 1), 2, steps)?, precision)
        };
        let both = Tensor::stack(&[half(-1, [3, 1])?, half(0, [2, 0])?], 2)?;
        Ok(both.reshape((b, 2 * steps, output))?)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::Backend;
    use candle_core::Device;

    fn random(shape: &[usize], seed: u64) -> Tensor {
        let n = shape.iter().product();
        Tensor::from_vec(Rng::new(seed, "test").normals(n), shape, &Device::Cpu).unwrap()
    }

    fn assert_same(ours: &Tensor, channels_first: &Tensor, bias: &Tensor, what: &str) {
        let bias = bias.reshape((1, (), 1)).unwrap();
        let theirs = channels_first.broadcast_add(&bias).unwrap().transpose(1, 2).unwrap();
        assert_eq!(ours.dims(), theirs.dims(), "{what}");
        let off = (ours - theirs).unwrap().abs().unwrap().flatten_all().unwrap().max(0).unwrap();
        assert!(off.to_scalar::<f32>().unwrap() < 1e-5, "{what}");
    }

    #[test]
    fn convolutions_are_candles() {
        for (kernel, stride, steps) in [(5, 1, 8), (3, 2, 8), (3, 2, 7), (1, 1, 4), (5, 1, 2)] {
            let mut p = Params::new(&Backend::CPU);
            let mut rng = Rng::new(1, "init");
            let conv = Conv1d::new(&mut p, "c", (3, 4, kernel), stride, &mut rng).unwrap();
            let x = random(&[2, steps, 3], 5);
            let first = x.transpose(1, 2).unwrap().contiguous().unwrap();
            let theirs = first.conv1d(&conv.weight, kernel / 2, stride, 1, 1).unwrap();
            assert_same(
                &conv.forward(&x, Precision::F32).unwrap(),
                &theirs,
                &conv.bias,
                &format!("{kernel} {stride} {steps}"),
            );
        }
    }

    #[test]
    fn upsampling_is_candles_transposed_convolution() {
        for steps in [1, 2, 5] {
            let mut p = Params::new(&Backend::CPU);
            let up = Upsample1d::new(&mut p, "u", 3, &mut Rng::new(1, "init")).unwrap();
            let x = random(&[2, steps, 3], 6);
            let first = x.transpose(1, 2).unwrap().contiguous().unwrap();
            let theirs = first.conv_transpose1d(&up.weight, 1, 0, 2, 1, 1).unwrap();
            assert_same(&up.forward(&x, Precision::F32).unwrap(), &theirs, &up.bias, &format!("{steps}"));
        }
    }
}
