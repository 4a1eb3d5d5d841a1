//! Compositions of candle's operations with a gradient of their own: candle's has more steps, or none that is fast.

use crate::error::Result;
use crate::precision::Precision;
use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CudaStorage, CustomOp3, D, DType, Layout, Result as CandleResult, Shape, Tensor};

/// Gradients of three inputs; of one that is not asked for it may be left out.
type Gradients = [Option<Tensor>; 3];

/// A result that is there already as an operation on its inputs: the last input is the result.
struct Known<F>(&'static str, F);

impl<F: Fn(&Tensor) -> Result<Gradients>> CustomOp3 for Known<F> {
    fn name(&self) -> &'static str {
        self.0
    }

    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
        result: &CpuStorage,
        layout: &Layout,
    ) -> CandleResult<(CpuStorage, Shape)> {
        Ok((result.try_clone(layout)?, layout.shape().clone()))
    }

    fn cuda_fwd(
        &self,
        _: &CudaStorage,
        _: &Layout,
        _: &CudaStorage,
        _: &Layout,
        result: &CudaStorage,
        layout: &Layout,
    ) -> CandleResult<(CudaStorage, Shape)> {
        Ok((result.try_clone(layout)?, layout.shape().clone()))
    }

    fn bwd(
        &self,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
        grad: &Tensor,
    ) -> CandleResult<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let [one, two, _] = (self.1)(grad).map_err(candle_core::Error::wrap)?;
        Ok((one, two, None))
    }
}

/// Whether a gradient of it is asked for: what is on no graph is its own detached self.
fn is_tracked(x: &Tensor) -> bool {
    x.detach().id() != x.id()
}

/// `result`, computed without a graph, as a function of two inputs with this gradient.
fn known(
    name: &'static str,
    (one, two): (&Tensor, &Tensor),
    result: &Tensor,
    gradient: impl Fn(&Tensor) -> Result<Gradients> + Send + Sync + 'static,
) -> Result<Tensor> {
    if !is_tracked(one) && !is_tracked(two) {
        return Ok(result.clone());
    }
    Ok(one.apply_op3(two, &result.contiguous()?, Known(name, gradient))?)
}

/// Softmax over the last dimension.
pub(crate) fn softmax(x: &Tensor) -> Result<Tensor> {
    let shares = candle_nn::ops::softmax_last_dim(&x.detach().contiguous()?)?;
    let kept = shares.clone();
    known("softmax", (x, &shares), &shares, move |grad| {
        let weighted = grad.mul(&kept)?;
        let of = (&weighted - kept.broadcast_mul(&weighted.sum_keepdim(D::Minus1)?)?)?;
        Ok([Some(of), None, None])
    })
}

/// `(x - mean) / sqrt(var + eps) * weight + bias` over the last dimension. candle's own takes the variance as a difference of two
/// means, which loses digits.
pub(crate) fn layer_norm(x: &Tensor, weight: &Tensor, bias: &Tensor, eps: f64) -> Result<Tensor> {
    let (values, scale) = (x.detach(), weight.detach());
    let centred = values.broadcast_sub(&values.mean_keepdim(D::Minus1)?)?;
    let spread = (centred.sqr()?.mean_keepdim(D::Minus1)? + eps)?.sqrt()?;
    let normed = centred.broadcast_div(&spread)?;
    let result = known("layer norm", (x, weight), &normed.broadcast_mul(&scale)?, move |grad| {
        let of_weight = grad.mul(&normed)?.flatten_to(normed.rank() - 2)?.sum(0)?;
        let grad = grad.broadcast_mul(&scale)?;
        let along = normed.broadcast_mul(&grad.mul(&normed)?.mean_keepdim(D::Minus1)?)?;
        let of_x = grad.broadcast_sub(&grad.mean_keepdim(D::Minus1)?)?;
        Ok([Some((of_x - along)?.broadcast_div(&spread)?), Some(of_weight), None])
    })?;
    Ok(result.broadcast_add(bias)?)
}

/// x: (b, H, W, C), framed with what the kernel reaches beyond the image; weight: (C', C, k, k) -> (b, h, w, C') with
/// H = (h - 1) stride + k
pub(crate) fn conv2d(x: &Tensor, weight: &Tensor, stride: usize, precision: Precision) -> Result<Tensor> {
    let (values, kernel) = (precision.cast(&x.detach())?, precision.cast(&weight.detach())?);
    let result = convolved(&values, &kernel, stride, precision)?;
    let asked = is_tracked(x);
    known("convolution", (x, weight), &result, move |grad| {
        let grad = precision.cast(grad)?;
        let of_x = if asked { Some(of_input(&grad, &kernel, stride, values.dims(), precision)?) } else { None };
        Ok([of_x, Some(of_kernel(&grad, &values, &kernel, stride)?), None])
    })
}

/// The forward pass, without a graph.
fn convolved(x: &Tensor, kernel: &Tensor, stride: usize, precision: Precision) -> Result<Tensor> {
    let (output, _, k, _) = kernel.dims4()?;
    if precision != Precision::F32 {
        // cuDNN's, which rounds f32 to TF32
        let y = x.permute((0, 3, 1, 2))?.conv2d(&kernel.contiguous()?, 0, stride, 1, 1)?;
        return Ok(y.permute((0, 2, 3, 1))?.to_dtype(DType::F32)?);
    }
    let (b, height, width, _) = x.dims4()?;
    let (h, w) = ((height - k) / stride + 1, (width - k) / stride + 1);
    let mut sum: Option<Tensor> = None;
    for dy in 0..k {
        let seen = patches(x, (dy, k), (h, w), stride)?;
        // (C', C, k) of this row of the kernel -> (k C, C')
        let row = kernel.narrow(2, dy, 1)?.squeeze(2)?.permute((2, 1, 0))?.contiguous()?.flatten_to(1)?;
        let part = seen.matmul(&row)?;
        sum = Some(sum.map_or(Ok(part.clone()), |sum| sum + &part)?);
    }
    Ok(sum.expect("a kernel has rows").reshape((b, h, w, output))?)
}

/// What a row of the kernel sees at every place: (b h w, k C)
fn patches(x: &Tensor, (dy, k): (usize, usize), (h, w): (usize, usize), stride: usize) -> Result<Tensor> {
    let rows = every(x, 1, (dy, h), stride)?;
    let taps = (0..k).map(|dx| every(&rows, 2, (dx, w), stride)).collect::<Result<Vec<_>>>()?;
    Ok(Tensor::cat(&taps, D::Minus1)?.flatten_to(2)?)
}

/// Every `stride`-th of a dimension, `count` of them from `from` on.
fn every(x: &Tensor, dim: usize, (from, count): (usize, usize), stride: usize) -> Result<Tensor> {
    let reach = (count - 1) * stride + 1;
    let x = x.narrow(dim, from, reach)?;
    if stride == 1 {
        return Ok(x);
    }
    let mut shape = x.dims().to_vec();
    let x = x.pad_with_zeros(dim, 0, count * stride - reach)?.contiguous()?;
    shape.splice(dim..=dim, [count, stride]);
    Ok(x.reshape(shape)?.narrow(dim + 1, 0, 1)?.squeeze(dim + 1)?)
}

/// The gradient of the input: the kernel turned round over the gradient, with zeros between its places where the stride left
/// places out. grad: (b, h, w, C')
fn of_input(grad: &Tensor, kernel: &Tensor, stride: usize, shape: &[usize], precision: Precision) -> Result<Tensor> {
    let k = kernel.dim(2)?;
    let mut spread = grad.clone();
    for dim in [1, 2] {
        let count = spread.dim(dim)?;
        if stride > 1 {
            let mut shape = spread.dims().to_vec();
            spread = spread.unsqueeze(dim + 1)?.pad_with_zeros(dim + 1, 0, stride - 1)?;
            shape[dim] = count * stride;
            spread = spread.contiguous()?.reshape(shape)?.narrow(dim, 0, (count - 1) * stride + 1)?;
        }
        // what no window reaches has no gradient
        let beyond = shape[dim] - ((count - 1) * stride + k);
        spread = spread.pad_with_zeros(dim, k - 1, k - 1 + beyond)?;
    }
    let turned = kernel.transpose(0, 1)?.contiguous()?.flip(&[2, 3])?;
    convolved(&spread.contiguous()?, &turned, 1, precision)
}

/// The gradient of the kernel, f32. grad: (b, h, w, C'), x: (b, H, W, C)
fn of_kernel(grad: &Tensor, x: &Tensor, kernel: &Tensor, stride: usize) -> Result<Tensor> {
    let (output, input, k, _) = kernel.dims4()?;
    let (_, h, w, _) = grad.dims4()?;
    let grad = grad.contiguous()?.flatten_to(2)?.t()?;
    // each (C', k C)
    let rows = (0..k).map(|dy| Ok(grad.matmul(&patches(x, (dy, k), (h, w), stride)?)?.reshape((output, k, input))?));
    let rows = rows.collect::<Result<Vec<_>>>()?;
    Ok(Tensor::stack(&rows, 1)?.permute((0, 3, 1, 2))?.contiguous()?.to_dtype(DType::F32)?)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::rng::Rng;
    use candle_core::{Device, Var};

    fn apart(a: &Tensor, b: &Tensor) -> f32 {
        (a - b).unwrap().abs().unwrap().flatten_all().unwrap().max(0).unwrap().to_scalar().unwrap()
    }

    fn random(shape: &[usize], rng: &mut Rng) -> Var {
        Var::from_vec(rng.normals(shape.iter().product()), shape, &Device::Cpu).unwrap()
    }

    #[test]
    fn softmax_has_candles_gradient() {
        let mut rng = Rng::new(1, "softmax");
        let (x, weight) = (random(&[3, 4, 5], &mut rng), random(&[3, 4, 5], &mut rng));
        let theirs = candle_nn::ops::softmax(&x, D::Minus1).unwrap();
        let ours = softmax(&x).unwrap();
        assert!(apart(&ours, &theirs) < 1e-6);
        let [ours, theirs] = [ours, theirs].map(|y| {
            let grads = y.mul(&weight.detach()).unwrap().sum_all().unwrap().backward().unwrap();
            grads.get(&x).unwrap().clone()
        });
        assert!(apart(&ours, &theirs) < 1e-6);
    }

    #[test]
    fn a_layer_norm_has_candles_gradients() {
        let mut rng = Rng::new(3, "norm");
        let (x, weight, bias) = (random(&[3, 4, 5], &mut rng), random(&[5], &mut rng), random(&[5], &mut rng));
        let share = random(&[3, 4, 5], &mut rng).detach();
        let theirs = candle_nn::ops::layer_norm_slow(&x, &weight, &bias, 1e-5).unwrap();
        let ours = layer_norm(&x, &weight, &bias, 1e-5).unwrap();
        assert!(apart(&ours, &theirs) < 1e-5);
        let [got, want] = [ours, theirs].map(|y| y.mul(&share).unwrap().sum_all().unwrap().backward().unwrap());
        for var in [&x, &weight, &bias] {
            assert!(apart(got.get(var).unwrap(), want.get(var).unwrap()) < 1e-5, "{:?}", var.dims());
        }
    }

    #[test]
    fn a_convolution_has_candles_gradients() {
        let mut rng = Rng::new(2, "convolution");
        for (k, stride, h, w) in [(1, 1, 3, 4), (3, 1, 5, 4), (3, 2, 3, 4), (1, 2, 4, 3), (7, 2, 3, 5), (4, 3, 2, 2)] {
            let (height, width) = ((h - 1) * stride + k, (w - 1) * stride + k);
            let (x, weight) = (random(&[2, height, width, 3], &mut rng), random(&[5, 3, k, k], &mut rng));
            let share = random(&[2, h, w, 5], &mut rng).detach();
            let theirs = x.permute((0, 3, 1, 2)).unwrap().contiguous().unwrap();
            let theirs = theirs.conv2d(&weight, 0, stride, 1, 1).unwrap().permute((0, 2, 3, 1)).unwrap();
            let want = theirs.mul(&share).unwrap().sum_all().unwrap().backward().unwrap();
            for precision in [Precision::F32, Precision::Tf32] {
                let ours = conv2d(&x, &weight, stride, precision).unwrap();
                assert!(apart(&ours, &theirs) < 1e-4, "{k} {stride} {precision:?}");
                let got = ours.mul(&share).unwrap().sum_all().unwrap().backward().unwrap();
                for var in [&x, &weight] {
                    let off = apart(got.get(var).unwrap(), want.get(var).unwrap());
                    assert!(off < 1e-3, "{k} {stride} {precision:?} {:?}: {off}", var.dims());
                }
            }
        }
    }
}
