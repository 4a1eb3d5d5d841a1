//! Where the items of an experiment's lists of keys are in the columns of a data set.

use std::path::{Path, PathBuf};

use dataset::{Dataset, KeyItem, WindowBatch};

use crate::ZooError;
use crate::experiment::{Experiment, IMAGE_PREFIX};

/// Where an item is: its feature, the index of its first dimension there, and its number of dimensions.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Slice {
    pub feature: String,
    pub from: usize,
    pub width: usize,
}

impl Slice {
    /// The item's values in an observation of a window; none where the windows lack the feature.
    pub fn of<'w>(&self, windows: &'w WindowBatch, row: usize, observation: usize) -> &'w [f32] {
        let values = windows.column(&self.feature).unwrap_or_default();
        values.get(self.span(values.len(), windows, row, observation)).unwrap_or_default()
    }

    /// [`Slice::of`], to be changed.
    pub fn of_mut<'w>(&self, windows: &'w mut WindowBatch, row: usize, observation: usize) -> &'w mut [f32] {
        let Some(at) = windows.observation.iter().position(|(name, _)| *name == self.feature) else {
            return &mut [];
        };
        let span = self.span(windows.observation[at].1.len(), windows, row, observation);
        &mut windows.observation[at].1[span]
    }

    fn span(&self, len: usize, windows: &WindowBatch, row: usize, observation: usize) -> std::ops::Range<usize> {
        let observations = windows.n * windows.n_obs_steps;
        let begin = (row * windows.n_obs_steps + observation) * (len / observations) + self.from;
        begin..begin + self.width
    }
}

/// The slices of all items.
pub(super) struct Slices {
    path: PathBuf,
    spans: Vec<(String, Slice)>,
}

impl Slices {
    /// Reads them off `dataset`; `section` is the experiment's that needs them, for messages.
    ///
    /// # Errors
    /// A column whose names do not say which keys it holds.
    pub fn new(experiment: &Experiment, dataset: &Dataset, path: &Path, section: &str) -> Result<Self, ZooError> {
        let keys = experiment.data.all_keys()?;
        let mut spans = Vec::new();
        for feature in keys.features().filter(|feature| !feature.starts_with(IMAGE_PREFIX)) {
            let items = keys.items(feature);
            let widths = KeyItem::widths(items, &dataset.names(feature)).ok_or_else(|| ZooError::UnfitData {
                path: path.to_owned(),
                reason: format!("{section}: the names of column {feature} do not say which keys it holds"),
            })?;
            let mut from = 0;
            for (item, width) in items.iter().zip(widths) {
                spans.push((item.to_string(), Slice { feature: feature.to_owned(), from, width }));
                from += width;
            }
        }
        Ok(Self { path: path.to_owned(), spans })
    }

    /// What is wrong with the items under `key`.
    pub fn unfit(&self, key: &str, reason: String) -> ZooError {
        ZooError::UnfitData { path: self.path.clone(), reason: format!("{key}: {reason}") }
    }

    /// The slices of `items`, all of them equally long, in their order.
    ///
    /// # Errors
    /// As [`Slices::of_each`].
    pub fn alike(&self, key: &str, items: &[String]) -> Result<Vec<Slice>, ZooError> {
        Ok(self.of_each(key, items)?.concat())
    }

    /// The slices of each of `items`, all of them equally long: an item of several features stands in each.
    ///
    /// # Errors
    /// An item that stands nowhere, items of unequal lengths, by name and under `key`.
    pub fn of_each(&self, key: &str, items: &[String]) -> Result<Vec<Vec<Slice>>, ZooError> {
        let unfit = |reason| self.unfit(key, reason);
        let mut all: Vec<Vec<Slice>> = Vec::with_capacity(items.len());
        for item in items {
            let here: Vec<Slice> =
                self.spans.iter().filter(|(text, _)| text == item).map(|(_, slice)| slice.clone()).collect();
            let Some(slice) = here.first() else { return Err(unfit(format!("{item} is an item of no feature"))) };
            if let Some(first) = all.first().map(|first| &first[0]).filter(|first| first.width != slice.width) {
                return Err(unfit(format!("{item} has {} numbers, {} has {}", slice.width, items[0], first.width)));
            }
            all.push(here);
        }
        Ok(all)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn an_item_of_two_features_has_a_slice_in_each() {
        let slice = |feature: &str, from| Slice { feature: feature.to_owned(), from, width: 3 };
        let spans = [("a", "all", 0), ("b", "all", 3), ("a", "one", 0), ("b", "two", 0)];
        let spans = spans.map(|(item, feature, from)| (item.to_owned(), slice(feature, from))).into();
        let slices = Slices { path: PathBuf::new(), spans };
        let items = ["a", "b"].map(str::to_owned);
        let each = slices.of_each("key", &items).unwrap();
        assert_eq!(each, [[slice("all", 0), slice("one", 0)], [slice("all", 3), slice("two", 0)]]);
        assert_eq!(slices.alike("key", &items).unwrap(), each.concat());
        let error = slices.of_each("key", &["c".to_owned()]).unwrap_err().to_string();
        assert!(error.contains("key: c is an item of no feature"), "{error}");
    }
}
