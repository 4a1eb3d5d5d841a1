//! Images as files inside a column: PNG or uncompressed PPM, JPEG as it was recorded, and back to pixels.

use super::features::ImageForm;
use std::io::Cursor;
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

/// What JPEG files begin with: start of image, then the next marker.
const JPEG: [u8; 3] = [0xFF, 0xD8, 0xFF];
/// The longest side of a JPEG picture that is opened.
const MOST_PIXELS: usize = 1 << 13;

/// What a picture's file name ends in.
pub(crate) fn extension(form: ImageForm) -> &'static str {
    match form {
        ImageForm::Png => "png",
        ImageForm::Ppm => "ppm",
    }
}

/// Bytes that a PPM file of this size needs at most.
pub(crate) fn ppm_bytes(height: usize, width: usize) -> usize {
    const HEADER: usize = 64;
    HEADER + height * width * 3
}

/// Appends one RGB picture as a file. `pixels` is `height * width * 3` bytes.
pub(crate) fn encode(
    form: ImageForm,
    height: usize,
    width: usize,
    pixels: &[u8],
    out: &mut Vec<u8>,
) -> Result<(), png::EncodingError> {
    match form {
        ImageForm::Ppm => {
            out.extend_from_slice(format!("P6\n{width} {height}\n255\n").as_bytes());
            out.extend_from_slice(pixels);
            Ok(())
        }
        ImageForm::Png => encode_png(height, width, pixels, out),
    }
}

/// Appends one RGB picture as a PNG file.
pub(crate) fn encode_png(
    height: usize,
    width: usize,
    pixels: &[u8],
    out: &mut Vec<u8>,
) -> Result<(), png::EncodingError> {
    let mut encoder = png::Encoder::new(out, width as u32, height as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(pixels)?;
    writer.finish()
}

/// Pixels of an encoded picture that must be `height` x `width` RGB; in words what is wrong otherwise.
pub(crate) fn decode(file: &[u8], height: usize, width: usize, out: &mut Vec<u8>) -> Result<(), String> {
    let found = match file {
        [b'P', b'6', ..] => decode_ppm(file, height, width, out)?,
        [0x89, b'P', b'N', b'G', ..] => decode_png(file, height * width * 3, out)?,
        _ if file.starts_with(&JPEG) => decode_jpeg(file, (height, width), out)?,
        _ => return Err("neither a PNG nor a PPM nor a JPEG file".to_owned()),
    };
    if found != (height, width) {
        return Err(format!("an image of {} x {} instead of {height} x {width}", found.0, found.1));
    }
    Ok(())
}

fn decode_ppm(file: &[u8], height: usize, width: usize, out: &mut Vec<u8>) -> Result<(usize, usize), String> {
    // magic, width, height and depth, separated by white space; one byte of white space before the pixels
    let mut fields = [0_usize; 3];
    let mut at = 2;
    for field in &mut fields {
        while file.get(at).is_some_and(u8::is_ascii_whitespace) {
            at += 1;
        }
        let start = at;
        while file.get(at).is_some_and(u8::is_ascii_digit) {
            at += 1;
        }
        let text = std::str::from_utf8(&file[start..at]).unwrap_or_default();
        *field = text.parse().map_err(|e| format!("a PPM header with a bad number: {e}"))?;
    }
    if fields[2] != 255 {
        return Err(format!("a PPM file of depth {} instead of 255", fields[2]));
    }
    let pixels = file.get(at + 1..).unwrap_or_default();
    if (fields[1], fields[0]) == (height, width) && pixels.len() != height * width * 3 {
        return Err(format!("a PPM file with {} bytes of pixels instead of {}", pixels.len(), height * width * 3));
    }
    out.extend_from_slice(pixels);
    Ok((fields[1], fields[0]))
}

fn decode_png(file: &[u8], expected: usize, out: &mut Vec<u8>) -> Result<(usize, usize), String> {
    let limits = png::Limits { bytes: 64 << 20 };
    let decoder = png::Decoder::new_with_limits(Cursor::new(file), limits);
    let mut reader = decoder.read_info().map_err(|e| format!("a broken PNG file: {e}"))?;
    let info = reader.info();
    let size = (info.height as usize, info.width as usize);
    if info.color_type != png::ColorType::Rgb || info.bit_depth != png::BitDepth::Eight {
        return Err(format!("a PNG file of {:?} with {:?} bits instead of 8-bit RGB", info.color_type, info.bit_depth));
    }
    if size.0.checked_mul(size.1).and_then(|n| n.checked_mul(3)) != Some(expected) {
        return Ok(size);
    }
    let start = out.len();
    out.resize(start + expected, 0);
    reader.next_frame(&mut out[start..]).map_err(|e| format!("a broken PNG file: {e}"))?;
    Ok(size)
}

/// A JPEG file without the zeros that recordings fill its row of bytes up with; `None` where it is none.
pub(crate) fn jpeg(row: &[u8]) -> Option<&[u8]> {
    let end = row.iter().rposition(|&byte| byte != 0).map_or(0, |last| last + 1);
    // whatever follows the end of image is not part of it
    row.starts_with(&JPEG).then(|| &row[..end])
}

/// Whether a file begins as a JPEG file does.
pub(crate) fn is_jpeg(file: &[u8]) -> bool {
    file.starts_with(&JPEG)
}

/// A JPEG file whose header was read.
type Jpeg<'a> = JpegDecoder<ZCursor<&'a [u8]>>;

/// The file with height and width.
fn opened(file: &[u8]) -> Result<(Jpeg<'_>, (usize, usize)), String> {
    let options = DecoderOptions::default()
        .set_max_width(MOST_PIXELS)
        .set_max_height(MOST_PIXELS)
        .set_strict_mode(true)
        .jpeg_set_out_colorspace(ColorSpace::RGB);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(file), options);
    let broken = |e: &dyn std::fmt::Debug| format!("a broken JPEG file: {e:?}");
    decoder.decode_headers().map_err(|e| broken(&e))?;
    let (width, height) = decoder.dimensions().ok_or_else(|| "a JPEG file without a size".to_owned())?;
    Ok((decoder, (height, width)))
}

/// Height and width of a JPEG file in colour, which LeRobot records; in words what is wrong otherwise.
pub(crate) fn jpeg_size(file: &[u8]) -> Result<(usize, usize), String> {
    let (decoder, size) = opened(file)?;
    match decoder.input_colorspace() {
        Some(ColorSpace::Luma) => Err("a grey JPEG file".to_owned()),
        _ => Ok(size),
    }
}

fn decode_jpeg(file: &[u8], expected: (usize, usize), out: &mut Vec<u8>) -> Result<(usize, usize), String> {
    let (mut decoder, size) = opened(file)?;
    if size != expected {
        return Ok(size);
    }
    let pixels = decoder.decode().map_err(|e| format!("a broken JPEG file: {e:?}"))?;
    if pixels.len() != size.0 * size.1 * 3 {
        return Err(format!("a JPEG file with {} bytes of pixels instead of {}", pixels.len(), size.0 * size.1 * 3));
    }
    out.extend_from_slice(&pixels);
    Ok(size)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn pictures_come_back_pixel_by_pixel(height in 1_usize..9, width in 1_usize..9, seed in any::<u64>(), ppm in any::<bool>()) {
            let mut rng = crate::shuffle::SplitMix64::new(seed, 0);
            let pixels: Vec<u8> = (0..height * width * 3).map(|_| rng.below(256) as u8).collect();
            let form = if ppm { ImageForm::Ppm } else { ImageForm::Png };
            let mut file = Vec::new();
            encode(form, height, width, &pixels, &mut file).unwrap();
            let mut back = vec![1, 2, 3];
            decode(&file, height, width, &mut back).unwrap();
            prop_assert_eq!(&back[3..], &pixels[..]);
            prop_assert!(decode(&file, height + 1, width, &mut Vec::new()).is_err());
            // a damaged file may decode to other pixels or be refused, it never panics
            let at = rng.below(file.len() as u64) as usize;
            file[at] ^= 1 << rng.below(8);
            let _ = decode(&file, height, width, &mut Vec::new());
            let _ = decode(&file[..at], height, width, &mut Vec::new());
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]
        #[test]
        fn damaged_jpeg_files_decode_to_something_or_are_refused(which in 0..2, seed in any::<u64>()) {
            let files: [&[u8]; 2] =
                [include_bytes!("../../tests/fixtures/jpeg/0.jpg"), include_bytes!("../../tests/fixtures/jpeg/1.jpg")];
            let mut file = files[which as usize].to_vec();
            let mut out = Vec::new();
            decode(&file, 18, 26, &mut out).unwrap();
            prop_assert_eq!(out.len(), 18 * 26 * 3);
            let mut rng = crate::shuffle::SplitMix64::new(seed, 0);
            for _ in 0..1 + rng.below(4) {
                let at = rng.below(file.len() as u64) as usize;
                file[at] ^= 1 << rng.below(8);
            }
            let cut = rng.below(file.len() as u64) as usize;
            for damaged in [&file[..], &file[..cut]] {
                out.clear();
                if decode(damaged, 18, 26, &mut out).is_ok() {
                    prop_assert_eq!(out.len(), 18 * 26 * 3);
                }
            }
        }
    }
}
