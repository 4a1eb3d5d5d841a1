//! Image encoders against PyTorch: torchvision's ResNet18 with GroupNorm, robomimic's SpatialSoftmax, LeRobot's positions.
//! Weights come from a formula (`common/recipe.rs`), so a fixture is inputs, outputs and probes of the gradients.
#![allow(clippy::unwrap_used)]

use crate::common::npz::{self, Array};
use crate::common::recipe::{self, assert_probes};
use candle_core::{Device, Tensor, Var};
use models::encoders::{ImageNorm, ResNet, ResNetShape, SpatialSoftmax, position_table};
use models::{Backend, Params, Rng};
use nn::{Value, compose};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

fn folder(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/vision").join(name)
}

fn fill(params: &Params) {
    let tensors = params.all().map(|(name, var)| (name.to_string(), recipe::tensor(name, var.dims()))).collect();
    params.load(&tensors).unwrap();
}

fn values(t: &Tensor) -> Vec<f32> {
    t.flatten_all().unwrap().to_vec1().unwrap()
}

fn close(what: &str, got: &Tensor, want: &Tensor, tolerance: f32) {
    assert_eq!(got.dims(), want.dims(), "{what}");
    let (got, want) = (values(got), values(want));
    let scale = want.iter().fold(1e-2f32, |m, x| m.max(x.abs()));
    let off = got.iter().zip(&want).fold(0f32, |m, (a, b)| m.max((a - b).abs())) / scale;
    println!("{what}: {off:.1e} of the largest");
    assert!(off <= tolerance, "{what} is {off} of the largest away");
}

/// Output, the gradient of the input and that of every parameter, for the loss `sum(y * weight)`.
fn check(name: &str, params: &Params, forward: impl Fn(&Tensor) -> Tensor) {
    let io = npz::read(&folder(name).join("io.npz"));
    let probes: BTreeMap<String, Array> = npz::arrays(&folder(name).join("gradient_probes.npz"));
    let x = Var::from_tensor(&io["x"]).unwrap();
    let y = forward(x.as_tensor());
    close(&format!("{name}: output"), &y, &io["y"], 1e-5);
    let loss = (y * &io["weight"]).unwrap().sum_all().unwrap();
    let grads = loss.backward().unwrap();
    close(&format!("{name}: gradient of the input"), grads.get(&x).unwrap(), &io["x_gradient"], 1e-4);
    for (parameter, var) in params.iter() {
        assert_probes(&probes, parameter, &values(grads.get(var).unwrap()), 1e-4, name);
    }
}

#[test]
fn a_narrow_resnet_with_group_norm_is_torchs() {
    let mut params = Params::new(&Backend::CPU);
    let shape = ResNetShape { blocks: [2, 2, 2, 2], width: 16, norm: ImageNorm::Group };
    let net = ResNet::new(&mut params, "", &shape, &mut Rng::new(0, "init")).unwrap();
    fill(&params);
    // torch's order is channels before rows
    check("encoder_resnet18_w16_group_norm", &params, |x| {
        let x = x.permute((0, 2, 3, 1)).unwrap().contiguous().unwrap();
        let map = compose(&Device::Cpu, |cx| net.forward(cx, &Value::with_graph(&x))).unwrap().into_graph();
        map.permute((0, 3, 1, 2)).unwrap().contiguous().unwrap()
    });
}

#[test]
fn keypoints_are_robomimics() {
    let mut params = Params::new(&Backend::CPU);
    let rng = &mut Rng::new(0, "init");
    let softmax = SpatialSoftmax::new(&mut params, "pool", 32, 16, rng).unwrap();
    let mut create = |name: &str, shape: &[usize]| params.create(name, shape, models::Init::Zeros, rng).unwrap();
    let mut convs = Vec::new();
    for (i, stride) in [(0, 2), (2, 2), (4, 2), (6, 1)] {
        let input = if i == 0 { 3 } else { 32 };
        convs.push((
            create(&format!("convs.{i}.weight"), &[32, input, 3, 3]),
            create(&format!("convs.{i}.bias"), &[32]),
            stride,
        ));
    }
    let (weight, bias) = (create("linear.weight", &[32, 32]), create("linear.bias", &[32]));
    fill(&params);
    check("encoder_conv4_spatial_softmax", &params, |x| {
        let mut x = x.clone();
        for (weight, bias, stride) in &convs {
            let y = x.conv2d(weight, 1, *stride, 1, 1).unwrap();
            x = y.broadcast_add(&bias.reshape((1, 32, 1, 1)).unwrap()).unwrap().relu().unwrap();
        }
        let x = x.permute((0, 2, 3, 1)).unwrap().contiguous().unwrap();
        let found = compose(&Device::Cpu, |cx| softmax.forward(cx, &Value::with_graph(&x))).unwrap().into_graph();
        found.matmul(&weight.t().unwrap()).unwrap().broadcast_add(&bias).unwrap()
    });
}

#[test]
fn positions_are_lerobots() {
    for (name, want) in npz::read(&folder("position_tables.npz")) {
        let sizes: Vec<usize> = name.split('_').map(|n| n.parse().unwrap()).collect();
        let [dim, h, w] = sizes[..] else { panic!("{name}") };
        let got = Tensor::from_vec(position_table(dim, (h, w)), (h * w, dim), &Device::Cpu).unwrap();
        let want = want.reshape((dim, h * w)).unwrap().t().unwrap().contiguous().unwrap();
        close(&name, &got, &want, 1e-6);
    }
}
