//! The study's small TRM: a recursion of dense layers in every cell by itself.
//!
//! Reference: acharyaanusha/Tiny-Recursive-Model, `SimpleTRM` and the TRM of
//! `maze_comparison.py`. Cells see each other only through the stem; with a dense stem not at
//! all. As there, `z` is overwritten rather than added to, the first answer is the uniform one, and from the second
//! supervision step on only the last inner step keeps a graph.
//!
//! Differences: there the first supervision step, too, keeps the graph of its last inner step only, so `z_init` never
//! learns; here the whole step is propagated back. There the head reads the answer before with its gradient, here
//! without. There the loss is divided by the number of supervision steps. `z_init` has a standard deviation of 0.02,
//! there 0.1.

use super::grids::{Conv3x3, GridDims, GridModel, channels_last};
use candle_core::{D, DType, Device, Tensor};
use models::layers::Linear;
use nn::Backend;
use nn::Result;
use nn::Rng;
use nn::{Init, Params};
use serde::{Deserialize, Serialize};

/// What turns the grid into features per cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stem {
    /// Two 3x3 convolutions with ReLU.
    Convolutions,
    /// One dense layer per cell.
    Dense,
}

/// Sizes of a [`SmallTrm`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SmallTrmConfig {
    /// How features are made.
    pub stem: Stem,
    /// Features per cell.
    pub features: usize,
    /// Width of `z`.
    pub latent: usize,
    /// Width of the embedded answer.
    pub answer: usize,
    /// Hidden width of the recursion.
    pub hidden: usize,
    /// Hidden width of the output head.
    pub head: usize,
    /// Updates of `z` per supervision step.
    pub inner_steps: usize,
    /// Supervision steps.
    pub supervision_steps: usize,
}

impl SmallTrmConfig {
    /// The 9,922 parameters of the study's 8x8 maze.
    pub fn simple() -> Self {
        Self {
            stem: Stem::Convolutions,
            features: 16,
            latent: 32,
            answer: 8,
            hidden: 64,
            head: 32,
            inner_steps: 3,
            supervision_steps: 5,
        }
    }

    /// The 28,258 parameters of the study's 10x10 maze.
    pub fn complex() -> Self {
        Self {
            stem: Stem::Dense,
            features: 32,
            latent: 64,
            answer: 16,
            hidden: 128,
            head: 64,
            inner_steps: 4,
            supervision_steps: 6,
        }
    }
}

/// The study's TRM.
#[derive(Debug)]
pub struct SmallTrm {
    params: Params,
    dims: GridDims,
    config: SmallTrmConfig,
    stem: StemLayers,
    z_init: Tensor,
    answer_embed: Tensor,
    update: [Linear; 2],
    head: [Linear; 2],
}

#[derive(Debug)]
enum StemLayers {
    Convolutions([Conv3x3; 2]),
    Dense(Linear),
}

impl SmallTrm {
    /// Builds it with weights from `rng`.
    ///
    /// # Errors
    /// When a tensor operation fails.
    pub fn new(dims: GridDims, config: SmallTrmConfig, rng: &mut Rng) -> Result<Self> {
        let mut params = Params::new(&Backend::CPU);
        let p = &mut params;
        let SmallTrmConfig { features, latent, answer, hidden, head, .. } = config;
        let stem = match config.stem {
            Stem::Convolutions => StemLayers::Convolutions([
                Conv3x3::new(p, "stem.0", (dims.channels, features), rng)?,
                Conv3x3::new(p, "stem.1", (features, features), rng)?,
            ]),
            Stem::Dense => StemLayers::Dense(Linear::new(p, "stem", dims.channels, features, rng)?),
        };
        let z_init = p.create("z_init", &[latent], Init::Normal { std: 0.02 }, rng)?;
        let shape = [dims.classes, answer];
        let answer_embed = p.create("answer_embed.weight", &shape, Init::Normal { std: 1.0 }, rng)?;
        let update = [
            Linear::new(p, "update.0", features + answer + latent, hidden, rng)?,
            Linear::new(p, "update.1", hidden, latent, rng)?,
        ];
        let head =
            [Linear::new(p, "head.0", answer + latent, head, rng)?, Linear::new(p, "head.1", head, dims.classes, rng)?];
        Ok(Self { params, dims, config, stem, z_init, answer_embed, update, head })
    }

    fn features(&self, grid: &Tensor) -> Result<Tensor> {
        let x = channels_last(grid)?;
        match &self.stem {
            StemLayers::Convolutions([a, b]) => Ok(b.forward(&a.forward(&x)?.relu()?)?.relu()?),
            StemLayers::Dense(layer) => layer.forward(&x),
        }
    }
}

impl GridModel for SmallTrm {
    fn params(&self) -> &Params {
        &self.params
    }

    fn forward(&self, grid: &Tensor) -> Result<Vec<(f64, Tensor)>> {
        let batch = self.dims.batch(grid)?;
        let (cells, classes) = (self.dims.cells(), self.dims.classes);
        let x = self.features(grid)?.reshape((batch, cells, self.config.features))?;
        let mut z = self.z_init.broadcast_as((batch, cells, self.config.latent))?.contiguous()?;
        let uniform = Tensor::full(1.0 / classes as f32, (batch * cells, classes), &Device::Cpu)?;
        let mut belief = uniform.to_dtype(DType::F32)?;
        let mut outputs = Vec::new();
        for step in 0..self.config.supervision_steps {
            let answer = belief.matmul(&self.answer_embed)?;
            let answer = answer.reshape((batch, cells, self.config.answer))?;
            for _ in 0..self.config.inner_steps {
                if step > 0 {
                    z = z.detach();
                }
                let seen = Tensor::cat(&[&x, &answer, &z], D::Minus1)?;
                z = self.update[1].forward(&self.update[0].forward(&seen)?.relu()?)?;
            }
            let seen = Tensor::cat(&[&answer, &z], D::Minus1)?;
            let scores = self.head[1].forward(&self.head[0].forward(&seen)?.relu()?)?;
            let flat = scores.detach().reshape((batch * cells, classes))?;
            belief = candle_nn::ops::softmax(&flat, D::Minus1)?;
            outputs.push((1.0 + 0.1 * step as f64, scores));
        }
        Ok(outputs)
    }
}
