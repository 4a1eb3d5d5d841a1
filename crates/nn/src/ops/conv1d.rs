//! Convolutions over the steps of sequences, (b, T, C). For their kernels a sequence is an image of one row.

use super::conv2d::{backward, forward, framed, weight_gradient, with_panels};
use crate::context::{Context, read};
use crate::error::{ModelError, Result};
use crate::kernels::{
    After, Conv, Film, Frame, add, add_bias, column_sums, group_norm, group_norm_backward, norm_mish,
    norm_mish_backward,
};
use crate::layers::{Conv1d, GroupNorm, Upsample1d};
use crate::tape::Backward;
use crate::value::Value;

/// What follows the activation.
#[derive(Debug, Clone, Copy)]
pub enum Then<'a> {
    /// nothing
    Nothing,
    /// channels of every sequence scaled and shifted, (b, 2C), scales before shifts; or only shifted, (b, C)
    Film(&'a Value),
    /// (b, T, C), added
    Add(&'a Value),
}

fn along((images, width, channels): (usize, usize, usize), output: usize, kernel: usize, stride: usize) -> Conv {
    let input = Frame { images, height: 1, width, channels, border: (0, (kernel - 1) / 2) };
    Conv { input, output, kernel: (1, kernel), stride: (1, stride) }
}

fn convolution(x: &Value, layer: &Conv1d) -> Result<Conv> {
    let [n, steps, channels] = super::sizes("convolution", &x.tensor)?;
    let (output, input, kernel) = layer.weight.dims3()?;
    super::check_width("convolution", x, input)?;
    Ok(along((n, steps, channels), output, kernel, layer.stride))
}

/// The convolution with its bias into `y`: (b, T / stride, C').
fn with_bias(cx: &mut Context<'_>, conv: &Conv, layer: &Conv1d, x: &Value, y: &mut [f32]) -> Result<()> {
    read("convolution", [&x.tensor, &layer.weight, &layer.bias], |[x, w, bias]| {
        add_bias(y, bias);
        let framed = framed(x, &conv.input, &mut cx.space.pool);
        forward(cx, conv, w, &framed, true, y)?;
        cx.space.pool.give(framed);
        Ok(())
    })
}

/// Adds the sums of a gradient's rows to that of a bias.
fn of_bias(back: &mut Backward<'_>, layer: &Conv1d, rows: &[f32]) {
    if let Some((into, _)) = back.parameter(&layer.bias) {
        column_sums(into, rows);
    }
}

/// A convolution with its bias: (b, T, C) -> (b, T / stride, C')
///
/// # Errors
/// An input of another width.
pub fn conv1d(cx: &mut Context<'_>, x: &Value, layer: &Conv1d) -> Result<Value> {
    let conv = convolution(x, layer)?;
    if cx.composed("convolution", [&x.tensor, &layer.weight, &layer.bias])? {
        return Ok(Value::constant(layer.forward(&x.tensor, cx.precision())?));
    }
    let made = conv.made((0, 0));
    let mut y = vec![0.0; made.inside()];
    with_bias(cx, &conv, layer, x, &mut y)?;
    let (x, layer, node) = (x.tensor.clone(), layer.clone(), x.node);
    cx.result(y, &[made.images, made.width, made.channels], true, move |grad, back| {
        of_bias(back, &layer, &grad);
        let framed = framed(&grad, &conv.made(conv.grad_border()), &mut back.space.pool);
        backward(back, &conv, &layer.weight, (&x, node), &framed)?;
        [framed, grad].into_iter().for_each(|buffer| back.space.pool.give(buffer));
        Ok(())
    })
}

/// `mish(norm(conv(x)))`, then what follows: (b, T, C) -> (b, T / stride, C')
///
/// # Errors
/// Shapes that do not go together.
pub fn conv1d_mish(
    cx: &mut Context<'_>,
    x: &Value,
    (layer, norm): (&Conv1d, &GroupNorm),
    then: Then<'_>,
) -> Result<Value> {
    let conv = convolution(x, layer)?;
    let (made, output) = (conv.made((0, 0)), conv.output);
    let shape = [made.images, made.width, output];
    super::check_shape("convolution", "norm", &norm.weight, &[output])?;
    let scales = match then {
        Then::Film(film) if film.dims() == [shape[0], 2 * output] => true,
        Then::Film(film) => {
            super::check_shape("convolution", "film", &film.tensor, &[shape[0], output]).map(|()| false)?
        }
        Then::Add(x) => super::check_shape("convolution", "sum", &x.tensor, &shape).map(|()| false)?,
        Then::Nothing => false,
    };
    let other = match then {
        Then::Film(other) | Then::Add(other) => Some(&other.tensor),
        Then::Nothing => None,
    };
    if cx.composed("convolution", [&x.tensor, &layer.weight, &layer.bias].into_iter().chain(other))? {
        let y = crate::layers::mish(&norm.forward(&layer.forward(&x.tensor, cx.precision())?)?)?;
        return Ok(Value::constant(match then {
            Then::Nothing => y,
            Then::Film(film) if scales => {
                let film = film.tensor.unsqueeze(1)?;
                y.broadcast_mul(&film.narrow(2, 0, output)?)?.broadcast_add(&film.narrow(2, output, output)?)?
            }
            Then::Film(film) => y.broadcast_add(&film.tensor.unsqueeze(1)?)?,
            Then::Add(x) => (y + &x.tensor)?,
        }));
    }
    let (mut y, mut inverse) = (cx.space.pool.take(made.inside()), cx.space.pool.take(made.images * norm.groups));
    with_bias(cx, &conv, layer, x, &mut y)?;
    group_norm(&mut y, &made, norm.groups, &mut inverse);
    let mut out = vec![0.0; made.inside()];
    read("convolution", [&norm.weight, &norm.bias], |[w, b]| {
        let mut run = |after: After<'_>| {
            norm_mish(&y, (w, b), after, made.width, &mut out);
            Ok(())
        };
        match then {
            Then::Nothing => run(After::Nothing),
            Then::Film(film) => {
                read("convolution", [&film.tensor], |[values]| run(After::Film(Film { values, scales })))
            }
            Then::Add(x) => read("convolution", [&x.tensor], |[x]| run(After::Plain(x))),
        }
    })?;
    if !cx.records() {
        [y, inverse].into_iter().for_each(|buffer| cx.space.pool.give(buffer));
        return cx.result(out, &shape, false, |_, _| Ok(()));
    }
    let (of_x, x, layer, norm) = (x.node, x.tensor.clone(), layer.clone(), norm.clone());
    let film = if let Then::Film(film) = then { Some((film.node, film.tensor.clone())) } else { None };
    let added = if let Then::Add(x) = then { x.node } else { None };
    cx.result(out, &shape, true, move |mut grad, back| {
        let whole = added.map(|_| back.space.pool.copy(&grad));
        let frame = conv.made(conv.grad_border());
        let mut before = back.space.pool.take(frame.buffer_len());
        frame.clear_border(&mut before);
        let (mut to_weight, mut to_bias) = (back.space.pool.zeros(output), back.space.pool.zeros(output));
        read("convolution", [&norm.weight, &norm.bias], |[w, b]| {
            match &film {
                None => norm_mish_backward(&mut grad, &y, (w, b), None, made.width),
                Some((node, film)) => {
                    let mut of_film = back.space.pool.take(film.elem_count());
                    read("convolution", [film], |[values]| {
                        let film = Some((Film { values, scales }, &mut of_film[..]));
                        norm_mish_backward(&mut grad, &y, (w, b), film, made.width);
                        Ok(())
                    })?;
                    back.add(*node, of_film);
                }
            }
            group_norm_backward(&grad, &y, &inverse, w, &frame, &mut to_weight, &mut to_bias, &mut before);
            Ok(())
        })?;
        for (parameter, grad) in [(&norm.weight, to_weight), (&norm.bias, to_bias)] {
            if let Some((into, _)) = back.parameter(parameter) {
                add(into, &grad);
            }
            back.space.pool.give(grad);
        }
        of_bias(back, &layer, &before[..frame.images * frame.image()]);
        backward(back, &conv, &layer.weight, (&x, of_x), &before)?;
        [y, inverse, before, grad].into_iter().for_each(|buffer| back.space.pool.give(buffer));
        if let Some(whole) = whole {
            back.add(added, whole);
        }
        Ok(())
    })
}

/// Twice as many steps: (b, T, C) -> (b, 2T, C')
///
/// # Errors
/// An input of another width.
pub fn upsample1d(cx: &mut Context<'_>, x: &Value, layer: &Upsample1d) -> Result<Value> {
    let [n, steps, _] = super::sizes("upsample", &x.tensor)?;
    let (input, output, kernel) = layer.weight.dims3()?;
    super::check_width("upsample", x, input)?;
    if kernel != 4 {
        let (expected, found) = (vec![input, output, 4], layer.weight.dims().to_vec());
        return Err(ModelError::Shape { operation: "upsample", object: "weight", expected, found });
    }
    if cx.composed("upsample", [&x.tensor, &layer.weight, &layer.bias])? {
        return Ok(Value::constant(layer.forward(&x.tensor, cx.precision())?));
    }
    // the way back of a convolution that halves the steps
    let conv = along((n, 2 * steps, output), input, kernel, 2);
    let mut y = vec![0.0; conv.input.inside()];
    read("upsample", [&x.tensor, &layer.weight, &layer.bias], |[x, w, bias]| {
        add_bias(&mut y, bias);
        let framed = framed(x, &conv.made(conv.grad_border()), &mut cx.space.pool);
        let name = || format!("{} backwards in panels of {}", w.as_ptr().addr(), conv.panel_widths().1);
        let run = |panels: &[f32]| conv.backward(&framed, panels, true, &mut y);
        with_panels(cx, (conv.panel_len().1, &name), |panels| conv.pack_backward(w, panels), run)?;
        cx.space.pool.give(framed);
        Ok(())
    })?;
    let (x, layer, node) = (x.tensor.clone(), layer.clone(), x.node);
    cx.result(y, &[n, 2 * steps, output], true, move |grad, back| {
        if let Some((into, _)) = back.parameter(&layer.bias) {
            column_sums(into, &grad);
        }
        let wide = framed(&grad, &conv.input, &mut back.space.pool);
        read("upsample", [&x, &layer.weight], |[x, w]| {
            let framed = framed(x, &conv.made(conv.grad_border()), &mut back.space.pool);
            weight_gradient(back, &conv, &layer.weight, &wide, &framed);
            back.space.pool.give(framed);
            if node.is_some() {
                let (mut of, mut panels) = (back.space.pool.take(x.len()), back.space.pool.take(conv.panel_len().0));
                conv.pack(w, &mut panels);
                conv.forward(&wide, &panels, false, &mut of);
                back.space.pool.give(panels);
                back.add(node, of);
            }
            Ok(())
        })?;
        [wide, grad].into_iter().for_each(|buffer| back.space.pool.give(buffer));
        Ok(())
    })
}
