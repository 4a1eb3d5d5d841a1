//! Fixed positions of the cells of a feature map, LeRobot's.

use std::f32::consts::TAU;

/// The table of a map of (h, w) for tokens of width `dim`: (h * w, dim), rows of the map one after the other.
///
/// DETR's (Carion et al., arXiv 2005.12872), as LeRobot's ACT computes it in f32: rows and columns are counted from 1 and
/// run to 2 pi, the first half of a token's numbers are of its row, the second half of its column, sine and cosine in turn.
pub fn position_table(dim: usize, (h, w): (usize, usize)) -> Vec<f32> {
    let half = dim / 2;
    let frequency = |j: usize| 10_000f32.powf(2.0 * (j / 2) as f32 / half as f32);
    let of = |at: usize, size: usize, out: &mut Vec<f32>| {
        let angle = (at + 1) as f32 / (size as f32 + 1e-6) * TAU;
        out.extend((0..half).map(|j| {
            let x = angle / frequency(j);
            if j % 2 == 0 { x.sin() } else { x.cos() }
        }));
    };
    let mut table = Vec::with_capacity(h * w * dim);
    for y in 0..h {
        for x in 0..w {
            of(y, h, &mut table);
            of(x, w, &mut table);
        }
    }
    table
}
