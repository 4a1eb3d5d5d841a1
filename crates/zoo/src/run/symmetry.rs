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
use dataset::{Dataset, WindowBatch};

use crate::ZooError;
use crate::experiment::Experiment;

use super::places::{Place, Places};

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
    places: Vec<Place>,
}

impl Symmetries {
    /// Finds where the vectors of the experiment's symmetries stand in the columns of `dataset`.
    ///
    /// # Errors
    /// An item that stands nowhere, items of unequal lengths, by name.
    pub fn new(experiment: &Experiment, dataset: &Dataset, path: &Path) -> Result<Self, ZooError> {
        let mut all = Vec::new();
        if !experiment.data.symmetries.is_empty() {
            let spans = Places::new(experiment, dataset, path, "data.symmetries")?;
            for (name, items) in &experiment.data.symmetries {
                let places = spans.alike(&format!("data.symmetries.{name}"), items)?;
                all.push(Symmetry { width: places[0].width, places });
            }
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
                for place in &symmetry.places {
                    for observation in 0..windows.n_obs_steps {
                        let vector = place.of_mut(windows, row, observation);
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
        let place = |feature: &str, from| Place { feature: feature.to_owned(), from, width: 3 };
        let places = vec![place("a", 1), place("b", 0), place("b", 3)];
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
