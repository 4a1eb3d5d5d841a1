//! The 1-D UNet over the steps of an action sequence, conditioned by FiLM: LeRobot's `DiffusionConditionalUnet1d` with its
//! tensor names, steps before channels. Diffusion, flow matching and MIP share it.

use crate::layers::{Conv1d, GroupNorm, Linear, Upsample1d};
use nn::ops::{Then, alias, cat_rows, conv1d, conv1d_mish, linear, mish, upsample1d};
use nn::{Context, ModelError, Params, Result, Rng, Size, Value};
use serde::{Deserialize, Serialize};

/// Groups of the last block's norm, whatever the others have.
const LAST_GROUPS: usize = 8;

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
            conv: Conv1d::new(p, &format!("{prefix}.block.0"), (input, output, kernel), 1, rng)?,
            norm: GroupNorm::new(p, &format!("{prefix}.block.1"), output, groups, rng)?,
        })
    }

    fn apply(&self, cx: &mut Context<'_>, x: &Value, then: Then<'_>) -> Result<Value> {
        conv1d_mish(cx, x, (&self.conv, &self.norm), then)
    }
}

/// Two blocks with the condition between them, and a way around.
#[derive(Debug)]
struct ResidualBlock {
    conv1: ConvBlock,
    cond_encoder: Linear,
    conv2: ConvBlock,
    residual_conv: Option<Conv1d>,
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
                false => Some(Conv1d::new(p, &residual, (input, output, 1), 1, rng)?),
            },
        })
    }

    /// x: (b, T, in), cond: (b, cond) after its activation -> (b, T, out)
    fn apply(&self, cx: &mut Context<'_>, x: &Value, cond: &Value) -> Result<Value> {
        let film = linear(cx, cond, &self.cond_encoder)?;
        let around = match &self.residual_conv {
            Some(conv) => conv1d(cx, x, conv)?,
            None => x.clone(),
        };
        let y = self.conv1.apply(cx, x, Then::Film(&film))?;
        self.conv2.apply(cx, &y, Then::Add(&around))
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
            let halve = (level < last).then(|| Conv1d::new(p, &name, (dim, dim, 3), 2, rng));
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
            final_conv: Conv1d::new(p, &format!("{name}.1"), (dim, action_dim, 1), 1, rng)?,
        })
    }

    /// x: (b, T, A), the step of each row, cond: (b, cond) -> (b, T, A)
    ///
    /// # Errors
    /// Shapes that do not go together.
    pub fn apply(&self, cx: &mut Context<'_>, x: &Value, steps: &[f32], cond: &Value) -> Result<Value> {
        let [first, second] = &self.step_encoder;
        let width = self.step_embed_dim;
        let embedded = Value::of(embedding(steps, width), (steps.len(), width), &cx.device().clone())?;
        let embedded = linear(cx, &embedded, first)?;
        let embedded = mish(cx, &embedded)?;
        let embedded = linear(cx, &embedded, second)?;
        // every block begins with the same activation of the same condition
        let cond = cat_rows(cx, &embedded, cond)?;
        let cond = mish(cx, &cond)?;
        let through = |cx: &mut Context<'_>, pair: &[ResidualBlock; 2], x: &Value| -> Result<Value> {
            let x = pair[0].apply(cx, x, &cond)?;
            pair[1].apply(cx, &x, &cond)
        };
        let mut x = x.clone();
        let mut skipped = Vec::with_capacity(self.down.len());
        for (pair, halve) in &self.down {
            x = through(cx, pair, &x)?;
            skipped.push(alias(cx, &x));
            if let Some(halve) = halve {
                x = conv1d(cx, &x, halve)?;
            }
        }
        x = through(cx, &self.mid, &x)?;
        for (pair, double) in &self.up {
            let skip = skipped.pop().expect("a level down for every level up");
            let (b, steps, channels) = x.dims3()?;
            let rows = |x: &Value| x.reshape((b * steps, channels));
            let both = cat_rows(cx, &rows(&x)?, &rows(&skip)?)?.reshape((b, steps, 2 * channels))?;
            x = through(cx, pair, &both)?;
            x = upsample1d(cx, &x, double)?;
        }
        x = self.final_block.apply(cx, &x, Then::Nothing)?;
        conv1d(cx, &x, &self.final_conv)
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
