//! Raw values to what a network reads, and actions back: the one place, for training, validation, evaluation and
//! reasoning.
//!
//! Numbers are normalised per feature. Images stay bytes: they are scaled where they are encoded, after they have
//! travelled. An image in the colours of other features is painted in them here.

use crate::batch::{Batch, tensor};
use crate::features::{FeatureKind, FeatureSpec, Features, Observation, Signature, Values, ValuesRef};
use crate::normaliser::{ACTION, Normaliser};
use crate::policy::ActionChunk;
use candle_core::{Device, Tensor};
use nn::{ModelError, Result};

/// A signature, the statistics of its features and of the actions, and the device on which a network reads them.
#[derive(Debug, Clone)]
pub struct Preprocess {
    signature: Signature,
    normaliser: Normaliser,
    device: Device,
}

impl Preprocess {
    /// # Errors
    /// A feature without statistics, or with statistics of another length, by name.
    pub fn new(signature: Signature, normaliser: Normaliser, device: &Device) -> Result<Self> {
        for spec in signature.observation.iter().filter(|spec| spec.kind != FeatureKind::Image) {
            normaliser.normalise(&spec.name, &mut vec![0.0; spec.width()])?;
        }
        normaliser.normalise(ACTION, &mut vec![0.0; signature.action_dim])?;
        Ok(Self { signature, normaliser, device: device.clone() })
    }

    /// What it reads and gives.
    pub fn signature(&self) -> &Signature {
        &self.signature
    }

    /// The statistics.
    pub fn normaliser(&self) -> &Normaliser {
        &self.normaliser
    }

    /// A batch of windows, row-major and in raw units: every feature of the signature, `actions` n*H*A, `is_pad` n*H.
    /// Further features are left alone.
    ///
    /// # Errors
    /// A feature that is missing, of the wrong length or of the wrong type, by name.
    pub fn batch(
        &self,
        action_horizon: usize,
        observation: &Features<ValuesRef<'_>>,
        actions: &[f32],
        is_pad: &[bool],
    ) -> Result<Batch> {
        self.batch_with(action_horizon, observation, &Features::new(), actions, is_pad)
    }

    /// The same with features that are on the device already, as a network reads them: images that are in no other colours.
    ///
    /// # Errors
    /// As [`Self::batch`].
    pub fn batch_with(
        &self,
        action_horizon: usize,
        observation: &Features<ValuesRef<'_>>,
        placed: &Features<Tensor>,
        actions: &[f32],
        is_pad: &[bool],
    ) -> Result<Batch> {
        let mut raw = Features::new();
        for spec in self.signature.observation.iter().filter(|spec| placed.get(&spec.name).is_none()) {
            raw.insert(&spec.name, observation.require("batch", &spec.name)?.to_values());
        }
        let seen = self.read(raw)?;
        let mut actions = actions.to_vec();
        self.normaliser.normalise(ACTION, &mut actions)?;
        Batch::new(&self.signature, action_horizon, seen, placed, actions, is_pad, &self.device)
    }

    /// What a network reads at the last of `history`, the observations of an episode so far, oldest first; of more than
    /// `n_obs_steps` the last ones count, and where there are fewer the first is repeated.
    ///
    /// -> by feature a batch of one row
    ///
    /// # Errors
    /// As [`Preprocess::batch`]; an empty history.
    pub fn observation(&self, history: &[Observation]) -> Result<Features<Tensor>> {
        let steps = self.signature.n_obs_steps;
        let Some(last) = history.len().checked_sub(1) else {
            let (found, expected) = ("empty".to_string(), "at least one observation".to_string());
            return Err(ModelError::Input { operation: "predict", object: "history", found, expected });
        };
        let shown: Vec<&Observation> = (0..steps).map(|k| &history[(last + k + 1).saturating_sub(steps)]).collect();
        let mut raw = Features::new();
        for spec in &self.signature.observation {
            let mut joined = empty(spec);
            for observation in &shown {
                let values = observation.require("predict", &spec.name)?.as_ref();
                if values.len() != spec.width() {
                    return Err(ModelError::FeatureShape {
                        operation: "predict",
                        name: spec.name.clone(),
                        expected: spec.shape.clone(),
                        found: vec![values.len()],
                    });
                }
                join(spec, &mut joined, values)?;
            }
            raw.insert(&spec.name, joined);
        }
        let mut read = self.read(raw)?;
        let mut tensors = Features::new();
        for spec in &self.signature.observation {
            let values = read.take("predict", &spec.name)?;
            tensors.insert(&spec.name, tensor(&spec.name, values, &self.signature.batch_shape(spec, 1), &self.device)?);
        }
        Ok(tensors)
    }

    /// Raw values of every feature, of any number of steps -> what a network reads.
    fn read(&self, mut raw: Features<Values>) -> Result<Features<Values>> {
        let given: Vec<_> = self.signature.observation.iter().filter(|spec| raw.get(&spec.name).is_some()).collect();
        for spec in given.iter().filter(|spec| !spec.colours.is_empty()) {
            let Values::U8(mut images) = raw.require("see", &spec.name)?.clone() else {
                return Err(wrong_type(spec, "numbers", "bytes"));
            };
            for (step, image) in images.chunks_exact_mut(spec.width()).enumerate() {
                let mut colours = [[0.0; 3]; 3];
                for (name, colour) in spec.colours.iter().zip(&mut colours) {
                    let numbers = raw.require("see", name)?.numbers().unwrap_or_default();
                    match numbers.get(3 * step..3 * step + 3) {
                        Some(numbers) => colour.copy_from_slice(numbers),
                        None => {
                            let (expected, found) = (vec![step + 1, 3], vec![numbers.len()]);
                            return Err(ModelError::FeatureShape {
                                operation: "see",
                                name: name.clone(),
                                expected,
                                found,
                            });
                        }
                    }
                }
                paint(image, colours);
            }
            raw.insert(&spec.name, Values::U8(images));
        }
        let mut read = Features::new();
        for spec in given {
            let values = raw.take("see", &spec.name)?;
            read.insert(&spec.name, self.normalised(spec, values)?);
        }
        Ok(read)
    }

    /// A predicted chunk in raw units. actions: (1, H, A)
    ///
    /// # Errors
    /// Another shape.
    pub fn chunk(&self, actions: &Tensor) -> Result<ActionChunk> {
        let (rows, horizon, width) = actions.dims3()?;
        if (rows, width) != (1, self.signature.action_dim) {
            return Err(ModelError::Shape {
                operation: "predict",
                object: "actions",
                expected: vec![1, horizon, self.signature.action_dim],
                found: actions.dims().to_vec(),
            });
        }
        let mut values = actions.flatten_all()?.to_vec1::<f32>()?;
        self.normaliser.unnormalise(ACTION, &mut values)?;
        ActionChunk::new(values, horizon, width)
    }

    fn normalised(&self, spec: &FeatureSpec, values: Values) -> Result<Values> {
        match (spec.kind, values) {
            (FeatureKind::Image, Values::U8(bytes)) => Ok(Values::U8(bytes)),
            (FeatureKind::Image, Values::F32(_)) => Err(wrong_type(spec, "numbers", "bytes")),
            (_, Values::F32(mut numbers)) => {
                self.normaliser.normalise(&spec.name, &mut numbers)?;
                Ok(Values::F32(numbers))
            }
            (_, Values::U8(_)) => Err(wrong_type(spec, "bytes", "numbers")),
        }
    }
}

/// Channel k of every pixel becomes how much of `colours[k]` it has: its product with that colour, over the colour's sum, so
/// that grey stays as it is and red, green and blue as colours are those channels. A colour of zeros has none.
fn paint(image: &mut [u8], colours: [[f32; 3]; 3]) {
    let shares = colours.map(|colour| {
        let sum: f32 = colour.iter().map(|part| part.abs()).sum();
        colour.map(|part| if sum > 0.0 { part / sum } else { 0.0 })
    });
    for pixel in image.chunks_exact_mut(3) {
        let seen = [0, 1, 2].map(|c| f32::from(pixel[c]));
        for (channel, share) in pixel.iter_mut().zip(&shares) {
            let product: f32 = share.iter().zip(&seen).map(|(share, seen)| share * seen).sum();
            // saturates
            *channel = product.round() as u8;
        }
    }
}

fn empty(spec: &FeatureSpec) -> Values {
    match spec.kind {
        FeatureKind::Image => Values::U8(Vec::new()),
        FeatureKind::State | FeatureKind::EnvironmentState | FeatureKind::Entity => Values::F32(Vec::new()),
    }
}

fn join(spec: &FeatureSpec, into: &mut Values, values: ValuesRef<'_>) -> Result<()> {
    match (into, values) {
        (Values::F32(into), ValuesRef::F32(values)) => into.extend_from_slice(values),
        (Values::U8(into), ValuesRef::U8(values)) => into.extend_from_slice(values),
        (Values::F32(_), ValuesRef::U8(_)) => return Err(wrong_type(spec, "bytes", "numbers")),
        (Values::U8(_), ValuesRef::F32(_)) => return Err(wrong_type(spec, "numbers", "bytes")),
    }
    Ok(())
}

fn wrong_type(spec: &FeatureSpec, found: &'static str, expected: &'static str) -> ModelError {
    ModelError::FeatureType { name: spec.name.clone(), kind: spec.kind.name(), found, expected }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::features::ENTITY_PREFIX;
    use crate::normaliser::{ENVIRONMENT_STATE, NormMode, STATE};
    use proptest::prelude::*;
    use std::collections::BTreeMap;

    /// state of 2, entity of 1 twice, action of 1; mean 1 and deviation 2 everywhere, of the action 10 and 5.
    fn preprocess(n_obs_steps: usize) -> Preprocess {
        let observation = vec![
            FeatureSpec::state(2),
            FeatureSpec::entity("a", 1, "ab", false),
            FeatureSpec::entity("b", 1, "ab", false),
        ];
        let signature = Signature { observation, n_obs_steps, action_dim: 1, ..Signature::default() };
        let (mut modes, mut tensors) = (BTreeMap::new(), BTreeMap::new());
        let widths = signature.observation.iter().map(|spec| (spec.name.as_str(), spec.width(), 1.0, 2.0));
        for (name, width, mean, std) in widths.chain([(ACTION, 1, 10.0, 5.0)]) {
            modes.insert(name.to_string(), NormMode::MeanStd);
            for (statistic, value) in [("mean", mean), ("std", std)] {
                let tensor = Tensor::from_vec(vec![value; width], width, &Device::Cpu).unwrap();
                tensors.insert(format!("{name}.{statistic}"), tensor.to_dtype(candle_core::DType::F32).unwrap());
            }
        }
        Preprocess::new(signature, Normaliser::new(&modes, &tensors).unwrap(), &Device::Cpu).unwrap()
    }

    fn seen(values: &[f32]) -> Observation {
        let names = [STATE, "observation.entity.a", "observation.entity.b"];
        let widths = [2, 1, 1];
        let mut rest = values;
        names
            .iter()
            .zip(widths)
            .map(|(name, width)| {
                let (head, tail) = rest.split_at(width);
                rest = tail;
                (name.to_string(), Values::F32(head.to_vec()))
            })
            .collect()
    }

    proptest! {
        /// A window of history and the same observations at inference are the same tensors.
        #[test]
        fn training_and_inference_see_the_same(
            n_obs_steps in 1_usize..4,
            steps in prop::collection::vec(prop::collection::vec(-5.0_f32..5.0, 4), 1..6),
        ) {
            let preprocess = preprocess(n_obs_steps);
            let history: Vec<Observation> = steps.iter().map(|values| seen(values)).collect();
            let shown = preprocess.observation(&history).unwrap();
            let clamped = |k: usize| (steps.len() + k).saturating_sub(n_obs_steps);
            let windows = Features::from_iter(history[0].names().map(|name| {
                let rows = (0..n_obs_steps).flat_map(|k| match history[clamped(k)].get(name) {
                    Some(Values::F32(values)) => values.clone(),
                    other => panic!("{other:?}"),
                });
                (name.to_string(), rows.collect::<Vec<f32>>())
            }));
            let borrowed = windows.map(|_, values| ValuesRef::F32(values));
            let batch = preprocess.batch(1, &borrowed, &[20.0], &[false]).unwrap();
            for (name, tensor) in batch.observation.iter() {
                let other = shown.get(name).unwrap();
                prop_assert_eq!(tensor.dims(), other.dims());
                let flat = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
                prop_assert_eq!(flat(tensor), flat(other));
                let raw: Vec<f32> = windows.get(name).unwrap().iter().map(|x| (x - 1.0) / (2.0 + 1e-8)).collect();
                prop_assert_eq!(flat(tensor), raw);
            }
            prop_assert_eq!(batch.actions.to_vec3::<f32>().unwrap(), [[[2.0]]]);
        }
    }

    #[test]
    fn images_are_painted_in_the_colours_of_other_features() {
        let names = ["a", "b", "c"].map(|name| format!("{ENTITY_PREFIX}{name}"));
        let observation = vec![
            FeatureSpec::state(2),
            FeatureSpec::entity("a", 3, "colour", true),
            FeatureSpec::entity("b", 3, "colour", true),
            FeatureSpec::entity("c", 3, "colour", true),
            FeatureSpec::image("front", 1, 2).in_colours(names.to_vec()),
        ];
        let signature = Signature { observation, n_obs_steps: 2, action_dim: 1, ..Signature::default() };
        let modes = [STATE, ACTION].into_iter().chain(names.iter().map(String::as_str));
        let modes = modes.map(|name| (name.to_string(), NormMode::Identity)).collect();
        let preprocess =
            Preprocess::new(signature, Normaliser::new(&modes, &BTreeMap::new()).unwrap(), &Device::Cpu).unwrap();
        let step = |colours: [[f32; 3]; 3], pixels: [u8; 6]| {
            let mut step = Observation::of_state(vec![0.0; 2], vec![]);
            names.iter().zip(colours).for_each(|(name, colour)| step.insert(name, colour.to_vec().into()));
            step.insert("front", Values::U8(pixels.to_vec()));
            step
        };
        let (red, green, blue) = ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]);
        // the colours of each step are that step's
        let history = [
            step([blue, red, green], [10, 20, 30, 77, 77, 77]),
            step([[0.5, 0.5, 0.0], [0.0; 3], [0.0, -1.0, 3.0]], [10, 20, 200, 77, 77, 77]),
        ];
        let seen = preprocess.observation(&history).unwrap();
        let front = seen.get("front").unwrap();
        assert_eq!(front.dims(), [1, 2, 1, 2, 3]);
        let bytes = front.flatten_all().unwrap().to_vec1::<u8>().unwrap();
        assert_eq!(bytes, [30, 10, 20, 77, 77, 77, 15, 0, 145, 77, 0, 39]);
        // in training the same
        let rows = history[0].names().map(|name| {
            let of = |step: &Observation| step.get(name).unwrap().clone();
            let both = match (of(&history[0]), of(&history[1])) {
                (Values::F32(a), Values::F32(b)) => Values::F32([a, b].concat()),
                (Values::U8(a), Values::U8(b)) => Values::U8([a, b].concat()),
                other => panic!("{other:?}"),
            };
            (name.to_string(), both)
        });
        let rows = Features::from_iter(rows);
        let batch = preprocess.batch(1, &rows.map(|_, values| values.as_ref()), &[0.0], &[false]).unwrap();
        assert_eq!(batch.observation.get("front").unwrap().flatten_all().unwrap().to_vec1::<u8>().unwrap(), bytes);
        // without them there is no image
        let mut blind = history[1].clone();
        blind.take("test", &names[1]).unwrap();
        let error = preprocess.observation(&[blind]).unwrap_err().to_string();
        assert!(error.contains("feature observation.entity.b is missing"), "{error}");
    }

    #[test]
    fn actions_come_back_in_raw_units() {
        let chunk = preprocess(1).chunk(&Tensor::new(&[[[2.0_f32], [-1.0]]], &Device::Cpu).unwrap()).unwrap();
        assert_eq!((chunk.actions.as_slice(), chunk.action_horizon), (&[20.0, 5.0][..], 2));
        let error = preprocess(1).chunk(&Tensor::new(&[[[2.0_f32, 1.0]]], &Device::Cpu).unwrap()).unwrap_err();
        assert!(error.to_string().contains("actions has shape [1, 1, 2], expected [1, 1, 1]"), "{error}");
    }

    #[test]
    fn what_does_not_fit_is_named() {
        let preprocess = preprocess(1);
        let error = |observation: &[Observation]| preprocess.observation(observation).unwrap_err().to_string();
        assert!(error(&[]).contains("history is empty"));
        let mut observation = seen(&[0.0; 4]);
        observation.insert(STATE, vec![0.0; 3].into());
        assert_eq!(error(&[observation.clone()]), "predict: observation.state has shape [3], expected [2]");
        observation.insert(STATE, Values::U8(vec![0; 2]));
        assert_eq!(error(&[observation]), "feature observation.state of kind state holds bytes, expected numbers");
        let given = "predict: feature observation.entity.a is missing; given: observation.state";
        assert_eq!(error(&[Observation::of_state(vec![0.0; 2], vec![])]), given);
        // a feature that the signature does not have is left alone
        let mut more = seen(&[0.0; 4]);
        more.insert(ENVIRONMENT_STATE, vec![0.0; 3].into());
        assert_eq!(preprocess.observation(&[more]).unwrap().len(), 3);
        let wide = Signature::low_dimensional(3, 0, 1);
        let error = Preprocess::new(wide, preprocess.normaliser().clone(), &Device::Cpu).unwrap_err().to_string();
        assert!(error.contains("observation.state with 3 values"), "{error}");
    }
}
