//! A batch of training windows in network units.

use crate::features::{Features, Signature, Values, ValuesRef};
use candle_core::{Device, Tensor};
use nn::{ModelError, Result};

/// Windows as tensors.
#[derive(Debug, Clone)]
pub struct Batch {
    /// (b, …) each as [`Signature::batch_shape`] says; f32, images u8
    pub observation: Features<Tensor>,
    /// (b, H, A)
    pub actions: Tensor,
    /// (b, H): 1 where the step lies beyond the end of its episode, else 0
    pub is_pad: Tensor,
    /// `is_pad` row by row on the CPU, if it came from there: reading it does not wait for a device
    pub padding: Option<Vec<f32>>,
    /// What the demonstrations took; `None` where nobody asked.
    pub taken: Option<Taken>,
    /// (b, cells): 1 where a demonstration comes by a cell of a grid now or later, else 0; `None` where nobody asked.
    pub visited: Option<Tensor>,
    /// (b, K): numbers that the demonstrations know and the policy does not see, normalised; `None` where nobody asked.
    pub auxiliary: Option<Tensor>,
    /// Rows of the whole batch that this one is a shard of: losses are averaged over this number.
    pub total_rows: usize,
    /// Steps of the whole batch that are not padding.
    pub total_valid_steps: usize,
    /// The same for all shards of a batch: what a model draws once per batch it draws from here.
    pub seed: u64,
}

/// What demonstrations took.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Taken {
    /// of each row the feature, by its place in the signature; `None` where it is not asked
    pub features: Vec<Option<u32>>,
    /// Rows of the whole batch where it is asked: the loss is averaged over this number.
    pub total: usize,
}

impl Taken {
    /// Of a whole batch.
    pub fn new(features: Vec<Option<u32>>) -> Self {
        let total = features.iter().flatten().count();
        Self { features, total }
    }
}

impl Batch {
    /// On a device, from row-major values: those of the signature's features, `actions` n*H*A, `is_pad` n*H. Features that are
    /// there already come as tensors in `placed`.
    ///
    /// # Errors
    /// Values of the wrong length, by name, or an empty batch.
    pub fn new(
        signature: &Signature,
        action_horizon: usize,
        mut observation: Features<Values>,
        placed: &Features<Tensor>,
        actions: Vec<f32>,
        is_pad: &[bool],
        device: &Device,
    ) -> Result<Self> {
        let n = is_pad.len() / action_horizon.max(1);
        check("is_pad", is_pad.len(), &[n, action_horizon])?;
        check("actions", actions.len(), &[n, action_horizon, signature.action_dim])?;
        for spec in signature.observation.iter().filter(|spec| placed.get(&spec.name).is_none()) {
            observation.require("batch", &spec.name)?;
        }
        let mut tensors = Features::new();
        for spec in &signature.observation {
            let shape = signature.batch_shape(spec, n);
            let made = match placed.get(&spec.name) {
                Some(placed) if placed.dims() == shape => placed.clone(),
                Some(placed) => {
                    let (operation, name, found) = ("batch", spec.name.clone(), placed.dims().to_vec());
                    return Err(ModelError::FeatureShape { operation, name, expected: shape, found });
                }
                None => tensor(&spec.name, observation.take("batch", &spec.name)?, &shape, device)?,
            };
            tensors.insert(&spec.name, made);
        }
        let pad: Vec<f32> = is_pad.iter().map(|&p| if p { 1.0 } else { 0.0 }).collect();
        Ok(Self {
            observation: tensors,
            actions: Tensor::from_vec(actions, (n, action_horizon, signature.action_dim), device)?,
            is_pad: Tensor::from_slice(&pad, (n, action_horizon), device)?,
            padding: Some(pad),
            taken: None,
            visited: None,
            auxiliary: None,
            total_rows: n,
            total_valid_steps: is_pad.iter().filter(|&&p| !p).count(),
            seed: 0,
        })
    }

    /// The same on the CPU, from borrowed values.
    ///
    /// # Errors
    /// As [`Batch::new`].
    pub fn from_slices(
        signature: &Signature,
        action_horizon: usize,
        observation: &Features<ValuesRef<'_>>,
        actions: &[f32],
        is_pad: &[bool],
    ) -> Result<Self> {
        let owned = observation.map(|_, values| values.to_values());
        Self::new(signature, action_horizon, owned, &Features::new(), actions.to_vec(), is_pad, &Device::Cpu)
    }

    /// Rows in this shard.
    pub fn rows(&self) -> usize {
        self.actions.dims().first().copied().unwrap_or(0)
    }

    /// Where its tensors are.
    pub fn device(&self) -> &Device {
        self.actions.device()
    }

    /// The same on a device.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn to_device(&self, device: &Device) -> Result<Self> {
        let placed = |tensor: &Tensor| tensor.to_device(device);
        Ok(Self {
            observation: self.observation.try_map(|_, tensor| placed(tensor))?,
            actions: placed(&self.actions)?,
            is_pad: placed(&self.is_pad)?,
            ..self.clone()
        })
    }

    /// Cuts the batch into at most `n` shards of consecutive rows whose losses add up to the loss of the whole.
    pub fn shards(&self, n: usize) -> Result<Vec<Self>> {
        let rows = self.rows();
        let n = n.clamp(1, rows.max(1));
        (0..n)
            .map(|i| {
                let (from, to) = (rows * i / n, rows * (i + 1) / n);
                let cut = |t: &Tensor| t.narrow(0, from, to - from)?.contiguous();
                let horizon = self.is_pad.dim(1)?;
                Ok(Self {
                    observation: self.observation.try_map(|_, tensor| cut(tensor))?,
                    actions: cut(&self.actions)?,
                    is_pad: cut(&self.is_pad)?,
                    padding: self.padding.as_ref().map(|pad| pad[from * horizon..to * horizon].to_vec()),
                    taken: self
                        .taken
                        .as_ref()
                        .map(|taken| Taken { features: taken.features[from..to].to_vec(), ..*taken }),
                    visited: self.visited.as_ref().map(cut).transpose()?,
                    auxiliary: self.auxiliary.as_ref().map(cut).transpose()?,
                    ..self.clone()
                })
            })
            .collect()
    }
}

fn check(name: &str, found: usize, expected: &[usize]) -> Result<()> {
    if found == expected.iter().product::<usize>() && found > 0 {
        return Ok(());
    }
    let (operation, name) = ("batch", name.to_string());
    Err(ModelError::FeatureShape { operation, name, expected: expected.to_vec(), found: vec![found] })
}

/// Values of feature `name` as a tensor of this shape.
pub(crate) fn tensor(name: &str, values: Values, shape: &[usize], device: &Device) -> Result<Tensor> {
    check(name, values.as_ref().len(), shape)?;
    Ok(match values {
        Values::F32(values) => Tensor::from_vec(values, shape, device)?,
        Values::U8(values) => Tensor::from_vec(values, shape, device)?,
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::features::FeatureSpec;
    use crate::normaliser::STATE;

    #[test]
    fn shards_cover_the_rows_and_keep_the_totals() {
        let signature = Signature::low_dimensional(2, 1, 1);
        let state: Vec<f32> = (0..10).map(|x| x as f32).collect();
        let mut pad = [false; 15];
        pad[4] = true;
        let observation = Features::of_slices(&state, &[0.0; 5]);
        let batch = Batch::from_slices(&signature, 3, &observation, &[0.0; 15], &pad).unwrap();
        assert_eq!((batch.rows(), batch.total_rows, batch.total_valid_steps), (5, 5, 14));
        let shards = batch.shards(2).unwrap();
        assert_eq!(shards.iter().map(Batch::rows).collect::<Vec<_>>(), [2, 3]);
        assert_eq!(shards[1].observation.get(STATE).unwrap().to_vec2::<f32>().unwrap()[0], [4.0, 5.0]);
        assert_eq!(shards[1].total_valid_steps, 14);
        assert_eq!(batch.shards(9).unwrap().len(), 5);
    }

    #[test]
    fn a_wrong_length_and_a_missing_feature_are_named() {
        let mut signature = Signature::low_dimensional(2, 0, 1);
        let make = |signature: &Signature, state: &[f32]| {
            let observation = Features::of_slices(state, &[]);
            Batch::from_slices(signature, 3, &observation, &[0.0; 3], &[false; 3]).map(|batch| batch.observation)
        };
        let error = make(&signature, &[0.0; 3]).unwrap_err().to_string();
        assert_eq!(error, "batch: observation.state has shape [3], expected [1, 2]");
        signature.n_obs_steps = 3;
        let observation = make(&signature, &[0.0; 6]).unwrap();
        assert_eq!(observation.get(STATE).unwrap().dims(), [1, 3, 2]);
        signature.observation.push(FeatureSpec::entity("cube", 3, "cube", false));
        let error = make(&signature, &[0.0; 6]).unwrap_err().to_string();
        assert_eq!(error, "batch: feature observation.entity.cube is missing; given: observation.state");
    }
}
