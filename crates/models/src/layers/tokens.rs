//! Observations as tokens.

use super::Linear;
use crate::error::Result;
use candle_core::Tensor;

/// Observations as tokens, a dense layer each.
#[derive(Debug)]
pub(crate) struct InputTokens {
    pub(crate) latent: Linear,
    pub(crate) robot_state: Linear,
    pub(crate) env_state: Option<Linear>,
}

impl InputTokens {
    /// latent: (b, L), state: (b, S), environment_state: (b, E) -> (b, M, D)
    pub(crate) fn forward(
        &self,
        latent: &Tensor,
        state: &Tensor,
        environment_state: Option<&Tensor>,
    ) -> Result<Tensor> {
        let mut tokens =
            vec![self.latent.forward(latent)?.unsqueeze(1)?, self.robot_state.forward(state)?.unsqueeze(1)?];
        if let (Some(layer), Some(env)) = (&self.env_state, environment_state) {
            tokens.push(layer.forward(env)?.unsqueeze(1)?);
        }
        Ok(Tensor::cat(&tokens, 1)?)
    }
}
