//! Numbers that float32 does not hold: a column of such a type, read as it is. In memory it is float32.

use super::fingerprint::INDEX_COLUMNS;
use super::info::Feature;
use super::open::Dataset;
use super::read::{self, BadColumn};
use crate::error::Result;
use crate::stats::FeatureStats;
use arrow_array::cast::AsArray;
use arrow_array::types::{Float64Type, Int64Type};
use arrow_schema::DataType;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

/// The numbers of a column, row after row.
#[derive(Debug, Clone, PartialEq)]
pub enum Wide {
    /// Doubles; of uint64 too where int64 does not hold them.
    Doubles(Vec<f64>),
    /// Whole numbers.
    Longs(Vec<i64>),
}

impl Wide {
    /// Whether a feature has numbers that float32 does not hold.
    fn has(feature: &Feature) -> bool {
        matches!(feature.dtype.as_str(), "float64" | "int32" | "int64" | "uint32" | "uint64")
    }

    fn read(root: &Path, name: &str, feature: &Feature) -> Result<Self> {
        let (mut longs, mut doubles) = (Vec::new(), Vec::new());
        let mut whole = feature.dtype != "float64";
        for path in read::files(root, "data")? {
            let (_, arrays) = read::columns(&path, &[name])?;
            let column = BadColumn { path: &path, name };
            let leaf = read::leaf(&column, &arrays[0], arrays[0].len(), feature.dim())?;
            let wrong = |e: arrow_schema::ArrowError| column.because(feature.dtype.clone(), e.to_string());
            let as_longs = whole.then(|| read::cast_all(&leaf, &DataType::Int64).ok()).flatten();
            match as_longs {
                Some(array) => longs.extend_from_slice(array.as_primitive::<Int64Type>().values()),
                None => {
                    whole = false;
                    doubles.extend(std::mem::take(&mut longs).into_iter().map(|v: i64| v as f64));
                    let array = read::cast_all(&leaf, &DataType::Float64).map_err(wrong)?;
                    doubles.extend_from_slice(array.as_primitive::<Float64Type>().values());
                }
            }
        }
        Ok(if whole { Self::Longs(longs) } else { Self::Doubles(doubles) })
    }

    /// The sum of some of the numbers.
    pub fn sum(&self, numbers: Range<usize>) -> f64 {
        match self {
            Self::Doubles(all) => all[numbers].iter().sum(),
            Self::Longs(all) => all[numbers].iter().map(|&number| number as f64).sum(),
        }
    }

    /// Statistics over some rows, of `dim` numbers each.
    pub(super) fn stats(&self, rows: &[(usize, usize)], dim: usize) -> Option<FeatureStats> {
        fn pieces<'v, T>(all: &'v [T], rows: &[(usize, usize)], dim: usize) -> Vec<&'v [T]> {
            rows.iter().filter_map(|&(from, to)| all.get(from * dim..to * dim)).collect()
        }
        match self {
            Self::Doubles(all) => FeatureStats::of_rows(&pieces(all, rows, dim), dim),
            Self::Longs(all) => FeatureStats::of_rows(&pieces(all, rows, dim), dim),
        }
    }
}

impl Dataset {
    /// The numeric columns whose numbers float32 does not hold, read from the files.
    ///
    /// # Errors
    /// Files that cannot be read.
    pub fn wide(&self) -> Result<BTreeMap<String, Wide>> {
        let features = self.info().features.0.iter();
        let wide = features.filter(|(name, feature)| Wide::has(feature) && !INDEX_COLUMNS.contains(&name.as_str()));
        wide.map(|(name, feature)| Ok((name.clone(), Wide::read(self.root(), name, feature)?))).collect()
    }

    /// [`Dataset::statistics_of`] of the numbers as the files have them. Training takes those of the float32 in memory.
    ///
    /// # Errors
    /// An episode that is not there, files that cannot be read.
    pub fn exact_statistics_of(&self, episodes: &[usize]) -> Result<BTreeMap<String, FeatureStats>> {
        let (ranges, mut all) = (self.ranges(episodes)?, self.statistics_of(episodes)?);
        for (name, numbers) in self.wide()? {
            let dim = self.info().features.get(&name).map_or(1, Feature::dim);
            all.extend(numbers.stats(&ranges, dim).map(|stats| (name, stats)));
        }
        Ok(all)
    }

    /// Each frame's time in seconds as the files have it, and whether they are float32; nothing where frames have none.
    ///
    /// # Errors
    /// Files that cannot be read.
    pub fn frame_times(&self) -> Result<Option<(Vec<f64>, bool)>> {
        let (mut all, mut single) = (Vec::with_capacity(self.frames()), true);
        for path in read::files(self.root(), "data")? {
            let (_, arrays) = read::columns_there(&path, &["timestamp"])?;
            let Some(array) = arrays.get("timestamp") else { return Ok(None) };
            let leaf = read::leaf(&BadColumn { path: &path, name: "timestamp" }, array, array.len(), 1)?;
            single &= *leaf.data_type() == DataType::Float32;
            all.extend_from_slice(&read::doubles(&path, "timestamp", array)?);
        }
        Ok(Some((all, single)))
    }
}
