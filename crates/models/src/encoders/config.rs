//! `[policy.vision]`: how images are seen.

use super::{ImageNorm, ResNetShape};
use nn::{ModelError, Result};
use serde::{Deserialize, Serialize};

/// Blocks of one layer; ResNet-152 has 36.
const MOST_BLOCKS: usize = 36;

/// Blocks of the network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "snake_case")]
pub enum Architecture {
    /// 2, 2, 2 and 2 blocks
    #[default]
    Resnet18,
    /// 3, 4, 6 and 3 blocks
    Resnet34,
}

/// What images are normalised by, after division by 255.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "snake_case")]
pub enum Normalisation {
    /// per channel mean and standard deviation of ImageNet
    #[default]
    Imagenet,
    /// per channel mean and standard deviation of the data set
    Dataset,
    /// none: values from 0 to 1
    Unit,
}

/// What becomes of a feature map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Default)]
#[serde(rename_all = "snake_case")]
pub enum TokenKind {
    /// one token per cell of the feature map; positional encodings are shared by all cameras, as in LeRobot
    #[default]
    Map,
    /// one token per camera: spatial-softmax coordinates of this many keypoints
    Keypoints {
        /// number of keypoints
        count: usize,
    },
}

/// Options of an image encoder.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct VisionConfig {
    /// architecture
    pub encoder: Architecture,
    /// blocks of each of the four layers, instead of the architecture's; the last ones may be 0, for a finer feature map
    #[serde(skip_serializing_if = "Option::is_none")]
    pub blocks: Option<[usize; 4]>,
    /// channels of the first layer
    pub width: usize,
    /// normalisation after convolutions
    pub norm: ImageNorm,
    /// how the feature map becomes tokens
    pub tokens: TokenKind,
    /// side of the square crop in pixels: random in training, central otherwise
    #[serde(skip_serializing_if = "Option::is_none")]
    pub crop: Option<usize>,
    /// random shift in training, in pixels; the border is repeated
    pub shift: usize,
    /// random brightness, contrast and saturation in training: factors from 1 - jitter to 1 + jitter
    pub jitter: f64,
    /// normalisation of pixels, after division by 255
    pub normalise: Normalisation,
    /// file with torchvision's pretrained weights
    #[serde(skip_serializing_if = "Option::is_none")]
    pub weights: Option<String>,
    /// learning rate of the encoder relative to the rest; absent: 1, or 0.1 with `weights`
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lr_backbone: Option<f64>,
    /// for policies that take one vector: dimensions per cell of the feature map, or per camera with keypoints; absent: 32, or 64 with
    /// keypoints
    #[serde(skip_serializing_if = "Option::is_none")]
    pub cell_features: Option<usize>,
}

/// What a cell of the map becomes where nothing else is said.
const CELL_FEATURES: usize = 32;
/// What a camera's keypoints become where nothing else is said, as in robomimic.
const KEYPOINT_FEATURES: usize = 64;

impl Default for VisionConfig {
    fn default() -> Self {
        Self {
            encoder: Architecture::Resnet18,
            blocks: None,
            width: 16,
            norm: ImageNorm::Group,
            tokens: TokenKind::Map,
            crop: None,
            shift: 0,
            jitter: 0.0,
            normalise: Normalisation::Imagenet,
            weights: None,
            lr_backbone: None,
            cell_features: None,
        }
    }
}

impl VisionConfig {
    /// Checks that an encoder with this configuration can exist.
    ///
    /// # Errors
    /// The first field that makes it impossible.
    pub fn validate(&self) -> Result<()> {
        let refuse = |field: &'static str, found: String, expected: &str| {
            Err(ModelError::Config { model: "vision", field, found, expected: expected.to_string() })
        };
        // narrower ones are for tests and imported files
        if self.width == 0 || self.width > 512 || !self.width.is_multiple_of(4) {
            return refuse("width", self.width.to_string(), "16, 32 or 64 (any multiple of 4 up to 512)");
        }
        if self.norm == ImageNorm::Group && self.width > 16 && !self.width.is_multiple_of(16) {
            return refuse("width", self.width.to_string(), "a multiple of 16 with norm = \"group\"");
        }
        if let Some(blocks) = self.blocks
            && (blocks[0] == 0 || blocks.windows(2).any(|pair| pair[0] == 0 && pair[1] > 0))
        {
            let expected = "at least 1 of the first layer, and none of a layer only where those behind have none";
            return refuse("blocks", format!("{blocks:?}"), expected);
        }
        if let Some(blocks) = self.blocks
            && blocks.iter().any(|blocks| *blocks > MOST_BLOCKS)
        {
            return refuse("blocks", format!("{blocks:?}"), &format!("at most {MOST_BLOCKS} a layer"));
        }
        if let TokenKind::Keypoints { count: 0 } = self.tokens {
            return refuse("tokens.keypoints.count", "0".to_string(), "at least 1");
        }
        if self.crop == Some(0) {
            return refuse("crop", "0".to_string(), "a side of at least 1, or nothing");
        }
        if !(0.0..1.0).contains(&self.jitter) {
            return refuse("jitter", self.jitter.to_string(), "at least 0 and below 1");
        }
        if let Some(lr) = self.lr_backbone
            && !(lr.is_finite() && lr >= 0.0)
        {
            return refuse("lr_backbone", lr.to_string(), "a share of the learning rate, 0 or more");
        }
        if let Some(count) = self.cell_features
            && (count == 0 || !count.is_multiple_of(4))
        {
            return refuse("cell_features", count.to_string(), "a multiple of 4");
        }
        Ok(())
    }

    /// Numbers that a cell of the map, or a camera's keypoints, become for a model that reads one vector.
    pub fn cell_features(&self) -> usize {
        self.cell_features.unwrap_or(match self.tokens {
            TokenKind::Map => CELL_FEATURES,
            TokenKind::Keypoints { .. } => KEYPOINT_FEATURES,
        })
    }

    /// The network it describes.
    pub fn shape(&self) -> ResNetShape {
        let blocks = self.blocks.unwrap_or(match self.encoder {
            Architecture::Resnet18 => [2, 2, 2, 2],
            Architecture::Resnet34 => [3, 4, 6, 3],
        });
        ResNetShape { blocks, width: self.width, norm: self.norm }
    }

    /// Size of what the network sees of an image.
    ///
    /// # Errors
    /// A crop that is larger than the image, a shift that would move it outside.
    pub fn seen(&self, (h, w): (usize, usize)) -> Result<(usize, usize)> {
        if self.shift > 0 && self.shift >= h.min(w) {
            return Err(ModelError::Config {
                model: "vision",
                field: "shift",
                found: self.shift.to_string(),
                expected: format!("less than the image's side, {}", h.min(w)),
            });
        }
        match self.crop {
            None => Ok((h, w)),
            Some(side) if side <= h.min(w) => Ok((side, side)),
            Some(side) => Err(ModelError::Config {
                model: "vision",
                field: "crop",
                found: side.to_string(),
                expected: format!("at most the image's side, {}", h.min(w)),
            }),
        }
    }

    /// Learning rate of the backbone as a share of the rest's.
    pub fn backbone_rate(&self) -> f64 {
        self.lr_backbone.unwrap_or(if self.weights.is_some() { 0.1 } else { 1.0 })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn blocks_that_are_no_network_are_refused() {
        let of = |blocks| VisionConfig { blocks: Some(blocks), ..VisionConfig::default() }.validate();
        for blocks in [[1, 0, 0, 0], [2, 2, 2, 2], [3, 8, 36, 3]] {
            of(blocks).unwrap();
        }
        for blocks in [[0, 2, 2, 2], [2, 0, 2, 2], [2, 2, 2, 1_000_000_000]] {
            assert!(of(blocks).unwrap_err().to_string().contains("blocks"));
        }
    }
}
