//! Images as openpi's `resize_with_pad` makes them: Pillow's bilinear filter, the aspect kept, the rest black.

/// An RGB image of `height` by `width` in a square of `size`, (size, size, 3).
pub(crate) fn resize_with_pad(rgb: &[u8], height: usize, width: usize, size: usize) -> Vec<u8> {
    if (height, width) == (size, size) {
        return rgb.to_vec();
    }
    let ratio = (width as f64 / size as f64).max(height as f64 / size as f64);
    // of a narrow image, too, something is seen
    let new = |side: usize| ((side as f64 / ratio) as usize).max(1);
    let (new_height, new_width) = (new(height), new(width));
    let wide = if new_width == width { rgb.to_vec() } else { columns(rgb, width, new_width) };
    let resized = if new_height == height { wide } else { rows(&wide, height, new_height, new_width) };
    let mut square = vec![0; size * size * 3];
    let (top, left) = ((size - new_height) / 2, (size - new_width) / 2);
    for (row, pixels) in resized.chunks_exact(3 * new_width).enumerate() {
        let at = 3 * ((top + row) * size + left);
        square[at..at + pixels.len()].copy_from_slice(pixels);
    }
    square
}

/// Bits after the point of Pillow's weights.
const PRECISION: u32 = 32 - 8 - 2;

/// For each pixel of the result the first pixel that it is made of, and the weights from there on.
fn weights(from: usize, to: usize) -> Vec<(usize, Vec<i32>)> {
    let scale = from as f64 / to as f64;
    let support = scale.max(1.0);
    let one = |at: usize| {
        let center = (at as f64 + 0.5) * scale;
        let first = (center - support + 0.5).max(0.0) as usize;
        let last = ((center + support + 0.5) as usize).min(from);
        let weight = |x: usize| (1.0 - ((x as f64 - center + 0.5) / support).abs()).max(0.0);
        let raw: Vec<f64> = (first..last).map(weight).collect();
        let sum: f64 = raw.iter().sum();
        (first, raw.iter().map(|w| (0.5 + w / sum * f64::from(1 << PRECISION)) as i32).collect())
    };
    (0..to).map(one).collect()
}

fn rounded(sum: i32) -> u8 {
    (sum >> PRECISION).clamp(0, 255) as u8
}

const HALF: i32 = 1 << (PRECISION - 1);

fn columns(rgb: &[u8], width: usize, to: usize) -> Vec<u8> {
    let weights = weights(width, to);
    let row = |row: &[u8]| -> Vec<u8> {
        let pixel = |(first, weights): &(usize, Vec<i32>)| {
            [0, 1, 2].map(|c| {
                let terms = weights.iter().enumerate().map(|(k, w)| w * i32::from(row[3 * (first + k) + c]));
                rounded(HALF + terms.sum::<i32>())
            })
        };
        weights.iter().flat_map(pixel).collect()
    };
    rgb.chunks_exact(3 * width).flat_map(row).collect()
}

fn rows(rgb: &[u8], height: usize, to: usize, width: usize) -> Vec<u8> {
    let line = 3 * width;
    let row = |(first, weights): (usize, Vec<i32>)| -> Vec<u8> {
        let value = |at: usize| {
            let terms = weights.iter().enumerate().map(|(k, w)| w * i32::from(rgb[(first + k) * line + at]));
            rounded(HALF + terms.sum::<i32>())
        };
        (0..line).map(value).collect()
    };
    weights(height, to).into_iter().flat_map(row).collect()
}
