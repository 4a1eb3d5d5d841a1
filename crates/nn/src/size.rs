//! How large a model will be, told from its options before anything is built.

use std::ops::{Add, Mul};

/// A model's size in numbers: rather less than it will take, so that nothing is refused that would have gone.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Size {
    /// weights
    pub weights: f64,
    /// numbers that one sample leaves behind for the backward pass
    pub activations: f64,
}

/// Bytes of a number.
const NUMBER: f64 = 4.0;
/// Copies of the weights in a training: themselves, the gradient, two moments.
const COPIES: f64 = 4.0;

impl Size {
    /// Bytes that a training takes with `samples` at once.
    pub fn training_bytes(&self, samples: usize) -> f64 {
        NUMBER * (COPIES * self.weights + self.activations * samples as f64)
    }
}

impl Add for Size {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self { weights: self.weights + other.weights, activations: self.activations + other.activations }
    }
}

impl Mul<usize> for Size {
    type Output = Self;
    fn mul(self, times: usize) -> Self {
        Self { weights: self.weights * times as f64, activations: self.activations * times as f64 }
    }
}
