//! Statistics of a feature: what a normaliser needs and what a LeRobotDataset stores.
//!
//! Values that are NaN or infinite do not count; a dimension without any other has zeros.
//! Mean and standard deviation (population, ddof 0) are computed in f64 in two passes; quantiles are
//! exact, with linear interpolation between order statistics as numpy's default does it.

use serde::{Deserialize, Serialize};
use std::cmp::Ordering;

/// The quantiles that LeRobot stores, with their names.
pub const QUANTILES: [(&str, f64); 5] = [("q01", 0.01), ("q10", 0.10), ("q50", 0.50), ("q90", 0.90), ("q99", 0.99)];

/// Per-dimension statistics of one feature over a number of frames.
///
/// Every vector has the feature's length; image features have one value a channel, in `[0, 1]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FeatureStats {
    /// Smallest value.
    pub min: Vec<f64>,
    /// Largest value.
    pub max: Vec<f64>,
    /// Arithmetic mean.
    pub mean: Vec<f64>,
    /// Population standard deviation.
    pub std: Vec<f64>,
    /// Number of frames.
    pub count: u64,
    /// 1% quantile.
    pub q01: Vec<f64>,
    /// 10% quantile.
    pub q10: Vec<f64>,
    /// Median.
    pub q50: Vec<f64>,
    /// 90% quantile.
    pub q90: Vec<f64>,
    /// 99% quantile.
    pub q99: Vec<f64>,
}

/// A number that statistics can be taken of.
pub trait Sample: Copy {
    /// The value in f64.
    fn to_f64(self) -> f64;
    /// Total order; NaN sorts last.
    fn order(&self, other: &Self) -> Ordering;
    /// Bytes of a value.
    const BYTES: usize;
    /// Appends the bytes of the value.
    fn put(self, bytes: &mut Vec<u8>);
    /// The value of [`Sample::BYTES`] bytes.
    fn from_bytes(bytes: &[u8]) -> Self;
    /// A number of [`Sample::BYTES`] bytes that is in the same order.
    fn key(self) -> u64;
    /// The value with this key.
    fn from_key(key: u64) -> Self;
}

macro_rules! bytes_of {
    ($t:ty) => {
        const BYTES: usize = size_of::<$t>();
        fn put(self, bytes: &mut Vec<u8>) {
            bytes.extend_from_slice(&self.to_le_bytes());
        }
        fn from_bytes(bytes: &[u8]) -> Self {
            bytes.first_chunk().map_or(<$t>::default(), |b| <$t>::from_le_bytes(*b))
        }
    };
}

impl Sample for f32 {
    fn to_f64(self) -> f64 {
        f64::from(self)
    }
    fn order(&self, other: &Self) -> Ordering {
        self.total_cmp(other)
    }
    bytes_of!(f32);
    fn key(self) -> u64 {
        let bits = self.to_bits();
        u64::from(if bits >> 31 == 0 { bits | 1 << 31 } else { !bits })
    }
    fn from_key(key: u64) -> Self {
        let key = key as u32;
        Self::from_bits(if key >> 31 == 1 { key & !(1 << 31) } else { !key })
    }
}

impl Sample for f64 {
    fn to_f64(self) -> f64 {
        self
    }
    fn order(&self, other: &Self) -> Ordering {
        self.total_cmp(other)
    }
    bytes_of!(f64);
    fn key(self) -> u64 {
        let bits = self.to_bits();
        if bits >> 63 == 0 { bits | 1 << 63 } else { !bits }
    }
    fn from_key(key: u64) -> Self {
        Self::from_bits(if key >> 63 == 1 { key & !(1 << 63) } else { !key })
    }
}

impl Sample for i64 {
    fn to_f64(self) -> f64 {
        self as f64
    }
    fn order(&self, other: &Self) -> Ordering {
        self.cmp(other)
    }
    bytes_of!(i64);
    fn key(self) -> u64 {
        self as u64 ^ 1 << 63
    }
    fn from_key(key: u64) -> Self {
        (key ^ 1 << 63) as i64
    }
}

/// Takes the next values of a dimension.
pub(crate) type Streamed<'f, T> = dyn FnMut(&[T]) + 'f;
/// Gives the values of a dimension to whom it is told, in order.
type Each<'e, T, E> = dyn FnMut(usize, &mut Streamed<'_, T>) -> Result<(), E> + 'e;

/// Order statistics of values that pass several times: each pass counts 16 more bits of those that may be wanted.
struct Radix {
    /// The ranks wanted, ascending; what is left of each below the bits that are known.
    ranks: Vec<u64>,
    /// The bits of each that are known.
    prefixes: Vec<u64>,
    /// Different prefixes, and the values of the next 16 bits that begin with each.
    counts: Vec<(u64, Vec<u64>)>,
    /// Where the counts of a prefix are, by its last 16 bits: one more, 0 for nowhere.
    places: Vec<u8>,
    bits: usize,
    shift: usize,
}

impl Radix {
    const DIGIT: usize = 16;
    const VALUES: usize = 1 << Self::DIGIT;

    /// For keys of so many bytes, of which the highest digit was counted.
    fn new(bytes: usize, ranks: &[usize], first: Vec<u64>) -> Self {
        let mut radix = Self {
            ranks: ranks.iter().map(|&rank| rank as u64).collect(),
            prefixes: vec![0; ranks.len()],
            counts: vec![(0, first)],
            places: vec![0; Self::VALUES],
            bits: 8 * bytes,
            shift: 8 * bytes - Self::DIGIT,
        };
        radix.descend();
        radix
    }

    /// Whether all bits are known.
    fn is_done(&self) -> bool {
        self.shift == self.bits
    }

    fn count(&mut self, key: u64) {
        let prefix = key >> (self.shift + Self::DIGIT);
        let place = self.places[prefix as usize & (Self::VALUES - 1)];
        if place == 0 {
            return;
        }
        // prefixes that end alike are few
        if let Some((_, counts)) = self.counts[usize::from(place) - 1..].iter_mut().find(|(known, _)| *known == prefix)
        {
            counts[(key >> self.shift) as usize & (Self::VALUES - 1)] += 1;
        }
    }

    /// Takes the next digit of every value wanted from the counts.
    fn descend(&mut self) {
        for (rank, prefix) in self.ranks.iter_mut().zip(&mut self.prefixes) {
            let Some((_, counts)) = self.counts.iter().find(|(known, _)| known == prefix) else { continue };
            let mut below = 0;
            let digit = counts.iter().position(|&count| {
                below += count;
                below > *rank
            });
            let digit = digit.unwrap_or(Self::VALUES - 1);
            *rank -= below - counts[digit];
            *prefix = *prefix << Self::DIGIT | digit as u64;
        }
        if self.shift == 0 {
            self.shift = self.bits;
            return;
        }
        self.shift -= Self::DIGIT;
        let mut known = self.prefixes.clone();
        // those that end alike beside each other
        known.sort_unstable_by_key(|prefix| (prefix & (Self::VALUES as u64 - 1), *prefix));
        known.dedup();
        self.places.fill(0);
        for (at, prefix) in known.iter().enumerate().rev() {
            self.places[*prefix as usize & (Self::VALUES - 1)] = at as u8 + 1;
        }
        self.counts = known.into_iter().map(|prefix| (prefix, vec![0; Self::VALUES])).collect();
    }
}

impl FeatureStats {
    fn with_capacity(dim: usize, count: u64) -> Self {
        let v = || Vec::with_capacity(dim);
        Self { min: v(), max: v(), mean: v(), std: v(), count, q01: v(), q10: v(), q50: v(), q90: v(), q99: v() }
    }

    /// Statistics of row-major values, `dim` to a row. `None` when there are no rows.
    pub fn of<T: Sample>(values: &[T], dim: usize) -> Option<Self> {
        Self::of_rows(&[values], dim)
    }

    /// Like [`FeatureStats::of`] over several pieces, one after the other.
    pub fn of_rows<T: Sample>(pieces: &[&[T]], dim: usize) -> Option<Self> {
        let rows = pieces.iter().map(|p| p.len()).sum::<usize>().checked_div(dim)?;
        if rows == 0 {
            return None;
        }
        let mut stats = Self::with_capacity(dim, rows as u64);
        let mut scratch: Vec<T> = Vec::with_capacity(rows);
        for d in 0..dim {
            scratch.clear();
            for piece in pieces {
                scratch.extend(piece.iter().skip(d).step_by(dim));
            }
            stats.push_dimension(&mut scratch);
        }
        Some(stats)
    }

    /// The same, bit for bit, of values that are not in memory: `each` gives those of a dimension, in order, as often as it is
    /// asked.
    pub(crate) fn streamed<T: Sample, E>(dim: usize, each: &mut Each<'_, T, E>) -> Result<Option<Self>, E> {
        let mut stats = Self::with_capacity(dim, 0);
        for d in 0..dim {
            let mut first = vec![0_u64; Radix::VALUES];
            let (mut rows, mut n, mut sum) = (0_u64, 0_usize, std::iter::empty::<f64>().sum::<f64>());
            let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
            each(d, &mut |values| {
                rows += values.len() as u64;
                for &value in values {
                    let v = value.to_f64();
                    if v.is_finite() {
                        (n, sum, low, high) = (n + 1, sum + v, low.min(v), high.max(v));
                        first[(value.key() >> (8 * T::BYTES - Radix::DIGIT)) as usize] += 1;
                    }
                }
            })?;
            stats.count = rows;
            if rows == 0 {
                return Ok(None);
            }
            if n == 0 {
                stats.vectors_mut().into_iter().for_each(|vector| vector.push(0.0));
                continue;
            }
            let mean = (sum / n as f64).max(low).min(high);
            let wanted = ranks_wanted(n);
            let mut radix = Radix::new(T::BYTES, &wanted, first);
            let mut squares = Some(std::iter::empty::<f64>().sum::<f64>());
            let mut variance = 0.0;
            while !radix.is_done() {
                each(d, &mut |values| {
                    for &value in values {
                        let v = value.to_f64();
                        if v.is_finite() {
                            squares = squares.map(|sum| sum + (v - mean).powi(2));
                            radix.count(value.key());
                        }
                    }
                })?;
                variance = squares.take().map_or(variance, |sum| sum / n as f64);
                radix.descend();
            }
            let found: Vec<f64> = radix.prefixes.iter().map(|&key| T::from_key(key).to_f64()).collect();
            let at = |rank: usize| found[wanted.partition_point(|&known| known < rank)];
            stats.push_summary(n, [low, high, mean, variance.sqrt()], at);
        }
        Ok(Some(stats))
    }

    /// Statistics of an image channel from its histogram over `0..=255`, scaled to `[0, 1]`.
    ///
    /// `counts` holds one histogram a channel; `frames` is the number of images sampled.
    pub fn of_histograms(counts: &[[u64; 256]], frames: u64) -> Option<Self> {
        let mut stats = Self::with_capacity(counts.len(), frames);
        for histogram in counts {
            let n: u64 = histogram.iter().sum();
            if n == 0 {
                return None;
            }
            let value_at = |rank: u64| {
                let mut seen = 0;
                let level = histogram.iter().position(|&c| {
                    seen += c;
                    seen > rank
                });
                level.expect("a rank below the number of pixels is inside the histogram") as f64
            };
            let moment = |f: &dyn Fn(f64) -> f64| {
                let total: f64 = histogram.iter().enumerate().map(|(v, &c)| f(v as f64) * c as f64).sum();
                total / n as f64
            };
            let mean = moment(&|v| v);
            let variance = moment(&|v| (v - mean) * (v - mean));
            stats.min.push(value_at(0) / 255.0);
            stats.max.push(value_at(n - 1) / 255.0);
            stats.mean.push(mean / 255.0);
            stats.std.push(variance.sqrt() / 255.0);
            let quantiles = stats.quantiles_mut();
            for (out, (_, q)) in quantiles.into_iter().zip(QUANTILES) {
                let (low, high, t) = ranks(n as usize, q);
                out.push(lerp(value_at(low as u64), value_at(high as u64), t) / 255.0);
            }
        }
        Some(stats)
    }

    /// Statistics of several disjoint parts taken together, each counting by its frames. Extremes, mean and standard
    /// deviation are the whole's; quantiles are the parts' means, as LeRobot has them, and empty where a part has none.
    /// `None` of no frames.
    pub fn pooled(parts: &[&Self]) -> Option<Self> {
        let dim = parts.first()?.mean.len();
        let count: u64 = parts.iter().map(|part| part.count).sum();
        if count == 0 || parts.iter().any(|part| part.mean.len() != dim) {
            return None;
        }
        type Get = fn(&FeatureStats) -> &Vec<f64>;
        let weighted = |value: &dyn Fn(&Self) -> f64| -> f64 {
            parts.iter().map(|part| part.count as f64 * value(part)).sum::<f64>() / count as f64
        };
        let averages = |get: Get| -> Vec<f64> {
            match parts.iter().all(|part| get(part).len() == dim) {
                true => (0..dim).map(|d| weighted(&|part| get(part)[d])).collect(),
                false => Vec::new(),
            }
        };
        let extreme = |get: Get, pick: fn(f64, f64) -> f64| -> Option<Vec<f64>> {
            (0..dim).map(|d| parts.iter().filter_map(|part| get(part).get(d).copied()).reduce(pick)).collect()
        };
        let mean = averages(|s| &s.mean);
        let std = (0..dim).map(|d| {
            let spread =
                |part: &Self| part.std.get(d).copied().unwrap_or(0.0).powi(2) + (part.mean[d] - mean[d]).powi(2);
            weighted(&spread).sqrt()
        });
        Some(Self {
            min: extreme(|s| &s.min, f64::min)?,
            max: extreme(|s| &s.max, f64::max)?,
            std: std.collect(),
            count,
            q01: averages(|s| &s.q01),
            q10: averages(|s| &s.q10),
            q50: averages(|s| &s.q50),
            q90: averages(|s| &s.q90),
            q99: averages(|s| &s.q99),
            mean,
        })
    }

    /// The quantile vectors in the order of [`QUANTILES`].
    pub fn quantiles(&self) -> [&[f64]; 5] {
        [&self.q01, &self.q10, &self.q50, &self.q90, &self.q99]
    }

    /// All vectors, in the order of [`FeatureStats::from_vectors`].
    pub(crate) fn vectors(&self) -> [&[f64]; 9] {
        let Self { min, max, mean, std, count: _, q01, q10, q50, q90, q99 } = self;
        [min, max, mean, std, q01, q10, q50, q90, q99]
    }

    pub(crate) fn from_vectors(count: u64, vectors: [Vec<f64>; 9]) -> Self {
        let [min, max, mean, std, q01, q10, q50, q90, q99] = vectors;
        Self { min, max, mean, std, count, q01, q10, q50, q90, q99 }
    }

    fn vectors_mut(&mut self) -> [&mut Vec<f64>; 9] {
        let Self { min, max, mean, std, count: _, q01, q10, q50, q90, q99 } = self;
        [min, max, mean, std, q01, q10, q50, q90, q99]
    }

    fn quantiles_mut(&mut self) -> [&mut Vec<f64>; 5] {
        [&mut self.q01, &mut self.q10, &mut self.q50, &mut self.q90, &mut self.q99]
    }

    fn push_dimension<T: Sample>(&mut self, values: &mut Vec<T>) {
        let mut sum = values.iter().map(|v| v.to_f64()).sum::<f64>();
        if !sum.is_finite() {
            values.retain(|v| v.to_f64().is_finite());
            sum = values.iter().map(|v| v.to_f64()).sum();
        }
        if values.is_empty() {
            return self.vectors_mut().into_iter().for_each(|vector| vector.push(0.0));
        }
        let n = values.len() as f64;
        let low = values.iter().fold(f64::INFINITY, |m, v| m.min(v.to_f64()));
        let high = values.iter().fold(f64::NEG_INFINITY, |m, v| m.max(v.to_f64()));
        // rounding must not push the mean of a constant column beside its only value
        let mean = (sum / n).max(low).min(high);
        let variance = values.iter().map(|v| (v.to_f64() - mean).powi(2)).sum::<f64>() / n;
        let wanted = ranks_wanted(values.len());
        // index columns, rewards and dones mostly are in order already
        if !values.is_sorted_by(|a, b| a.order(b).is_le()) {
            select_ranks(values, 0, &wanted);
        }
        self.push_summary(values.len(), [low, high, mean, variance.sqrt()], |rank| values[rank].to_f64());
    }

    /// Appends a dimension of `n` values, of which `at` gives order statistics.
    fn push_summary(&mut self, n: usize, [low, high, mean, std]: [f64; 4], at: impl Fn(usize) -> f64) {
        self.min.push(low);
        self.max.push(high);
        self.mean.push(mean);
        self.std.push(std);
        for (out, (_, q)) in self.quantiles_mut().into_iter().zip(QUANTILES) {
            let (low, high, t) = ranks(n, q);
            out.push(lerp(at(low), at(high), t));
        }
    }
}

/// The order statistics that quantiles of `n` values are made of, ascending.
fn ranks_wanted(n: usize) -> Vec<usize> {
    let mut wanted: Vec<usize> = QUANTILES.into_iter().map(|(_, q)| ranks(n, q)).flat_map(|(a, b, _)| [a, b]).collect();
    wanted.sort_unstable();
    wanted.dedup();
    wanted
}

/// The two order statistics around quantile `q` of `n` values, and the weight of the second.
fn ranks(n: usize, q: f64) -> (usize, usize, f64) {
    let position = q * (n - 1) as f64;
    let low = position.floor() as usize;
    (low, (low + 1).min(n - 1), position - low as f64)
}

/// numpy's interpolation: symmetric in its ends, so that equal ends give themselves.
fn lerp(a: f64, b: f64, t: f64) -> f64 {
    if t >= 0.5 { b - (b - a) * (1.0 - t) } else { a + (b - a) * t }
}

/// Partially sorts `values` so that every index in `ranks` (sorted; offset by `base`) holds its order statistic.
fn select_ranks<T: Sample>(values: &mut [T], base: usize, ranks: &[usize]) {
    let Some(&middle) = ranks.get(ranks.len() / 2) else { return };
    let (left, _, right) = values.select_nth_unstable_by(middle - base, T::order);
    let half = ranks.len() / 2;
    select_ranks(left, base, &ranks[..half]);
    select_ranks(right, middle + 1, &ranks[half + 1..]);
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    /// The definition, by sorting.
    fn naive(values: &[f64], q: f64) -> f64 {
        let mut v = values.to_vec();
        v.sort_by(f64::total_cmp);
        let position = q * (v.len() - 1) as f64;
        let low = position.floor() as usize;
        let high = position.ceil() as usize;
        v[low] + (v[high] - v[low]) * (position - low as f64)
    }

    proptest! {
        #[test]
        fn statistics_agree_with_their_definitions(rows in prop::collection::vec((-1e3_f32..1e3, -1.0_f32..1.0), 1..200)) {
            let flat: Vec<f32> = rows.iter().flat_map(|&(a, b)| [a, b]).collect();
            let stats = FeatureStats::of(&flat, 2).unwrap();
            for d in 0..2 {
                let column: Vec<f64> = flat.iter().skip(d).step_by(2).map(|&v| f64::from(v)).collect();
                let n = column.len() as f64;
                let mean = column.iter().sum::<f64>() / n;
                let var = column.iter().map(|v| v * v).sum::<f64>() / n - mean * mean;
                prop_assert!((stats.mean[d] - mean).abs() < 1e-9);
                prop_assert!((stats.std[d].powi(2) - var).abs() < 1e-6);
                prop_assert_eq!(stats.min[d], column.iter().copied().fold(f64::INFINITY, f64::min));
                prop_assert_eq!(stats.max[d], column.iter().copied().fold(f64::NEG_INFINITY, f64::max));
                for (got, (_, q)) in stats.quantiles().iter().zip(QUANTILES) {
                    prop_assert!((got[d] - naive(&column, q)).abs() < 1e-9);
                }
            }
            prop_assert_eq!(stats.count, rows.len() as u64);
        }

        #[test]
        fn a_histogram_gives_the_statistics_of_its_pixels(pixels in prop::collection::vec(any::<u8>(), 1..300)) {
            let mut histogram = [0_u64; 256];
            for &p in &pixels {
                histogram[usize::from(p)] += 1;
            }
            let values: Vec<f64> = pixels.iter().map(|&p| f64::from(p)).collect();
            let expected = FeatureStats::of(&values, 1).unwrap();
            let got = FeatureStats::of_histograms(&[histogram], 1).unwrap();
            for (a, b) in [(&got.min, &expected.min), (&got.max, &expected.max), (&got.mean, &expected.mean), (&got.std, &expected.std), (&got.q01, &expected.q01), (&got.q50, &expected.q50), (&got.q99, &expected.q99)] {
                prop_assert!((a[0] - b[0] / 255.0).abs() < 1e-9, "{a:?} {b:?}");
            }
        }
    }

    proptest! {
        #[test]
        fn parts_taken_together_are_the_whole(rows in prop::collection::vec(-1e3_f64..1e3, 2..100), at in any::<prop::sample::Index>()) {
            let (a, b) = rows.split_at(1 + at.index(rows.len() - 1));
            let parts = [FeatureStats::of(a, 1).unwrap(), FeatureStats::of(b, 1).unwrap()];
            let (whole, pooled) = (FeatureStats::of(&rows, 1).unwrap(), FeatureStats::pooled(&[&parts[0], &parts[1]]).unwrap());
            prop_assert_eq!((whole.count, &whole.min, &whole.max), (pooled.count, &pooled.min, &pooled.max));
            prop_assert!((whole.mean[0] - pooled.mean[0]).abs() < 1e-9 && (whole.std[0] - pooled.std[0]).abs() < 1e-9);
            prop_assert!(pooled.q50[0] >= parts[0].q50[0].min(parts[1].q50[0]));
            let old = FeatureStats { q10: Vec::new(), ..parts[1].clone() };
            prop_assert!(FeatureStats::pooled(&[&parts[0], &old]).unwrap().q10.is_empty());
        }
    }

    #[test]
    fn no_rows_have_no_statistics() {
        assert_eq!(FeatureStats::pooled(&[]), None);
        assert_eq!(FeatureStats::of::<f32>(&[], 3), None);
        assert_eq!(FeatureStats::of::<f32>(&[], 0), None);
    }

    #[test]
    fn numpy_agrees_on_a_known_vector() {
        // numpy.quantile([3, 1, 4, 1, 5, 9, 2, 6], [.01, .1, .5, .9, .99]), std ddof 0
        let stats = FeatureStats::of(&[3.0_f64, 1.0, 4.0, 1.0, 5.0, 9.0, 2.0, 6.0], 1).unwrap();
        let got: Vec<f64> = stats.quantiles().iter().map(|q| q[0]).collect();
        for (g, e) in got.iter().zip([1.0, 1.0, 3.5, 6.9, 8.79]) {
            assert!((g - e).abs() < 1e-12, "{got:?}");
        }
        assert!((stats.std[0] - 2.570_870_475_150_391_7).abs() < 1e-12);
    }
}
