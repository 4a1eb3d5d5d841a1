//! What there is to say about a data set that is no fault: demos that masks name and that are not there, demos that training and
//! validation share.

use super::info::Provenance;
use super::open::{Dataset, read_info};
use crate::error::Result;
use crate::source::list;
use std::collections::BTreeMap;
use std::path::Path;

/// What is said of a mask that names `named` demos, `absent` of which are not there.
pub(crate) fn mask_note(mask: &str, named: usize, absent: &[String]) -> String {
    let demos = list(absent.iter().map(String::as_str));
    format!("mask/{mask}: {} of the {named} demos it names are not in the file: {demos}", absent.len())
}

/// Masks for training and for validation or tests that share demos.
pub(crate) fn shared_notes<T: Ord + ToString>(masks: &BTreeMap<String, Vec<T>>) -> Vec<String> {
    const HELD_OUT: [&str; 4] = ["valid", "val", "validation", "test"];
    let mut notes = Vec::new();
    // robomimic cuts a mask `x` into `x_train` and `x_valid`
    for (train, mine) in masks {
        let Some(prefix) = train.strip_suffix("train").filter(|p| p.is_empty() || p.ends_with('_')) else { continue };
        for other in HELD_OUT.map(|name| format!("{prefix}{name}")) {
            let Some(theirs) = masks.get(&other) else { continue };
            let shared: Vec<String> = theirs.iter().filter(|d| mine.contains(d)).map(T::to_string).collect();
            if !shared.is_empty() {
                let demos = list(shared.iter().map(String::as_str));
                notes.push(format!(
                    "masks {train} and {other} share {} demos: {demos}; what is measured on them says nothing about others",
                    shared.len()
                ));
            }
        }
    }
    notes
}

impl Provenance {
    /// What there is to say about the masks: demos that they name and that were not there, masks for training and
    /// validation that share episodes.
    pub fn mask_notes(&self) -> Vec<String> {
        let absent = self.masks_absent.iter().map(|(mask, absent)| {
            let named = absent.len() + self.masks.get(mask).map_or(0, Vec::len);
            mask_note(mask, named, absent)
        });
        let id = |&episode: &usize| self.demos.get(episode).cloned().unwrap_or_else(|| episode.to_string());
        let masks: BTreeMap<String, Vec<String>> =
            self.masks.iter().map(|(name, episodes)| (name.clone(), episodes.iter().map(id).collect())).collect();
        absent.chain(shared_notes(&masks)).collect()
    }

    /// What a user of the data set should know: of its masks, and what the conversion left out.
    pub fn notes(&self) -> Vec<String> {
        let mut notes = self.mask_notes();
        notes.extend(self.skipped.iter().map(|s| format!("{} was left out: {}", s.demo, s.reason)));
        if !self.left_out.is_empty() {
            notes.push(format!("could not be read in some demos and is left out there: {}", self.left_out.join(", ")));
        }
        notes
    }
}

/// What a user of the data set at `root` should know; nothing of sets that were not converted here.
pub fn notes(root: &Path) -> Result<Vec<String>> {
    Ok(read_info(root)?.actrm.map_or_else(Vec::new, |provenance| provenance.notes()))
}

impl Dataset {
    /// In words the values of a column that are NaN or infinite: of some episodes, the first of each dimension; nothing of a column
    /// that is not in memory.
    pub fn not_finite(&self, name: &str, episodes: &[usize]) -> Vec<String> {
        let Some(column) = self.column(name) else { return Vec::new() };
        let mut found = Vec::new();
        for episode in episodes.iter().filter_map(|&episode| self.episodes().get(episode)) {
            let values = column.data.get(episode.from * column.dim..episode.to * column.dim).unwrap_or_default();
            if values.iter().fold(true, |all, v| all & v.is_finite()) {
                continue;
            }
            let demo = episode.demo.as_ref().map_or_else(String::new, |demo| format!(" ({demo})"));
            for dimension in 0..column.dim {
                let mine = values.iter().skip(dimension).step_by(column.dim).enumerate();
                let mut bad = mine.filter(|(_, v)| !v.is_finite());
                let Some((frame, value)) = bad.next() else { continue };
                let more = match bad.count() {
                    0 => String::new(),
                    more => format!(" (and {more} more frames)"),
                };
                let episode = episode.index;
                found.push(format!(
                    "{name}: episode {episode}{demo}, frame {frame}, dimension {dimension}: {value}{more}"
                ));
            }
        }
        found
    }
}
