//! `[data.symmetries]`: values of an observation that mean the same in any order. They are permuted at random in every training
//! sample, in the same way wherever they are.
//!
//! ```toml
//! [data.symmetries]
//! colour = ["cube0_rgb", "cube1_rgb", "goal_rgb[0:3]", "goal_rgb[3:6]"]
//! ```
//!
//! One order of the three channels is drawn for a sample, and all four vectors are put into it. The key of a camera's images
//! (`agentview_image`) stands for the colour of every pixel.

use dataset::WindowBatch;
use dataset::shuffle::SplitMix64;

use super::slices::Slice;
use super::{DataSection, Fitted, Source, Stage, Transform};
use crate::ZooError;
use crate::experiment::IMAGE_PREFIX;

/// Keeps the draws apart from those of the batches' order, which have the same seed.
const PURPOSE: u64 = 0x5359_4d4d_4554_5259;
/// Values of a pixel.
const CHANNELS: usize = 3;

pub(super) struct Symmetry;

impl Transform for Symmetry {
    fn name(&self) -> &'static str {
        "symmetries"
    }

    fn items<'d>(&self, data: &'d DataSection) -> Vec<(String, &'d Vec<String>)> {
        data.symmetries.iter().map(|(name, items)| (format!("data.symmetries.{name}"), items)).collect()
    }

    fn fit(&self, source: &Source<'_>) -> Result<Option<Box<dyn Fitted>>, ZooError> {
        let data = &source.experiment.data;
        if data.symmetries.is_empty() {
            return Ok(None);
        }
        let slices = source.slices(self.name())?;
        let mut all = Vec::new();
        for (key, items) in self.items(data) {
            let (images, items): (Vec<_>, Vec<_>) = items.iter().partition(|item| data.camera_of(item).is_some());
            let items: Vec<String> = items.into_iter().cloned().collect();
            let vectors = slices.alike(&key, &items)?;
            let width = vectors.first().map_or(CHANNELS, |slice| slice.width);
            if width != CHANNELS && !images.is_empty() {
                let reason = format!("{key}: {} has {width} numbers, a pixel has {CHANNELS}", items[0]);
                return Err(ZooError::UnfitData { path: source.path.to_owned(), reason });
            }
            let cameras = images.into_iter().filter_map(|item| data.camera_of(item));
            all.push(Permuted { width, vectors, cameras: cameras.map(|c| format!("{IMAGE_PREFIX}{c}")).collect() });
        }
        Ok(Some(Box::new(Symmetries { seed: source.experiment.train.seed ^ PURPOSE, all })))
    }
}

/// The symmetries of a run.
struct Symmetries {
    seed: u64,
    all: Vec<Permuted>,
}

/// Vectors that are permuted in the same way.
#[derive(Debug, PartialEq)]
struct Permuted {
    width: usize,
    vectors: Vec<Slice>,
    /// cameras of which every pixel is permuted
    cameras: Vec<String>,
}

impl Fitted for Symmetries {
    fn applies(&self, stage: Stage) -> bool {
        stage != Stage::Validation
    }

    fn apply(&self, step: u64, windows: &mut WindowBatch) {
        let mut rng = SplitMix64::new(self.seed, step);
        let mut before = Vec::new();
        for symmetry in &self.all {
            for row in 0..windows.n {
                let mut order: Vec<usize> = (0..symmetry.width).collect();
                rng.shuffle(&mut order);
                for slice in &symmetry.vectors {
                    for observation in 0..windows.n_obs_steps {
                        let vector = slice.of_mut(windows, row, observation);
                        before.clear();
                        before.extend_from_slice(vector);
                        vector.iter_mut().zip(&order).for_each(|(value, &at)| *value = before[at]);
                    }
                }
                for (_, bytes) in windows.pictures.iter_mut().filter(|(name, _)| symmetry.cameras.contains(name)) {
                    let share = bytes.len() / windows.n;
                    for pixel in bytes[row * share..(row + 1) * share].chunks_exact_mut(CHANNELS) {
                        let before = [pixel[0], pixel[1], pixel[2]];
                        pixel.iter_mut().zip(&order).for_each(|(value, &at)| *value = before[at]);
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
        let slice = |feature: &str, from| Slice { feature: feature.to_owned(), from, width: 3 };
        let vectors = vec![slice("a", 1), slice("b", 0), slice("b", 3)];
        Symmetries { seed, all: vec![Permuted { width: 3, vectors, cameras: vec!["front".to_owned()] }] }
    }

    fn windows(n: usize, n_obs_steps: usize) -> WindowBatch {
        let column = |dim: usize| (0..n * n_obs_steps).flat_map(|_| (0..dim).map(|i| i as f32)).collect();
        let observation = vec![("a".to_owned(), column(5)), ("b".to_owned(), column(6))];
        // pictures of 1 x 2
        let pictures = |first: u8| (0..n * n_obs_steps).flat_map(|_| first..first + 6).collect();
        let pictures = vec![("front".to_owned(), pictures(0)), ("back".to_owned(), pictures(6))];
        WindowBatch { n, n_obs_steps, observation, pictures, ..WindowBatch::default() }
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
                let pixels = |camera: usize| &batch.pictures[camera].1[(window * 2 + step) * 6..][..6];
                assert!(pixels(0).iter().map(|x| f32::from(*x)).eq(order.iter().copied().chain(moved(3.0))));
                assert!(pixels(1).iter().copied().eq(6..12), "images that are not named stay");
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
            batch
        };
        assert_eq!(after(1, 7), after(1, 7));
        assert_ne!(after(1, 7), after(1, 8));
        assert_ne!(after(1, 7), after(2, 7));
        let mut batch = windows(20, 1);
        Symmetries { seed: 1, all: Vec::new() }.apply(7, &mut batch);
        assert_eq!(batch, windows(20, 1));
    }
}
