//! The values of columns: taken out of a demo as numbers, before they become Arrow arrays.

use super::features::{Column, IndexColumn, Mapping, Origin};
use super::info::RotationForm;
use crate::error::{DatasetError, InputError, Result};
use crate::keys::{KeyItem, Moment};
use crate::rotation;
use crate::stats::FeatureStats;
use crate::tree::{Array, Demo, Dtype};
use crate::words::{INSTRUCTION_WORDS, instruction_words};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::Path;

/// One episode's values of one column.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Values {
    F32(Vec<f32>),
    /// Only where LeRobot wrote them.
    F64(Vec<f64>),
    I64(Vec<i64>),
    Bool(Vec<bool>),
    /// Images are not held whole; they are read and encoded by rows. Texts have no statistics either.
    Pictures,
}

/// Where an episode stands in the data set.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Position {
    pub episode: usize,
    pub first_frame: usize,
    pub task_index: usize,
    pub length: usize,
}

impl Values {
    /// sha256 of the values in little-endian order. Pictures have their own way (see `PictureSummary`).
    pub(crate) fn digest(&self) -> [u8; 32] {
        let mut hash = Sha256::new();
        match self {
            Self::F32(v) => hash_numbers(&mut hash, v, |x| x.to_le_bytes()),
            Self::F64(v) => hash_numbers(&mut hash, v, |x| x.to_le_bytes()),
            Self::I64(v) => hash_numbers(&mut hash, v, |x| x.to_le_bytes()),
            Self::Bool(v) => hash_numbers(&mut hash, v, |x| [u8::from(*x)]),
            Self::Pictures => {}
        }
        hash.finalize().into()
    }

    /// The digest of the values as an opened data set has them: whole numbers and doubles as float32.
    pub(crate) fn digest_as_read(&self) -> [u8; 32] {
        match self {
            Self::F64(v) => Self::F32(v.iter().map(|&v| v as f32).collect()).digest(),
            Self::I64(v) => Self::F32(v.iter().map(|&v| v as f32).collect()).digest(),
            _ => self.digest(),
        }
    }

    /// Statistics over rows of `dim` values; `None` for pictures and for no rows.
    pub(crate) fn stats(&self, dim: usize) -> Option<FeatureStats> {
        stats_of(&[self], dim)
    }
}

/// Statistics over the values of several episodes.
pub(crate) fn stats_of(episodes: &[&Values], dim: usize) -> Option<FeatureStats> {
    match episodes.first()? {
        Values::F32(_) => {
            let pieces: Vec<&[f32]> = episodes
                .iter()
                .filter_map(|v| if let Values::F32(v) = v { Some(v.as_slice()) } else { None })
                .collect();
            FeatureStats::of_rows(&pieces, dim)
        }
        Values::F64(_) => {
            let pieces: Vec<&[f64]> = episodes
                .iter()
                .filter_map(|v| if let Values::F64(v) = v { Some(v.as_slice()) } else { None })
                .collect();
            FeatureStats::of_rows(&pieces, dim)
        }
        Values::I64(_) => {
            let pieces: Vec<&[i64]> = episodes
                .iter()
                .filter_map(|v| if let Values::I64(v) = v { Some(v.as_slice()) } else { None })
                .collect();
            FeatureStats::of_rows(&pieces, dim)
        }
        Values::Bool(_) => {
            let numbers: Vec<f32> = episodes
                .iter()
                .filter_map(|v| if let Values::Bool(v) = v { Some(v.as_slice()) } else { None })
                .flatten()
                .map(|&b| f32::from(u8::from(b)))
                .collect();
            FeatureStats::of(&numbers, dim)
        }
        Values::Pictures => None,
    }
}

fn hash_numbers<T, const N: usize>(hash: &mut Sha256, values: &[T], bytes: impl Fn(&T) -> [u8; N]) {
    let mut block = Vec::with_capacity(4096 * N);
    for part in values.chunks(4096) {
        block.clear();
        block.extend(part.iter().flat_map(&bytes));
        hash.update(&block);
    }
}

/// Takes the values of one column out of `demo`, for the whole episode.
fn column_values(
    path: &Path,
    column: &Column,
    demo: &Demo,
    task: &str,
    fps: f64,
    position: Position,
) -> Result<Values> {
    let length = position.length;
    let single = |key: &str| numbers(path, demo, key, 1, length);
    Ok(match &column.origin {
        Origin::Concat(parts) => Values::F32(concat(path, demo, task, parts, column.dim(), length)?),
        Origin::Action { key, width, rotation } => {
            let stored = numbers(path, demo, key, *width, length)?;
            Values::F32(match rotation {
                RotationForm::AxisAngle => stored,
                RotationForm::SixD => rotation::actions_to_6d(&stored),
            })
        }
        Origin::Reward => Values::F32(single("rewards")?),
        Origin::Stored(key) => stored(path, demo, key, column, length)?,
        Origin::Flag(key) => Values::Bool(single(key)?.iter().map(|&v| v != 0.0).collect()),
        Origin::Success => Values::Bool(single("rewards")?.iter().map(|&v| v >= 1.0).collect()),
        Origin::Image { .. } | Origin::Depth { .. } => Values::Pictures,
        Origin::Index(index) => index_values(*index, fps, position),
    })
}

/// Every column's values for one episode, in the mapping's order; `task` is its instruction.
pub(crate) fn episode_values(
    path: &Path,
    mapping: &Mapping,
    demo: &Demo,
    task: &str,
    position: Position,
) -> Result<Vec<Values>> {
    mapping.columns.iter().map(|c| column_values(path, c, demo, task, mapping.fps, position)).collect()
}

/// Values of the five columns that follow from an episode's place.
pub(crate) fn index_values(index: IndexColumn, fps: f64, position: Position) -> Values {
    let length = position.length;
    let constant = |v: usize| Values::I64(vec![v as i64; length]);
    let counting = |from: usize| Values::I64((from as i64..(from + length) as i64).collect());
    match index {
        IndexColumn::Timestamp => Values::F32((0..length).map(|i| (i as f64 / fps) as f32).collect()),
        IndexColumn::FrameIndex => counting(0),
        IndexColumn::EpisodeIndex => constant(position.episode),
        IndexColumn::Index => counting(position.first_frame),
        IndexColumn::TaskIndex => constant(position.task_index),
    }
}

fn concat(
    path: &Path,
    demo: &Demo,
    task: &str,
    parts: &[(KeyItem, BTreeMap<String, usize>)],
    width: usize,
    length: usize,
) -> Result<Vec<f32>> {
    let mut out = vec![0.0; width * length];
    let (mut offset, mut row) = (0, Vec::new());
    for (item, widths) in parts {
        let mut datasets = Vec::with_capacity(widths.len());
        for (key, &width) in widths {
            let place = format!("obs/{key}");
            // the chooser saw that the source has the words or an instruction
            let made = key == INSTRUCTION_WORDS && !demo.datasets.contains_key(&place);
            let values = match made {
                true => instruction_words(task).repeat(length),
                false => numbers(path, demo, &place, width, length)?,
            };
            datasets.push((key, width, values));
        }
        for (step, out) in out.chunks_exact_mut(width).enumerate() {
            let values_of = |key: &str, moment: Moment| {
                let (_, width, values) = datasets.iter().find(|(name, ..)| *name == key)?;
                let step = moment.step(step);
                Some(&values[step * width..(step + 1) * width])
            };
            row.clear();
            item.append(values_of, &mut row).expect("the datasets of the item were just taken out");
            out[offset..offset + row.len()].copy_from_slice(&row);
        }
        offset += row.len();
    }
    Ok(out)
}

/// The values of a dataset in the type of their column.
fn stored(path: &Path, demo: &Demo, key: &str, column: &Column, length: usize) -> Result<Values> {
    let array = demo.datasets.get(key).ok_or_else(|| missing(path, demo, key))?;
    let wrong = || wrong_shape(path, demo, key, &format!("{length} steps of {} numbers", column.dim()));
    let doubles = || array.to_f64().filter(|v| v.len() == column.dim() * length).ok_or_else(wrong);
    Ok(match (column.feature.dtype.as_str(), &array.dtype) {
        ("int64", kind @ (Dtype::I64 | Dtype::U64)) if array.len() == column.dim() * length => {
            let (values, _) = array.bytes.as_chunks();
            let values: Vec<i64> = values.iter().map(|v| i64::from_le_bytes(*v)).collect();
            match values.iter().find(|&&value| *kind == Dtype::U64 && value < 0) {
                None => Values::I64(values),
                Some(&value) => {
                    return Err(DatasetError::BadDataset {
                        path: path.to_path_buf(),
                        object: format!("{} {key}", demo.id),
                        expected: "whole numbers below 2^63, which an int64 column holds".to_owned(),
                        found: (value as u64).to_string(),
                    });
                }
            }
        }
        ("int64", _) => Values::I64(doubles()?.iter().map(|&v| v as i64).collect()),
        ("bool", _) => Values::Bool(doubles()?.iter().map(|&v| v != 0.0).collect()),
        ("float64", _) => Values::F64(doubles()?),
        _ => Values::F32(numbers(path, demo, key, column.dim(), length)?),
    })
}

fn numbers(path: &Path, demo: &Demo, key: &str, width: usize, length: usize) -> Result<Vec<f32>> {
    let array = demo.datasets.get(key).ok_or_else(|| missing(path, demo, key))?;
    let values = array.to_f32().filter(|v| v.len() == width * length);
    values.ok_or_else(|| wrong_shape(path, demo, key, &format!("{length} steps of {width} numbers")))
}

fn missing(path: &Path, demo: &Demo, key: &str) -> DatasetError {
    InputError::MissingKey {
        path: path.to_path_buf(),
        demo: demo.id.clone(),
        key: key.to_owned(),
        found: demo.datasets.keys().map(String::as_str).collect::<Vec<_>>().join(", "),
    }
    .into()
}

fn wrong_shape(path: &Path, demo: &Demo, key: &str, expected: &str) -> DatasetError {
    InputError::WrongShape {
        path: path.to_path_buf(),
        demo: demo.id.clone(),
        key: key.to_owned(),
        expected: expected.to_owned(),
        found: describe(demo.datasets.get(key)),
    }
    .into()
}

fn describe(array: Option<&Array>) -> String {
    array.map_or_else(|| "nothing".to_owned(), |a| format!("{} {:?}", a.dtype, a.shape))
}
