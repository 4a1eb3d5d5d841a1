//! The recursion over the memory, the original's, and ACT's decoder.

use super::{Carry, Config, Observed, decoder};
use crate::layers::{Decoder, Encoder, LayerInit, Shape};
use nn::ops::add;
use nn::{Context, Init, Params, Result, Rng, Value};

/// The design.
#[derive(Debug)]
pub(super) struct OverMemory {
    block: Encoder,
    z_init: [Vec<f32>; 2],
    pub(super) decoder: Decoder,
}

/// The fixed values that `z_h` and `z_l` begin with, (D) each: a pure function of the width, so that nothing untrained
/// needs storing.
fn fixed_values(dim: usize) -> [Vec<f32>; 2] {
    let init = Init::TruncatedNormal { std: 1.0 };
    ["actrm z_h", "actrm z_l"].map(|name| init.values(&[dim], &mut Rng::new(0, name)))
}

impl OverMemory {
    pub(super) fn new(p: &mut Params, config: &Config, shape: Shape, rng: &mut Rng) -> Result<Self> {
        // no dropout inside the recursion
        let quiet = Shape { dropout: 0.0, hidden: config.block_feedforward(), ..shape };
        Ok(Self {
            block: Encoder::new(p, "reasoning", config.reasoning.n_layers, quiet, LayerInit::Xavier, rng)?,
            z_init: fixed_values(config.dim_model),
            decoder: decoder(p, config, rng)?,
        })
    }

    /// `l_cycles` updates of `z_l`, one of `z_h`; pos: (1, M, D). No gradient flows back to the carry.
    pub(super) fn round(
        &self,
        cx: &mut Context<'_>,
        config: &Config,
        observed: &Observed,
        carry: &Carry,
        pos: &Value,
    ) -> Result<Carry> {
        let shape = observed.memory.dims().to_vec();
        let state = |state: &Option<Value>, begun: &[f32]| match state {
            Some(state) => Ok(state.detach()),
            None => {
                Value::of(begun.repeat(observed.memory.len() / begun.len()), shape.clone(), observed.memory.device())
            }
        };
        let answer = state(&carry.answer, &self.z_init[0])?;
        let mut reasoning = state(&carry.reasoning, &self.z_init[1])?;
        for _ in 0..config.reasoning.l_cycles {
            // summed anew for each update, so that each adds its own gradient to the memory's
            let injected = add(cx, &observed.memory, &answer)?;
            let x = add(cx, &injected, &reasoning)?;
            reasoning = self.block.apply(cx, &x, pos, None, shape[1])?;
        }
        let x = add(cx, &answer, &reasoning)?;
        let answer = self.block.apply(cx, &x, pos, None, shape[1])?;
        Ok(Carry { answer: Some(answer), reasoning: Some(reasoning) })
    }
}
