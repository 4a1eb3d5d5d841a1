//! `[data.symmetries]`: numbers of an observation that mean the same in any order, permuted at random in every training
//! sample, alike wherever they stand. Validation sees the observations as they are.
//!
//! ```toml
//! [data.symmetries]
//! colour = ["cube0_rgb", "cube1_rgb", "goal_rgb[0:3]", "goal_rgb[3:6]"]
//! ```
//!
//! One order of the three channels is drawn for a sample, and all four vectors are put into it. A batch depends on the
//! seed and the step alone, so that a resumed run needs no state of this.

use std::path::Path;

use dataset::shuffle::SplitMix64;
use dataset::{Dataset, KeyItem, WindowBatch};

use crate::ZooError;
use crate::experiment::Experiment;

/// Keeps the draws apart from those of the batches' order, which have the same seed.
const PURPOSE: u64 = 0x5359_4d4d_4554_5259;

/// The symmetries of a run.
pub(crate) struct Symmetries {
    seed: u64,
    all: Vec<Symmetry>,
}

/// Vectors that are permuted alike.
#[derive(Debug, PartialEq)]
struct Symmetry {
    width: usize,
    /// feature, and where in its row the vector begins
    places: Vec<(String, usize)>,
}

impl Symmetries {
    /// Finds where the vectors of the experiment's symmetries stand in the columns of `dataset`.
    ///
    /// # Errors
    /// An item that stands nowhere, items of unequal lengths, by name.
    pub fn new(experiment: &Experiment, dataset: &Dataset, path: &Path) -> Result<Self, ZooError> {
        let unfit = |reason: String| ZooError::UnfitData { path: path.to_owned(), reason };
        let keys = experiment.data.feature_keys()?;
        let mut spans = Vec::new();
        if !experiment.data.symmetries.is_empty() {
            for feature in keys.features() {
                let items = keys.items(feature);
                let names = dataset.names(feature);
                let widths = KeyItem::widths(items, &names).ok_or_else(|| {
                    unfit(format!("data.symmetries: the names of column {feature} do not say which keys it holds"))
                })?;
                let mut from = 0;
                for (item, width) in items.iter().zip(widths) {
                    spans.push((item.to_string(), feature.to_owned(), from, width));
                    from += width;
                }
            }
        }
        let mut all = Vec::new();
        for (name, items) in &experiment.data.symmetries {
            let mut symmetry = Symmetry { width: 0, places: Vec::new() };
            for item in items {
                let here: Vec<_> = spans.iter().filter(|(text, ..)| text == item).collect();
                if here.is_empty() {
                    return Err(unfit(format!("data.symmetries.{name}: {item} is an item of no feature")));
                }
                for (_, feature, from, width) in here {
                    if symmetry.width != 0 && symmetry.width != *width {
                        let (first, expected) = (&items[0], symmetry.width);
                        let reason = format!("{item} has {width} numbers, {first} has {expected}");
                        return Err(unfit(format!("data.symmetries.{name}: {reason}")));
                    }
                    symmetry.width = *width;
                    symmetry.places.push((feature.clone(), *from));
                }
            }
            all.push(symmetry);
        }
        Ok(Self { seed: experiment.train.seed ^ PURPOSE, all })
    }

    /// Permutes the windows of step `step`, each by itself.
    pub fn apply(&self, step: u64, windows: &mut WindowBatch) {
        let mut rng = SplitMix64::new(self.seed, step);
        let mut before = Vec::new();
        for symmetry in &self.all {
            for row in 0..windows.n {
                let mut order: Vec<usize> = (0..symmetry.width).collect();
                rng.shuffle(&mut order);
                for (feature, from) in &symmetry.places {
                    let Some((_, values)) = windows.observation.iter_mut().find(|(name, _)| name == feature) else {
                        continue;
                    };
                    let per_window = values.len() / windows.n;
                    let dim = per_window / windows.n_obs_steps;
                    for step in values[row * per_window..(row + 1) * per_window].chunks_exact_mut(dim) {
                        let vector = &mut step[*from..from + symmetry.width];
                        before.clear();
                        before.extend_from_slice(vector);
                        vector.iter_mut().zip(&order).for_each(|(value, &at)| *value = before[at]);
                    }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::collections::BTreeSet;

    use super::*;

    fn symmetries(seed: u64) -> Symmetries {
        let places = vec![("a".to_owned(), 1), ("b".to_owned(), 0), ("b".to_owned(), 3)];
        Symmetries { seed, all: vec![Symmetry { width: 3, places }] }
    }

    fn windows(n: usize, n_obs_steps: usize) -> WindowBatch {
        let column = |dim: usize| (0..n * n_obs_steps).flat_map(|_| (0..dim).map(|i| i as f32)).collect();
        let observation = vec![("a".to_owned(), column(5)), ("b".to_owned(), column(6))];
        WindowBatch { n, n_obs_steps, observation, ..WindowBatch::default() }
    }

    #[test]
    fn all_vectors_of_a_window_are_put_into_one_order() {
        let (mut batch, mut seen) = (windows(200, 2), BTreeSet::new());
        symmetries(1).apply(7, &mut batch);
        let (a, b) = (batch.column("a").unwrap(), batch.column("b").unwrap());
        for window in 0..200 {
            let order: Vec<f32> = b[window * 12..window * 12 + 3].to_vec();
            let moved = |by: f32| order.iter().map(|x| x + by).collect::<Vec<_>>();
            for step in 0..2 {
                let (a, b) = (&a[(window * 2 + step) * 5..][..5], &b[(window * 2 + step) * 6..][..6]);
                assert_eq!((a[0], a[4]), (0.0, 4.0), "what is not named stays");
                assert_eq!(a[1..4], moved(1.0));
                assert_eq!((&b[..3], &b[3..]), (&order[..], &moved(3.0)[..]));
            }
            seen.insert(order.iter().map(|x| *x as u32).collect::<Vec<_>>());
        }
        assert_eq!(seen.len(), 6, "every order of three");
    }

    #[test]
    fn a_batch_depends_on_seed_and_step_alone() {
        let after = |seed: u64, step: u64| {
            let mut batch = windows(20, 1);
            symmetries(seed).apply(step, &mut batch);
            batch.observation
        };
        assert_eq!(after(1, 7), after(1, 7));
        assert_ne!(after(1, 7), after(1, 8));
        assert_ne!(after(1, 7), after(2, 7));
        let mut batch = windows(20, 1);
        Symmetries { seed: 1, all: Vec::new() }.apply(7, &mut batch);
        assert_eq!(batch, windows(20, 1));
    }
}
