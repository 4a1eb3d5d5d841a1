//! Values that their column does not hold as the source has them: looked for as demos are read, noted at the end.

use super::encode::Loaded;
use super::features::{Column, Origin};
use crate::tree::{Array, Dtype};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Something of each dataset, by the column that it goes into.
type OfColumns<T> = BTreeMap<String, BTreeMap<String, T>>;

/// What was found so far.
#[derive(Debug, Default, Clone, Serialize, Deserialize)]
pub(super) struct Doubts {
    /// Steps of truths that are neither 0 nor 1.
    other: OfColumns<usize>,
    /// The largest whole number that is rounded.
    rounded: OfColumns<i128>,
}

impl Doubts {
    /// Those of the demos that begin in a row group.
    pub(super) fn of(columns: &[Column], loaded: &[Loaded]) -> Self {
        let mut found = Self::default();
        for (column, loaded) in columns.iter().flat_map(|c| loaded.iter().map(move |l| (c, l))) {
            for key in column.keys().into_iter().filter(|_| loaded.part.begins()) {
                let Some(array) = loaded.demo.datasets.get(&key) else { continue };
                if matches!(column.origin, Origin::Flag(_)) {
                    let truths = array.to_f32().unwrap_or_default();
                    match truths.iter().filter(|&&v| v != 0.0 && v != 1.0).count() {
                        0 => {}
                        steps => found.add_other(&key, &column.name, steps),
                    }
                } else if column.feature.dtype == "float32"
                    && let Some(number) = rounded(array)
                {
                    found.add_rounded(&key, &column.name, number);
                }
            }
        }
        found
    }

    fn add_other(&mut self, key: &str, column: &str, steps: usize) {
        *self.other.entry(key.to_owned()).or_default().entry(column.to_owned()).or_default() += steps;
    }

    fn add_rounded(&mut self, key: &str, column: &str, number: i128) {
        let most = self.rounded.entry(key.to_owned()).or_default().entry(column.to_owned()).or_insert(number);
        *most = larger(*most, number);
    }

    /// Joins those of the next row groups.
    pub(super) fn extend(&mut self, next: &Self) {
        each(&next.other).for_each(|(key, column, &steps)| self.add_other(key, column, steps));
        each(&next.rounded).for_each(|(key, column, &number)| self.add_rounded(key, column, number));
    }

    pub(super) fn notes(&self) -> Vec<String> {
        let other = each(&self.other).map(|(key, column, steps)| {
            format!("{key}: {steps} steps are neither 0 nor 1; {column} is true wherever they are not 0")
        });
        let rounded = each(&self.rounded).map(|(key, column, number)| {
            format!("{key}: whole numbers up to {number} are rounded in {column}, which is float32")
        });
        other.chain(rounded).collect()
    }
}

fn each<T>(all: &OfColumns<T>) -> impl Iterator<Item = (&str, &str, &T)> {
    all.iter().flat_map(|(key, columns)| columns.iter().map(move |(column, it)| (key.as_str(), column.as_str(), it)))
}

fn larger(a: i128, b: i128) -> i128 {
    if b.unsigned_abs() > a.unsigned_abs() { b } else { a }
}

/// The largest of the whole numbers that float32 does not hold.
fn rounded(array: &Array) -> Option<i128> {
    macro_rules! numbers {
        ($t:ty) => {{
            let (values, _) = array.bytes.as_chunks();
            let numbers = values.iter().map(|v| i128::from(<$t>::from_le_bytes(*v)));
            numbers.filter(|&v| v as f32 as i128 != v).reduce(larger)
        }};
    }
    match array.dtype {
        Dtype::I32 => numbers!(i32),
        Dtype::U32 => numbers!(u32),
        Dtype::I64 => numbers!(i64),
        Dtype::U64 => numbers!(u64),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whole_numbers_that_float32_rounds_are_found() {
        let of = |values: &[i64]| rounded(&Array::from_i64(vec![values.len()], values));
        assert_eq!(of(&[1 << 24, -3, 1 << 40]), None);
        assert_eq!(of(&[1, (1 << 24) + 1, -(1 << 30) - 1, 1 << 50]), Some(-(1 << 30) - 1));
        assert_eq!(of(&[i64::MAX, i64::MIN]), Some(i128::from(i64::MAX)));
    }
}
