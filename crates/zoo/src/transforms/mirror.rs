//! `[data.mirror]`: half of the training samples, drawn at random, are mirrored. Images are flipped left to right, and the values that
//! a mirror negates are negated.
//!
//! ```toml
//! [data.mirror]
//! robot0_eef_pos = [1, -1, 1]
//! robot0_gripper_qpos = [1, 1]
//! action = [1, -1, 1, -1, 1, -1, 1]
//! ```
//!
//! Every item of the lists of keys has a sign for each of its dimensions, so that none is forgotten, and so have the actions. Whoever
//! sets it has to know that robot, cameras and task look alike on both sides.

use std::collections::BTreeSet;

use dataset::WindowBatch;
use dataset::shuffle::SplitMix64;
use models::ACTION;

use super::slices::Slice;
use super::{Fitted, Source, Transform};
use crate::ZooError;
use crate::experiment::Experiment;

/// Keeps the draws apart from those of the batches' order, which have the same seed.
const PURPOSE: u64 = 0x4d69_7272_6f72_2121;
/// Values of a pixel.
const CHANNELS: usize = 3;

pub(super) struct Mirror;

impl Transform for Mirror {
    fn name(&self) -> &'static str {
        "mirror"
    }

    /// A mirror says of every dimension whether it is negated: of all `known` items but images, and of actions.
    fn check(&self, experiment: &Experiment, known: &[String]) -> Result<(), ZooError> {
        let data = &experiment.data;
        if data.mirror.is_empty() {
            return Ok(());
        }
        let invalid = |expected: String, found: String| {
            Err(ZooError::InvalidValue { key: "data.mirror".to_owned(), expected, found })
        };
        if !data.exchange.is_empty() || !data.grids.is_empty() {
            let found = data.mirror.keys().cloned().collect::<Vec<_>>().join(", ");
            return invalid("none with data.exchange or data.grids".to_owned(), found);
        }
        let numbers = known.iter().filter(|item| data.camera_of(item).is_none()).map(String::as_str);
        let wanted: BTreeSet<&str> = numbers.chain([ACTION]).collect();
        let given: BTreeSet<&str> = data.mirror.keys().map(String::as_str).collect();
        if let Some(item) = given.difference(&wanted).next() {
            let wanted: Vec<&str> = wanted.iter().copied().collect();
            return invalid(format!("items of the lists of keys: {}", wanted.join(", ")), format!("`{item}`"));
        }
        if let Some(item) = wanted.difference(&given).next() {
            return invalid("signs of every item and of action".to_owned(), format!("none of `{item}`"));
        }
        match data.mirror.iter().find(|(_, signs)| signs.is_empty() || signs.iter().any(|sign| sign.abs() != 1)) {
            Some((item, signs)) => invalid("1 or -1 for each number".to_owned(), format!("{signs:?} of `{item}`")),
            None => Ok(()),
        }
    }

    fn fit(&self, source: &Source<'_>) -> Result<Option<Box<dyn Fitted>>, ZooError> {
        let signs = &source.experiment.data.mirror;
        if signs.is_empty() {
            return Ok(None);
        }
        let fits = |item: &str, width: usize, signs: &[i8]| match signs.len() == width {
            true => Ok(()),
            false => Err(ZooError::UnfitData {
                path: source.path.to_owned(),
                reason: format!("data.mirror.{item}: {} signs, {width} numbers", signs.len()),
            }),
        };
        let slices = source.slices(self.name())?;
        let seed = source.experiment.train.seed ^ PURPOSE;
        let mut mirrored = Mirrored { seed, action_dim: source.windows.action_dim(), ..Mirrored::default() };
        for (item, signs) in signs.iter().filter(|(item, _)| *item != ACTION) {
            for slice in slices.alike("data.mirror", std::slice::from_ref(item))? {
                fits(item, slice.width, signs)?;
                let one = |i| Slice { from: slice.from + i, width: 1, ..slice.clone() };
                mirrored.numbers.extend(negated(signs).map(one));
            }
        }
        let of_actions = &signs[ACTION];
        fits(ACTION, mirrored.action_dim, of_actions)?;
        mirrored.actions = negated(of_actions).collect();
        mirrored.rows =
            source.windows.pictures().map(|(camera, (_, width))| (camera.to_owned(), width * CHANNELS)).collect();
        Ok(Some(Box::new(mirrored)))
    }
}

/// What a mirror changes in the windows.
#[derive(Debug, Default)]
struct Mirrored {
    seed: u64,
    /// dimensions of the observation that are negated
    numbers: Vec<Slice>,
    /// the same of an action
    actions: Vec<usize>,
    action_dim: usize,
    /// bytes of an image's row, by camera
    rows: Vec<(String, usize)>,
}

/// The dimensions that are negated.
fn negated(signs: &[i8]) -> impl Iterator<Item = usize> {
    signs.iter().enumerate().filter(|(_, sign)| **sign < 0).map(|(i, _)| i)
}

impl Fitted for Mirrored {
    fn apply(&self, step: u64, windows: &mut WindowBatch) {
        let mut rng = SplitMix64::new(self.seed, step);
        for row in 0..windows.n {
            if rng.next_u64() & 1 == 1 {
                self.mirror(row, windows);
            }
        }
    }
}

impl Mirrored {
    fn mirror(&self, row: usize, windows: &mut WindowBatch) {
        for slice in &self.numbers {
            for observation in 0..windows.n_obs_steps {
                slice.of_mut(windows, row, observation).iter_mut().for_each(|value| *value = -*value);
            }
        }
        let share = windows.actions.len() / windows.n;
        for action in windows.actions[row * share..(row + 1) * share].chunks_exact_mut(self.action_dim) {
            self.actions.iter().for_each(|&i| action[i] = -action[i]);
        }
        for ((_, pictures), (_, line)) in windows.pictures.iter_mut().zip(&self.rows) {
            let share = pictures.len() / windows.n;
            pictures[row * share..(row + 1) * share].chunks_exact_mut(*line).for_each(flip);
        }
    }
}

/// An image's row from right to left.
fn flip(line: &mut [u8]) {
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

    fn mirror(seed: u64) -> Mirrored {
        let slice = |feature: &str, from| Slice { feature: feature.to_owned(), from, width: 1 };
        Mirrored {
            seed,
            numbers: vec![slice("a", 1), slice("b", 0)],
            actions: negated(&[1, -1, -1]).collect(),
            action_dim: 3,
            rows: vec![("front".to_owned(), 9)],
        }
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
        let mirrored = mirror(1);
        mirrored.mirror(0, &mut twice);
        assert_ne!(twice, before);
        mirrored.mirror(0, &mut twice);
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
    }
}
