//! The TRM against the official implementation's numbers: every folder with `config.json`, `model.safetensors` and
//! `io.safetensors` (inputs and the outputs of successive supervision steps) below `tests/fixtures/trm_official` and
//! below the directory that `ACTRM_PARITY_DIR` names.
//!
//! The recursion amplifies rounding: in f64 the same maths leaves the reference's f32 numbers by 1e-6 to 4e-4
//! (attention) and by 2e-5 to 1 (mlp_t) over the four steps of the shipped fixtures, and no f32 implementation but the
//! reference's own binary can stay closer. So every number must lie within 1e-5 of the reference, or, where rounding
//! alone is larger than that, within a small multiple of what f64 leaves. Each step is checked twice: on from our own
//! previous states, and on from the reference's.
#![allow(clippy::unwrap_used)]

use candle_core::{DType, Device, Tensor};
use solvers::trm::{Carry, Config, Gradient, StepOutput, Trm};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Largest absolute difference between any two numbers where rounding is not amplified beyond it.
const TOLERANCE: f64 = 1e-5;
/// Where it is: multiple of the distance between the reference and the same maths in f64.
const ROUNDING: f64 = 4.0;

fn load(path: PathBuf) -> BTreeMap<String, Tensor> {
    candle_core::safetensors::load(path, &Device::Cpu).unwrap().into_iter().collect()
}

/// The fixtures at or below a folder.
fn walk(folder: &Path, found: &mut Vec<PathBuf>) {
    if ["config.json", "model.safetensors", "io.safetensors"].iter().all(|file| folder.join(file).is_file()) {
        found.push(folder.to_path_buf());
    }
    for entry in std::fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display())) {
        let path = entry.unwrap().path();
        if path.is_dir() {
            walk(&path, found);
        }
    }
}

fn difference(got: &Tensor, expected: &Tensor) -> f64 {
    let expected = expected.to_dtype(DType::F64).unwrap();
    let difference = (got.to_dtype(DType::F64).unwrap() - expected).unwrap().abs().unwrap();
    difference.max_all().unwrap().to_scalar().unwrap()
}

fn check(folder: &Path) {
    let config = std::fs::read_to_string(folder.join("config.json")).unwrap();
    let config = Config::from_official(&serde_json::from_str(&config).unwrap()).unwrap();
    let mut model = Trm::new(config, 0).unwrap();
    model.load(&load(folder.join("model.safetensors"))).unwrap();
    let io = load(folder.join("io.safetensors"));
    let inputs = io["inputs"].to_dtype(DType::U32).unwrap();
    let identifiers = io.get("puzzle_identifiers").map(|t| t.to_dtype(DType::U32).unwrap());
    let mut steps = 0;
    let start = model.initial_carry(inputs.dim(0).unwrap()).unwrap();
    let [mut on, mut off, mut composed, mut exact, mut reference] = [(); 5].map(|()| start.clone());
    while io.contains_key(&format!("step{steps}.logits")) {
        let ids = identifiers.as_ref();
        let expected = |name: &str| &io[&format!("step{steps}.{name}")];
        let compare = |what: &str, out: &StepOutput, exact: &StepOutput| {
            let parts = |out: &StepOutput| {
                let StepOutput { logits, q_halt, carry } = out.clone();
                [("logits", logits), ("q_halt_logits", q_halt), ("z_h", carry.z_h), ("z_l", carry.z_l)]
            };
            // one distance for the whole step: a single number may be off by nothing by luck
            let rounding = parts(exact).iter().map(|(name, t)| difference(t, expected(name))).fold(0.0, f64::max);
            for (name, got) in &parts(out) {
                let allowed = TOLERANCE.max(ROUNDING * rounding);
                let off = difference(got, expected(name));
                assert!(
                    off <= allowed,
                    "{}: step {steps}: {what}: {name} is off by {off:e}, allowed {allowed:e}",
                    folder.display()
                );
            }
        };
        let exact_out = model.supervision_step_exact(&exact, &inputs, ids).unwrap();
        let out = model.supervision_step(&on, &inputs, ids, Gradient::On).unwrap();
        compare("kernel, with gradient", &out, &exact_out);
        on = out.carry;
        let out = model.supervision_step(&off, &inputs, ids, Gradient::Off).unwrap();
        compare("kernel, without gradient", &out, &exact_out);
        off = out.carry;
        let out = model.supervision_step_composed(&composed, &inputs, ids, Gradient::Off).unwrap();
        compare("composed", &out, &exact_out);
        composed = out.carry;
        exact = exact_out.carry;

        let exact_out = model.supervision_step_exact(&reference, &inputs, ids).unwrap();
        let out = model.supervision_step(&reference, &inputs, ids, Gradient::Off).unwrap();
        compare("from the reference's states", &out, &exact_out);
        reference = Carry { z_h: expected("z_h").clone(), z_l: expected("z_l").clone() };
        steps += 1;
    }
    assert!(steps > 0, "{}: no step to compare", folder.display());
}

#[test]
fn the_official_outputs_are_reproduced() {
    let mut found = Vec::new();
    walk(&Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures"), &mut found);
    assert_eq!(found.len(), 2, "fixtures of this repository: {found:?}");
    if let Some(own) = std::env::var_os("ACTRM_PARITY_DIR") {
        walk(Path::new(&own), &mut found);
    }
    found.iter().for_each(|folder| check(folder));
}

#[test]
fn tensors_of_another_model_are_named() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/trm_official");
    let config = std::fs::read_to_string(folder.join("attention/config.json")).unwrap();
    let config = Config::from_official(&serde_json::from_str(&config).unwrap()).unwrap();
    let mut model = Trm::new(config, 0).unwrap();
    let mut tensors = load(folder.join("mlp_t/model.safetensors"));
    let error = model.load(&tensors).unwrap_err().to_string();
    assert!(error.contains("L_level.layers.0.self_attn.o_proj.weight is missing"), "{error}");
    tensors = load(folder.join("attention/model.safetensors"));
    let state = tensors.remove("inner.H_init").unwrap();
    let error = model.load(&tensors).unwrap_err().to_string();
    assert!(error.contains("inner.H_init is missing"), "{error}");
    tensors.insert("inner.H_init".into(), state.narrow(0, 0, 8).unwrap());
    let error = model.load(&tensors).unwrap_err().to_string();
    assert!(error.contains("inner.H_init has shape [8]"), "{error}");
}
