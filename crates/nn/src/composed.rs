//! Compositions of candle's operations with a gradient of their own: candle's takes more operations.

use crate::error::{ModelError, Result};
use crate::precision::Precision;
use candle_core::backend::BackendStorage;
use candle_core::{
    CpuStorage, CudaStorage, CustomOp3, D, DType, Layout, Result as CandleResult, Shape, Storage, Tensor,
};
use std::sync::{Mutex, PoisonError};

/// Gradients of up to three inputs; one that is not asked for may be left out.
type Gradients = [Option<Tensor>; 3];

/// A result that is there already, as an operation with a gradient.
struct Known<F> {
    name: &'static str,
    result: Mutex<Option<Tensor>>,
    gradient: F,
}

impl<F> Known<F> {
    /// Lends the result once.
    fn with<R>(&self, f: impl FnOnce(&Storage, &Layout) -> CandleResult<R>) -> CandleResult<(R, Shape)> {
        let result = self.result.lock().unwrap_or_else(PoisonError::into_inner).take();
        let Some(result) = result else { candle_core::bail!("{}: the result was taken before", self.name) };
        let (storage, layout) = result.storage_and_layout();
        Ok((f(&storage, layout)?, layout.shape().clone()))
    }
}

impl<F: Fn(&Tensor) -> Result<Gradients>> CustomOp3 for Known<F> {
    fn name(&self) -> &'static str {
        self.name
    }

    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
    ) -> CandleResult<(CpuStorage, Shape)> {
        self.with(|storage, layout| match storage {
            Storage::Cpu(storage) => storage.try_clone(layout),
            _ => candle_core::bail!("{}: inputs on the CPU, the result elsewhere", self.name),
        })
    }

    fn cuda_fwd(
        &self,
        _: &CudaStorage,
        _: &Layout,
        _: &CudaStorage,
        _: &Layout,
        _: &CudaStorage,
        _: &Layout,
    ) -> CandleResult<(CudaStorage, Shape)> {
        self.with(|storage, layout| match storage {
            Storage::Cuda(storage) => storage.try_clone(layout),
            _ => candle_core::bail!("{}: inputs on a GPU, the result elsewhere", self.name),
        })
    }

    fn bwd(
        &self,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
        grad: &Tensor,
    ) -> CandleResult<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        (self.gradient)(grad).map(<(_, _, _)>::from).map_err(candle_core::Error::wrap)
    }
}

/// Whether a gradient of it is asked for: what is on no graph is its own detached self.
fn is_tracked(x: &Tensor) -> bool {
    x.detach().id() != x.id()
}

/// `result`, computed without a graph, as a function of up to three inputs with this gradient.
fn known(
    name: &'static str,
    inputs: &[&Tensor],
    result: Tensor,
    gradient: impl Fn(&Tensor) -> Result<Gradients> + Send + Sync + 'static,
) -> Result<Tensor> {
    if !inputs.iter().any(|input| is_tracked(input)) {
        return Ok(result);
    }
    let one = inputs[0];
    // a place that no input has is held by one without a gradient
    let [two, three] = [1, 2].map(|at| inputs.get(at).map_or_else(|| one.detach(), |input| (*input).clone()));
    // the operation copies a storage from its beginning
    let result = match result.is_contiguous() && result.layout().start_offset() == 0 {
        true => result,
        false => result.force_contiguous()?,
    };
    let result = Mutex::new(Some(result));
    Ok(one.apply_op3(&two, &three, Known { name, result, gradient })?)
}

/// `max(x, 0)`, whose gradient at 0 is 0
pub(crate) fn relu(x: &Tensor) -> Result<Tensor> {
    let y = x.detach().relu()?;
    let kept = y.clone();
    known("relu", &[x], y, move |grad| Ok([Some(grad.mul(&kept.gt(0.0)?.to_dtype(DType::F32)?)?), None, None]))
}

/// x times a mask without a gradient.
pub(crate) fn masked(x: &Tensor, mask: Tensor) -> Result<Tensor> {
    let y = x.detach().mul(&mask)?;
    known("mask", &[x], y, move |grad| Ok([Some(grad.mul(&mask)?), None, None]))
}

/// `x * scale + shift`, neither of which has a gradient.
pub(crate) fn affine(x: &Tensor, scale: Tensor, shift: &Tensor) -> Result<Tensor> {
    let y = x.detach().broadcast_mul(&scale)?.broadcast_add(shift)?;
    known("affine", &[x], y, move |grad| Ok([Some(grad.broadcast_mul(&scale)?), None, None]))
}

/// The largest of 3 x 3 numbers that are not negative, in steps of 2, with a frame of zeros: (b, h, w, C) -> (b, h / 2, w / 2, C).
/// The first of several equal ones gets the gradient.
pub(crate) fn max_pool(x: &Tensor) -> Result<Tensor> {
    let (b, h, w, c) = x.dims4()?;
    let (down, right) = (h.div_ceil(2), w.div_ceil(2));
    let framed = x.detach().pad_with_zeros(1, 1, 2 * down + 1 - h)?.pad_with_zeros(2, 1, 2 * right + 1 - w)?;
    // even and odd rows and columns: what windows see at one place lies side by side there
    let framed = framed.contiguous()?.reshape((b, down + 1, 2, right + 1, 2 * c))?;
    let parts: Vec<Tensor> = (0..4)
        .map(|at| framed.narrow(2, at / 2, 1)?.squeeze(2)?.narrow(3, at % 2 * c, c)?.contiguous())
        .collect::<candle_core::Result<_>>()?;
    // which part a tap is in, and from where
    let taps = (0..9).map(|tap| (tap / 3, tap % 3)).map(|(dy, dx)| (dy % 2 * 2 + dx % 2, dy / 2, dx / 2));
    let seen: Vec<_> = taps
        .map(|(part, y, x)| Ok((part, y, x, parts[part].narrow(1, y, down)?.narrow(2, x, right)?.contiguous()?)))
        .collect::<Result<_>>()?;
    let mut best = seen[0].3.clone();
    for (.., tap) in &seen[1..] {
        best = best.maximum(tap)?;
    }
    let kept = best.clone();
    known("max pool", &[x], best, move |grad| {
        // what is zero passes no gradient on
        let mut open = kept.gt(0.0)?.to_dtype(DType::F32)?;
        let mut of_parts = vec![Tensor::zeros((b, down + 1, right + 1, c), DType::F32, grad.device())?; 4];
        for (part, y, x, tap) in &seen {
            let hit = tap.eq(&kept)?.to_dtype(DType::F32)?.mul(&open)?;
            open = (&open - &hit)?;
            let of = grad.mul(&hit)?.pad_with_zeros(1, *y, 1 - y)?.pad_with_zeros(2, *x, 1 - x)?;
            of_parts[*part] = (&of_parts[*part] + of)?;
        }
        let row = |at: usize| Tensor::stack(&of_parts[at..at + 2], 3);
        let all = Tensor::stack(&[row(0)?, row(2)?], 2)?.reshape((b, 2 * down + 2, 2 * right + 2, c))?;
        Ok([Some(all.narrow(1, 1, h)?.narrow(2, 1, w)?.contiguous()?), None, None])
    })
}

/// x: (…, in), weight: (out, in), bias: (out) -> (…, out)
pub(crate) fn linear(x: &Tensor, weight: &Tensor, bias: Option<&Tensor>, precision: Precision) -> Result<Tensor> {
    let mut shape = x.dims().to_vec();
    let (output, input) = weight.dims2()?;
    let rows = x.elem_count() / input.max(1);
    if let Some(last) = shape.last_mut() {
        *last = output;
    }
    let (asked, given) = (is_tracked(x), x.dims().to_vec());
    let seen = precision.cast(&x.detach().reshape((rows, input))?)?;
    let kept = precision.cast(&weight.detach())?;
    let y = seen.matmul(&kept.t()?)?.to_dtype(DType::F32)?;
    let y = bias.map_or(Ok(y.clone()), |bias| y.broadcast_add(&bias.detach()))?;
    let has_bias = bias.is_some();
    let inputs: Vec<&Tensor> = [x, weight].into_iter().chain(bias).collect();
    known("linear", &inputs, y.reshape(shape)?, move |grad| {
        let grad = grad.reshape((rows, output))?;
        let of_bias = if has_bias { Some(grad.sum(0)?) } else { None };
        let grad = precision.cast(&grad)?;
        let of_x = match asked {
            true => Some(grad.matmul(&kept)?.to_dtype(DType::F32)?.reshape(given.as_slice())?),
            false => None,
        };
        Ok([of_x, Some(grad.t()?.matmul(&seen)?.to_dtype(DType::F32)?), of_bias])
    })
}

/// What attention among heads needs to know beside its inputs.
pub(crate) struct Among<'a> {
    pub heads: usize,
    pub batch: usize,
    /// added to the scores, such as (1, 1, n, m)
    pub bias: Option<Tensor>,
    /// (b, m), 1 where a key is not there
    pub key_pad: Option<&'a Tensor>,
    /// of the shares, (b, heads, n, m)
    pub dropout: Option<Tensor>,
}

/// q: (b or 1, n, D), kv: (b or 1, m, 2D) -> (b, n, D)
pub(crate) fn attention(q: &Tensor, kv: &Tensor, among: Among<'_>, precision: Precision) -> Result<Tensor> {
    let ((q_batch, queries, dim), (kv_batch, keys, _)) = (q.dims3()?, kv.dims3()?);
    let Among { heads, batch, bias, key_pad, dropout } = among;
    let size = dim / heads;
    let split = move |x: &Tensor, n: usize| -> Result<Tensor> {
        let x = x.reshape((x.dim(0)?, n, heads, size))?.transpose(1, 2)?;
        precision.cast(&x.broadcast_as((batch, heads, n, size))?.contiguous()?)
    };
    // (b, heads, n, d) -> (b or 1, n, D)
    let merge = move |x: &Tensor, n: usize, given: usize| -> Result<Tensor> {
        let x = x.to_dtype(DType::F32)?.transpose(1, 2)?.reshape((batch, n, dim))?;
        Ok(if given == batch { x } else { x.sum_keepdim(0)? })
    };
    let (seen, told) = (q.detach(), kv.detach());
    let part = |at: usize| Ok::<_, ModelError>(told.narrow(D::Minus1, at * dim, dim)?.contiguous()?);
    let (q4, k4, v4) = (split(&seen, queries)?, split(&part(0)?, keys)?, split(&part(1)?, keys)?);
    let scale = 1.0 / (size as f64).sqrt();
    let mut scores = (q4.matmul(&k4.transpose(2, 3)?)?.to_dtype(DType::F32)? * scale)?;
    if let Some(bias) = bias {
        scores = scores.broadcast_add(&bias)?;
    }
    let shares = crate::layers::masked_softmax(&scores, key_pad)?;
    let mixing = dropout.as_ref().map_or(Ok(shares.clone()), |mask| shares.mul(mask))?;
    let mixing = precision.cast(&mixing)?;
    let y = merge(&mixing.matmul(&v4)?, queries, batch)?;
    known("attention", &[q, kv], y, move |grad| {
        let grad = split(grad, queries)?;
        let of_v = mixing.transpose(2, 3)?.matmul(&grad)?;
        let of_shares = grad.matmul(&v4.transpose(2, 3)?)?.to_dtype(DType::F32)?;
        let of_shares = dropout.as_ref().map_or(Ok(of_shares.clone()), |mask| of_shares.mul(mask))?;
        let weighted = of_shares.mul(&shares)?;
        let of_scores = (&weighted - shares.broadcast_mul(&weighted.sum_keepdim(D::Minus1)?)?)?;
        let of_scores = precision.cast(&(of_scores * scale)?)?;
        let of_q = merge(&of_scores.matmul(&k4)?, queries, q_batch)?;
        let of_k = merge(&of_scores.transpose(2, 3)?.matmul(&q4)?, keys, kv_batch)?;
        let of_kv = Tensor::cat(&[of_k, merge(&of_v, keys, kv_batch)?], D::Minus1)?;
        Ok([Some(of_q), Some(of_kv), None])
    })
}

/// Softmax over the last dimension.
pub(crate) fn softmax(x: &Tensor) -> Result<Tensor> {
    let shares = candle_nn::ops::softmax_last_dim(&x.detach().contiguous()?)?;
    let kept = shares.clone();
    known("softmax", &[x], shares, move |grad| {
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
    let result = normed.broadcast_mul(&scale)?.broadcast_add(&bias.detach())?;
    known("layer norm", &[x, weight, bias], result, move |grad| {
        let of_bias = grad.flatten_to(normed.rank() - 2)?.sum(0)?;
        let of_weight = grad.mul(&normed)?.flatten_to(normed.rank() - 2)?.sum(0)?;
        let grad = grad.broadcast_mul(&scale)?;
        let along = normed.broadcast_mul(&grad.mul(&normed)?.mean_keepdim(D::Minus1)?)?;
        let of_x = grad.broadcast_sub(&grad.mean_keepdim(D::Minus1)?)?;
        Ok([Some((of_x - along)?.broadcast_div(&spread)?), Some(of_weight), Some(of_bias)])
    })
}

/// x: (b, H, W, C), framed with what the kernel reaches beyond the image; weight: (C', C, k, k) -> (b, h, w, C') with
/// H = (h - 1) stride + k
pub(crate) fn conv2d(x: &Tensor, weight: &Tensor, stride: usize, precision: Precision) -> Result<Tensor> {
    let (values, kernel) = (precision.cast(&x.detach())?, precision.cast(&weight.detach())?);
    let result = convolved(&values, &kernel, stride, precision)?;
    let asked = is_tracked(x);
    known("convolution", &[x, weight], result, move |grad| {
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
        let y = x.permute((0, 3, 1, 2))?.contiguous()?.conv2d(&kernel.contiguous()?, 0, stride, 1, 1)?;
        return Ok(y.permute((0, 2, 3, 1))?.to_dtype(DType::F32)?);
    }
    let (b, height, width, _) = x.dims4()?;
    let taps = kernel.permute((2, 3, 1, 0))?.contiguous()?.flatten_to(2)?;
    let y = patches(x, k, stride)?.matmul(&taps)?;
    Ok(y.reshape((b, (height - k) / stride + 1, (width - k) / stride + 1, output))?)
}

/// What the kernel sees at every place: (b h w, k k C)
fn patches(x: &Tensor, k: usize, stride: usize) -> Result<Tensor> {
    let (b, height, width, channels) = x.dims4()?;
    let x = x.contiguous()?.reshape((b, height * width, channels))?;
    if (k, stride) == (1, 1) {
        return Ok(x.flatten_to(1)?);
    }
    // where every tap of every place is in an image: one part for its row, one for its column
    let part = |size: usize, step: usize| -> Result<(Tensor, usize)> {
        let count = (size - k) / stride + 1;
        let places = (0..count).flat_map(|at| (0..k).map(move |tap| ((at * stride + tap) * step) as u32));
        Ok((Tensor::from_iter(places, x.device())?, count))
    };
    let ((rows, h), (columns, w)) = (part(height, width)?, part(width, 1)?);
    let places = rows.reshape((h, 1, k, 1))?.broadcast_add(&columns.reshape((1, w, 1, k))?)?;
    Ok(x.index_select(&places.flatten_all()?, 1)?.reshape((b * h * w, k * k * channels))?)
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
    let grad = grad.contiguous()?.flatten_to(2)?.t()?;
    let of = grad.matmul(&patches(x, k, stride)?)?.reshape((output, k, k, input))?;
    Ok(of.permute((0, 3, 1, 2))?.contiguous()?.to_dtype(DType::F32)?)
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
