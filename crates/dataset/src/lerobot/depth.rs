//! Depth: a number a pixel, in metres or millimetres, a TIFF file a frame, as LeRobot writes and reads it.

use super::export::Rows;
use super::info::{Feature, MAX_PIXELS, MAX_SIDE, is_picture};
use super::open::Dataset;
use super::tiff;
use crate::error::{DatasetError, Result};
use crate::plan::KeyPlan;
use crate::sheet::Picture;
use crate::tree::Dtype;
use serde_json::{Value, json};
use std::ops::Range;

/// Frames that are unpacked from a column at once.
const ROWS: usize = 32;

/// What a frame's pixels are: the two kinds that LeRobot has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum DepthKind {
    /// float32, in metres where it is recorded.
    F32,
    /// uint16, in millimetres where it is recorded.
    U16,
}

impl DepthKind {
    /// What a dataset of this type becomes; `None` where LeRobot has no place for it.
    pub(crate) fn of(dtype: &Dtype) -> Option<Self> {
        match dtype {
            Dtype::F32 | Dtype::F64 => Some(Self::F32),
            Dtype::U16 => Some(Self::U16),
            _ => None,
        }
    }

    /// Bytes of a pixel.
    pub(crate) fn size(self) -> usize {
        match self {
            Self::F32 => 4,
            Self::U16 => 2,
        }
    }

    /// The type of a dataset that a column of this kind holds exactly.
    pub(crate) fn dtype(self) -> Dtype {
        match self {
            Self::F32 => Dtype::F32,
            Self::U16 => Dtype::U16,
        }
    }

    /// LeRobot's rule: whole numbers are millimetres.
    fn unit(self) -> DepthUnit {
        match self {
            Self::F32 => DepthUnit::Metres,
            Self::U16 => DepthUnit::Millimetres,
        }
    }

    /// The numbers in little-endian `bytes`; both kinds fit f32.
    pub(crate) fn values(self, bytes: &[u8]) -> impl Iterator<Item = f32> + '_ {
        bytes.chunks_exact(self.size()).map(move |b| match *b {
            [a, b, c, d] => f32::from_le_bytes([a, b, c, d]),
            [a, b] => f32::from(u16::from_le_bytes([a, b])),
            _ => unreachable!("chunks of 2 or 4"),
        })
    }
}

/// Least height and width of depth maps whose dataset has no axis for the channel: what is smaller may be a table.
const LEAST: usize = 8;

/// Height and width of the depth maps in a dataset; `None` where it has none: they are a number a pixel, metres as floats
/// or millimetres as uint16, under a name that says what they are, with an axis for their one channel or without.
pub(crate) fn size(path: &str, key: &KeyPlan) -> Option<(usize, usize)> {
    let name = path.strip_prefix("obs/")?.to_lowercase();
    let (rows, height, width, least) = match key.shape[..] {
        [rows, height, width, 1] => (rows, height, width, 1),
        [rows, height, width] => (rows, height, width, LEAST),
        _ => return None,
    };
    let is_depth = rows > 0 && height.min(width) >= least && name.contains("depth");
    (is_depth && DepthKind::of(&key.dtype).is_some()).then_some((height, width))
}

/// The column that LeRobot's recorder would make of depth.
pub(crate) fn feature(height: usize, width: usize, kind: DepthKind) -> Feature {
    Feature {
        dtype: "image".to_owned(),
        shape: vec![height, width, 1],
        names: json!(["height", "width", "channels"]),
        info: Some(json!({"is_depth_map": true, "depth_unit": kind.unit().name()})),
    }
}

/// Little-endian pixels of a column of `kind` from those of a dataset, exact but for the rounding of float64.
pub(crate) fn stored(dtype: &Dtype, bytes: &[u8], out: &mut Vec<u8>) {
    match dtype {
        Dtype::F64 => {
            for eight in bytes.chunks_exact(8) {
                let value = f64::from_le_bytes(eight.try_into().expect("8 bytes"));
                out.extend_from_slice(&(value as f32).to_le_bytes());
            }
        }
        _ => out.extend_from_slice(bytes),
    }
}

/// In words the first pixel that is no distance: LeRobot would read it, and its statistics and everything that is trained
/// would be NaN.
pub(crate) fn not_finite(kind: DepthKind, width: usize, bytes: &[u8]) -> Option<String> {
    let (at, value) = kind.values(bytes).enumerate().find(|(_, value)| !value.is_finite())?;
    Some(format!("{value} in row {}, column {}", at / width.max(1), at % width.max(1)))
}

/// What depth is measured in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DepthUnit {
    /// `m`
    Metres,
    /// `mm`, which LeRobot gives unless asked.
    #[default]
    Millimetres,
}

impl DepthUnit {
    /// The unit that LeRobot calls `name`, `m` or `mm`.
    pub fn named(name: &str) -> Option<Self> {
        match name {
            "m" => Some(Self::Metres),
            "mm" => Some(Self::Millimetres),
            _ => None,
        }
    }

    /// What LeRobot calls it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Metres => "m",
            Self::Millimetres => "mm",
        }
    }

    /// Depth of the unit `stored` in this one, by LeRobot's arithmetic; as it is where no unit is stated.
    pub fn of(self, stored: Option<&str>, depth: f32) -> f32 {
        match (stored.and_then(Self::named), self) {
            (Some(Self::Metres), Self::Millimetres) => depth * 1000.0,
            (Some(Self::Millimetres), Self::Metres) => depth / 1000.0,
            _ => depth,
        }
    }

    /// What statistics in the unit `stored` are multiplied with, as LeRobot does.
    pub fn factor(self, stored: Option<&str>) -> f64 {
        match (stored.and_then(Self::named), self) {
            (Some(Self::Metres), Self::Millimetres) => 1000.0,
            (Some(Self::Millimetres), Self::Metres) => 1.0 / 1000.0,
            _ => 1.0,
        }
    }
}

/// The depth maps of one camera in an episode.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthMaps {
    /// Rows of a map.
    pub height: usize,
    /// Pixels in a row.
    pub width: usize,
    /// `m` or `mm`; `None` where the data set does not say.
    pub unit: Option<String>,
    /// Map after map, in that unit: rows from the top, pixels from the left.
    pub data: Vec<f32>,
}

impl DepthMaps {
    /// The map of a frame of the episode.
    ///
    /// # Panics
    /// When there is no such frame.
    pub fn frame(&self, frame: usize) -> &[f32] {
        let size = self.height * self.width;
        &self.data[frame * size..(frame + 1) * size]
    }

    /// A frame for people: white is what is nearest in the episode, black what is farthest.
    ///
    /// # Panics
    /// When there is no such frame.
    pub fn picture(&self, frame: usize) -> Picture {
        let far = self.data.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let near = self.data.iter().copied().fold(f32::INFINITY, f32::min);
        let level = |&v: &f32| (255.0 * (far - v) / (far - near).max(f32::MIN_POSITIVE)).round() as u8;
        let rgb = self.frame(frame).iter().flat_map(|v| [level(v); 3]).collect();
        Picture { height: self.height, width: self.width, rgb }
    }
}

impl Dataset {
    /// Names of the features that are depth, in the order of `info.json`.
    pub fn depth_names(&self) -> impl Iterator<Item = &str> {
        self.info().features.0.iter().filter(|(_, f)| f.is_depth()).map(|(name, _)| name.as_str())
    }

    /// The depth maps of one episode, the numbers that LeRobot reads in the unit that they are stored in.
    ///
    /// # Errors
    /// No depth of this name, depth as video, a frame that is damaged or of another size, by name.
    ///
    /// # Panics
    /// When there is no such episode.
    pub fn depth_maps(&self, name: &str, episode: usize) -> Result<DepthMaps> {
        self.depth_of(name, episode..episode + 1)
    }

    /// The depth maps of some episodes, one after the other.
    pub(crate) fn depth_of(&self, name: &str, episodes: Range<usize>) -> Result<DepthMaps> {
        let (height, width) = self.depth_size(name)?;
        let mut rows = Rows::open(self.root(), "data", Some(name), ROWS)?;
        rows.skip(self.episodes().get(episodes.start).map_or(0, |first| first.from))?;
        let mut data = Vec::new();
        for episode in episodes {
            self.each_depth(&mut rows, name, episode, &mut |_, kind, bytes| {
                data.extend(kind.values(bytes));
                Ok(())
            })?;
        }
        let unit = self.info().features.get(name).and_then(Feature::depth_unit).map(str::to_owned);
        Ok(DepthMaps { height, width, unit, data })
    }

    /// Calls `take` with each frame's number, kind and pixels, of the episode that `rows` have come to.
    pub(crate) fn each_depth(
        &self,
        rows: &mut Rows,
        name: &str,
        episode: usize,
        take: &mut TakeDepth<'_>,
    ) -> Result<()> {
        let (height, width) = self.depth_size(name)?;
        let length = self.episodes()[episode].length;
        let mut pixels = Vec::with_capacity(height * width * 4);
        let mut frame = 0;
        while frame < length {
            let batch = rows.next_rows(length - frame)?;
            for file in &self.files(name, batch.column(0))? {
                pixels.clear();
                let file = file.unwrap_or_default();
                let kind =
                    tiff::decode(file, height, width, &mut pixels).map_err(|found| DatasetError::BadDataset {
                        path: rows.file().to_path_buf(),
                        object: format!("column {name}, frame {frame} of episode {episode}"),
                        expected: format!("a TIFF file with {height} x {width} of depth"),
                        found,
                    })?;
                take(frame, kind, &pixels)?;
                frame += 1;
            }
        }
        Ok(())
    }

    /// Height and width of a feature of depth.
    pub(crate) fn depth_size(&self, name: &str) -> Result<(usize, usize)> {
        let found = self.info().features.get(name).filter(|f| f.is_depth());
        let feature = found.ok_or_else(|| DatasetError::NotInDataset {
            path: self.root().to_path_buf(),
            wanted: format!("depth {name}"),
            found: match self.depth_names().collect::<Vec<_>>().join(", ") {
                none if none.is_empty() => "no depth".to_owned(),
                names => names,
            },
        })?;
        let bad = |expected: &str, found: String| DatasetError::BadDataset {
            path: self.root().join("meta/info.json"),
            object: name.to_owned(),
            expected: expected.to_owned(),
            found,
        };
        if feature.dtype == "video" {
            let codec = feature.info.as_ref().and_then(|info| info.get("video.codec")).and_then(Value::as_str);
            let found = format!("depth as a {} video, which is not read", codec.unwrap_or("quantised"));
            return Err(bad("depth as images", found));
        }
        match feature.shape[..] {
            [height, width, 1] if is_picture(height, width) => Ok((height, width)),
            _ => {
                let expected =
                    format!("depth of shape [height, width, 1], up to {MAX_SIDE} on a side and {MAX_PIXELS} pixels");
                Err(bad(&expected, format!("{:?}", feature.shape)))
            }
        }
    }
}

/// What is done with a frame of depth: its number, its kind, its pixels.
pub(crate) type TakeDepth<'f> = dyn FnMut(usize, DepthKind, &[u8]) -> Result<()> + 'f;
