//! Keypoints of feature maps on slices, forwards and backwards: the maths of `encoders/spatial_softmax.rs`.

use super::{Grads, Pass};
use crate::encoders::{KEYPOINTS, Size};
use nn::kernels::exp;
use nn::layers::cell_places;

/// Where keypoints are in feature maps.
#[derive(Debug)]
pub(super) struct Keypoints {
    /// how much of each cell is each one's, (n, cells, K)
    shares: Vec<f32>,
    /// x and y of every keypoint in turn, (n, 2 K)
    pub(super) places: Vec<f32>,
    /// x and y of every cell
    grid: Vec<[f32; 2]>,
    /// K
    count: usize,
}

impl Keypoints {
    /// map: (n, cells, C)
    pub(super) fn find(pass: &mut Pass<'_>, map: &[f32], count: usize, (h, w): Size) -> Self {
        let grid = cell_places((h, w));
        let mut shares = pass.linear(&chosen(), map);
        let mut places = pass.space.pool.zeros(shares.len() / grid.len() * 2);
        let (mut largest, mut sums) = (pass.take(count), pass.take(count));
        for (shares, places) in shares.chunks_exact_mut(grid.len() * count).zip(places.chunks_exact_mut(2 * count)) {
            largest.fill(f32::NEG_INFINITY);
            for cell in shares.chunks_exact(count) {
                largest.iter_mut().zip(cell).for_each(|(largest, score)| *largest = largest.max(*score));
            }
            sums.fill(0.0);
            for cell in shares.chunks_exact_mut(count) {
                for ((share, largest), sum) in cell.iter_mut().zip(&largest).zip(&mut sums) {
                    *share = exp(*share - largest);
                    *sum += *share;
                }
            }
            for (cell, at) in shares.chunks_exact_mut(count).zip(&grid) {
                for ((share, sum), place) in cell.iter_mut().zip(&sums).zip(places.chunks_exact_mut(2)) {
                    *share /= sum;
                    place[0] += *share * at[0];
                    place[1] += *share * at[1];
                }
            }
        }
        pass.give(largest);
        pass.give(sums);
        Self { shares, places, grid, count }
    }

    /// The gradient of the places, (n, 2 K), becomes that of the map; that of the layer is added to `grads`.
    pub(super) fn backward(
        self,
        pass: &mut Pass<'_>,
        (map, channels): (&[f32], usize),
        places: &[f32],
        grads: &mut Grads<'_>,
    ) -> Vec<f32> {
        let (count, picture) = (self.count, self.grid.len() * self.count);
        let mut scores = pass.take(self.shares.len());
        let mut means = pass.take(count);
        let all = scores.chunks_exact_mut(picture).zip(self.shares.chunks_exact(picture));
        for ((scores, shares), places) in all.zip(places.chunks_exact(2 * count)) {
            means.fill(0.0);
            let cells = scores.chunks_exact_mut(count).zip(shares.chunks_exact(count));
            for ((scores, shares), at) in cells.zip(&self.grid) {
                let keypoints = scores.iter_mut().zip(shares).zip(places.chunks_exact(2)).zip(&mut means);
                for (((score, share), place), mean) in keypoints {
                    *score = at[0] * place[0] + at[1] * place[1];
                    *mean += *share * *score;
                }
            }
            for (scores, shares) in scores.chunks_exact_mut(count).zip(shares.chunks_exact(count)) {
                for ((score, share), mean) in scores.iter_mut().zip(shares).zip(&means) {
                    *score = share * (*score - mean);
                }
            }
        }
        pass.linear_backward(&chosen(), map, &scores, channels, grads);
        let map = pass.linear_input(&chosen(), &scores, channels);
        pass.give(scores);
        pass.give(means);
        self.free(pass);
        map
    }

    pub(super) fn free(self, pass: &mut Pass<'_>) {
        pass.give(self.shares);
        pass.give(self.places);
    }
}

/// The layer that says how much a cell is a keypoint's.
fn chosen() -> String {
    format!("{KEYPOINTS}.nets")
}
