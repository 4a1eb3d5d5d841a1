//! From an image to tokens: what ACT and its relatives see with.
//!
//! An encoder reads images that are normalised already, (b, H, W, 3), and gives every camera either one token a cell of
//! its feature map (ACT, LeRobot) or one token of keypoints. All cameras go through the same network. Convolutions and
//! their tensors are torchvision's and LeRobot's by name and order.

mod augmentation;
mod config;
mod position;

pub use augmentation::Augmentation;
pub use config::{Architecture, Normalisation, TokenKind, VisionConfig};
pub use nn::layers::{ImageNorm, ResNet, ResNetShape, SpatialSoftmax};
pub use position::position_table;

use crate::layers::Linear;
use candle_core::{DType, Tensor};
use nn::Rng;
use nn::ops::{cat_tokens, linear, narrow_tokens};
use nn::{Context, Value, compose};
use nn::{Init, Params};
use nn::{ModelError, Result, some_names};
use std::collections::BTreeMap;

/// Prefix of the backbone's tensors, LeRobot's.
pub const BACKBONE: &str = "backbone";
/// Prefix of the layer between feature map and tokens, LeRobot's.
pub const PROJECTION: &str = "encoder_img_feat_input_proj";
/// Prefix of the layer that chooses keypoints.
pub const KEYPOINTS: &str = "encoder_img_keypoints";
/// Prefix of the layer between keypoints and token.
pub const KEYPOINT_PROJECTION: &str = "encoder_img_keypoint_input_proj";
/// Mean of the images of each camera, (cameras, 3), on the scale from 0 to 1: a buffer.
pub const IMAGE_MEAN: &str = "encoder_img_mean";
/// Standard deviation of the same.
pub const IMAGE_STD: &str = "encoder_img_std";
/// Name of the positions of keypoint tokens, one a camera.
pub const CAMERA_EMBED: &str = "encoder_img_camera_embed";

/// Height and width of an image as the network gets it.
pub type Size = (usize, usize);

/// What is made of a feature map.
#[derive(Debug)]
enum Head {
    /// a dense layer for every cell
    Map { weight: Tensor, bias: Tensor, tables: Vec<Tensor> },
    /// where each keypoint is
    Keypoints { softmax: SpatialSoftmax, project: Linear, embed: Option<Tensor> },
}

/// Backbone and tokens of all cameras.
#[derive(Debug)]
pub struct ImageEncoder {
    config: VisionConfig,
    backbone: ResNet,
    head: Head,
    /// of the cameras' images
    given: Vec<Size>,
    /// of what is seen of them
    sizes: Vec<Size>,
    /// (cameras, 3)
    mean: Tensor,
    std: Tensor,
    composed: bool,
}

impl ImageEncoder {
    /// For cameras whose images have these sizes, in order, and tokens of width `dim`.
    ///
    /// # Errors
    /// A configuration or a size that describes no possible network.
    pub fn new(params: &mut Params, config: &VisionConfig, given: &[Size], dim: usize, rng: &mut Rng) -> Result<Self> {
        let mut encoder = Self::without_positions(params, config, given, dim, rng)?;
        if let Head::Keypoints { embed, .. } = &mut encoder.head {
            let name = format!("{CAMERA_EMBED}.weight");
            *embed = Some(params.create(&name, &[given.len(), dim], Init::Normal { std: 1.0 }, rng)?);
        }
        Ok(encoder)
    }

    /// The same for a model whose tokens lie side by side, so that no position is learned.
    ///
    /// # Errors
    /// As [`ImageEncoder::new`].
    pub fn without_positions(
        params: &mut Params,
        config: &VisionConfig,
        given: &[Size],
        dim: usize,
        rng: &mut Rng,
    ) -> Result<Self> {
        config.validate()?;
        if given.is_empty() || given.iter().any(|&(h, w)| h == 0 || w == 0) {
            let expected = "one size a camera, at least 1 x 1".to_string();
            return Err(ModelError::Config {
                model: "vision",
                field: "cameras",
                found: format!("{given:?}"),
                expected,
            });
        }
        let sizes = given.iter().map(|&size| config.seen(size)).collect::<Result<Vec<_>>>()?;
        let (mean, std) = augmentation::statistics(config.normalise);
        let device = params.device().clone();
        let mut buffer = |name: &str, values: [f32; 3]| {
            let values = Tensor::from_vec(values.repeat(given.len()), (given.len(), 3), &device)?;
            params.insert_buffer(name, values)
        };
        let (mean, std) = (buffer(IMAGE_MEAN, mean)?, buffer(IMAGE_STD, std)?);
        let shape = config.shape();
        let backbone = ResNet::new(params, &format!("{BACKBONE}."), &shape, rng)?;
        let channels = shape.channels_out();
        let head = match config.tokens {
            TokenKind::Map => {
                if !dim.is_multiple_of(4) {
                    let expected = "a multiple of 4, for positions in two dimensions".to_string();
                    let found = dim.to_string();
                    return Err(ModelError::Config { model: "vision", field: "dim_model", found, expected });
                }
                let bound = 1.0 / (channels as f64).sqrt();
                let uniform = Init::Uniform { bound };
                let weight = params.create(&format!("{PROJECTION}.weight"), &[dim, channels, 1, 1], uniform, rng)?;
                let bias = params.create(&format!("{PROJECTION}.bias"), &[dim], uniform, rng)?;
                let table = |&size: &Size| {
                    let (h, w) = shape.map_size(size);
                    Ok(Tensor::from_vec(position_table(dim, (h, w)), (h * w, dim), &device)?)
                };
                Head::Map { weight, bias, tables: sizes.iter().map(table).collect::<Result<_>>()? }
            }
            TokenKind::Keypoints { .. } if sizes.iter().all(|&size| shape.map_size(size) == (1, 1)) => {
                return Err(ModelError::Config {
                    model: "vision",
                    field: "tokens",
                    found: "keypoints in maps of one cell, which are always in the same place".to_string(),
                    expected: "map, fewer blocks or larger images".to_string(),
                });
            }
            TokenKind::Keypoints { count } => Head::Keypoints {
                softmax: SpatialSoftmax::new(params, KEYPOINTS, channels, count, rng)?,
                project: Linear::new(params, KEYPOINT_PROJECTION, 2 * count, dim, rng)?,
                embed: None,
            },
        };
        params.set_rate(&format!("{BACKBONE}."), config.backbone_rate());
        let (config, given, composed) = (config.clone(), given.to_vec(), params.backend().is_composed());
        Ok(Self { config, backbone, head, given, sizes, mean, std, composed })
    }

    /// Sets what the images of each camera are normalised by, on the scale from 0 to 1.
    ///
    /// # Errors
    /// Another number of cameras, or parameters without cameras.
    pub fn set_statistics(params: &Params, mean: &[[f32; 3]], std: &[[f32; 3]]) -> Result<()> {
        for (name, rows) in [(IMAGE_MEAN, mean), (IMAGE_STD, std)] {
            let values = Tensor::from_vec(rows.concat(), (rows.len(), 3), params.device())?;
            params.set_buffer(name, &values)?;
        }
        params.changed();
        Ok(())
    }

    /// Takes the backbone's weights from `tensors` under torchvision's names; what a classifier has besides is left alone.
    /// A GroupNorm keeps its own weights: those of a batch norm mean something else.
    ///
    /// # Errors
    /// A tensor that is missing or misshapen.
    pub fn load_backbone(params: &Params, norm: ImageNorm, tensors: &BTreeMap<String, Tensor>) -> Result<()> {
        let mut all = params.tensors();
        let prefix = format!("{BACKBONE}.");
        for (name, value) in all.iter_mut() {
            let Some(theirs) = name.strip_prefix(&prefix) else { continue };
            if norm == ImageNorm::Group && value.dims().len() == 1 {
                continue;
            }
            let given = tensors.get(theirs).ok_or_else(|| ModelError::MissingTensor {
                name: theirs.to_string(),
                given: some_names(tensors.keys()),
            })?;
            *value = given.clone();
        }
        params.load(&all)
    }

    /// Positions of all tokens: (T, D). Fixed for map tokens, learned for keypoints.
    ///
    /// # Errors
    /// An encoder without positions.
    pub fn positions(&self) -> Result<Tensor> {
        match &self.head {
            Head::Map { tables, .. } => Ok(Tensor::cat(tables, 0)?),
            Head::Keypoints { embed: Some(embed), .. } => Ok(embed.clone()),
            Head::Keypoints { embed: None, .. } => {
                let (found, expected) = ("none".to_string(), "learned ones".to_string());
                Err(ModelError::Input { operation: "see", object: "positions", found, expected })
            }
        }
    }

    /// images: one (b, H, W, 3) a camera, normalised -> (b, T, D), with candle's graph
    ///
    /// # Errors
    /// Another number of cameras or another size of image.
    pub fn forward(&self, images: &[Tensor]) -> Result<Tensor> {
        compose(self.mean.device(), |cx| Ok(self.apply(cx, images)?.into_graph()))
    }

    /// images: one (b, H, W, 3) a camera, normalised -> (b, T, D). Cameras of one size go through the network as one batch.
    ///
    /// # Errors
    /// Another number of cameras or another size of image.
    pub fn apply(&self, cx: &mut Context<'_>, images: &[Tensor]) -> Result<Value> {
        self.check(images)?;
        let b = images[0].dim(0)?;
        let mut tokens: Vec<Option<Value>> = vec![None; images.len()];
        // backwards, so that gradients are added in the order of the cameras
        for first in (0..images.len()).rev() {
            let alike: Vec<usize> = (0..images.len()).filter(|&i| self.sizes[i] == self.sizes[first]).collect();
            if alike[0] != first {
                continue;
            }
            let of_size =
                alike.iter().map(|&i| images[i].to_dtype(DType::F32)).collect::<candle_core::Result<Vec<_>>>()?;
            let map = self.backbone.forward(cx, &Value::from(&Tensor::cat(&of_size, 0)?))?;
            let all = match &self.head {
                Head::Map { weight, bias, .. } => {
                    let &[n, h, w, c] = map.dims() else { unreachable!("a map has four dimensions") };
                    let layer = Linear { weight: weight.clone(), bias: Some(bias.clone()) };
                    linear(cx, &map.reshape((n, h * w, c))?, &layer)?
                }
                Head::Keypoints { softmax, project, .. } => {
                    let places = softmax.forward(cx, &map)?;
                    let (n, width) = places.dims2()?;
                    linear(cx, &places.reshape((n, 1, width))?, project)?
                }
            };
            // one image after the other, camera by camera: as one sequence its parts are the cameras'
            let (n, t, dim) = all.dims3()?;
            let all = all.reshape((1, n * t, dim))?;
            for (at, &i) in alike.iter().enumerate() {
                tokens[i] = Some(narrow_tokens(cx, &all, at * b * t, b * t)?.reshape((b, t, dim))?);
            }
        }
        let tokens: Vec<&Value> = tokens.iter().flatten().collect();
        cx.seen();
        if let [one] = tokens[..] { Ok(one.clone()) } else { cat_tokens(cx, b, &tokens) }
    }

    /// Whether the positions are a parameter.
    pub(crate) fn learns_positions(&self) -> bool {
        matches!(self.head, Head::Keypoints { .. })
    }

    /// Checks number and sizes of the images.
    pub(crate) fn check(&self, images: &[Tensor]) -> Result<()> {
        if images.len() != self.sizes.len() {
            let (found, expected) = (images.len().to_string(), self.sizes.len().to_string());
            return Err(ModelError::Input { operation: "see", object: "number of cameras", found, expected });
        }
        let b = images.first().map_or(Ok(0), |x| x.dim(0))?;
        for (x, &(h, w)) in images.iter().zip(&self.sizes) {
            if x.dims() != [b, h, w, 3] {
                let (expected, found) = (vec![b, h, w, 3], x.dims().to_vec());
                return Err(ModelError::Shape { operation: "see", object: "image", expected, found });
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
