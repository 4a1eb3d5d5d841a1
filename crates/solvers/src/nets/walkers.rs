//! Networks for the reinforcement half of the puzzle study: an observation vector to action
//! scores and, where the algorithm wants one, a value.
//!
//! Sizes of [`MlpWalker`] (20,356 on the 5x5 maze) and [`TrmWalker`] (69,038 for any number of
//! cycles) are those of acharyaanusha/Tiny-Recursive-Model, `trm_core/trm_rl.py`; the value head
//! is ours and optional. [`TrmWalker`] differs from the original in two places. From the second cycle on, the original
//! adds `carry` of the high state to the output of the high blocks; here it is added to their input. The original
//! leaves out the previous action in the first step of an episode; here it is action 0.
//! [`ConvWalker`] is ours: a small TRM with 3x3 convolutions over the maze.

use super::grids::dense;
use crate::trm::{self, Recursion};
use candle_core::{D, Tensor};
use models::layers::{LayerNorm, Linear};
use nn::Backend;
use nn::Rng;
use nn::{Init, Params};
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};

/// What a policy network says about a batch of observations.
#[derive(Debug, Clone)]
pub struct WalkerOutput {
    /// `(batch, actions)`, before the softmax.
    pub logits: Tensor,
    /// `(batch,)`, expected return, if the network has a value head.
    pub value: Option<Tensor>,
}

/// A network that scores actions.
pub trait WalkerNet: Send + Sync {
    /// Its parameters.
    fn params(&self) -> &Params;

    /// Numbers in an observation, number of actions, and whether there is a value head.
    fn sizes(&self) -> (usize, usize, bool);

    /// `observation: (batch, observation_dim)`, `previous_action: (batch,)` of u32, used by
    /// networks that look at it.
    ///
    /// # Errors
    /// When a shape does not fit, or the previous action is wanted and absent.
    fn forward(&self, observation: &Tensor, previous_action: Option<&Tensor>) -> Result<WalkerOutput>;
}

/// Which policy network, and its sizes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum WalkerConfig {
    /// Dense layers with ReLU.
    Mlp {
        /// Widths of the hidden layers; the study's are 128, 128.
        hidden: Vec<usize>,
        /// Whether a value head shares the hidden layers.
        #[serde(default)]
        value: bool,
    },
    /// The study's hierarchical recursion.
    Trm {
        /// Width of the high-level state; the study's is 64.
        high: usize,
        /// Width of the low-level state; the study's is 32.
        low: usize,
        /// Cycles K.
        cycles: usize,
        /// Whether the previous action is seen; it is in the study.
        #[serde(default)]
        previous_action: bool,
        /// Whether there is a value head.
        #[serde(default)]
        value: bool,
    },
    /// A TRM with 3x3 convolutions over `channels` planes of `height x width`, the first of which marks the agent.
    Conv {
        /// Planes of the observation.
        channels: usize,
        /// Rows.
        height: usize,
        /// Columns.
        width: usize,
        /// Width of the state per cell.
        hidden: usize,
        /// Hidden width of the block's dense part.
        inner: usize,
        /// Applications of the block, at least 2.
        cycles: usize,
        /// Whether there is a value head.
        #[serde(default)]
        value: bool,
    },
}

impl WalkerConfig {
    /// Builds the network with weights drawn from `seed`.
    ///
    /// # Errors
    /// When the configuration cannot work.
    pub fn build(&self, observation: usize, actions: usize, seed: u64) -> Result<Box<dyn WalkerNet>> {
        let mut rng = Rng::new(seed, "policy net");
        let rng = &mut rng;
        Ok(match *self {
            Self::Mlp { ref hidden, value } => Box::new(MlpWalker::new(observation, actions, hidden, value, rng)?),
            Self::Trm { high, low, cycles, previous_action, value } => {
                let sizes = TrmPolicySizes { observation, actions, high, low, cycles };
                Box::new(TrmWalker::new(sizes, previous_action, value, rng)?)
            }
            Self::Conv { channels, height, width, hidden, inner, cycles, value } => {
                if channels * height * width != observation {
                    return Err(ModelError::Config {
                        model: "conv policy",
                        field: "channels x height x width",
                        found: (channels * height * width).to_string(),
                        expected: format!("the observation's length, {observation}"),
                    });
                }
                if cycles < 2 {
                    return Err(ModelError::Config {
                        model: "conv policy",
                        field: "cycles",
                        found: cycles.to_string(),
                        expected: "at least 2".into(),
                    });
                }
                let grid = (channels, height, width);
                Box::new(ConvWalker::new(grid, actions, (hidden, inner, cycles), value, rng)?)
            }
        })
    }
}

/// Rows of a dense layer's weight.
fn out_size(layer: &Linear) -> usize {
    layer.weight.dims()[0]
}

fn value_head(params: &mut Params, wanted: bool, input: usize, rng: &mut Rng) -> Result<Option<Linear>> {
    wanted.then(|| Linear::new(params, "value", input, 1, rng)).transpose()
}

fn value(head: Option<&Linear>, x: &Tensor) -> Result<Option<Tensor>> {
    head.map(|head| Ok(head.forward(x)?.squeeze(D::Minus1)?)).transpose()
}

/// Dense layers.
#[derive(Debug)]
pub struct MlpWalker {
    params: Params,
    observation: usize,
    layers: Vec<Linear>,
    head: Linear,
    value: Option<Linear>,
}

impl MlpWalker {
    fn new(observation: usize, actions: usize, hidden: &[usize], with_value: bool, rng: &mut Rng) -> Result<Self> {
        let mut params = Params::new(&Backend::CPU);
        let mut width = observation;
        let mut layers = Vec::new();
        for (i, &next) in hidden.iter().enumerate() {
            layers.push(Linear::new(&mut params, &format!("layers.{i}"), width, next, rng)?);
            width = next;
        }
        let head = Linear::new(&mut params, "head", width, actions, rng)?;
        let value = value_head(&mut params, with_value, width, rng)?;
        Ok(Self { params, observation, layers, head, value })
    }
}

impl WalkerNet for MlpWalker {
    fn params(&self) -> &Params {
        &self.params
    }

    fn sizes(&self) -> (usize, usize, bool) {
        (self.observation, out_size(&self.head), self.value.is_some())
    }

    fn forward(&self, observation: &Tensor, _: Option<&Tensor>) -> Result<WalkerOutput> {
        let mut x = observation.clone();
        for layer in &self.layers {
            x = layer.forward(&x)?.relu()?;
        }
        Ok(WalkerOutput { logits: self.head.forward(&x)?, value: value(self.value.as_ref(), &x)? })
    }
}

/// `x + w3(silu(w1 n) * w2 n)` with `n = norm(x)`.
#[derive(Debug)]
struct SwigluBlock {
    norm: LayerNorm,
    gate: Linear,
    up: Linear,
    down: Linear,
}

impl SwigluBlock {
    fn new(params: &mut Params, prefix: &str, dim: usize, inner: usize, rng: &mut Rng) -> Result<Self> {
        let at = |name: &str| format!("{prefix}.{name}");
        Ok(Self {
            norm: LayerNorm::new(params, &at("norm"), dim, rng)?,
            gate: Linear::new(params, &at("gate"), dim, inner, rng)?,
            up: Linear::new(params, &at("up"), dim, inner, rng)?,
            down: Linear::new(params, &at("down"), inner, dim, rng)?,
        })
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let n = self.norm.forward(x)?;
        let gated = (self.gate.forward(&n)?.silu()? * self.up.forward(&n)?)?;
        Ok((x + self.down.forward(&gated)?)?)
    }
}

#[derive(Debug, Clone, Copy)]
struct TrmPolicySizes {
    observation: usize,
    actions: usize,
    high: usize,
    low: usize,
    cycles: usize,
}

/// A policy like the study's hierarchical one: per cycle two SwiGLU blocks on the high state, one dense
/// block on the low one, and a way back up.
#[derive(Debug)]
pub struct TrmWalker {
    params: Params,
    observation: usize,
    cycles: usize,
    previous: Option<(Tensor, Linear)>,
    input: Linear,
    carry: Linear,
    high: [SwigluBlock; 2],
    down: Linear,
    low_norm: LayerNorm,
    low: [Linear; 2],
    up: Linear,
    head: [Linear; 2],
    value: Option<Linear>,
}

impl TrmWalker {
    fn new(sizes: TrmPolicySizes, previous_action: bool, with_value: bool, rng: &mut Rng) -> Result<Self> {
        let TrmPolicySizes { observation, actions, high, low, cycles } = sizes;
        if cycles < 2 {
            // with one cycle `carry` is never applied and would get no gradient
            return Err(ModelError::Config {
                model: "trm policy",
                field: "cycles",
                found: cycles.to_string(),
                expected: "at least 2".into(),
            });
        }
        let mut params = Params::new(&Backend::CPU);
        let p = &mut params;
        let previous = if previous_action {
            let table = p.create("previous.embed", &[actions, high], Init::Normal { std: 1.0 }, rng)?;
            Some((table, Linear::new(p, "previous.project", observation + high, observation, rng)?))
        } else {
            None
        };
        let input = Linear::new(p, "input", observation, high, rng)?;
        let carry = Linear::new(p, "carry", high, high, rng)?;
        let blocks =
            [SwigluBlock::new(p, "high.0", high, 2 * high, rng)?, SwigluBlock::new(p, "high.1", high, 2 * high, rng)?];
        let down = Linear::new(p, "down", high, low, rng)?;
        let low_norm = LayerNorm::new(p, "low.norm", low, rng)?;
        let low_layers = [Linear::new(p, "low.0", low, 2 * low, rng)?, Linear::new(p, "low.1", 2 * low, low, rng)?];
        let up = Linear::new(p, "up", low, high, rng)?;
        let head = [Linear::new(p, "head.0", high, high / 2, rng)?, Linear::new(p, "head.1", high / 2, actions, rng)?];
        let value = value_head(p, with_value, high, rng)?;
        Ok(Self {
            params,
            observation,
            cycles,
            previous,
            input,
            carry,
            high: blocks,
            down,
            low_norm,
            low: low_layers,
            up,
            head,
            value,
        })
    }
}

impl WalkerNet for TrmWalker {
    fn params(&self) -> &Params {
        &self.params
    }

    fn sizes(&self) -> (usize, usize, bool) {
        (self.observation, out_size(&self.head[1]), self.value.is_some())
    }

    fn forward(&self, observation: &Tensor, previous_action: Option<&Tensor>) -> Result<WalkerOutput> {
        let observation = match (&self.previous, previous_action) {
            (None, _) => observation.clone(),
            (Some((table, project)), Some(action)) => {
                let embedded = table.index_select(action, 0)?;
                project.forward(&Tensor::cat(&[observation, &embedded], D::Minus1)?)?
            }
            (Some(_), None) => {
                return Err(ModelError::Input {
                    operation: "trm policy",
                    object: "previous action",
                    found: "absent".into(),
                    expected: "one per observation".into(),
                });
            }
        };
        let mut h = self.input.forward(&observation)?;
        for cycle in 0..self.cycles {
            if cycle > 0 {
                h = (&h + self.carry.forward(&h)?)?;
            }
            for block in &self.high {
                h = block.forward(&h)?;
            }
            let low = self.down.forward(&h)?;
            let fed = dense(&self.low, &self.low_norm.forward(&low)?)?;
            h = (h + self.up.forward(&(low + fed)?)?)?;
        }
        Ok(WalkerOutput { logits: dense(&self.head, &h)?, value: value(self.value.as_ref(), &h)? })
    }
}

/// A TRM with one round, from states of zero: `z = net(z + x)` for all cycles but the last, then `h = net(z)`, where
/// `net` is `h = rms(h + conv(h))`, `h = rms(h + swiglu(h))`. Scores are read where the agent stands, the value from the
/// mean as well.
#[derive(Debug)]
pub struct ConvWalker {
    params: Params,
    grid: (usize, usize, usize),
    cycles: usize,
    fused: Recursion,
    input: Linear,
    /// The network's weights in the kernel's order.
    block: [Tensor; 3],
    head: Linear,
    value: Option<Linear>,
}

impl ConvWalker {
    fn new(
        grid: (usize, usize, usize),
        actions: usize,
        (hidden, inner, cycles): (usize, usize, usize),
        with_value: bool,
        rng: &mut Rng,
    ) -> Result<Self> {
        let (channels, height, width) = grid;
        let config = trm::Config {
            mixing: trm::Mixing::Conv,
            positions: trm::Positions::None,
            grid: Some([height, width]),
            layers: 1,
            inner_size: Some(inner),
            ..trm::Config::new(1, height * width, hidden)
        };
        config.check()?;
        let mut params = Params::new(&Backend::CPU);
        let p = &mut params;
        let weight = |params: &mut Params, name: &str, input: usize, output: usize, rng: &mut Rng| {
            let init = Init::TruncatedNormal { std: 1.0 / (input as f64).sqrt() };
            Ok::<_, ModelError>(Linear::with_init(params, name, (input, output), init, None, rng)?.weight)
        };
        Ok(Self {
            input: Linear::new(p, "input", channels, hidden, rng)?,
            block: [
                weight(p, "mix", 9 * hidden, hidden, rng)?,
                weight(p, "gate_up", hidden, 2 * inner, rng)?,
                weight(p, "down", inner, hidden, rng)?,
            ],
            // a flat policy at first: exploration must not start with an opinion
            head: Linear::with_init(p, "head", (hidden, actions), Init::Zeros, Some(Init::Zeros), rng)?,
            value: value_head(p, with_value, 2 * hidden, rng)?,
            fused: Recursion::new(&config, None)?,
            params,
            grid,
            cycles,
        })
    }
}

impl WalkerNet for ConvWalker {
    fn params(&self) -> &Params {
        &self.params
    }

    fn sizes(&self) -> (usize, usize, bool) {
        let (channels, height, width) = self.grid;
        (channels * height * width, out_size(&self.head), self.value.is_some())
    }

    fn forward(&self, observation: &Tensor, _: Option<&Tensor>) -> Result<WalkerOutput> {
        let (channels, height, width) = self.grid;
        let batch = observation.dim(0)?;
        let planes = observation.reshape((batch, channels, height * width))?;
        let agent = planes.narrow(1, 0, 1)?.reshape((batch, height * width, 1))?;
        let x = self.input.forward(&planes.transpose(1, 2)?.contiguous()?)?;
        let zeros = x.zeros_like()?.detach();
        let carry = trm::Carry { z_h: zeros.clone(), z_l: zeros };
        let flat = Tensor::cat(
            &self.block.each_ref().map(Tensor::flatten_all).into_iter().collect::<candle_core::Result<Vec<_>>>()?,
            0,
        )?;
        let h = self.fused.step(&flat, &carry, &x, (1, self.cycles - 1), trm::Gradient::On)?.z_h;
        let here = h.broadcast_mul(&agent)?.sum(1)?;
        let seen = Tensor::cat(&[&here, &h.mean(1)?], D::Minus1)?;
        Ok(WalkerOutput { logits: self.head.forward(&here)?, value: value(self.value.as_ref(), &seen)? })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use candle_core::Device;

    fn study_trm(cycles: usize) -> WalkerConfig {
        WalkerConfig::Trm { high: 64, low: 32, cycles, previous_action: true, value: false }
    }

    fn small_conv() -> WalkerConfig {
        WalkerConfig::Conv { channels: 3, height: 5, width: 5, hidden: 20, inner: 32, cycles: 6, value: true }
    }

    #[test]
    fn parameter_counts_are_the_studys() {
        let mlp = WalkerConfig::Mlp { hidden: vec![128, 128], value: false };
        assert_eq!(mlp.build(25, 4, 0).unwrap().params().count(), 20_356);
        for cycles in [3, 5] {
            assert_eq!(study_trm(cycles).build(25, 4, 0).unwrap().params().count(), 69_038);
        }
        let conv = small_conv().build(75, 4, 0).unwrap().params().count();
        assert!(conv <= 6_100, "{conv}");
    }

    #[test]
    fn every_parameter_gets_a_gradient() {
        let mlp = WalkerConfig::Mlp { hidden: vec![16], value: true };
        for (config, size) in [(mlp, 25), (study_trm(3), 25), (small_conv(), 75)] {
            let net = config.build(size, 4, 1).unwrap();
            let mut rng = Rng::new(1, "observation");
            // off the zeros that heads and biases start from, which hide gradients behind them
            for (_, var) in net.params().iter() {
                let noise = Tensor::from_vec(rng.normals(var.elem_count()), var.shape(), &Device::Cpu).unwrap();
                var.set(&(var.as_tensor().detach() + (noise * 0.1).unwrap()).unwrap()).unwrap();
            }
            let x = Tensor::from_vec(rng.normals(3 * size), (3, size), &Device::Cpu).unwrap();
            let previous = Tensor::new(&[0u32, 3, 1], &Device::Cpu).unwrap();
            let out = net.forward(&x, Some(&previous)).unwrap();
            let mut loss = out.logits.sin().unwrap().sum_all().unwrap();
            if let Some(value) = &out.value {
                assert_eq!(value.dims(), [3]);
                loss = (loss + value.sqr().unwrap().sum_all().unwrap()).unwrap();
            }
            let grads = loss.backward().unwrap();
            for (name, var) in net.params().iter() {
                let grad = grads.get(var.as_tensor());
                let grad = grad.unwrap_or_else(|| panic!("{config:?}: {name} has no gradient"));
                let size = grad.abs().unwrap().sum_all().unwrap();
                assert!(size.to_scalar::<f32>().unwrap() > 0.0, "{config:?}: {name}");
            }
        }
    }

    #[test]
    fn a_missing_previous_action_is_named() {
        let net = study_trm(3).build(25, 4, 1).unwrap();
        let x = Tensor::zeros((1, 25), candle_core::DType::F32, &Device::Cpu).unwrap();
        let error = net.forward(&x, None).unwrap_err().to_string();
        assert!(error.contains("previous action"), "{error}");
    }
}
