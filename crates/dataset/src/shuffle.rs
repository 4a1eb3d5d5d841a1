//! A small seeded generator, the shuffle drawn from it, and the order in which a training reads its windows.
//!
//! SplitMix64 (Steele, Lea, Flood: "Fast splittable pseudorandom number generators", 2014). It orders
//! batches and splits sets; nothing here needs cryptographic strength, everything here needs the same
//! order on every machine.

/// SplitMix64: 64 bits of state, one addition and three mixing steps per draw.
#[derive(Debug, Clone)]
pub struct SplitMix64(u64);

impl SplitMix64 {
    /// A generator for one purpose: the same `seed` and `stream` always give the same draws, and two
    /// streams of one seed are unrelated.
    pub fn new(seed: u64, stream: u64) -> Self {
        let mut outer = Self(seed);
        let mixed = outer.next_u64();
        let mut inner = Self(mixed ^ stream.wrapping_mul(0xD134_2543_DE82_EF95));
        let state = inner.next_u64();
        Self(state)
    }

    /// The next 64 bits.
    pub fn next_u64(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// A number in `0..bound`, without modulo bias (Lemire's multiplication with rejection).
    ///
    /// # Panics
    /// When `bound` is zero.
    pub fn below(&mut self, bound: u64) -> u64 {
        assert!(bound > 0, "an empty range has no number to draw");
        let threshold = bound.wrapping_neg() % bound;
        loop {
            let wide = u128::from(self.next_u64()) * u128::from(bound);
            if wide as u64 >= threshold {
                return (wide >> 64) as u64;
            }
        }
    }

    /// Fisher-Yates: every order is equally likely.
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for i in (1..items.len()).rev() {
            let j = self.below(i as u64 + 1) as usize;
            items.swap(i, j);
        }
    }
}

/// The numbers below `len` in the order of an epoch, which depends on `seed` and `epoch` only.
pub fn order(seed: u64, epoch: u64, len: usize) -> Vec<u32> {
    let mut order: Vec<u32> = (0..len as u32).collect();
    SplitMix64::new(seed, epoch).shuffle(&mut order);
    order
}

/// Which windows make which step's batch: epochs of shuffles laid end to end, cut into batches of one size.
///
/// A step's batch depends on the seed and the step alone, so that a resumed run needs no state of it.
#[derive(Debug, Clone)]
pub struct Sampler {
    seed: u64,
    batch_size: u64,
    epoch: Option<(u64, Vec<u32>)>,
}

impl Sampler {
    /// Batches of `batch_size`.
    pub fn new(seed: u64, batch_size: usize) -> Self {
        Self { seed, batch_size: batch_size as u64, epoch: None }
    }

    /// Which of `len` windows make step `step`, counted from 0.
    ///
    /// # Panics
    /// When there are none.
    pub fn batch(&mut self, len: usize, step: u64) -> Vec<u32> {
        assert!(len > 0, "no windows, no batches");
        positions(step, self.batch_size, len as u64).map(|(epoch, position)| self.order(len, epoch)[position]).collect()
    }

    fn order(&mut self, len: usize, epoch: u64) -> &[u32] {
        if self.epoch.as_ref().is_none_or(|(number, kept)| (*number, kept.len()) != (epoch, len)) {
            self.epoch = Some((epoch, order(self.seed, epoch, len)));
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
    use super::*;
    use proptest::prelude::*;

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

    #[test]
    fn a_batch_depends_on_seed_and_step_alone() {
        let mut forward = Sampler::new(7, 3);
        let all: Vec<Vec<u32>> = (0..9).map(|step| forward.batch(5, step)).collect();
        let backward: Vec<Vec<u32>> = (0..9).rev().map(|step| forward.batch(5, step)).collect();
        assert_eq!(all, backward.into_iter().rev().collect::<Vec<_>>());
        let joined: Vec<u32> = all.concat();
        assert_eq!(joined[..5], order(7, 0, 5)[..]);
        assert_eq!(joined[5..10], order(7, 1, 5)[..]);
    }

    #[test]
    fn the_first_draws_are_those_of_the_published_generator() {
        // reference values of SplitMix64 for state 1234567, from the Rosetta Code task
        let mut rng = SplitMix64(1_234_567);
        let draws: Vec<u64> = (0..3).map(|_| rng.next_u64()).collect();
        assert_eq!(draws, [6_457_827_717_110_365_317, 3_203_168_211_198_807_973, 9_817_491_932_198_370_423]);
    }

    #[test]
    fn a_shuffle_is_a_permutation_that_depends_on_seed_and_stream() {
        let order = |seed, stream| {
            let mut v: Vec<u32> = (0..100).collect();
            SplitMix64::new(seed, stream).shuffle(&mut v);
            v
        };
        let mut sorted = order(1, 0);
        assert_eq!(sorted, order(1, 0));
        assert_ne!(sorted, order(1, 1));
        assert_ne!(sorted, order(2, 0));
        sorted.sort_unstable();
        assert_eq!(sorted, (0..100).collect::<Vec<u32>>());
    }

    #[test]
    fn draws_below_a_bound_cover_it_evenly() {
        let mut rng = SplitMix64::new(7, 7);
        let mut counts = [0_u32; 6];
        for _ in 0..60_000 {
            counts[rng.below(6) as usize] += 1;
        }
        assert!(counts.iter().all(|&c| (9_600..10_400).contains(&c)), "{counts:?}");
    }
}
