//! Pictures beside and below each other as one, for people: contact sheets, strips, what two cameras see at once.

use std::io;

use crate::lerobot::encode_png;

/// An RGB picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    /// Rows.
    pub height: usize,
    /// Pixels in a row.
    pub width: usize,
    /// `height * width * 3` bytes: rows from the top, pixels from the left.
    pub rgb: Vec<u8>,
}

impl Picture {
    /// One colour.
    pub fn plain(height: usize, width: usize, colour: [u8; 3]) -> Self {
        Self { height, width, rgb: colour.repeat(height * width) }
    }

    /// Every pixel as a square of `factor` pixels.
    #[must_use]
    pub fn enlarged(&self, factor: usize) -> Self {
        let mut rgb = Vec::with_capacity(self.rgb.len() * factor * factor);
        for row in self.rgb.chunks_exact((self.width * 3).max(1)) {
            let line: Vec<u8> = row.chunks_exact(3).flat_map(|pixel| pixel.repeat(factor)).collect();
            (0..factor).for_each(|_| rgb.extend_from_slice(&line));
        }
        Self { height: self.height * factor, width: self.width * factor, rgb }
    }

    /// Rows of pictures as one picture, white where there is none, with `gap` pixels of white between them. A column is
    /// as wide as its widest picture, a row as high as its highest.
    pub fn sheet(rows: &[Vec<Picture>], gap: usize) -> Self {
        let columns = rows.iter().map(Vec::len).max().unwrap_or(0);
        let width_of = |c: usize| rows.iter().filter_map(|row| row.get(c)).map(|p| p.width).max().unwrap_or(0);
        let widths: Vec<usize> = (0..columns).map(width_of).collect();
        let heights: Vec<usize> = rows.iter().map(|row| row.iter().map(|p| p.height).max().unwrap_or(0)).collect();
        let all = |sizes: &[usize]| sizes.iter().sum::<usize>() + gap * sizes.len().saturating_sub(1);
        let mut sheet = Self::plain(all(&heights), all(&widths), [255; 3]);
        let mut top = 0;
        for (row, height) in rows.iter().zip(&heights) {
            let mut left = 0;
            for (picture, width) in row.iter().zip(&widths) {
                sheet.put(picture, top, left);
                left += width + gap;
            }
            top += height + gap;
        }
        sheet
    }

    /// Puts a picture that fits over a part of this one.
    fn put(&mut self, picture: &Picture, top: usize, left: usize) {
        let line = picture.width * 3;
        for (y, from) in picture.rgb.chunks_exact(line.max(1)).enumerate() {
            let at = ((top + y) * self.width + left) * 3;
            self.rgb[at..at + line].copy_from_slice(from);
        }
    }

    /// As a PNG file.
    ///
    /// # Errors
    /// A picture without pixels, or with too few bytes for its size.
    pub fn to_png(&self) -> io::Result<Vec<u8>> {
        let mut file = Vec::new();
        encode_png(self.height, self.width, &self.rgb, &mut file)?;
        Ok(file)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn pictures_lie_in_rows_with_white_between() {
        let red = Picture::plain(1, 2, [255, 0, 0]);
        let blue = Picture::plain(2, 1, [0, 0, 255]);
        let sheet = Picture::sheet(&[vec![red.clone(), blue], vec![red]], 1);
        assert_eq!((sheet.height, sheet.width), (4, 4));
        let letter = |pixel: &[u8]| match pixel {
            [255, 0, 0] => 'r',
            [0, 0, 255] => 'b',
            [255, 255, 255] => '.',
            other => panic!("{other:?}"),
        };
        let rows: Vec<String> = sheet.rgb.chunks(12).map(|row| row.chunks(3).map(letter).collect()).collect();
        assert_eq!(rows, ["rr.b", "...b", "....", "rr.."]);
        assert_eq!(Picture::sheet(&[], 3).rgb.len(), 0);
    }

    #[test]
    fn enlarged_pixels_are_squares_and_files_come_back() {
        let small = Picture { height: 1, width: 2, rgb: vec![1, 2, 3, 4, 5, 6] };
        let large = small.enlarged(2);
        assert_eq!((large.height, large.width), (2, 4));
        assert_eq!(large.rgb, [[1, 2, 3, 1, 2, 3, 4, 5, 6, 4, 5, 6]; 2].concat());
        let mut reader = png::Decoder::new(std::io::Cursor::new(large.to_png().unwrap())).read_info().unwrap();
        let mut back = vec![0; large.rgb.len()];
        reader.next_frame(&mut back).unwrap();
        assert_eq!(back, large.rgb);
        assert!(Picture { rgb: vec![0; 3], ..small }.to_png().is_err());
    }
}
