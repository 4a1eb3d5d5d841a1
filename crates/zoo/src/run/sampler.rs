//! Which windows make which step's batch: epochs of deterministic shuffles, laid end to end.
//!
//! A step's batch depends on the seed and the step alone, so that a resumed run needs no state of it.

use dataset::Windows;

/// Cuts the stream of shuffled epochs into batches of one size.
pub(super) struct Sampler {
    seed: u64,
    batch_size: u64,
    epoch: Option<(u64, Vec<u32>)>,
}

impl Sampler {
    pub fn new(seed: u64, batch_size: usize) -> Self {
        Self { seed, batch_size: batch_size as u64, epoch: None }
    }

    /// The ones of `windows` that make step `step`, counted from 0.
    pub fn batch(&mut self, windows: &Windows, step: u64) -> Vec<u32> {
        let size = windows.len() as u64;
        positions(step, self.batch_size, size).map(|(epoch, position)| self.order(windows, epoch)[position]).collect()
    }

    fn order(&mut self, windows: &Windows, epoch: u64) -> &[u32] {
        if self.epoch.as_ref().is_none_or(|(number, _)| *number != epoch) {
            self.epoch = Some((epoch, windows.shuffled(self.seed, epoch)));
        }
        &self.epoch.as_ref().expect("it was just set").1
    }
}

/// Epoch and position in it of each sample of a step.
fn positions(step: u64, batch_size: u64, size: u64) -> impl Iterator<Item = (u64, usize)> {
    let first = step * batch_size;
    (first..first + batch_size).map(move |sample| (sample / size, (sample % size) as usize))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        /// Whatever the sizes: each epoch gives every window once, in steps of one size.
        #[test]
        fn epochs_are_cut_without_loss(batch_size in 1_u64..20, size in 1_u64..50) {
            let steps = size * 2;
            let all: Vec<(u64, usize)> = (0..steps).flat_map(|s| positions(s, batch_size, size)).collect();
            prop_assert_eq!(all.len() as u64, steps * batch_size);
            for (i, (epoch, position)) in all.iter().enumerate() {
                prop_assert_eq!(*epoch * size + *position as u64, i as u64);
                prop_assert!((*position as u64) < size);
            }
        }
    }
}
