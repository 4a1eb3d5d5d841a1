//! What the tests of models share: the same model on candle's operations and finite differences as oracles.
#![allow(clippy::unwrap_used)]

use crate::batch::Batch;
pub(crate) use crate::cases::{batch, signatures, vision_config};
use crate::model::PolicyModel;
use crate::train::{StepMetrics, TrainConfig, Trainer};
use candle_core::{Device, Tensor};
use nn::simd::{Level, at_most};
use nn::{Gradients, LossValues, ParamLayout, Result, Rng};
use std::sync::Arc;

/// Moves norms and biases away from their initial 1 and 0, where errors would hide.
pub(crate) fn move_parameters(model: &dyn PolicyModel) {
    let mut rng = Rng::new(2, "moved");
    for (_, var) in model.params().iter() {
        let noise = Tensor::from_vec(rng.normals(var.elem_count()), var.dims(), &Device::Cpu).unwrap();
        var.set(&(var.as_tensor() + (noise * 0.1).unwrap()).unwrap()).unwrap();
    }
}

/// The losses of a training on one batch, after making sure that it gives the same bits twice.
pub(crate) fn losses_of_training<M: PolicyModel + 'static>(
    build: impl Fn() -> Result<M>,
    batch: &Batch,
    (steps, lr): (u64, f64),
) -> Vec<StepMetrics> {
    let run = || {
        let config = TrainConfig { steps, lr, warmup_steps: 3, ..Default::default() };
        let mut trainer = Trainer::new(Box::new(build().unwrap()), config, 5).unwrap();
        (0..steps).map(|_| trainer.step(batch).unwrap()).collect::<Vec<_>>()
    };
    let losses = run();
    assert_eq!(run(), losses);
    losses
}

/// Loss and gradients as the trainer gets them.
pub(crate) fn gradients(model: &dyn PolicyModel, batch: &Batch) -> (LossValues, Gradients) {
    let mut grads = Gradients::zeros(Arc::new(ParamLayout::new(model.params()))).unwrap();
    let loss = model.accumulate_gradients(batch, &mut Rng::new(4, "step"), &mut grads).unwrap();
    (loss.read().unwrap(), grads)
}

/// On every instruction set of this machine: loss, its parts and all gradients are those of `loss` on autograd, with
/// the same random numbers, also when the workspace is used a second time.
pub(crate) fn assert_the_step_is_the_composed_one(model: &dyn PolicyModel, batch: &Batch, what: &str) {
    let composed = model.loss(batch, &mut Rng::new(4, "step")).unwrap();
    let want = LossValues::from_parts(&composed).unwrap();
    let tape = composed.total.backward().unwrap();
    for level in Level::ALL {
        at_most(level, || {
            let (got, grads) = gradients(model, batch);
            let close = |a: f32, b: f32| (a - b).abs() < 1e-5 * b.abs().max(1.0);
            assert!(close(got.total, want.total), "{got:?} {want:?} {what}");
            assert_eq!(got.parts.keys().collect::<Vec<_>>(), want.parts.keys().collect::<Vec<_>>());
            for (name, value) in &want.parts {
                assert!(close(got.parts[name], *value), "{name}: {got:?} {want:?} {what}");
            }
            for (name, var) in model.params().iter() {
                let want = tape.get(var).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
                let scale = want.iter().fold(1e-2f32, |m, x| m.max(x.abs()));
                for (g, w) in grads.get(name).unwrap().iter().zip(&want) {
                    assert!((g - w).abs() < 1e-4 * scale, "{name}: {g} {w} (largest {scale}) {level:?} {what}");
                }
            }
            let mut twice = grads.clone();
            model.accumulate_gradients(batch, &mut Rng::new(4, "step"), &mut twice).unwrap();
            for (a, b) in twice.values().iter().zip(grads.values()) {
                // added to what is there, sums of many terms round otherwise
                assert!((a - 2.0 * b).abs() <= 1e-4 * b.abs().max(1e-2), "{a} {b} {what}");
            }
        });
    }
}

/// For every parameter: along its gradient the loss rises by the gradient's norm.
pub(crate) fn assert_the_gradient_is_the_slope(model: &dyn PolicyModel, batch: &Batch, what: &str) {
    let (loss, grads) = gradients(model, batch);
    for (name, var) in model.params().iter() {
        let grad = grads.get(name).unwrap();
        let norm = grad.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt();
        if norm == 0.0 {
            continue;
        }
        let direction = (Tensor::from_slice(grad, var.dims(), &Device::Cpu).unwrap() / norm).unwrap();
        let here = var.as_tensor().copy().unwrap().detach();
        let loss_at = |step: f64| {
            var.set(&(&here + (&direction * step).unwrap()).unwrap()).unwrap();
            f64::from(gradients(model, batch).0.total)
        };
        // ReLU and L1 have kinks, which a short step seldom crosses; the loss has 24 bits, which a long step needs less
        let rounding = 2e-7 * f64::from(loss.total.abs()).max(1.0);
        let mut slopes = Vec::new();
        let fits = [3e-3, 1e-3, 3e-4].into_iter().any(|step| {
            let slope = (loss_at(step) - loss_at(-step)) / (2.0 * step);
            slopes.push((step, slope));
            (slope - norm).abs() < 0.02 * norm + rounding / step
        });
        var.set(&here).unwrap();
        assert!(fits, "{name}: steps and slopes {slopes:?}, gradient {norm} {what}");
    }
}
