#![allow(clippy::unwrap_used)]
use super::super::winograd::Winograd;
use super::*;
use crate::rng::Rng;
use crate::simd::{Level, at_most};

/// What a convolution is by its definition, in f64: (n, h, w, c) and (O, I, k, k) -> (n, oh, ow, O).
fn naive(conv: &Conv, x: &[f32], w: &[f32]) -> Vec<f64> {
    let (f, made, k) = (conv.input, conv.made((0, 0)), conv.kernel);
    let mut out = vec![0.0; made.inside()];
    each(conv, |to, from, weight| out[to] += f64::from(x[from]) * f64::from(w[weight]));
    assert_eq!((f.channels * made.channels * k.0 * k.1, w.len()), (w.len(), conv.weights()));
    out
}

/// Calls `f(output, input, weight)` for every product of the definition.
fn each(conv: &Conv, mut f: impl FnMut(usize, usize, usize)) {
    let (x, made, k) = (conv.input, conv.made((0, 0)), conv.kernel);
    for n in 0..x.images {
        for oy in 0..made.height {
            for ox in 0..made.width {
                for (ky, kx) in (0..k.0 * k.1).map(|t| (t / k.1, t % k.1)) {
                    let (y, x0) = (oy * conv.stride.0 + ky, ox * conv.stride.1 + kx);
                    let pad = ((k.0 - 1) / 2, (k.1 - 1) / 2);
                    if y < pad.0 || x0 < pad.1 || y - pad.0 >= x.height || x0 - pad.1 >= x.width {
                        continue;
                    }
                    let pixel = (n * x.height + y - pad.0) * x.width + x0 - pad.1;
                    for o in 0..conv.output {
                        for i in 0..x.channels {
                            let to = ((n * made.height + oy) * made.width + ox) * conv.output + o;
                            f(to, pixel * x.channels + i, ((o * x.channels + i) * k.0 + ky) * k.1 + kx);
                        }
                    }
                }
            }
        }
    }
}

fn framed(frame: &Frame, values: &[f32]) -> Vec<f32> {
    let mut x = vec![f32::NAN; frame.buffer_len()];
    frame.clear_border(&mut x);
    let row = frame.width * frame.channels;
    for (r, line) in values.chunks_exact(row).enumerate() {
        let at = frame.at(r / frame.height, r % frame.height);
        x[at..at + row].copy_from_slice(line);
    }
    x
}

fn close(got: &[f32], want: &[f64], what: &str) {
    assert_eq!(got.len(), want.len(), "{what}");
    let scale = want.iter().fold(1e-3f64, |m, x| m.max(x.abs()));
    for (i, (g, w)) in got.iter().zip(want).enumerate() {
        assert!((f64::from(*g) - w).abs() < 1e-5 * scale, "{what} [{i}]: {g} {w}");
    }
}

/// Odd and even sizes, channels above and below a vector, images smaller than the kernel.
fn cases() -> Vec<Conv> {
    let mut all = Vec::new();
    for (images, height, width, channels, output, kernel, stride) in [
        (2, 9, 7, 3, 5, 7, 2),
        (1, 12, 12, 3, 16, 7, 2),
        (3, 5, 6, 4, 7, 3, 1),
        (2, 5, 6, 16, 16, 3, 1),
        (2, 6, 5, 16, 33, 3, 2),
        (1, 1, 1, 5, 4, 3, 2),
        (1, 2, 1, 17, 48, 3, 1),
        (2, 7, 4, 19, 9, 1, 2),
        (1, 3, 3, 8, 70, 1, 1),
        (1, 18, 17, 2, 40, 3, 2),
    ] {
        for border in [kernel / 2, 3] {
            let input = Frame { images, height, width, channels, border: (border, border) };
            all.push(Conv { input, output, kernel: (kernel, kernel), stride: (stride, stride) });
        }
    }
    // sequences: those of a UNet, one step alone, and the way back of an upsampling
    for (images, width, channels, output, kernel, stride) in [
        (3, 8, 7, 20, 5, 1),
        (1, 1, 16, 33, 5, 1),
        (2, 8, 17, 5, 3, 2),
        (1, 2, 4, 16, 3, 2),
        (2, 6, 9, 9, 4, 2),
        (4, 5, 6, 3, 1, 1),
    ] {
        for border in [(0, kernel / 2), (1, 2)] {
            let input = Frame { images, height: 1, width, channels, border };
            all.push(Conv { input, output, kernel: (1, kernel), stride: (1, stride) });
        }
    }
    all
}

#[test]
fn all_three_products_are_those_of_the_definition() {
    for conv in cases() {
        let what = format!("{conv:?}");
        let mut rng = Rng::new(1, "conv");
        let (x, w) = (rng.normals(conv.input.inside()), rng.normals(conv.weights()));
        let grad = rng.normals(conv.made((0, 0)).inside());
        let (mut dx, mut dw) = (vec![0f64; x.len()], vec![0f64; w.len()]);
        each(&conv, |to, from, weight| {
            dx[from] += f64::from(grad[to]) * f64::from(w[weight]);
            dw[weight] += f64::from(grad[to]) * f64::from(x[from]);
        });
        for level in Level::ALL {
            at_most(level, || {
                let frame = framed(&conv.input, &x);
                let mut panels = vec![f32::NAN; conv.panel_len().0];
                conv.pack(&w, &mut panels);
                let mut out = vec![f32::NAN; conv.made((0, 0)).inside()];
                conv.forward(&frame, &panels, false, &mut out);
                close(&out, &naive(&conv, &x, &w), &what);
                out.fill(3.0);
                conv.forward(&frame, &panels, true, &mut out);
                close(&out, &naive(&conv, &x, &w).iter().map(|x| x + 3.0).collect::<Vec<_>>(), &what);

                let g = framed(&conv.made(conv.grad_border()), &grad);
                let mut turned = vec![f32::NAN; w.len()];
                let mut into = vec![0.5; w.len()];
                conv.weight_gradient(&frame, &g, &mut turned, &mut into, &mut Pack::default());
                close(&into, &dw.iter().map(|x| x + 0.5).collect::<Vec<_>>(), &what);

                if conv.kernel.0 < 7 {
                    let mut panels = vec![f32::NAN; conv.panel_len().1];
                    conv.pack_backward(&w, &mut panels);
                    let mut got = vec![f32::NAN; x.len()];
                    conv.backward(&g, &panels, false, &mut got);
                    close(&got, &dx, &what);
                    got.fill(2.0);
                    conv.backward(&g, &panels, true, &mut got);
                    close(&got, &dx.iter().map(|x| x + 2.0).collect::<Vec<_>>(), &what);
                }
            });
        }
    }
}

/// Maps of a ResNet, and sizes that tiles do not divide.
fn tiled() -> Vec<Conv> {
    let sizes = [(1, 21, 21, 32, 48), (3, 11, 10, 48, 32), (8, 6, 6, 64, 32), (40, 3, 3, 32, 64), (4, 9, 7, 32, 32)];
    let mut all = Vec::new();
    for (images, height, width, channels, output) in sizes {
        for border in [(1, 1), (2, 3)] {
            let input = Frame { images, height, width, channels, border };
            all.push(Conv { input, output, kernel: (3, 3), stride: (1, 1) });
        }
    }
    all
}

#[test]
fn products_in_tiles_are_those_of_the_definition() {
    for conv in tiled() {
        let what = format!("{conv:?}");
        let tiles = Winograd::of(&conv).expect("enough tiles and channels");
        let mut rng = Rng::new(2, "tiles");
        let (x, w) = (rng.normals(conv.input.inside()), rng.normals(conv.weights()));
        let grad = rng.normals(conv.made((0, 0)).inside());
        let (mut dx, mut dw) = (vec![0f64; x.len()], vec![0f64; w.len()]);
        each(&conv, |to, from, weight| {
            dx[from] += f64::from(grad[to]) * f64::from(w[weight]);
            dw[weight] += f64::from(grad[to]) * f64::from(x[from]);
        });
        for level in Level::ALL {
            at_most(level, || {
                let frame = framed(&conv.input, &x);
                let (forth, back) = tiles.panel_len();
                let mut panels = vec![f32::NAN; forth];
                tiles.pack(&w, &mut panels);
                let mut scratch = vec![f32::NAN; tiles.scratch()];
                let mut out = vec![f32::NAN; conv.made((0, 0)).inside()];
                tiles.forward(&frame, &panels, false, &mut out, &mut scratch);
                close(&out, &naive(&conv, &x, &w), &what);
                tiles.forward(&frame, &panels, true, &mut out, &mut scratch);
                close(&out, &naive(&conv, &x, &w).iter().map(|x| 2.0 * x).collect::<Vec<_>>(), &what);

                let g = framed(&conv.made((1, 1)), &grad);
                let mut panels = vec![f32::NAN; back];
                tiles.pack_backward(&w, &mut panels);
                let mut got = vec![f32::NAN; x.len()];
                tiles.backward(&g, &panels, false, &mut got, &mut scratch);
                close(&got, &dx, &what);

                let mut into = vec![0.5; w.len()];
                let mut points = vec![f32::NAN; tiles.weights()];
                tiles.weight_gradient((&frame, &g), &mut into, &mut points, &mut scratch, &mut Pack::default());
                close(&into, &dw.iter().map(|x| x + 0.5).collect::<Vec<_>>(), &what);
            });
        }
    }
}

#[test]
fn tiles_are_for_many_images_and_channels_only() {
    let conv = |images, height, channels, output, kernel, stride| {
        let input = Frame { images, height, width: height, channels, border: (1, 1) };
        Conv { input, output, kernel: (kernel, kernel), stride: (stride, stride) }
    };
    assert!(Winograd::of(&conv(8, 21, 64, 64, 3, 1)).is_some());
    for plain in [
        conv(8, 21, 64, 64, 3, 2),
        conv(8, 21, 64, 64, 1, 1),
        conv(8, 21, 16, 64, 3, 1),
        conv(8, 21, 40, 64, 3, 1),
        conv(1, 6, 64, 64, 3, 1),
        conv(64, 1, 64, 64, 3, 1),
    ] {
        assert!(Winograd::of(&plain).is_none(), "{plain:?}");
    }
}
