//! ResNet of basic blocks, up to its last feature map.
//!
//! He et al., "Deep Residual Learning for Image Recognition", arXiv 1512.03385. Reference: torchvision's `resnet18` and
//! `resnet34`, whose tensor names these are; LeRobot 0.6.1 builds it with `FrozenBatchNorm2d`. Deviations: the number of
//! channels of the first layer and the number of blocks are free; with `norm = "group"` every norm is a GroupNorm of
//! `max(1, channels / 16)` groups, as Diffusion Policy and R3PL have it, under the names of the batch norms.

use crate::composed;
use crate::context::Context;
use crate::ops::{ConvNorm, conv2d, max_pool};
use crate::precision::Precision;
use crate::value::Value;
use crate::{Init, Params, Result, Rng};
use candle_core::Tensor;
use serde::{Deserialize, Serialize};

/// Added to variances, torch's.
pub const CONV_NORM_EPS: f64 = 1e-5;

/// What follows a convolution.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "snake_case")]
pub enum ImageNorm {
    /// GroupNorm, for random initial weights
    #[default]
    Group,
    /// batch norm with the statistics of the pretrained weights
    Frozen,
}

/// What a ResNet is made of.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ResNetShape {
    /// blocks of each of the four layers; the last ones may have none, which leaves a finer map
    pub blocks: [usize; 4],
    /// channels of the first layer; each layer has twice those of the one before
    pub width: usize,
    /// what follows a convolution
    pub norm: ImageNorm,
}

impl ResNetShape {
    /// Layers that have blocks.
    fn layers(&self) -> usize {
        self.blocks.iter().take_while(|&&count| count > 0).count()
    }

    /// Channels of the last feature map.
    pub fn channels_out(&self) -> usize {
        self.width << self.layers().saturating_sub(1)
    }

    /// Size of the last feature map: once more than there are layers half, rounded up.
    pub fn map_size(&self, (h, w): (usize, usize)) -> (usize, usize) {
        let halved = |n: usize| (0..=self.layers()).fold(n, |n, _| n.div_ceil(2));
        (halved(h), halved(w))
    }

    /// Groups of a GroupNorm over `channels`.
    pub fn groups(channels: usize) -> usize {
        (channels / 16).max(1)
    }

    /// Every block in order: prefix of its tensors, channels before, channels after, stride.
    pub fn all_blocks(&self) -> Vec<(String, usize, usize, usize)> {
        let mut all = Vec::new();
        let mut before = self.width;
        for (layer, &count) in self.blocks.iter().enumerate() {
            let after = self.width << layer;
            for i in 0..count {
                let stride = if i == 0 && layer > 0 { 2 } else { 1 };
                all.push((format!("layer{}.{i}", layer + 1), before, after, stride));
                before = after;
            }
        }
        all
    }
}

/// A convolution without bias; padding is half the kernel.
#[derive(Debug)]
struct Conv {
    weight: Tensor,
    stride: usize,
}

impl Conv {
    /// Kaiming normal over the outputs, as torchvision's ResNet.
    fn new(
        params: &mut Params,
        name: &str,
        (input, output): (usize, usize),
        (kernel, stride): (usize, usize),
        rng: &mut Rng,
    ) -> Result<Self> {
        let std = (2.0 / (kernel * kernel * output) as f64).sqrt();
        let shape = [output, input, kernel, kernel];
        Ok(Self { weight: params.create(&format!("{name}.weight"), &shape, Init::Normal { std }, rng)?, stride })
    }

    fn parts(&self) -> (&Tensor, usize) {
        (&self.weight, self.stride)
    }
}

/// x: (b, h, w, C), padding half the kernel -> (b, h / stride, w / stride, C'). What no window reaches is cut off first.
pub(crate) fn conv2d_composed(x: &Tensor, weight: &Tensor, stride: usize, precision: Precision) -> Result<Tensor> {
    let kernel = weight.dim(2)?;
    let before = kernel / 2;
    let mut x = x.clone();
    for axis in [1, 2] {
        let size = x.dim(axis)?;
        let reached = (size.div_ceil(stride) - 1) * stride + kernel;
        let after = reached.saturating_sub(before + size);
        x = x.pad_with_zeros(axis, before, after)?.narrow(axis, 0, reached)?;
    }
    composed::conv2d(&x.contiguous()?, weight, stride, precision)
}

impl ConvNorm {
    fn new(params: &mut Params, name: &str, channels: usize, kind: ImageNorm, rng: &mut Rng) -> Result<Self> {
        let named = |last: &str| format!("{name}.{last}");
        Ok(match kind {
            ImageNorm::Group => Self::Group {
                weight: params.create(&named("weight"), &[channels], Init::Ones, rng)?,
                bias: params.create(&named("bias"), &[channels], Init::Zeros, rng)?,
                groups: ResNetShape::groups(channels),
            },
            ImageNorm::Frozen => {
                let mut buffer = |last: &str, value: f32| {
                    let values = Tensor::full(value, channels, params.device())?;
                    params.insert_buffer(&named(last), values)
                };
                Self::Frozen {
                    weight: buffer("weight", 1.0)?,
                    bias: buffer("bias", 0.0)?,
                    mean: buffer("running_mean", 0.0)?,
                    variance: buffer("running_var", 1.0)?,
                }
            }
        })
    }

    /// (b, h, w, C) -> the same
    pub(crate) fn composed(&self, x: &Tensor) -> Result<Tensor> {
        let (b, h, w, c) = x.dims4()?;
        match self {
            Self::Group { weight, bias, groups } => {
                let x = x.reshape((b, h * w, *groups, c / groups))?;
                let centred = x.broadcast_sub(&x.mean_keepdim((1, 3))?)?;
                let spread = (centred.sqr()?.mean_keepdim((1, 3))? + CONV_NORM_EPS)?.sqrt()?;
                let x = centred.broadcast_div(&spread)?.reshape((b, h, w, c))?;
                Ok(x.broadcast_mul(weight)?.broadcast_add(bias)?)
            }
            Self::Frozen { weight, bias, mean, variance } => {
                let scale = (weight / (variance + CONV_NORM_EPS)?.sqrt()?)?.detach();
                let shift = (bias - (mean * &scale)?)?.detach();
                composed::affine(x, scale, &shift)
            }
        }
    }
}

/// Two convolutions around which the input is added again.
#[derive(Debug)]
struct Block {
    conv1: Conv,
    bn1: ConvNorm,
    conv2: Conv,
    bn2: ConvNorm,
    downsample: Option<(Conv, ConvNorm)>,
}

impl Block {
    fn forward(&self, cx: &mut Context<'_>, x: &Value) -> Result<Value> {
        let y = conv2d(cx, x, self.conv1.parts(), &self.bn1, None, true)?;
        let shortcut = match &self.downsample {
            Some((conv, norm)) => conv2d(cx, x, conv.parts(), norm, None, false)?,
            None => x.clone(),
        };
        conv2d(cx, &y, self.conv2.parts(), &self.bn2, Some(&shortcut), true)
    }
}

/// The network.
#[derive(Debug)]
pub struct ResNet {
    shape: ResNetShape,
    conv1: Conv,
    bn1: ConvNorm,
    blocks: Vec<Block>,
}

impl ResNet {
    /// Creates torchvision's tensors under `prefix`.
    ///
    /// # Errors
    /// If a name is taken.
    pub fn new(params: &mut Params, prefix: &str, shape: &ResNetShape, rng: &mut Rng) -> Result<Self> {
        let norm = |p: &mut Params, name: String, channels: usize, rng: &mut Rng| {
            ConvNorm::new(p, &name, channels, shape.norm, rng)
        };
        let conv1 = Conv::new(params, &format!("{prefix}conv1"), (3, shape.width), (7, 2), rng)?;
        let bn1 = norm(params, format!("{prefix}bn1"), shape.width, rng)?;
        let mut blocks = Vec::new();
        for (name, before, after, stride) in shape.all_blocks() {
            let name = format!("{prefix}{name}");
            let downsample = match stride == 1 && before == after {
                true => None,
                false => Some((
                    Conv::new(params, &format!("{name}.downsample.0"), (before, after), (1, stride), rng)?,
                    norm(params, format!("{name}.downsample.1"), after, rng)?,
                )),
            };
            blocks.push(Block {
                conv1: Conv::new(params, &format!("{name}.conv1"), (before, after), (3, stride), rng)?,
                bn1: norm(params, format!("{name}.bn1"), after, rng)?,
                conv2: Conv::new(params, &format!("{name}.conv2"), (after, after), (3, 1), rng)?,
                bn2: norm(params, format!("{name}.bn2"), after, rng)?,
                downsample,
            });
        }
        Ok(Self { shape: shape.clone(), conv1, bn1, blocks })
    }

    /// What it is made of.
    pub fn shape(&self) -> &ResNetShape {
        &self.shape
    }

    /// (b, H, W, 3) -> (b, ceil(H / 32), ceil(W / 32), 8 width)
    ///
    /// # Errors
    /// Something that is no batch of images.
    pub fn forward(&self, cx: &mut Context<'_>, x: &Value) -> Result<Value> {
        let x = conv2d(cx, x, self.conv1.parts(), &self.bn1, None, true)?;
        let mut x = max_pool(cx, &x)?;
        for block in &self.blocks {
            x = block.forward(cx, &x)?;
        }
        Ok(x)
    }
}
