//! Convolutions of images, (n, h, w, C): rows after rows, as they come. Frames of zeros and panels are the operations' own.

use crate::composed;
use crate::context::{Context, read};
use crate::error::{ModelError, Result};
use crate::kernels::{
    Conv, Frame, Pool, Winograd, add, exp, group_norm, group_norm_backward, max_pool as max_pool_on, max_pool_backward,
    relu_backward, scale_backward, scale_relu,
};
use crate::layers::{CONV_NORM_EPS, cell_places};
use crate::tape::Backward;
use crate::value::Value;
use candle_core::Tensor;
use std::sync::Arc;

/// What follows a convolution.
#[derive(Debug, Clone)]
pub enum ConvNorm {
    /// GroupNorm
    Group {
        /// (C)
        weight: Tensor,
        /// (C)
        bias: Tensor,
        /// groups of channels
        groups: usize,
    },
    /// batch norm with fixed statistics
    Frozen {
        /// (C)
        weight: Tensor,
        /// (C)
        bias: Tensor,
        /// (C)
        mean: Tensor,
        /// (C)
        variance: Tensor,
    },
}

impl ConvNorm {
    /// What it multiplies and adds.
    fn scale_and_shift(&self) -> Result<[Vec<f32>; 2]> {
        match self {
            Self::Group { weight, bias, .. } => read("norm", [weight, bias], |values| Ok(values.map(<[f32]>::to_vec))),
            Self::Frozen { weight, bias, mean, variance } => {
                read("norm", [weight, bias, mean, variance], |[weight, bias, mean, variance]| {
                    let (mut scale, mut shift) = (weight.to_vec(), bias.to_vec());
                    for (((scale, shift), mean), variance) in scale.iter_mut().zip(&mut shift).zip(mean).zip(variance) {
                        *scale /= (variance + CONV_NORM_EPS as f32).sqrt();
                        *shift -= mean * *scale;
                    }
                    Ok([scale, shift])
                })
            }
        }
    }
}

/// x in a frame with its border of zeros.
pub(super) fn framed(x: &[f32], frame: &Frame, pool: &mut Pool) -> Vec<f32> {
    let mut out = pool.take(frame.buffer_len());
    frame.clear_border(&mut out);
    let line = frame.width * frame.channels;
    for (r, row) in x.chunks_exact(line).enumerate() {
        let at = frame.at(r / frame.height, r % frame.height);
        out[at..at + line].copy_from_slice(row);
    }
    out
}

/// Calls `run` with panels of a weight; predictions make them once, under a name.
pub(super) fn with_panels(
    cx: &mut Context<'_>,
    (len, name): (usize, &dyn Fn() -> String),
    pack: impl FnOnce(&mut [f32]),
    run: impl FnOnce(&[f32]),
) -> Result<()> {
    if cx.is_prepared() {
        let make = |_: &mut Context<'_>| {
            let mut panels = vec![0.0; len];
            pack(&mut panels);
            Ok(Arc::new(panels))
        };
        run(cx.fixed(name, make)?.as_slice());
        return Ok(());
    }
    let mut panels = cx.space.pool.take(len);
    pack(&mut panels);
    run(&panels);
    cx.space.pool.give(panels);
    Ok(())
}

/// The convolution in tiles, where that is fewer products; with `add` added to what is there. Predictions stay with the plain
/// sum: what an entry does may not depend on how many images it is asked about at once.
pub(super) fn forward(cx: &mut Context<'_>, conv: &Conv, w: &[f32], x: &[f32], add: bool, y: &mut [f32]) -> Result<()> {
    if let Some(tiles) = Winograd::of(conv).filter(|_| !cx.is_prepared()) {
        let pool = &mut cx.space.pool;
        let (mut panels, mut scratch) = (pool.take(tiles.panel_len().0), pool.take(tiles.scratch()));
        tiles.pack(w, &mut panels);
        tiles.forward(x, &panels, add, y, &mut scratch);
        [panels, scratch].into_iter().for_each(|buffer| pool.give(buffer));
        return Ok(());
    }
    // panels are as wide as the vectors of the instruction set that reads them
    let name = || format!("{} in panels of {}", w.as_ptr().addr(), conv.panel_widths().0);
    let run = |panels: &[f32]| conv.forward(x, panels, add, y);
    with_panels(cx, (conv.panel_len().0, &name), |panels| conv.pack(w, panels), run)
}

fn input_gradient(back: &mut Backward<'_>, conv: &Conv, w: &[f32], grad: &[f32], add: bool, out: &mut [f32]) {
    let pool = &mut back.space.pool;
    if let Some(tiles) = Winograd::of(conv) {
        let (mut panels, mut scratch) = (pool.take(tiles.panel_len().1), pool.take(tiles.scratch()));
        tiles.pack_backward(w, &mut panels);
        tiles.backward(grad, &panels, add, out, &mut scratch);
        [panels, scratch].into_iter().for_each(|buffer| pool.give(buffer));
        return;
    }
    let mut panels = pool.take(conv.panel_len().1);
    conv.pack_backward(w, &mut panels);
    conv.backward(grad, &panels, add, out);
    pool.give(panels);
}

pub(super) fn weight_gradient(back: &mut Backward<'_>, conv: &Conv, weight: &Tensor, x: &[f32], grad: &[f32]) {
    let pool = &mut back.space.pool;
    let (tiles, mut scratch) = match Winograd::of(conv) {
        Some(tiles) => (Some((tiles, pool.take(tiles.weights()))), pool.take(tiles.scratch())),
        None => (None, pool.take(conv.weights())),
    };
    if let Some((into, space)) = back.parameter(weight) {
        match tiles {
            Some((tiles, mut points)) => {
                tiles.weight_gradient((x, grad), into, &mut points, &mut scratch, &mut space.pack);
                space.pool.give(points);
            }
            None => conv.weight_gradient(x, grad, &mut scratch, into, &mut space.pack),
        }
    }
    back.space.pool.give(scratch);
}

/// Adds the gradients of a convolution's weight and of what it read. grad: that of its output, in a frame of `grad_border`
pub(super) fn backward(
    back: &mut Backward<'_>,
    conv: &Conv,
    weight: &Tensor,
    (x, node): (&Tensor, Option<usize>),
    grad: &[f32],
) -> Result<()> {
    read("convolution", [x, weight], |[x, w]| {
        let framed = framed(x, &conv.input, &mut back.space.pool);
        weight_gradient(back, conv, weight, &framed, grad);
        back.space.pool.give(framed);
        if node.is_some() {
            let (mut of, sum) = match back.take(node) {
                Some(sum) => (sum, true),
                None => (back.space.pool.take(x.len()), false),
            };
            input_gradient(back, conv, w, grad, sum, &mut of);
            back.add(node, of);
        }
        Ok(())
    })
}

/// `norm(conv(x)) + shortcut`, then ReLU unless it is not wanted; padding is half the kernel. x: (n, h, w, C), weight:
/// (C', C, k, k) -> (n, h / stride, w / stride, C')
///
/// # Errors
/// Shapes that do not go together.
pub fn conv2d(
    cx: &mut Context<'_>,
    x: &Value,
    (weight, stride): (&Tensor, usize),
    norm: &ConvNorm,
    shortcut: Option<&Value>,
    relu: bool,
) -> Result<Value> {
    let [n, h, w, c] = super::sizes("convolution", &x.tensor)?;
    let (output, _, k, _) = weight.dims4()?;
    super::check_shape("convolution", "weight", weight, &[output, c, k, k])?;
    if let Some(shortcut) = shortcut {
        if !relu {
            let (found, expected) = ("without ReLU".to_string(), "with it".to_string());
            return Err(ModelError::Input { operation: "convolution", object: "shortcut", found, expected });
        }
        let made = [n, h.div_ceil(stride), w.div_ceil(stride), output];
        super::check_shape("convolution", "shortcut", &shortcut.tensor, &made)?;
    }
    let tensors = [&x.tensor, weight].into_iter().chain(shortcut.map(|shortcut| &shortcut.tensor));
    if cx.composed("convolution", tensors)? {
        let y = crate::layers::conv2d_composed(&x.tensor, weight, stride, cx.precision())?;
        let y = norm.composed(&y)?;
        let y = shortcut.map_or(Ok(y.clone()), |shortcut| &y + &shortcut.tensor)?;
        return Ok(Value::constant(if relu { composed::relu(&y)? } else { y }.contiguous()?));
    }
    let input = Frame { images: n, height: h, width: w, channels: c, border: (k / 2, k / 2) };
    let conv = Conv { input, output, kernel: (k, k), stride: (stride, stride) };
    let made = conv.made((0, 0));
    let shape = [made.images, made.height, made.width, made.channels];
    let mut y = cx.space.pool.take(made.inside());
    read("convolution", [&x.tensor, weight], |[x, w]| {
        let framed = framed(x, &conv.input, &mut cx.space.pool);
        forward(cx, &conv, w, &framed, false, &mut y)?;
        cx.space.pool.give(framed);
        Ok(())
    })?;
    let mut inverse = Vec::new();
    if let ConvNorm::Group { groups, .. } = norm {
        inverse = cx.space.pool.take(made.images * groups);
        group_norm(&mut y, &made, *groups, &mut inverse);
    }
    let [scale, shift] = norm.scale_and_shift()?;
    let mut out = vec![0.0; made.inside()];
    if relu {
        match shortcut {
            Some(shortcut) => read("convolution", [&shortcut.tensor], |[x]| {
                scale_relu(&y, &scale, &shift, Some(x), &made, &mut out);
                Ok(())
            })?,
            None => scale_relu(&y, &scale, &shift, None, &made, &mut out),
        }
    } else {
        for (out, y) in out.chunks_exact_mut(output).zip(y.chunks_exact(output)) {
            for (((out, y), scale), shift) in out.iter_mut().zip(y).zip(&scale).zip(&shift) {
                *out = y * scale + shift;
            }
        }
    }
    // a frozen norm passes its gradient on without the values
    if !cx.records() || matches!(norm, ConvNorm::Frozen { .. }) {
        [std::mem::take(&mut y), std::mem::take(&mut inverse)].into_iter().for_each(|b| cx.space.pool.give(b));
    }
    if !cx.records() {
        return cx.result(out, &shape, false, |_, _| Ok(()));
    }
    let result = Tensor::from_vec(out, &shape, cx.device())?;
    let (of_x, of_shortcut, kept) = (x.node, shortcut.and_then(|shortcut| shortcut.node), result.clone());
    let (x, weight, norm) = (x.tensor.clone(), weight.clone(), norm.clone());
    cx.result_of(result, true, move |mut grad, back| {
        if relu {
            read("convolution", [&kept], |[out]| {
                relu_backward(&mut grad, &made, out);
                Ok(())
            })?;
        }
        let frame = conv.made(conv.grad_border());
        let [scale, _] = norm.scale_and_shift()?;
        let mut before = back.space.pool.take(frame.buffer_len());
        frame.clear_border(&mut before);
        match &norm {
            ConvNorm::Group { weight, bias, .. } => {
                let (mut to_weight, mut to_bias) = (back.space.pool.zeros(output), back.space.pool.zeros(output));
                group_norm_backward(&grad, &y, &inverse, &scale, &frame, &mut to_weight, &mut to_bias, &mut before);
                for (parameter, grad) in [(weight, to_weight), (bias, to_bias)] {
                    if let Some((into, _)) = back.parameter(parameter) {
                        add(into, &grad);
                    }
                    back.space.pool.give(grad);
                }
            }
            ConvNorm::Frozen { .. } => scale_backward(&grad, &scale, &frame, &mut before),
        }
        backward(back, &conv, &weight, (&x, of_x), &before)?;
        [y, inverse, before].into_iter().for_each(|buffer| back.space.pool.give(buffer));
        back.add(of_shortcut, grad);
        Ok(())
    })
}

/// The maximum over windows of 3x3, stride 2, padding 1, of numbers that are not negative.
///
/// # Errors
/// Something that is no batch of images.
pub fn max_pool(cx: &mut Context<'_>, x: &Value) -> Result<Value> {
    let [n, h, w, c] = super::sizes("max pool", &x.tensor)?;
    if cx.composed("max pool", [&x.tensor])? {
        return Ok(Value::constant(composed::max_pool(&x.tensor)?));
    }
    let from = Frame { images: n, height: h, width: w, channels: c, border: (1, 1) };
    let to = Frame { height: h.div_ceil(2), width: w.div_ceil(2), border: (0, 0), ..from };
    let (mut out, mut winner) = (vec![0.0; to.inside()], cx.space.pool.take(to.inside()));
    read("max pool", [&x.tensor], |[x]| {
        let framed = framed(x, &from, &mut cx.space.pool);
        max_pool_on(&framed, &from, &to, &mut out, &mut winner);
        cx.space.pool.give(framed);
        Ok(())
    })?;
    let result = Tensor::from_vec(out, &[n, to.height, to.width, c][..], cx.device())?;
    if !cx.records() {
        cx.space.pool.give(winner);
        return cx.result_of(result, false, |_, _| Ok(()));
    }
    let (node, kept) = (x.node, result.clone());
    cx.result_of(result, node.is_some(), move |mut grad, back| {
        // what is zero passes no gradient on
        read("max pool", [&kept], |[out]| {
            relu_backward(&mut grad, &to, out);
            Ok(())
        })?;
        let from = Frame { border: (0, 0), ..from };
        let mut of = back.space.pool.zeros(from.inside());
        max_pool_backward(&grad, &winner, &from, &to, &mut of);
        [winner, grad].into_iter().for_each(|buffer| back.space.pool.give(buffer));
        back.add(node, of);
        Ok(())
    })
}

/// Expected positions under a softmax over the cells of a map, one a keypoint: scores: (n, h*w, K) -> x and y of every keypoint
/// in turn, (n, 2 K)
///
/// # Errors
/// Another number of cells.
pub fn spatial_softmax(cx: &mut Context<'_>, scores: &Value, (h, w): (usize, usize)) -> Result<Value> {
    let [n, cells, k] = super::sizes("spatial softmax", &scores.tensor)?;
    super::check_shape("spatial softmax", "scores", &scores.tensor, &[n, h * w, k])?;
    let places = cell_places((h, w));
    if cx.composed("spatial softmax", [&scores.tensor])? {
        let scores = scores.tensor.transpose(1, 2)?.contiguous()?;
        let shifted = scores.broadcast_sub(&scores.max_keepdim(2)?.detach())?.exp()?;
        let share = shifted.broadcast_div(&shifted.sum_keepdim(2)?)?;
        let places = Tensor::from_vec(places.concat(), (cells, 2), cx.device())?;
        let found = share.reshape((n * k, cells))?.matmul(&places)?;
        return Ok(Value::constant(found.reshape((n, 2 * k))?));
    }
    let mut shares = cx.space.pool.take(n * cells * k);
    let mut out = vec![0.0; n * 2 * k];
    read("spatial softmax", [&scores.tensor], |[scores]| {
        shares.copy_from_slice(scores);
        Ok(())
    })?;
    let (mut largest, mut sums) = (cx.space.pool.take(k), cx.space.pool.take(k));
    for (shares, found) in shares.chunks_exact_mut(cells * k).zip(out.chunks_exact_mut(2 * k)) {
        largest.fill(f32::NEG_INFINITY);
        for cell in shares.chunks_exact(k) {
            largest.iter_mut().zip(cell).for_each(|(largest, score)| *largest = largest.max(*score));
        }
        sums.fill(0.0);
        for cell in shares.chunks_exact_mut(k) {
            for ((share, largest), sum) in cell.iter_mut().zip(&largest).zip(&mut sums) {
                *share = exp(*share - largest);
                *sum += *share;
            }
        }
        for (cell, at) in shares.chunks_exact_mut(k).zip(&places) {
            for ((share, sum), found) in cell.iter_mut().zip(&sums).zip(found.chunks_exact_mut(2)) {
                *share /= sum;
                found[0] += *share * at[0];
                found[1] += *share * at[1];
            }
        }
    }
    [largest, sums].into_iter().for_each(|buffer| cx.space.pool.give(buffer));
    if !cx.records() {
        cx.space.pool.give(std::mem::take(&mut shares));
    }
    let node = scores.node;
    cx.result(out, &[n, 2 * k], node.is_some(), move |grad, back| {
        let mut of = back.space.pool.take(shares.len());
        let mut means = back.space.pool.take(k);
        let all = of.chunks_exact_mut(cells * k).zip(shares.chunks_exact(cells * k));
        for ((of, shares), grad) in all.zip(grad.chunks_exact(2 * k)) {
            means.fill(0.0);
            for ((of, shares), at) in of.chunks_exact_mut(k).zip(shares.chunks_exact(k)).zip(&places) {
                for (((of, share), grad), mean) in of.iter_mut().zip(shares).zip(grad.chunks_exact(2)).zip(&mut means) {
                    *of = at[0] * grad[0] + at[1] * grad[1];
                    *mean += *share * *of;
                }
            }
            for (of, shares) in of.chunks_exact_mut(k).zip(shares.chunks_exact(k)) {
                for ((of, share), mean) in of.iter_mut().zip(shares).zip(&means) {
                    *of = share * (*of - mean);
                }
            }
        }
        [means, shares, grad].into_iter().for_each(|buffer| back.space.pool.give(buffer));
        back.add(node, of);
        Ok(())
    })
}
