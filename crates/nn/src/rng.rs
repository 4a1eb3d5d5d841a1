//! The one source of randomness: ChaCha8, seeded, with a state that can be saved.
//!
//! candle's CPU backend cannot be seeded, so initial weights, latents, dropout masks and batch order all come from here.

use crate::error::{ModelError, Result};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};

/// A seeded generator. Two with the same seed and stream name give the same numbers on every machine.
#[derive(Debug, Clone)]
pub struct Rng {
    inner: ChaCha8Rng,
}

/// FNV-1a: names a stream by a number.
fn stream_number(name: &str) -> u64 {
    name.bytes().fold(0xcbf2_9ce4_8422_2325, |h, b| (h ^ u64::from(b)).wrapping_mul(0x0000_0100_0000_01b3))
}

impl Rng {
    /// A generator for `seed`; different `stream` names are independent of each other.
    pub fn new(seed: u64, stream: &str) -> Self {
        let mut inner = ChaCha8Rng::seed_from_u64(seed);
        inner.set_stream(stream_number(stream));
        Self { inner }
    }

    /// The next 64 bits.
    pub fn next_u64(&mut self) -> u64 {
        self.inner.next_u64()
    }

    /// Uniform in [0, 1) with 24 bits.
    pub fn uniform(&mut self) -> f32 {
        (self.inner.next_u32() >> 8) as f32 / (1u32 << 24) as f32
    }

    /// Uniform in `0..n`, without bias.
    ///
    /// # Panics
    /// If `n` is 0.
    pub fn below(&mut self, n: u64) -> u64 {
        assert!(n > 0, "an empty range has no member");
        // rejection: the last, incomplete stretch of n numbers is drawn again
        let zone = u64::MAX - u64::MAX % n;
        loop {
            let x = self.next_u64();
            if x < zone {
                return x % n;
            }
        }
    }

    /// Standard normal (Box–Muller, in f64).
    pub fn normal_f32(&mut self) -> f32 {
        let unit = 1.0 / (1u64 << 53) as f64;
        let u = ((self.next_u64() >> 11) as f64 + 1.0) * unit;
        let v = (self.next_u64() >> 11) as f64 * unit;
        ((-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()) as f32
    }

    /// `n` standard normal numbers.
    pub fn normals(&mut self, n: usize) -> Vec<f32> {
        (0..n).map(|_| self.normal_f32()).collect()
    }

    /// Fisher–Yates.
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for i in (1..items.len()).rev() {
            let j = self.below(i as u64 + 1) as usize;
            items.swap(i, j);
        }
    }

    /// Seed, stream and position: 56 bytes.
    pub fn state(&self) -> Vec<u8> {
        let mut bytes = self.inner.get_seed().to_vec();
        bytes.extend(self.inner.get_stream().to_le_bytes());
        bytes.extend(self.inner.get_word_pos().to_le_bytes());
        bytes
    }

    /// The generator that `state` was taken from.
    ///
    /// # Errors
    /// If `state` is not 56 bytes long.
    pub fn from_state(state: &[u8]) -> Result<Self> {
        let wrong = || ModelError::State {
            object: "random number generator",
            detail: format!("state has {} bytes, expected 56", state.len()),
        };
        if state.len() != 56 {
            return Err(wrong());
        }
        let part = |range: std::ops::Range<usize>| state.get(range).ok_or_else(wrong);
        let seed: [u8; 32] = part(0..32)?.try_into().ok().ok_or_else(wrong)?;
        let stream: [u8; 8] = part(32..40)?.try_into().ok().ok_or_else(wrong)?;
        let position: [u8; 16] = part(40..56)?.try_into().ok().ok_or_else(wrong)?;
        let mut inner = ChaCha8Rng::from_seed(seed);
        inner.set_stream(u64::from_le_bytes(stream));
        inner.set_word_pos(u128::from_le_bytes(position));
        Ok(Self { inner })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_saved_state_goes_on_where_it_was() {
        let mut rng = Rng::new(7, "dropout");
        for _ in 0..13 {
            rng.uniform();
        }
        let mut again = Rng::from_state(&rng.state()).unwrap();
        for _ in 0..100 {
            assert_eq!(rng.normal_f32().to_bits(), again.normal_f32().to_bits());
            assert_eq!(rng.uniform().to_bits(), again.uniform().to_bits());
        }
        assert!(Rng::from_state(&[0; 55]).is_err());
    }

    #[test]
    fn the_first_numbers_of_a_seed_never_change() {
        // a change here changes every trained model: bump the experiment format if it is meant
        let mut rng = Rng::new(1, "init");
        let got: Vec<u64> = (0..3).map(|_| rng.next_u64()).collect();
        assert_eq!(got, [10_918_279_902_693_391_332, 2_650_071_597_253_625_280, 11_148_525_250_861_914_345]);
        assert_ne!(Rng::new(1, "latent").next_u64(), got[0]);
        assert_ne!(Rng::new(2, "init").next_u64(), got[0]);
    }

    #[test]
    fn moments_are_those_of_the_distribution() {
        let mut rng = Rng::new(3, "test");
        let n = 200_000;
        let xs = rng.normals(n);
        let mean = xs.iter().map(|&x| f64::from(x)).sum::<f64>() / n as f64;
        let var = xs.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>() / n as f64;
        assert!(mean.abs() < 0.01 && (var - 1.0).abs() < 0.02, "{mean} {var}");
        let mut counts = [0u32; 5];
        for _ in 0..50_000 {
            counts[rng.below(5) as usize] += 1;
        }
        assert!(counts.iter().all(|&c| (9_500..10_500).contains(&c)), "{counts:?}");
    }
}
