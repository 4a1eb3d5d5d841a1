//! Raw units to network units and back, per feature, with LeRobot's formulas and names.

use candle_core::{DType, Device, Tensor};
use nn::{ModelError, Result, some_names};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Feature name of the robot's own state.
pub const STATE: &str = "observation.state";
/// Feature name of the rest of the world.
pub const ENVIRONMENT_STATE: &str = "observation.environment_state";
/// Feature name of the actions.
pub const ACTION: &str = "action";

/// What is done to a feature.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "snake_case")]
pub enum NormMode {
    /// (x - mean) / (std + 1e-8); inverse x * std + mean
    #[default]
    MeanStd,
    /// 2 (x - min) / (max - min) - 1
    MinMax,
    /// x
    Identity,
}

impl NormMode {
    /// The two statistics that it needs: (subtracted, scale).
    fn statistics(self) -> &'static [&'static str] {
        match self {
            Self::MeanStd => &["mean", "std"],
            Self::MinMax => &["min", "max"],
            Self::Identity => &[],
        }
    }
}

#[derive(Debug, Clone, PartialEq)]
struct Feature {
    mode: NormMode,
    /// mean or min
    a: Vec<f32>,
    /// std or max
    b: Vec<f32>,
}

/// Statistics and mode of every feature that a policy reads or writes.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Normaliser {
    features: BTreeMap<String, Feature>,
}

/// A constant dimension that `guard_constant` made harmless.
#[derive(Debug, Clone, PartialEq)]
pub struct Guarded {
    /// the feature
    pub feature: String,
    /// the dimension
    pub dim: usize,
    /// its spread (std, or max - min) in the data
    pub spread: f32,
}

impl Normaliser {
    pub(crate) const EPS: f32 = 1e-8;
    /// Spread that a constant dimension of the actions is given: an error of the network hardly moves what is executed.
    const CONSTANT_ACTION: f32 = 0.01;

    /// Takes the statistics that `modes` need from `tensors`, named `<feature>.mean`, `.std`, `.min`, `.max`.
    ///
    /// # Errors
    /// A statistic that is missing, not one-dimensional, of another length than its partner, or not finite.
    pub fn new(modes: &BTreeMap<String, NormMode>, tensors: &BTreeMap<String, Tensor>) -> Result<Self> {
        let mut features = BTreeMap::new();
        for (name, &mode) in modes {
            let mut found = Vec::new();
            for statistic in mode.statistics() {
                let key = format!("{name}.{statistic}");
                let tensor = tensors.get(&key).ok_or_else(|| ModelError::MissingStatistic {
                    name: key.clone(),
                    given: some_names(tensors.keys()),
                })?;
                let values = tensor.to_dtype(DType::F32)?.flatten_all()?.to_vec1::<f32>()?;
                if let Some(value) = values.iter().find(|x| !x.is_finite()) {
                    return Err(ModelError::Input {
                        operation: "normaliser",
                        object: "statistic",
                        found: format!("{key} with a value {value}"),
                        expected: "finite numbers".to_string(),
                    });
                }
                found.push(values);
            }
            let b = found.pop().unwrap_or_default();
            let a = found.pop().unwrap_or_default();
            if a.len() != b.len() {
                return Err(ModelError::Shape {
                    operation: "normaliser",
                    object: "a feature's second statistic",
                    expected: vec![a.len()],
                    found: vec![b.len()],
                });
            }
            features.insert(name.clone(), Feature { mode, a, b });
        }
        Ok(Self { features })
    }

    /// Gives every dimension whose spread is below `1e-6 * max(1, |centre|)` a spread of 1, so that it maps to 0 and a
    /// value never seen in the data is not blown up by 1/1e-8. A dimension of the actions gets 0.01, so that a policy does not execute
    /// its own error there, unless `actions_vary`: training shows actions that are not in the data (mirrored, turned). The changed
    /// statistics are what is stored: LeRobot's own formula then gives the same numbers. Returns what was changed.
    pub fn guard_constant(&mut self, actions_vary: bool) -> Vec<Guarded> {
        let mut changed = Vec::new();
        for (name, feature) in &mut self.features {
            for (dim, (a, b)) in feature.a.iter_mut().zip(&mut feature.b).enumerate() {
                let spread = if feature.mode == NormMode::MinMax { *b - *a } else { *b };
                if spread.abs() >= 1e-6 * a.abs().max(1.0) {
                    continue;
                }
                changed.push(Guarded { feature: name.clone(), dim, spread });
                let room = if name == ACTION && !actions_vary { Self::CONSTANT_ACTION } else { 1.0 };
                // beside a large value a smaller spread would be rounded away
                let room = room.max(4e-6 * a.abs());
                if feature.mode == NormMode::MinMax {
                    (*a, *b) = (*a - room / 2.0, *a + room / 2.0);
                } else {
                    *b = room;
                }
            }
        }
        changed
    }

    /// The mode of every feature.
    pub fn modes(&self) -> BTreeMap<String, NormMode> {
        self.features.iter().map(|(k, f)| (k.clone(), f.mode)).collect()
    }

    /// The statistics under LeRobot's names, on the CPU, as they are stored.
    pub fn tensors(&self) -> Result<BTreeMap<String, Tensor>> {
        let mut tensors = BTreeMap::new();
        for (name, feature) in &self.features {
            for (statistic, values) in feature.mode.statistics().iter().zip([&feature.a, &feature.b]) {
                let tensor = Tensor::from_slice(values, values.len(), &Device::Cpu)?;
                tensors.insert(format!("{name}.{statistic}"), tensor);
            }
        }
        Ok(tensors)
    }

    fn feature(&self, name: &str, values: &[f32]) -> Result<&Feature> {
        let feature = self.features.get(name).ok_or_else(|| ModelError::MissingStatistic {
            name: name.to_string(),
            given: some_names(self.features.keys()),
        })?;
        let dim = feature.a.len();
        if feature.mode != NormMode::Identity && (dim == 0 || !values.len().is_multiple_of(dim)) {
            return Err(ModelError::Input {
                operation: "normalise",
                object: "feature",
                found: format!("{name} with {} values", values.len()),
                expected: format!("a multiple of {dim}"),
            });
        }
        Ok(feature)
    }

    /// Raw to network units in place; `values` is one row or several.
    ///
    /// # Errors
    /// An unknown feature, or a length that is not a multiple of its dimension.
    pub fn normalise(&self, name: &str, values: &mut [f32]) -> Result<()> {
        let feature = self.feature(name, values)?;
        feature.each_row(values, |x, a, b| match feature.mode {
            NormMode::MeanStd => (x - a) / (b + Self::EPS),
            NormMode::MinMax => 2.0 * (x - a) / if b == a { Self::EPS } else { b - a } - 1.0,
            NormMode::Identity => x,
        });
        Ok(())
    }

    /// Network to raw units in place.
    ///
    /// # Errors
    /// As `normalise`.
    pub fn unnormalise(&self, name: &str, values: &mut [f32]) -> Result<()> {
        let feature = self.feature(name, values)?;
        feature.each_row(values, |x, a, b| match feature.mode {
            NormMode::MeanStd => x * b + a,
            NormMode::MinMax => (x + 1.0) / 2.0 * if b == a { Self::EPS } else { b - a } + a,
            NormMode::Identity => x,
        });
        Ok(())
    }
}

impl Feature {
    fn each_row(&self, values: &mut [f32], f: impl Fn(f32, f32, f32) -> f32) {
        if self.mode == NormMode::Identity {
            return;
        }
        for row in values.chunks_exact_mut(self.a.len()) {
            for ((x, &a), &b) in row.iter_mut().zip(&self.a).zip(&self.b) {
                *x = f(*x, a, b);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    fn normaliser(mode: NormMode, a: &[f32], b: &[f32]) -> Normaliser {
        let names = mode.statistics();
        let mut tensors = BTreeMap::new();
        for (name, values) in names.iter().zip([a, b]) {
            let tensor = Tensor::from_slice(values, values.len(), &Device::Cpu).unwrap();
            tensors.insert(format!("action.{name}"), tensor);
        }
        Normaliser::new(&BTreeMap::from([(ACTION.to_string(), mode)]), &tensors).unwrap()
    }

    proptest! {
        #[test]
        fn the_inverse_undoes_it(
            rows in proptest::collection::vec(-5f32..5.0, 3..30),
            a in proptest::collection::vec(-2f32..2.0, 3), spread in proptest::collection::vec(0.01f32..4.0, 3),
            min_max: bool,
        ) {
            let rows = &rows[..rows.len() / 3 * 3];
            let b: Vec<f32> = if min_max { a.iter().zip(&spread).map(|(a, s)| a + s).collect() } else { spread };
            let mode = if min_max { NormMode::MinMax } else { NormMode::MeanStd };
            let normaliser = normaliser(mode, &a, &b);
            let mut values = rows.to_vec();
            normaliser.normalise(ACTION, &mut values).unwrap();
            normaliser.unnormalise(ACTION, &mut values).unwrap();
            for (got, want) in values.iter().zip(rows) {
                prop_assert!((got - want).abs() < 1e-4, "{} {}", got, want);
            }
        }
    }

    #[test]
    fn constant_dims_are_guarded_and_reported() {
        for mode in [NormMode::MeanStd, NormMode::MinMax] {
            let (a, b): (&[f32], &[f32]) = if mode == NormMode::MinMax {
                (&[0.0, 0.04, 2e7], &[2.0, 0.04, 2e7])
            } else {
                (&[1.0, 0.04, 2e7], &[1.0, 0.0, 0.0])
            };
            for feature in [STATE, ACTION] {
                let names = mode.statistics();
                let tensor = |values: &[f32]| Tensor::from_slice(values, values.len(), &Device::Cpu).unwrap();
                let tensors =
                    names.iter().zip([a, b]).map(|(name, values)| (format!("{feature}.{name}"), tensor(values)));
                let of = || {
                    let modes = BTreeMap::from([(feature.to_string(), mode)]);
                    Normaliser::new(&modes, &tensors.clone().collect()).unwrap()
                };
                let mut varied = of();
                let changed = varied.guard_constant(true);
                let dims: Vec<_> = changed.iter().map(|changed| (changed.feature.as_str(), changed.dim)).collect();
                assert_eq!(dims, [(feature, 1), (feature, 2)]);
                // a value that was never seen is not blown up
                let mut values = [1.0, 0.05, 2e7 + 4.0];
                varied.normalise(feature, &mut values).unwrap();
                assert!(values[1].abs() < 0.1 && values[2].abs() < 1.0, "{values:?}");
                assert!(varied.guard_constant(true).is_empty());
                // what is executed stays near the constant, whatever the network says
                let mut fixed = of();
                fixed.guard_constant(false);
                let mut values = [0.5, 0.5, 0.0];
                fixed.unnormalise(feature, &mut values).unwrap();
                assert_eq!((values[1] - 0.04).abs() < 0.01, feature == ACTION, "{values:?}");
            }
        }
    }

    #[test]
    fn a_missing_statistic_is_named() {
        let modes = BTreeMap::from([(STATE.to_string(), NormMode::MeanStd)]);
        let error = Normaliser::new(&modes, &BTreeMap::new()).unwrap_err();
        assert!(error.to_string().contains("observation.state.mean"), "{error}");
        let good = normaliser(NormMode::MeanStd, &[0.0, 0.0], &[1.0, 1.0]);
        assert!(good.normalise(STATE, &mut [0.0]).is_err());
        assert!(good.normalise(ACTION, &mut [0.0; 3]).is_err());
    }

    #[test]
    fn tensors_rebuild_it() {
        let one = normaliser(NormMode::MinMax, &[0.0, -1.0], &[2.0, 0.5]);
        assert_eq!(Normaliser::new(&one.modes(), &one.tensors().unwrap()).unwrap(), one);
    }
}
