//! Convolutions of a pass: weights in panels, gradients into their buffers.

use super::{Grads, Pass, slot};
use nn::kernels::{Conv, Frame, Winograd};

/// A frame with its border of zeros.
pub(crate) fn framed(pass: &mut Pass<'_>, frame: &Frame) -> Vec<f32> {
    let mut x = pass.take(frame.buffer_len());
    frame.clear_border(&mut x);
    x
}

/// Calls `run` with panels of a weight; predictions make them once. `kind` says which, the panels' width among it.
fn with_panels(
    pass: &mut Pass<'_>,
    (len, kind): (usize, &dyn Fn() -> String),
    make: impl Fn(&mut [f32]),
    run: impl FnOnce(&[f32]),
) {
    match pass.packed {
        Some(packed) => {
            let panels = packed.made_once(&kind(), || {
                let mut panels = vec![0.0; len];
                make(&mut panels);
                panels
            });
            run(&panels);
        }
        None => {
            let mut panels = pass.take(len);
            make(&mut panels);
            run(&panels);
            pass.give(panels);
        }
    }
}

/// The convolution in tiles, where that is fewer products. Predictions stay with the plain sum: what an entry does may not
/// depend on how many pictures it is asked about at once.
fn in_tiles(pass: &Pass<'_>, conv: &Conv) -> Option<Winograd> {
    if pass.packed.is_some() { None } else { Winograd::of(conv) }
}

/// x: the convolution's input in its frame -> y: (pixels, O); with `add` added to what is there.
pub(crate) fn convolve(pass: &mut Pass<'_>, name: &str, conv: &Conv, x: &[f32], add: bool, y: &mut [f32]) {
    let weight = pass.weight(name, ".weight");
    if let Some(tiles) = in_tiles(pass, conv) {
        let (mut panels, mut scratch) = (pass.take(tiles.panel_len().0), pass.take(tiles.scratch()));
        tiles.pack(weight, &mut panels);
        tiles.forward(x, &panels, add, y, &mut scratch);
        pass.give(panels);
        return pass.give(scratch);
    }
    // panels are as wide as the vectors of the instruction set that reads them
    let kind = || format!("{name} in panels of {}", conv.panel_widths().0);
    let run = |panels: &[f32]| conv.forward(x, panels, add, y);
    with_panels(pass, (conv.panel_len().0, &kind), |panels| conv.pack(weight, panels), run);
}

/// grad: that of the output, in a frame of the convolution's `grad_border` -> that of the input, (pixels, I). The way
/// forward of a transposed convolution.
pub(crate) fn input_gradient(pass: &mut Pass<'_>, name: &str, conv: &Conv, grad: &[f32], add: bool, out: &mut [f32]) {
    let weight = pass.weight(name, ".weight");
    if let Some(tiles) = in_tiles(pass, conv) {
        let (mut panels, mut scratch) = (pass.take(tiles.panel_len().1), pass.take(tiles.scratch()));
        tiles.pack_backward(weight, &mut panels);
        tiles.backward(grad, &panels, add, out, &mut scratch);
        pass.give(panels);
        return pass.give(scratch);
    }
    let kind = || format!("{name} backwards in panels of {}", conv.panel_widths().1);
    let run = |panels: &[f32]| conv.backward(grad, panels, add, out);
    with_panels(pass, (conv.panel_len().1, &kind), |panels| conv.pack_backward(weight, panels), run);
}

/// Adds the gradient of the weight.
pub(crate) fn weight_gradient(
    pass: &mut Pass<'_>,
    name: &str,
    conv: &Conv,
    x: &[f32],
    grad: &[f32],
    grads: &mut Grads<'_>,
) {
    if let Some(tiles) = in_tiles(pass, conv) {
        let (mut points, mut scratch) = (pass.take(tiles.weights()), pass.take(tiles.scratch()));
        let into = slot(grads, name, ".weight");
        tiles.weight_gradient((x, grad), into, &mut points, &mut scratch, &mut pass.space.pack);
        pass.give(points);
        return pass.give(scratch);
    }
    let mut turned = pass.take(conv.weights());
    conv.weight_gradient(x, grad, &mut turned, slot(grads, name, ".weight"), &mut pass.space.pack);
    pass.give(turned);
}
