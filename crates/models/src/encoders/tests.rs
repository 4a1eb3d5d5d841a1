//! Image encoders by hand beside the same on candle's operations.
#![allow(clippy::unwrap_used)]
use super::*;
use candle_core::Device;
use nn::Backend;
use nn::ops::term_of;
use nn::simd::{Level, at_most};
use nn::{Cache, Gradients, Loss, ParamLayout, Value};
use std::sync::Arc;

const DIM: usize = 12;

/// Both norms, one and two sizes of image, odd ones among them.
#[test]
fn tokens_and_gradients_are_the_composed_ones() {
    let (map, five) = (TokenKind::Map, TokenKind::Keypoints { count: 5 });
    for (width, norm, sizes, rows, tokens, blocks) in [
        (16, ImageNorm::Group, vec![(37, 41)], 2, map, None),
        (8, ImageNorm::Frozen, vec![(40, 40), (40, 40)], 1, map, None),
        (32, ImageNorm::Group, vec![(33, 64), (35, 33), (33, 64)], 1, map, None),
        // more convolutions in tiles
        (32, ImageNorm::Frozen, vec![(60, 52), (60, 52)], 4, map, None),
        // keypoints, finer maps
        (16, ImageNorm::Group, vec![(33, 64), (35, 33), (33, 64)], 2, five, None),
        (8, ImageNorm::Group, vec![(37, 41), (37, 41)], 3, five, Some([2, 1, 1, 0])),
        (8, ImageNorm::Frozen, vec![(40, 33)], 2, map, Some([1, 2, 0, 0])),
    ] {
        let config = VisionConfig { width, norm, tokens, blocks, ..VisionConfig::default() };
        let (mut params, mut rng, cache) = (Params::new(&Backend::CPU), Rng::new(6, "init"), Cache::default());
        // with seed 5 one maximum is decided by rounding
        let encoder = ImageEncoder::without_positions(&mut params, &config, &sizes, DIM, &mut rng).unwrap();
        for (name, var) in params.all() {
            // away from 1 and 0; variances stay positive
            let noise = Tensor::from_vec(rng.normals(var.elem_count()), var.dims(), &Device::Cpu).unwrap();
            let noise = if name.ends_with("var") { noise.abs().unwrap() } else { noise };
            let scale = if var.dims().len() == 1 { 0.1 } else { 0.0 };
            var.set(&(var.as_tensor() + (noise * scale).unwrap()).unwrap()).unwrap();
        }
        let mut image = |&(h, w): &Size| Tensor::from_vec(rng.normals(rows * h * w * 3), (rows, h, w, 3), &Device::Cpu);
        let images: Vec<Tensor> = sizes.iter().map(|size| image(size).unwrap()).collect();
        let loss = |cx: &mut Context<'_>| {
            let y = encoder.apply(cx, &images)?;
            let weights = Rng::new(9, "weights").normals(y.len());
            let composed = Tensor::from_slice(&weights, y.dims(), &Device::Cpu)?;
            let on_slices = move |y: &[f32], grad: Option<(&mut [f32], f64)>| {
                if let Some((grad, _)) = grad {
                    grad.copy_from_slice(&weights);
                }
                y.iter().zip(&weights).map(|(y, w)| f64::from(*y) * f64::from(*w)).sum()
            };
            let mut loss = Loss::default();
            loss.add("sum", term_of(cx, &y, on_slices, |y| Ok(y.mul(&composed)?.sum_all()?))?, 1.0);
            Ok(loss)
        };
        let graph = cache.composed_loss(&params, None, loss).unwrap().total.backward().unwrap();
        let flat = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let close = |got: &[f32], want: &[f32], tolerance: f32, what: &str| {
            assert_eq!(got.len(), want.len(), "{what}");
            let scale = want.iter().fold(1e-2f32, |m, x| m.max(x.abs()));
            for (g, w) in got.iter().zip(want) {
                assert!((g - w).abs() <= tolerance * scale, "{what} {sizes:?}: {g} {w} (largest {scale})");
            }
        };
        let want = flat(&encoder.forward(&images).unwrap());
        for level in Level::ALL {
            at_most(level, || {
                let step = || {
                    let mut grads = Gradients::zeros(Arc::new(ParamLayout::new(&params))).unwrap();
                    cache.step(&params, None, &mut grads, loss).unwrap();
                    grads
                };
                let grads = step();
                for (name, var) in params.iter() {
                    close(grads.get(name).unwrap(), &flat(graph.get(var).unwrap()), 2e-4, &format!("{name} {level:?}"));
                }
                // the same bits from a workspace that was used before
                assert!(step().values().iter().zip(grads.values()).all(|(a, b)| a.to_bits() == b.to_bits()));
                // predictions keep their panels
                for _ in 0..2 {
                    let tokens =
                        |cx: &mut Context<'_>| Ok::<_, ModelError>(Value::detached(&encoder.apply(cx, &images)?));
                    let got = cache.predict(&params, &mut || {}, tokens).unwrap();
                    close(&flat(&got), &want, 1e-5, &format!("tokens {level:?}"));
                }
            });
        }
    }
}
