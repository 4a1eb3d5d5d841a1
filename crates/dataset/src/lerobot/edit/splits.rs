//! Named ranges of episodes of a result.

use super::Edit;
use std::collections::{BTreeMap, BTreeSet};

impl Edit<'_> {
    /// Of one set its own, less what was dropped; of several sets one range, and a note where they had others.
    pub(super) fn splits(&self, notes: &mut Vec<String>) -> BTreeMap<String, String> {
        if let ([input], [taken]) = (self.inputs, self.taken.as_slice()) {
            let kept = |end: usize| taken.partition_point(|&episode| episode < end);
            let range = |(name, text): (&String, &String)| {
                let (from, to) = text.split_once(':')?;
                let (from, to) = (from.trim().parse().ok()?, to.trim().parse().ok()?);
                Some((name.clone(), format!("{}:{}", kept(from), kept(to))))
            };
            return input.set.info().splits.iter().filter_map(range).collect();
        }
        let names: BTreeSet<&String> = self.inputs.iter().flat_map(|input| input.set.info().splits.keys()).collect();
        let whole = |input: &super::Input| {
            let all = format!("0:{}", input.set.episodes().len());
            input.set.info().splits.values().all(|range| *range == all)
        };
        if names.len() > 1 || !self.inputs.iter().all(whole) {
            let names: Vec<&str> = names.iter().map(|name| name.as_str()).collect();
            notes.push(format!(
                "splits ({}) are left out: no range holds those of several sets; all episodes are in one split",
                names.join(", ")
            ));
        }
        let name = match names.first() {
            Some(only) if names.len() == 1 && self.inputs.iter().all(|i| i.set.info().splits.len() == 1) => only,
            _ => "train",
        };
        let total: usize = self.taken.iter().map(Vec::len).sum();
        BTreeMap::from([(name.to_owned(), format!("0:{total}"))])
    }
}
