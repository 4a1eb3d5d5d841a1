//! The 1-D UNet over the steps of an action sequence, conditioned by FiLM: LeRobot's `DiffusionConditionalUnet1d` with its
//! tensor names, steps before channels. Diffusion, flow matching and MIP share it.

use crate::layers::{Conv1d, GroupNorm, Linear, Upsample1d, mish};
use candle_core::Tensor;
use nn::Params;
use nn::Rng;
use nn::Size;
use nn::device::HERE;
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};

/// Groups of the last block's norm, whatever the others have.
pub(super) const LAST_GROUPS: usize = 8;

/// Options of the network, with LeRobot's names and defaults.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NetworkConfig {
    /// channels of each level; each level has half the time steps of the one before
    pub down_dims: Vec<usize>,
    /// kernel size of the convolutions; odd
    pub kernel_size: usize,
    /// groups of the group norms
    pub n_groups: usize,
    /// dimension of the time step's embedding; even
    pub step_embed_dim: usize,
    /// whether the condition also scales channels (FiLM), or only shifts them
    pub film_scale: bool,
}

impl Default for NetworkConfig {
    fn default() -> Self {
        Self { down_dims: vec![512, 1024, 2048], kernel_size: 5, n_groups: 8, step_embed_dim: 128, film_scale: true }
    }
}

impl NetworkConfig {
    /// Checks that a network over `action_horizon` steps can exist.
    ///
    /// # Errors
    /// The first field that makes it impossible.
    pub fn validate(&self, model: &'static str, action_horizon: usize) -> Result<()> {
        let refuse = |field, found: String, expected: String| Err(ModelError::Config { model, field, found, expected });
        if self.down_dims.is_empty() || self.down_dims.contains(&0) {
            return refuse(
                "network.down_dims",
                format!("{:?}", self.down_dims),
                "channels, at least one level".to_string(),
            );
        }
        if self.kernel_size.is_multiple_of(2) {
            return refuse("network.kernel_size", self.kernel_size.to_string(), "an odd number".to_string());
        }
        let divides = |dim: &usize| self.n_groups > 0 && dim.is_multiple_of(self.n_groups);
        if !self.down_dims.iter().all(divides) {
            return refuse("network.n_groups", self.n_groups.to_string(), "a divisor of all down_dims".to_string());
        }
        if !self.down_dims[0].is_multiple_of(LAST_GROUPS) {
            let found = format!("{:?}", self.down_dims);
            return refuse("network.down_dims", found, format!("a multiple of {LAST_GROUPS} first"));
        }
        if self.step_embed_dim < 4 || !self.step_embed_dim.is_multiple_of(2) {
            return refuse(
                "network.step_embed_dim",
                self.step_embed_dim.to_string(),
                "an even number from 4".to_string(),
            );
        }
        // LeRobot asks for one more halving than there is
        let factor = u32::try_from(self.down_dims.len()).ok().and_then(|levels| 2_usize.checked_pow(levels));
        if !factor.is_some_and(|factor| action_horizon > 0 && action_horizon.is_multiple_of(factor)) {
            let expected = format!("a multiple of 2^{}, for as many levels", self.down_dims.len());
            return refuse("action_horizon", action_horizon.to_string(), expected);
        }
        Ok(())
    }

    /// How large the network will be over `action_horizon` steps: without what depends on the observation.
    pub fn size(&self, action_horizon: usize) -> Size {
        let (kernel, embed) = (self.kernel_size as f64, self.step_embed_dim as f64);
        let block = |input: usize, output: usize, steps: f64| {
            let (input, output) = (input as f64, output as f64);
            let film = embed * output * if self.film_scale { 2.0 } else { 1.0 };
            let residual = if input == output { 0.0 } else { input * output };
            let weights = kernel * (input + output) * output + film + residual;
            Size { weights, activations: steps * (kernel * (input + output) + 8.0 * output) }
        };
        let mut total = Size { weights: 8.0 * embed * embed, activations: 0.0 };
        let mut steps = action_horizon as f64;
        let mut before = 1;
        for (level, &dim) in self.down_dims.iter().enumerate() {
            total = total + block(before, dim, steps) + block(dim, dim, steps);
            if level > 0 {
                // its way up again, with the step between
                total = total + block(2 * dim, before, steps) + block(before, before, steps);
                let (dim, before) = (dim as f64, before as f64);
                total = total + Size { weights: 3.0 * before * before + 4.0 * before * before, activations: dim };
            }
            before = dim;
            steps /= 2.0;
        }
        total + block(before, before, steps) + block(before, before, steps)
    }
}

/// Convolution, group norm, Mish.
#[derive(Debug)]
struct ConvBlock {
    conv: Conv1d,
    norm: GroupNorm,
}

impl ConvBlock {
    fn new(
        p: &mut Params,
        prefix: &str,
        (input, output, kernel): (usize, usize, usize),
        groups: usize,
        rng: &mut Rng,
    ) -> Result<Self> {
        Ok(Self {
            conv: Conv1d::new(p, &format!("{prefix}.block.0"), (input, output, kernel), (1, kernel / 2), rng)?,
            norm: GroupNorm::new(p, &format!("{prefix}.block.1"), output, groups, rng)?,
        })
    }

    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        mish(&self.norm.forward(&self.conv.forward(x)?)?)
    }
}

/// Two blocks with the condition between them, and a way around.
#[derive(Debug)]
struct ResidualBlock {
    conv1: ConvBlock,
    cond_encoder: Linear,
    conv2: ConvBlock,
    residual_conv: Option<Conv1d>,
    film_scale: bool,
}

impl ResidualBlock {
    fn new(
        p: &mut Params,
        prefix: &str,
        (input, output, cond): (usize, usize, usize),
        config: &NetworkConfig,
        rng: &mut Rng,
    ) -> Result<Self> {
        let (kernel, groups) = (config.kernel_size, config.n_groups);
        let film = if config.film_scale { 2 * output } else { output };
        let residual = format!("{prefix}.residual_conv");
        Ok(Self {
            conv1: ConvBlock::new(p, &format!("{prefix}.conv1"), (input, output, kernel), groups, rng)?,
            cond_encoder: Linear::new(p, &format!("{prefix}.cond_encoder.1"), cond, film, rng)?,
            conv2: ConvBlock::new(p, &format!("{prefix}.conv2"), (output, output, kernel), groups, rng)?,
            residual_conv: match input == output {
                true => None,
                false => Some(Conv1d::new(p, &residual, (input, output, 1), (1, 0), rng)?),
            },
            film_scale: config.film_scale,
        })
    }

    /// x: (b, T, in), cond: (b, cond) after its activation -> (b, T, out)
    fn forward(&self, x: &Tensor, cond: &Tensor) -> Result<Tensor> {
        let out = self.conv1.forward(x)?;
        let channels = out.dim(2)?;
        let film = self.cond_encoder.forward(cond)?.unsqueeze(1)?;
        let out = match self.film_scale {
            true => {
                let (scale, shift) = (film.narrow(2, 0, channels)?, film.narrow(2, channels, channels)?);
                out.broadcast_mul(&scale)?.broadcast_add(&shift)?
            }
            false => out.broadcast_add(&film)?,
        };
        let out = self.conv2.forward(&out)?;
        Ok(match &self.residual_conv {
            Some(conv) => (out + conv.forward(x)?)?,
            None => (out + x)?,
        })
    }
}

/// The network.
#[derive(Debug)]
pub struct Unet {
    step_embed_dim: usize,
    step_encoder: [Linear; 2],
    /// two blocks, and what halves the number of steps except at the last level
    down: Vec<([ResidualBlock; 2], Option<Conv1d>)>,
    mid: [ResidualBlock; 2],
    up: Vec<([ResidualBlock; 2], Upsample1d)>,
    final_block: ConvBlock,
    final_conv: Conv1d,
}

impl Unet {
    /// Over actions of `action_dim` numbers, conditioned by `cond` numbers and the step; `config` was validated.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn new(
        p: &mut Params,
        prefix: &str,
        (action_dim, cond): (usize, usize),
        config: &NetworkConfig,
        rng: &mut Rng,
    ) -> Result<Self> {
        let embed = config.step_embed_dim;
        let cond = cond + embed;
        let dims = &config.down_dims;
        let mut pair = |p: &mut Params, prefix: &str, input: usize, output: usize| -> Result<[ResidualBlock; 2]> {
            Ok([
                ResidualBlock::new(p, &format!("{prefix}.0"), (input, output, cond), config, rng)?,
                ResidualBlock::new(p, &format!("{prefix}.1"), (output, output, cond), config, rng)?,
            ])
        };
        let mut blocks = Vec::new();
        let mut before = action_dim;
        for (level, &dim) in dims.iter().enumerate() {
            blocks.push(pair(p, &format!("{prefix}.down_modules.{level}"), before, dim)?);
            before = dim;
        }
        let mid = pair(p, &format!("{prefix}.mid_modules"), before, before)?;
        let mut rising = Vec::new();
        for (level, dim) in dims.windows(2).rev().enumerate() {
            rising.push((pair(p, &format!("{prefix}.up_modules.{level}"), 2 * dim[1], dim[0])?, dim[0]));
        }
        let last = dims.len() - 1;
        let mut down = Vec::new();
        for (level, (pair, &dim)) in blocks.into_iter().zip(dims).enumerate() {
            let name = format!("{prefix}.down_modules.{level}.2");
            let halve = (level < last).then(|| Conv1d::new(p, &name, (dim, dim, 3), (2, 1), rng));
            down.push((pair, halve.transpose()?));
        }
        let mut up = Vec::new();
        for (level, (pair, dim)) in rising.into_iter().enumerate() {
            up.push((pair, Upsample1d::new(p, &format!("{prefix}.up_modules.{level}.2"), dim, rng)?));
        }
        let encoder = format!("{prefix}.diffusion_step_encoder");
        let name = format!("{prefix}.final_conv");
        let (dim, kernel) = (dims[0], config.kernel_size);
        Ok(Self {
            step_embed_dim: embed,
            step_encoder: [
                Linear::new(p, &format!("{encoder}.1"), embed, 4 * embed, rng)?,
                Linear::new(p, &format!("{encoder}.3"), 4 * embed, embed, rng)?,
            ],
            down,
            mid,
            up,
            final_block: ConvBlock::new(p, &format!("{name}.0"), (dim, dim, kernel), LAST_GROUPS, rng)?,
            final_conv: Conv1d::new(p, &format!("{name}.1"), (dim, action_dim, 1), (1, 0), rng)?,
        })
    }

    /// x: (b, T, A), the step of each row, cond: (b, cond) -> (b, T, A)
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn forward(&self, x: &Tensor, steps: &[f32], cond: &Tensor) -> Result<Tensor> {
        let [first, second] = &self.step_encoder;
        let width = self.step_embed_dim;
        let embedded = Tensor::from_vec(embedding(steps, width), (steps.len(), width), &HERE)?;
        let embedded = second.forward(&mish(&first.forward(&embedded)?)?)?;
        // every block begins with the same activation of the same condition
        let cond = mish(&Tensor::cat(&[&embedded, cond], 1)?)?;
        let through = |pair: &[ResidualBlock; 2], x: &Tensor| pair[1].forward(&pair[0].forward(x, &cond)?, &cond);
        let mut x = x.clone();
        let mut skipped = Vec::with_capacity(self.down.len());
        for (pair, halve) in &self.down {
            x = through(pair, &x)?;
            skipped.push(x.clone());
            if let Some(halve) = halve {
                x = halve.forward(&x)?;
            }
        }
        x = through(&self.mid, &x)?;
        for (pair, double) in &self.up {
            let skip = skipped.pop().expect("a level down for every level up");
            x = double.forward(&through(pair, &Tensor::cat(&[&x, &skip], 2)?)?)?;
        }
        self.final_conv.forward(&self.final_block.forward(&x)?)
    }
}

/// steps: b numbers -> (b, dim), sines, then cosines, of frequencies from 1 down to 1/10000
pub(super) fn embedding(steps: &[f32], dim: usize) -> Vec<f32> {
    let half = dim / 2;
    // rounded where the reference rounds
    let rate = (10_000f64.ln() / (half - 1) as f64) as f32;
    let mut values = Vec::with_capacity(steps.len() * dim);
    for &step in steps {
        let angles: Vec<f32> = (0..half).map(|i| step * (i as f32 * -rate).exp()).collect();
        values.extend(angles.iter().map(|angle| angle.sin()));
        values.extend(angles.iter().map(|angle| angle.cos()));
    }
    values
}
