//! `[data.mirror]`: half of the training samples, drawn at random, are what a mirror shows. Pictures are turned left to right,
//! and the numbers that a mirror negates are negated. Validation sees what was recorded.
//!
//! ```toml
//! [data.mirror]
//! robot0_eef_pos = [1, -1, 1]
//! robot0_gripper_qpos = [1, 1]
//! action = [1, -1, 1, -1, 1, -1, 1]
//! ```
//!
//! Every item of the lists of keys has a sign for each of its numbers, so that none is forgotten, and so have the actions. It is for
//! whoever sets it to know that robot, cameras and task look alike on both sides. A batch depends on the seed and the step
//! alone, so that a resumed run needs no state of this.

use std::path::Path;

use dataset::shuffle::SplitMix64;
use dataset::{Dataset, WindowBatch, Windows};
use models::ACTION;

use crate::ZooError;
use crate::experiment::Experiment;

use super::places::{Place, Places};

/// Keeps the draws apart from those of the batches' order, which have the same seed.
const PURPOSE: u64 = 0x4d69_7272_6f72_2121;
/// Numbers of a pixel.
const CHANNELS: usize = 3;

/// What a mirror changes in a run's windows; nothing where none is set.
#[derive(Debug, Default)]
pub(super) struct Mirror {
    seed: u64,
    changed: Option<Changed>,
}

#[derive(Debug, Default)]
struct Changed {
    /// numbers of the observation that are negated
    numbers: Vec<Place>,
    /// the same of an action
    actions: Vec<usize>,
    /// of an action
    action_dim: usize,
    /// bytes of a picture's row, by camera
    rows: Vec<(String, usize)>,
}

/// The numbers that are negated.
fn negated(signs: &[i8]) -> impl Iterator<Item = usize> {
    signs.iter().enumerate().filter(|(_, sign)| **sign < 0).map(|(i, _)| i)
}

impl Mirror {
    /// Finds where the numbers stand in the columns of `dataset`, of which `windows` are.
    ///
    /// # Errors
    /// As many signs as an item has not numbers.
    pub fn new(experiment: &Experiment, dataset: &Dataset, windows: &Windows, path: &Path) -> Result<Self, ZooError> {
        let signs = &experiment.data.mirror;
        if signs.is_empty() {
            return Ok(Self::default());
        }
        let fits = |item: &str, width: usize, signs: &[i8]| match signs.len() == width {
            true => Ok(()),
            false => Err(ZooError::UnfitData {
                path: path.to_owned(),
                reason: format!("data.mirror.{item}: {} signs, {width} numbers", signs.len()),
            }),
        };
        let places = Places::new(experiment, dataset, path, "data.mirror")?;
        let mut changed = Changed { action_dim: windows.action_dim(), ..Changed::default() };
        for (item, signs) in signs.iter().filter(|(item, _)| *item != ACTION) {
            for place in places.alike("data.mirror", std::slice::from_ref(item))? {
                fits(item, place.width, signs)?;
                let one = |i| Place { from: place.from + i, width: 1, ..place.clone() };
                changed.numbers.extend(negated(signs).map(one));
            }
        }
        let of_actions = &signs[ACTION];
        fits(ACTION, changed.action_dim, of_actions)?;
        changed.actions = negated(of_actions).collect();
        changed.rows = windows.pictures().map(|(camera, (_, width))| (camera.to_owned(), width * CHANNELS)).collect();
        Ok(Self { seed: experiment.train.seed ^ PURPOSE, changed: Some(changed) })
    }

    /// Mirrors about half of the windows of step `step`.
    pub fn apply(&self, step: u64, windows: &mut WindowBatch) {
        let Some(changed) = &self.changed else { return };
        let mut rng = SplitMix64::new(self.seed, step);
        for row in 0..windows.n {
            if rng.next_u64() & 1 == 1 {
                changed.apply(row, windows);
            }
        }
    }
}

impl Changed {
    fn apply(&self, row: usize, windows: &mut WindowBatch) {
        for place in &self.numbers {
            for observation in 0..windows.n_obs_steps {
                place.of_mut(windows, row, observation).iter_mut().for_each(|value| *value = -*value);
            }
        }
        let share = windows.actions.len() / windows.n;
        for action in windows.actions[row * share..(row + 1) * share].chunks_exact_mut(self.action_dim) {
            self.actions.iter().for_each(|&i| action[i] = -action[i]);
        }
        for ((_, pictures), (_, line)) in windows.pictures.iter_mut().zip(&self.rows) {
            let share = pictures.len() / windows.n;
            pictures[row * share..(row + 1) * share].chunks_exact_mut(*line).for_each(turn);
        }
    }
}

/// A picture's row from right to left.
fn turn(line: &mut [u8]) {
    let pixels = line.len() / CHANNELS;
    for pixel in 0..pixels / 2 {
        let (left, right) = line.split_at_mut((pixels - 1 - pixel) * CHANNELS);
        left[pixel * CHANNELS..][..CHANNELS].swap_with_slice(&mut right[..CHANNELS]);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn mirror(seed: u64) -> Mirror {
        let place = |feature: &str, from| Place { feature: feature.to_owned(), from, width: 1 };
        let changed = Changed {
            numbers: vec![place("a", 1), place("b", 0)],
            actions: negated(&[1, -1, -1]).collect(),
            action_dim: 3,
            rows: vec![("front".to_owned(), 9)],
        };
        Mirror { seed, changed: Some(changed) }
    }

    fn windows(n: usize) -> WindowBatch {
        let column = |dim: usize| (0..n * 2).flat_map(|_| (0..dim).map(|i| i as f32 + 1.0)).collect();
        // two observations of pictures of 2 x 3
        let pictures = (0..n * 2).flat_map(|_| 0..18u8).collect();
        WindowBatch {
            n,
            n_obs_steps: 2,
            observation: vec![("a".to_owned(), column(2)), ("b".to_owned(), column(1))],
            pictures: vec![("front".to_owned(), pictures)],
            // two actions
            actions: column(3),
            is_pad: vec![false; n * 2],
            ..WindowBatch::default()
        }
    }

    #[test]
    fn half_of_the_samples_are_what_a_mirror_shows() {
        let mut batch = windows(400);
        mirror(1).apply(7, &mut batch);
        let picture = [6, 7, 8, 3, 4, 5, 0, 1, 2, 15, 16, 17, 12, 13, 14, 9, 10, 11];
        let mut mirrored = 0;
        for row in 0..400 {
            let (a, b) = (&batch.column("a").unwrap()[row * 4..][..4], &batch.column("b").unwrap()[row * 2..][..2]);
            let (actions, pictures) = (&batch.actions[row * 6..][..6], &batch.pictures[0].1[row * 36..][..36]);
            if b[0] < 0.0 {
                mirrored += 1;
                assert_eq!((a, b), (&[1.0, -2.0, 1.0, -2.0][..], &[-1.0, -1.0][..]));
                assert_eq!(actions, [1.0, -2.0, -3.0, 1.0, -2.0, -3.0]);
                assert_eq!((&pictures[..18], &pictures[18..]), (&picture[..], &picture[..]));
            } else {
                assert_eq!((a, b), (&[1.0, 2.0, 1.0, 2.0][..], &[1.0, 1.0][..]));
                assert_eq!(actions, [1.0, 2.0, 3.0, 1.0, 2.0, 3.0]);
                assert!(pictures[..18].iter().copied().eq(0..18u8));
            }
        }
        assert!((150..250).contains(&mirrored), "{mirrored}");
        // twice in the mirror is as it was
        let (before, mut twice) = (windows(1), windows(1));
        let changed = mirror(1).changed.unwrap();
        changed.apply(0, &mut twice);
        assert_ne!(twice, before);
        changed.apply(0, &mut twice);
        assert_eq!(twice, before);
    }

    #[test]
    fn a_batch_depends_on_seed_and_step_alone() {
        let after = |seed: u64, step: u64| {
            let mut batch = windows(20);
            mirror(seed).apply(step, &mut batch);
            batch
        };
        assert_eq!(after(1, 7), after(1, 7));
        assert_ne!(after(1, 7), after(1, 8));
        assert_ne!(after(1, 7), after(2, 7));
        let mut batch = windows(20);
        Mirror::default().apply(7, &mut batch);
        assert_eq!(batch, windows(20));
    }
}
