//! Weights from a formula that PyTorch's side of the fixtures repeats bit by bit: element i of a tensor is the (i+1)-th
//! number of SplitMix64 seeded with FNV-1a of the tensor's name, scaled by its shape. No library's random numbers, no libm
//! but the square root.
#![allow(clippy::unwrap_used)]

use super::npz::Array;
use candle_core::{Device, Tensor};
use std::collections::BTreeMap;

/// `n` numbers in [0, 1)
fn uniform(name: &str, n: usize) -> impl Iterator<Item = f64> {
    let key = name.bytes().fold(0xcbf2_9ce4_8422_2325u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3));
    (1..=n as u64).map(move |i| {
        let z = key.wrapping_add(i.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 * 2f64.powi(-53)
    })
}

/// Offset and bound of a tensor.
fn rule(name: &str, shape: &[usize]) -> (f64, f64) {
    if name.ends_with("running_var") {
        return (1.0, 0.5);
    }
    if name.ends_with("running_mean") {
        return (0.0, 0.1);
    }
    if shape.len() == 1 {
        if !name.ends_with(".weight") {
            return (0.0, 0.1);
        }
        // the last norms of a branch are smaller, so that depth does not blow up
        let last = name.rsplit('.').nth(1).unwrap();
        let small = ["bn2", "bn3", "1"].contains(&last) && name.contains("backbone");
        return (if small { 0.5 } else { 1.0 }, 0.25);
    }
    let fan_in = shape[1..].iter().product::<usize>() as f64;
    let bound = match shape.len() {
        4 => (6.0 / fan_in).sqrt(),
        _ if name.contains("embed") => 1.0,
        _ => (3.0 / fan_in).sqrt(),
    };
    (0.0, bound)
}

/// The tensor of this name.
pub fn tensor(name: &str, shape: &[usize]) -> Tensor {
    let (offset, bound) = rule(name, shape);
    let values: Vec<f32> =
        uniform(name, shape.iter().product()).map(|r| (offset + bound * (2.0 * r - 1.0)) as f32).collect();
    Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
}

/// Compares `got` with what was kept of the tensor `name` of a reference: its norm, its sum, its product with known numbers,
/// and entries at known places. Differences are relative to the norm and to the largest kept entry.
pub fn assert_probes(probes: &BTreeMap<String, Array>, name: &str, got: &[f32], tolerance: f64, what: &str) {
    let kept = |part: &str| {
        &probes.get(&format!("{name}|{part}")).unwrap_or_else(|| panic!("{what}: no probe of {name}")).values
    };
    let (sums, places, values) = (kept("sums"), kept("places"), kept("values"));
    let exact = |x: &f32| f64::from(*x);
    let norm = got.iter().map(|x| exact(x).powi(2)).sum::<f64>().sqrt();
    let known: f64 =
        uniform(&format!("probe:{name}"), got.len()).zip(got).map(|(r, x)| (2.0 * r - 1.0) * exact(x)).sum();
    // sums of n numbers may be off by the root of n times the difference of one
    let scale = sums[0].max(1e-2) * (got.len() as f64).sqrt().min(64.0);
    for (part, got, want) in
        [("norm", norm, sums[0]), ("sum", got.iter().map(exact).sum(), sums[1]), ("product", known, sums[2])]
    {
        assert!((got - want).abs() <= tolerance * scale, "{what}: {part} of {name} is {got}, expected {want}");
    }
    let root_mean = sums[0] / (got.len() as f64).sqrt();
    let largest = values.iter().fold(root_mean.max(1e-2), |m, x| m.max(x.abs()));
    for (&at, &want) in places.iter().zip(values) {
        let got = exact(&got[at as usize]);
        assert!((got - want).abs() <= tolerance * largest, "{what}: {name}[{at}] is {got}, expected {want}");
    }
}
