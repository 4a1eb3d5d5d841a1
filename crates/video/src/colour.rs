//! Between RGB and the planes of a video, 8 bits, 4:2:0, BT.601 in limited range.
//!
//! Reading follows what LeRobot's readers do (FFmpeg's swscale, on x86), integer by integer; it was measured, for even
//! heights. Writing rounds the standard's formula and takes the mean of 2 x 2 pixels for chroma.

/// The planes of a decoded picture. Those of chroma have half the columns and rows, rounded up.
pub(crate) struct Planes<'a> {
    pub y: &'a [u8],
    pub u: &'a [u8],
    pub v: &'a [u8],
    /// Bytes from a row to the next, of luma and of chroma.
    pub strides: (usize, usize),
}

fn product(a: i32, b: i32) -> i32 {
    (a * b) >> 16
}

fn clamp(value: i32) -> u8 {
    value.clamp(0, 255) as u8
}

/// Fills `out`, `width * height * 3` bytes; false where the planes are too short for that.
pub(crate) fn to_rgb(planes: &Planes<'_>, width: usize, height: usize, out: &mut [u8]) -> bool {
    let columns = width.div_ceil(2);
    if out.len() != width * height * 3 {
        return false;
    }
    for (row, out) in out.chunks_exact_mut(width * 3).enumerate() {
        let part = |plane: &'_ [u8], row: usize, stride: usize, count: usize| -> Option<(usize, usize)> {
            let from = row.checked_mul(stride)?;
            (plane.len() >= from.checked_add(count)?).then_some((from, from + count))
        };
        let (Some(y), Some(u), Some(v)) = (
            part(planes.y, row, planes.strides.0, width),
            part(planes.u, row / 2, planes.strides.1, columns),
            part(planes.v, row / 2, planes.strides.1, columns),
        ) else {
            return false;
        };
        let (y, u, v) = (&planes.y[y.0..y.1], &planes.u[u.0..u.1], &planes.v[v.0..v.1]);
        for ((pair, luma), (&u, &v)) in out.chunks_mut(6).zip(y.chunks(2)).zip(u.iter().zip(v)) {
            let (u, v) = (8 * i32::from(u) - 1024, 8 * i32::from(v) - 1024);
            let (red, green, blue) = (product(v, 13_075), product(u, -3209) + product(v, -6660), product(u, 16_525));
            for (pixel, &luma) in pair.chunks_exact_mut(3).zip(luma) {
                let y = product(8 * i32::from(luma) - 128, 9539);
                pixel[0] = clamp(y + red);
                pixel[1] = clamp(y + green);
                pixel[2] = clamp(y + blue);
            }
        }
    }
    true
}

/// The planes of an RGB picture, without filling between rows: luma, then the two of chroma.
pub fn from_rgb(rgb: &[u8], width: usize, height: usize) -> [Vec<u8>; 3] {
    // the standard's factors by 2^16, so rounded that grey has no colour
    let luma = |[r, g, b]: [i32; 3]| 16 + ((16_829 * r + 33_039 * g + 6_416 * b + (1 << 15)) >> 16);
    let mut y = Vec::with_capacity(width * height);
    for pixel in rgb.chunks_exact(3) {
        y.push(clamp(luma([i32::from(pixel[0]), i32::from(pixel[1]), i32::from(pixel[2])])));
    }
    let (columns, rows) = (width.div_ceil(2), height.div_ceil(2));
    let (mut u, mut v) = (Vec::with_capacity(columns * rows), Vec::with_capacity(columns * rows));
    for row in 0..rows {
        for column in 0..columns {
            let mut sums = [0; 3];
            for (dy, dx) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                // at the rim of odd sizes the last pixel counts twice
                let at = (2 * row + dy).min(height - 1) * width + (2 * column + dx).min(width - 1);
                for (sum, &value) in sums.iter_mut().zip(&rgb[3 * at..3 * at + 3]) {
                    *sum += i32::from(value);
                }
            }
            let [r, g, b] = sums;
            let chroma = |value: i32| clamp(128 + ((value + (1 << 17)) >> 18));
            u.push(chroma(-9_714 * r - 19_070 * g + 28_784 * b));
            v.push(chroma(28_784 * r - 24_103 * g - 4_681 * b));
        }
    }
    [y, u, v]
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    /// The rule as the reference states it, a pixel at a time.
    fn pixel(y: u8, u: u8, v: u8) -> [u8; 3] {
        let m = |a: i64, b: i64| (a * b).div_euclid(65_536);
        let (y, u, v) = (m(8 * i64::from(y) - 128, 9539), 8 * i64::from(u) - 1024, 8 * i64::from(v) - 1024);
        [y + m(v, 13_075), y + m(u, -3209) + m(v, -6660), y + m(u, 16_525)].map(|c| c.clamp(0, 255) as u8)
    }

    proptest! {
        #[test]
        fn every_pixel_follows_the_rule(width in 1_usize..9, half in 1_usize..4, pad in 0_usize..3, seed in any::<u64>()) {
            let height = 2 * half;
            let columns = width.div_ceil(2);
            let noise = |salt: u64, count: usize| -> Vec<u8> {
                (0..count as u64).map(|i| ((seed ^ salt).wrapping_mul(2 * i + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 56) as u8).collect()
            };
            let strides = (width + pad, columns + 2 * pad);
            let (y, u, v) = (noise(1, strides.0 * height), noise(2, strides.1 * half), noise(3, strides.1 * half));
            let mut out = vec![0; width * height * 3];
            let planes = Planes { y: &y, u: &u, v: &v, strides };
            prop_assert!(to_rgb(&planes, width, height, &mut out));
            for (at, found) in out.chunks_exact(3).enumerate() {
                let (row, column) = (at / width, at % width);
                let chroma = row / 2 * strides.1 + column / 2;
                prop_assert_eq!(found, &pixel(y[row * strides.0 + column], u[chroma], v[chroma])[..]);
            }
            // rows that the planes do not have
            let larger = to_rgb(&planes, width, height + 2, &mut vec![0; width * (height + 2) * 3]);
            prop_assert!(!larger);
        }

        #[test]
        fn plain_colours_come_back_within_three_levels(r in 0_u8..=255, g in 0_u8..=255, b in 0_u8..=255, width in 1_usize..5) {
            let rgb = [r, g, b].repeat(width * 2);
            let [y, u, v] = from_rgb(&rgb, width, 2);
            let mut back = vec![0; rgb.len()];
            let planes = Planes { y: &y, u: &u, v: &v, strides: (width, width.div_ceil(2)) };
            let read = to_rgb(&planes, width, 2, &mut back);
            prop_assert!(read);
            for (a, b) in rgb.iter().zip(&back) {
                prop_assert!(a.abs_diff(*b) <= 3, "{rgb:?} {back:?}");
            }
            if r == g && g == b {
                prop_assert!(u.iter().chain(&v).all(|&c| c == 128));
            }
        }
    }
}
