//! From bytes to what the network reads: a part of the image, its colours changed a little in training, normalised.

use super::config::{Normalisation, VisionConfig};
use super::{ImageEncoder, Size};
use candle_core::{DType, Tensor};
use nn::Rng;
use nn::{ModelError, Result};

/// ImageNet's mean and standard deviation of red, green and blue, of numbers from 0 to 1.
const IMAGENET: ([f32; 3], [f32; 3]) = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]);
/// Added to standard deviations, LeRobot's.
const EPS: f32 = 1e-8;
/// Shares of red, green and blue in grey.
const GREY: [f32; 3] = [0.299, 0.587, 0.114];

/// What images are normalised by before anything else is known: mean and standard deviation.
pub(crate) fn statistics(normalise: Normalisation) -> ([f32; 3], [f32; 3]) {
    match normalise {
        Normalisation::Imagenet | Normalisation::Dataset => IMAGENET,
        Normalisation::Unit => ([0.0; 3], [1.0; 3]),
    }
}

/// Which part of an image is read, and how its colours change.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Augmentation {
    /// row of the image that becomes the first; may lie outside
    pub top: isize,
    /// column of the image that becomes the first; may lie outside
    pub left: isize,
    /// factors of brightness, contrast and saturation
    pub colour: [f32; 3],
}

impl Augmentation {
    /// The middle of the image, as it is.
    pub fn centre((h, w): Size, (seen_h, seen_w): Size) -> Self {
        Self { top: ((h - seen_h) / 2) as isize, left: ((w - seen_w) / 2) as isize, colour: [1.0; 3] }
    }

    /// A random part of the image in random colours.
    pub fn draw(config: &VisionConfig, (h, w): Size, (seen_h, seen_w): Size, rng: &mut Rng) -> Self {
        let mut place = |room: usize| match room + 2 * config.shift {
            0 => 0,
            all => rng.below(all as u64 + 1) as isize - config.shift as isize,
        };
        let (top, left) = (place(h - seen_h), place(w - seen_w));
        let mut factor = || match config.jitter {
            0.0 => 1.0,
            jitter => 1.0 + (2.0 * rng.uniform() - 1.0) * jitter as f32,
        };
        Self { top, left, colour: [factor(), factor(), factor()] }
    }

    /// Whether training draws another augmentation each time.
    pub fn is_random(config: &VisionConfig) -> bool {
        config.crop.is_some() || config.shift > 0 || config.jitter > 0.0
    }

    /// image: (h, w, 3) -> out: (seen_h, seen_w, 3), normalised. Beyond the image its border is repeated.
    pub fn take(
        &self,
        image: &[u8],
        (h, w): Size,
        (_, seen_w): Size,
        (mean, std): ([f32; 3], [f32; 3]),
        out: &mut [f32],
    ) {
        let plain = self.colour == [1.0; 3];
        // all values that a byte can have
        let table: Vec<[f32; 3]> = (0..256u16)
            .map(|x| {
                let x = f32::from(x) / 255.0;
                if plain { std::array::from_fn(|c| (x - mean[c]) / (std[c] + EPS)) } else { [x; 3] }
            })
            .collect();
        for (y, line) in out.chunks_exact_mut(seen_w * 3).enumerate() {
            let row = (self.top + y as isize).clamp(0, h as isize - 1) as usize;
            let row = &image[row * w * 3..(row + 1) * w * 3];
            for (x, pixel) in line.chunks_exact_mut(3).enumerate() {
                let column = (self.left + x as isize).clamp(0, w as isize - 1) as usize;
                for c in 0..3 {
                    pixel[c] = table[usize::from(row[column * 3 + c])][c];
                }
            }
        }
        if !plain {
            self.recolour(out);
            for pixel in out.chunks_exact_mut(3) {
                for c in 0..3 {
                    pixel[c] = (pixel[c] - mean[c]) / (std[c] + EPS);
                }
            }
        }
    }

    /// Brightness, contrast, saturation, in this order and as torchvision defines them; numbers from 0 to 1.
    fn recolour(&self, x: &mut [f32]) {
        let [brightness, contrast, saturation] = self.colour;
        let grey = |p: &[f32]| GREY[0] * p[0] + GREY[1] * p[1] + GREY[2] * p[2];
        x.iter_mut().for_each(|x| *x = (*x * brightness).clamp(0.0, 1.0));
        let pixels = (x.len() / 3).max(1) as f64;
        let mean = (x.chunks_exact(3).map(|p| f64::from(grey(p))).sum::<f64>() / pixels) as f32;
        for pixel in x.chunks_exact_mut(3) {
            pixel.iter_mut().for_each(|x| *x = (mean + contrast * (*x - mean)).clamp(0.0, 1.0));
            let grey = grey(pixel);
            pixel.iter_mut().for_each(|x| *x = (grey + saturation * (*x - grey)).clamp(0.0, 1.0));
        }
    }
}

impl ImageEncoder {
    /// What the network reads of one camera's images, (b, H, W, 3) of bytes: random parts drawn from `rng`, or without
    /// it their middle -> (b, H', W', 3).
    ///
    /// # Errors
    /// Another size of image, or no bytes.
    pub fn prepare(&self, camera: usize, images: &Tensor, rng: Option<&mut Rng>) -> Result<Tensor> {
        let (size, seen) = (self.given[camera], self.sizes[camera]);
        let rows = images.dims().first().copied().unwrap_or(0);
        if images.dims() != [rows, size.0, size.1, 3] {
            let (expected, found) = (vec![rows, size.0, size.1, 3], images.dims().to_vec());
            return Err(ModelError::Shape { operation: "see", object: "image", expected, found });
        }
        if images.dtype() != DType::U8 {
            let (found, expected) = (format!("{:?}", images.dtype()), "bytes".to_string());
            return Err(ModelError::Input { operation: "see", object: "image", found, expected });
        }
        let mut rng = rng.filter(|_| Augmentation::is_random(&self.config));
        let augmentations = (0..rows).map(|_| match &mut rng {
            Some(rng) => Augmentation::draw(&self.config, size, seen, rng),
            None => Augmentation::centre(size, seen),
        });
        if self.composed {
            return self.prepare_composed(camera, images, &augmentations.collect::<Vec<_>>());
        }
        let bytes = images.contiguous()?;
        let (storage, layout) = bytes.storage_and_layout();
        let candle_core::Storage::Cpu(storage) = &*storage else {
            let (found, expected) = ("on another device".to_string(), "on the CPU".to_string());
            return Err(ModelError::Input { operation: "see", object: "image", found, expected });
        };
        let from = layout.start_offset();
        let bytes = &storage.as_slice::<u8>()?[from..from + layout.shape().elem_count()];
        let row_of = |t: &Tensor| -> Result<[f32; 3]> {
            let row = t.get(camera)?.to_vec1::<f32>()?;
            Ok([row[0], row[1], row[2]])
        };
        let of_camera = (row_of(&self.mean)?, row_of(&self.std)?);
        let mut out = vec![0.0; rows * seen.0 * seen.1 * 3];
        let each = bytes.chunks_exact(size.0 * size.1 * 3).zip(out.chunks_exact_mut(seen.0 * seen.1 * 3));
        for ((image, out), augmentation) in each.zip(augmentations) {
            augmentation.take(image, size, seen, of_camera, out);
        }
        Ok(Tensor::from_vec(out, (rows, seen.0, seen.1, 3), images.device())?)
    }

    /// The same on candle's operations.
    fn prepare_composed(&self, camera: usize, images: &Tensor, augmentations: &[Augmentation]) -> Result<Tensor> {
        let ((h, w), (seen_h, seen_w), device) = (self.given[camera], self.sizes[camera], images.device());
        // lines of all images at once, first the rows of each and then, turned, its columns
        let part = |x: &Tensor, from: fn(&Augmentation) -> isize, (count, all): (usize, usize)| {
            let places = augmentations.iter().enumerate().flat_map(|(image, augmentation)| {
                let place = |i: usize| (from(augmentation) + i as isize).clamp(0, all as isize - 1) as u32;
                (0..count).map(move |i| (image * all) as u32 + place(i)).collect::<Vec<_>>()
            });
            let (images, _, across, _) = x.dims4()?;
            let lines = x.contiguous()?.reshape((images * all, across * 3))?;
            lines.index_select(&Tensor::from_iter(places, device)?, 0)?.reshape((images, count, across, 3))
        };
        let x = part(images, |augmentation| augmentation.top, (seen_h, h))?;
        let x = part(&x.transpose(1, 2)?, |augmentation| augmentation.left, (seen_w, w))?.transpose(1, 2)?;
        let mut x = (x.contiguous()?.to_dtype(DType::F32)? / 255.0)?;
        if augmentations.iter().any(|augmentation| augmentation.colour != [1.0; 3]) {
            let factor = |at: usize| {
                let factors = augmentations.iter().map(|augmentation| augmentation.colour[at]).collect::<Vec<_>>();
                Tensor::from_vec(factors, (augmentations.len(), 1, 1, 1), device)
            };
            let weights = Tensor::new(&GREY, device)?;
            let grey = |x: &Tensor| x.broadcast_mul(&weights)?.sum_keepdim(3);
            let towards = |from: &Tensor, x: &Tensor, factor: &Tensor| {
                x.broadcast_sub(from)?.broadcast_mul(factor)?.broadcast_add(from)?.clamp(0f32, 1f32)
            };
            x = x.broadcast_mul(&factor(0)?)?.clamp(0f32, 1f32)?;
            x = towards(&grey(&x)?.mean_keepdim((1, 2))?, &x, &factor(1)?)?;
            x = towards(&grey(&x)?, &x, &factor(2)?)?;
        }
        let (mean, std) = (self.mean.get(camera)?, (self.std.get(camera)? + f64::from(EPS))?);
        Ok(x.broadcast_sub(&mean)?.broadcast_div(&std)?.detach())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::encoders::{ImageEncoder, TokenKind};
    use candle_core::Device;
    use nn::Backend;
    use nn::Params;

    fn image((h, w): Size) -> Vec<u8> {
        (0..h * w * 3).map(|i| (i * 7 % 251) as u8).collect()
    }

    #[test]
    fn the_middle_is_robomimics_and_normalised_as_lerobot_does() {
        let (size, seen) = ((84, 84), (76, 76));
        let augmentation = Augmentation::centre(size, seen);
        assert_eq!((augmentation.top, augmentation.left), (4, 4));
        let bytes = image(size);
        let mut out = vec![0.0; 76 * 76 * 3];
        augmentation.take(&bytes, size, seen, IMAGENET, &mut out);
        let x = f32::from(bytes[((4 + 10) * 84 + 4 + 20) * 3 + 1]) / 255.0;
        assert_eq!(out[(10 * 76 + 20) * 3 + 1], (x - 0.456) / (0.224 + 1e-8));
    }

    #[test]
    fn random_parts_cover_all_places_and_repeat_with_the_seed() {
        let config = VisionConfig { crop: Some(6), shift: 1, jitter: 0.2, ..VisionConfig::default() };
        let draw = |seed| {
            let mut rng = Rng::new(seed, "look");
            (0..500).map(|_| Augmentation::draw(&config, (8, 9), (6, 6), &mut rng)).collect::<Vec<_>>()
        };
        let augmentations = draw(1);
        assert_eq!(augmentations, draw(1));
        assert_ne!(augmentations, draw(2));
        let (tops, lefts): (Vec<isize>, Vec<isize>) = augmentations.iter().map(|l| (l.top, l.left)).unzip();
        assert_eq!((tops.iter().min(), tops.iter().max()), (Some(&-1), Some(&3)));
        assert_eq!((lefts.iter().min(), lefts.iter().max()), (Some(&-1), Some(&4)));
        assert!(augmentations.iter().flat_map(|l| l.colour).all(|f| (0.8..=1.2).contains(&f)));
        // the border is repeated
        let (bytes, mut out) = (image((8, 9)), vec![0.0; 36 * 3]);
        let augmentation = Augmentation { top: -1, left: 0, colour: [1.0; 3] };
        augmentation.take(&bytes, (8, 9), (6, 6), ([0.0; 3], [1.0; 3]), &mut out);
        assert_eq!(out[..18], out[18..36]);
    }

    #[test]
    fn what_could_not_be_seen_is_refused() {
        let told = |config: &VisionConfig| config.seen((8, 9)).unwrap_err().to_string();
        let shifted = |shift| VisionConfig { shift, ..VisionConfig::default() };
        assert!(shifted(7).seen((8, 9)).is_ok());
        for shift in [8, usize::MAX] {
            assert!(told(&shifted(shift)).contains("shift is") && told(&shifted(shift)).contains("side, 8"));
        }
        // a keypoint in a map of one cell says nothing
        let keypoints = |size| {
            let config = VisionConfig { tokens: TokenKind::Keypoints { count: 3 }, ..VisionConfig::default() };
            let mut rng = Rng::new(1, "init");
            ImageEncoder::without_positions(&mut Params::new(&Backend::CPU), &config, &[size, (5, 3)], 8, &mut rng)
        };
        assert!(keypoints((33, 33)).is_ok());
        let blind = keypoints((32, 32)).map(|_| ()).unwrap_err().to_string();
        assert!(blind.contains("tokens is keypoints in maps of one cell"), "{blind}");
    }

    #[test]
    fn the_composed_images_are_the_same() {
        let bytes = Tensor::from_vec([image((8, 9)), image((8, 9))].concat(), (2, 8, 9, 3), &Device::Cpu).unwrap();
        for jitter in [0.0, 0.3] {
            let config = VisionConfig { crop: Some(6), shift: 2, jitter, width: 8, ..VisionConfig::default() };
            let [fast, composed] = [Backend::CPU, Backend::composed(Device::Cpu)].map(|backend| {
                let (params, mut rng) = (&mut Params::new(&backend), Rng::new(1, "init"));
                let encoder = ImageEncoder::without_positions(params, &config, &[(8, 9)], 8, &mut rng).unwrap();
                let drawn = encoder.prepare(0, &bytes, Some(&mut rng)).unwrap();
                let both = Tensor::cat(&[drawn, encoder.prepare(0, &bytes, None).unwrap()], 0).unwrap();
                both.flatten_all().unwrap().to_vec1::<f32>().unwrap()
            });
            assert!(fast.iter().zip(&composed).all(|(a, b)| (a - b).abs() < 1e-5), "{fast:?} {composed:?}");
        }
    }

    #[test]
    fn colours_change_and_stay_colours() {
        let mut x = vec![0.2, 0.5, 0.9, 0.0, 1.0, 0.3];
        let grey = |p: &[f32]| 0.299 * p[0] + 0.587 * p[1] + 0.114 * p[2];
        Augmentation { top: 0, left: 0, colour: [1.0, 1.0, 0.0] }.recolour(&mut x);
        let expected = [grey(&[0.2, 0.5, 0.9]); 3];
        assert!(x[..3].iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{x:?}");
        let mut x = vec![0.2, 0.5, 0.9];
        Augmentation { top: 0, left: 0, colour: [2.0, 1.0, 1.0] }.recolour(&mut x);
        assert!(x.iter().zip([0.4, 1.0, 1.0]).all(|(a, b)| (a - b).abs() < 1e-6), "{x:?}");
    }
}
