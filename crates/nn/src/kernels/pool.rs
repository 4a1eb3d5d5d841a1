//! Buffers that are used again in the next step.

use std::collections::BTreeMap;

/// Free buffers by capacity. A training step asks for the same lengths every time, so after the first ones nothing is allocated.
#[derive(Debug, Default)]
pub struct Pool {
    free: BTreeMap<usize, Vec<Vec<f32>>>,
}

/// A buffer may be larger than asked for by this share of it: what layers of about one size need is one buffer then.
const SPARE: usize = 4;

impl Pool {
    /// A buffer of `len` numbers with any content.
    pub fn take(&mut self, len: usize) -> Vec<f32> {
        let mut fitting = self.free.range_mut(len..=len + len / SPARE);
        let Some(mut buffer) = fitting.find_map(|(_, buffers)| buffers.pop()) else { return vec![0.0; len] };
        buffer.resize(len, 0.0);
        buffer
    }

    /// A buffer of zeros.
    pub fn zeros(&mut self, len: usize) -> Vec<f32> {
        let mut buffer = self.take(len);
        buffer.fill(0.0);
        buffer
    }

    /// A copy of `values`.
    pub fn copy(&mut self, values: &[f32]) -> Vec<f32> {
        let mut buffer = self.take(values.len());
        buffer.copy_from_slice(values);
        buffer
    }

    /// Takes a buffer back.
    pub fn give(&mut self, buffer: Vec<f32>) {
        if buffer.capacity() > 0 {
            self.free.entry(buffer.capacity()).or_default().push(buffer);
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_buffer_serves_again_for_what_is_not_much_smaller() {
        let mut pool = Pool::default();
        let first = pool.take(100);
        let at = first.as_ptr();
        pool.give(first);
        let other = pool.take(79);
        assert_ne!(other.as_ptr(), at);
        let again = pool.take(80);
        assert_eq!((again.as_ptr(), again.len()), (at, 80));
        pool.give(again);
        let whole = pool.take(100);
        assert_eq!((whole.as_ptr(), whole.len()), (at, 100));
        pool.give(Vec::new());
        assert!(!pool.free.contains_key(&0), "nobody asks for none, so they would pile up");
    }
}
