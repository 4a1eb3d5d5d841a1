//! Which episodes an edit is about: by number, demo and mask, or as shares of a set.

use super::super::open::Dataset;
use crate::error::{DatasetError, Result};
use crate::shuffle::SplitMix64;
use std::collections::BTreeSet;

/// Demos that a message names.
const SHOWN: usize = 10;

/// Episodes by number, by demo and by mask: all of them together.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Selection {
    /// Numbers of episodes, from 0.
    pub episodes: Vec<usize>,
    /// Ids of demos, where the set was converted from demonstrations.
    pub demos: Vec<String>,
    /// Masks, or named ranges of sets that LeRobot wrote.
    pub masks: Vec<String>,
}

impl Selection {
    /// Their numbers in `set`.
    ///
    /// # Errors
    /// [`DatasetError::NotInDataset`] for the first that is not there, and when there are none.
    pub fn resolve(&self, set: &Dataset) -> Result<BTreeSet<usize>> {
        let missing = |wanted: String, found: String| DatasetError::NotInDataset {
            path: set.root().to_path_buf(),
            wanted,
            found,
        };
        set.ranges(&self.episodes)?;
        let mut chosen: BTreeSet<usize> = self.episodes.iter().copied().collect();
        for demo in &self.demos {
            let found = set.episodes().iter().find(|e| e.demo.as_ref() == Some(demo)).ok_or_else(|| {
                let ids: Vec<&str> = set.episodes().iter().filter_map(|e| e.demo.as_deref()).collect();
                let more = if ids.len() > SHOWN { format!(" and {} more", ids.len() - SHOWN) } else { String::new() };
                let found = match ids.is_empty() {
                    true => "none: it was not converted from demonstrations".to_owned(),
                    false => format!("{}{more}", ids[..ids.len().min(SHOWN)].join(", ")),
                };
                missing(format!("demo {demo}"), found)
            })?;
            chosen.insert(found.index);
        }
        for mask in &self.masks {
            chosen.extend(set.required_split(mask)?);
        }
        match (chosen.is_empty(), self.masks.as_slice()) {
            (false, _) => Ok(chosen),
            (true, []) => {
                Err(missing("episode that was chosen".to_owned(), format!("{} to choose from", set.episodes().len())))
            }
            (true, masks) => Err(missing(format!("episode in {}", masks.join(", ")), "an empty mask".to_owned())),
        }
    }
}

/// How a set is split: the names of the parts and what goes into each.
#[derive(Debug, Clone, PartialEq)]
pub enum Parts {
    /// Shares of the episodes, together 1 at most.
    Fractions(Vec<(String, f64)>),
    /// Numbers of episodes.
    Counts(Vec<(String, usize)>),
    /// Masks, which have no episode in common; the parts have their names.
    Masks(Vec<String>),
}

impl Parts {
    /// Episodes of each part, ascending.
    pub(super) fn resolve(&self, set: &Dataset, seed: Option<u64>) -> Result<Vec<(String, Vec<usize>)>> {
        let total = set.episodes().len();
        let bad = |object: String, expected: String, found: String| DatasetError::BadDataset {
            path: set.root().to_path_buf(),
            object,
            expected,
            found,
        };
        let ends: Vec<(String, usize)> = match self {
            Self::Masks(masks) => {
                let parts = masks.iter().map(|mask| Ok((mask.clone(), set.required_split(mask)?)));
                let parts = parts.collect::<Result<Vec<_>>>()?;
                return checked(parts, &bad);
            }
            Self::Fractions(parts) => {
                let sum: f64 = parts.iter().map(|(_, share)| share).sum();
                let good = parts.iter().all(|(_, share)| share.is_finite() && *share > 0.0) && sum <= 1.0 + 1e-9;
                if !good {
                    let found = parts.iter().map(|(name, share)| format!("{name} {share}")).collect::<Vec<_>>();
                    return Err(bad(
                        "parts".to_owned(),
                        "shares above 0, together 1 at most".to_owned(),
                        found.join(", "),
                    ));
                }
                let mut share = 0.0;
                let mut end = |of: f64| {
                    share += of;
                    ((share * total as f64).round() as usize).min(total)
                };
                parts.iter().map(|(name, of)| (name.clone(), end(*of))).collect()
            }
            Self::Counts(parts) => {
                let mut sum = 0_usize;
                let mut end = |count: usize| {
                    sum = sum.saturating_add(count);
                    sum
                };
                let ends: Vec<(String, usize)> = parts.iter().map(|(name, n)| (name.clone(), end(*n))).collect();
                if ends.last().is_some_and(|(_, end)| *end > total) {
                    let expected = format!("{total} episodes at most, as there are");
                    return Err(bad("parts".to_owned(), expected, ends[ends.len() - 1].1.to_string()));
                }
                ends
            }
        };
        let mut order: Vec<usize> = (0..total).collect();
        if let Some(seed) = seed {
            SplitMix64::new(seed, 0).shuffle(&mut order);
        }
        let mut from = 0;
        let part = |(name, end): (String, usize)| {
            let mut mine = order[from..end].to_vec();
            mine.sort_unstable();
            from = end;
            (name, mine)
        };
        checked(ends.into_iter().map(part).collect(), &bad)
    }
}

/// Names that folders can have, each once; no part empty, no episode in two.
fn checked(
    parts: Vec<(String, Vec<usize>)>,
    bad: &dyn Fn(String, String, String) -> DatasetError,
) -> Result<Vec<(String, Vec<usize>)>> {
    let mut owners: Vec<(usize, &str)> = Vec::new();
    for (at, (name, episodes)) in parts.iter().enumerate() {
        let plain = !name.is_empty() && !name.starts_with('.') && !name.contains(['/', '\0']);
        if !plain || parts[..at].iter().any(|(other, _)| other == name) {
            let expected = "a name for a folder, another for each part".to_owned();
            return Err(bad(format!("part {}", at + 1), expected, format!("{name:?}")));
        }
        if episodes.is_empty() {
            return Err(bad(format!("part {name}"), "1 episode or more".to_owned(), "none".to_owned()));
        }
        owners.extend(episodes.iter().map(|&episode| (episode, name.as_str())));
    }
    owners.sort_unstable();
    if let Some(two) = owners.windows(2).find(|two| two[0].0 == two[1].0) {
        let object = format!("parts {} and {}", two[0].1, two[1].1);
        return Err(bad(object, "no episode in both".to_owned(), format!("episode {}", two[0].0)));
    }
    if parts.is_empty() {
        return Err(bad("parts".to_owned(), "1 or more".to_owned(), "none".to_owned()));
    }
    Ok(parts)
}
