//! A batch of training windows in network units.

use crate::error::{ModelError, Result};
use candle_core::{Device, Tensor};
use serde::{Deserialize, Serialize};

/// Sizes that the data set fixes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dims {
    /// numbers in the robot's own state
    pub state: usize,
    /// numbers in the environment's state; 0 if there is none
    pub environment_state: usize,
    /// numbers in an action
    pub action: usize,
}

/// Windows as tensors, all f32.
#[derive(Debug, Clone)]
pub struct Batch {
    /// (b, S)
    pub state: Tensor,
    /// (b, E)
    pub environment_state: Option<Tensor>,
    /// (b, H, A)
    pub actions: Tensor,
    /// (b, H): 1 where the step lies beyond the end of its episode, else 0
    pub is_pad: Tensor,
    /// Rows of the whole batch that this one is a shard of: losses are averaged over this number.
    pub total_rows: usize,
    /// Steps of the whole batch that are not padding.
    pub total_valid_steps: usize,
    /// The same for all shards of a batch: what a model draws once per batch it draws from here.
    pub seed: u64,
}

impl Batch {
    /// From row-major slices: `state` n*S, `environment_state` n*E (empty if E = 0), `actions` n*H*A, `is_pad` n*H.
    ///
    /// # Errors
    /// A slice of the wrong length, or an empty batch.
    pub fn from_slices(
        dims: &Dims,
        action_horizon: usize,
        state: &[f32],
        environment_state: &[f32],
        actions: &[f32],
        is_pad: &[bool],
    ) -> Result<Self> {
        let n = is_pad.len() / action_horizon.max(1);
        let check = |object: &'static str, found: usize, expected: &[usize]| {
            if found == expected.iter().product::<usize>() && found > 0 {
                return Ok(());
            }
            Err(ModelError::Shape { operation: "batch", object, expected: expected.to_vec(), found: vec![found] })
        };
        check("is_pad", is_pad.len(), &[n, action_horizon])?;
        check("state", state.len(), &[n, dims.state])?;
        if dims.environment_state > 0 || !environment_state.is_empty() {
            check("environment_state", environment_state.len(), &[n, dims.environment_state])?;
        }
        check("actions", actions.len(), &[n, action_horizon, dims.action])?;
        let dev = &Device::Cpu;
        let pad: Vec<f32> = is_pad.iter().map(|&p| if p { 1.0 } else { 0.0 }).collect();
        let environment_state = match dims.environment_state {
            0 => None,
            e => Some(Tensor::from_slice(environment_state, (n, e), dev)?),
        };
        Ok(Self {
            state: Tensor::from_slice(state, (n, dims.state), dev)?,
            environment_state,
            actions: Tensor::from_slice(actions, (n, action_horizon, dims.action), dev)?,
            is_pad: Tensor::from_vec(pad, (n, action_horizon), dev)?,
            total_rows: n,
            total_valid_steps: is_pad.iter().filter(|&&p| !p).count(),
            seed: 0,
        })
    }

    /// Rows in this shard.
    pub fn rows(&self) -> usize {
        self.state.dims().first().copied().unwrap_or(0)
    }

    /// Cuts the batch into at most `n` shards of consecutive rows whose losses add up to the loss of the whole.
    pub fn shards(&self, n: usize) -> Result<Vec<Self>> {
        let rows = self.rows();
        let n = n.clamp(1, rows.max(1));
        (0..n)
            .map(|i| {
                let (from, to) = (rows * i / n, rows * (i + 1) / n);
                let cut = |t: &Tensor| t.narrow(0, from, to - from)?.contiguous();
                Ok(Self {
                    state: cut(&self.state)?,
                    environment_state: self.environment_state.as_ref().map(cut).transpose()?,
                    actions: cut(&self.actions)?,
                    is_pad: cut(&self.is_pad)?,
                    ..self.clone()
                })
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn shards_cover_the_rows_and_keep_the_totals() {
        let dims = Dims { state: 2, environment_state: 1, action: 1 };
        let state: Vec<f32> = (0..10).map(|x| x as f32).collect();
        let mut pad = [false; 15];
        pad[4] = true;
        let batch = Batch::from_slices(&dims, 3, &state, &[0.0; 5], &[0.0; 15], &pad).unwrap();
        assert_eq!((batch.rows(), batch.total_rows, batch.total_valid_steps), (5, 5, 14));
        let shards = batch.shards(2).unwrap();
        assert_eq!(shards.iter().map(Batch::rows).collect::<Vec<_>>(), [2, 3]);
        assert_eq!(shards[1].state.to_vec2::<f32>().unwrap()[0], [4.0, 5.0]);
        assert_eq!(shards[1].total_valid_steps, 14);
        assert_eq!(batch.shards(9).unwrap().len(), 5);
    }

    #[test]
    fn a_wrong_length_names_the_slice() {
        let dims = Dims { state: 2, environment_state: 0, action: 1 };
        let error = Batch::from_slices(&dims, 3, &[0.0; 3], &[], &[0.0; 3], &[false; 3]).unwrap_err();
        assert!(error.to_string().contains("state"), "{error}");
    }
}
