#![allow(clippy::unwrap_used)]
use super::*;
use crate::encoders::{ImageEncoder, VisionConfig};
use crate::fused::{Shape, Workspaces, with_weights};
use crate::layers::Activation;
use candle_core::{Device, Tensor};
use nn::Params;
use nn::Rng;
use nn::simd::{Level, at_most};
use nn::{Gradients, ParamLayout};
use std::sync::Arc;

const DIM: usize = 12;

struct Case {
    encoder: ImageEncoder,
    params: Params,
    sizes: Vec<Size>,
    pictures: Vec<Vec<f32>>,
    rows: usize,
    tokens: TokenKind,
}

impl Case {
    fn eyes(&self) -> Eyes<'_> {
        Eyes { shape: self.encoder.backbone().shape(), sizes: &self.sizes, tokens: self.tokens }
    }
}

/// Both norms, one and two sizes of picture, odd ones among them.
fn cases() -> Vec<Case> {
    let mut all = Vec::new();
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
        let mut params = Params::new();
        let mut rng = Rng::new(5, "init");
        let encoder = ImageEncoder::without_positions(&mut params, &config, &sizes, DIM, &mut rng).unwrap();
        for (name, var) in params.all() {
            // away from 1 and 0; variances stay positive
            let noise = Tensor::from_vec(rng.normals(var.elem_count()), var.dims(), &Device::Cpu).unwrap();
            let noise = if name.ends_with("var") { noise.abs().unwrap() } else { noise };
            let scale = if var.dims().len() == 1 { 0.1 } else { 0.0 };
            var.set(&(var.as_tensor() + (noise * scale).unwrap()).unwrap()).unwrap();
        }
        let pictures = sizes.iter().map(|(h, w)| rng.normals(rows * h * w * 3)).collect();
        all.push(Case { encoder, params, sizes, pictures, rows, tokens });
    }
    all
}

fn close(got: &[f32], want: &[f32], tolerance: f32, what: &str) {
    assert_eq!(got.len(), want.len(), "{what}");
    let scale = want.iter().fold(1e-2f32, |m, x| m.max(x.abs()));
    for (g, w) in got.iter().zip(want) {
        assert!((g - w).abs() <= tolerance * scale, "{what}: {g} {w} (largest {scale})");
    }
}

#[test]
fn tokens_and_gradients_are_the_composed_ones() {
    for case in cases() {
        let inputs = case
            .pictures
            .iter()
            .zip(&case.sizes)
            .map(|(x, &(h, w))| Tensor::from_slice(x, (case.rows, h, w, 3), &Device::Cpu).unwrap());
        let want = case.encoder.forward(&inputs.collect::<Vec<_>>()).unwrap();
        let tokens = want.dim(1).unwrap();
        let mut rng = Rng::new(9, "weights");
        let weights = rng.normals(case.rows * tokens * DIM);
        let loss = (&want * Tensor::from_slice(&weights, want.dims(), &Device::Cpu).unwrap()).unwrap();
        let tape = loss.sum_all().unwrap().backward().unwrap();
        let want = want.flatten_all().unwrap().to_vec1::<f32>().unwrap();

        // other tokens stand before and behind
        let (first, all) = (2, tokens + 3);
        let spread = |x: &[f32]| {
            let mut wide = vec![7.0; case.rows * all * DIM];
            for (to, from) in wide.chunks_exact_mut(all * DIM).zip(x.chunks_exact(tokens * DIM)) {
                to[first * DIM..(first + tokens) * DIM].copy_from_slice(from);
            }
            wide
        };
        let shape =
            Shape { dim: DIM, heads: 1, hidden: 1, activation: Activation::Relu, dropout: 0.0, pre_norm: false };
        let spaces = Workspaces::default();
        for level in Level::ALL {
            at_most(level, || {
                let layout = Arc::new(ParamLayout::new(&case.params));
                let mut runs = Vec::new();
                for _ in 0..2 {
                    let mut grads = Gradients::zeros(layout.clone());
                    let eyes = case.eyes();
                    spaces.with(|space| {
                        with_weights(&case.params, |weights_of| {
                            let pass =
                                &mut Pass { weights: weights_of, shape, space, rng: None, packed: None, on_seen: None };
                            let mut x = spread(&vec![0.0; want.len()]);
                            let looked = eyes.forward(pass, &case.pictures, &mut x, (first, all));
                            close(&x, &spread(&want), 1e-5, "tokens");
                            eyes.backward(pass, looked, &spread(&weights), (first, all), &mut grads.views());
                        })
                        .unwrap();
                    });
                    runs.push(grads);
                }
                for (name, var) in case.params.iter() {
                    let want = tape.get(var).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
                    close(runs[0].get(name).unwrap(), &want, 2e-4, &format!("{name} {level:?} {:?}", case.sizes));
                }
                // the same bits from a workspace that was used before
                assert!(runs[0].values().iter().zip(runs[1].values()).all(|(a, b)| a.to_bits() == b.to_bits()));
            });
        }
        // predictions keep their panels
        let packed = spaces.packed(&case.params);
        for _ in 0..2 {
            let mut x = spread(&vec![0.0; want.len()]);
            let eyes = case.eyes();
            spaces.with(|space| {
                with_weights(&case.params, |weights| {
                    let pass = &mut Pass { weights, shape, space, rng: None, packed: Some(&packed), on_seen: None };
                    eyes.forward(pass, &case.pictures, &mut x, (first, all)).free(pass);
                })
                .unwrap();
            });
            close(&x, &spread(&want), 1e-5, "predicted tokens");
        }
    }
}
