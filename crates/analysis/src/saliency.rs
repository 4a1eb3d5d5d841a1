//! What a policy looks at: parts of its pictures are covered, one after the other, and its answer compared.
//!
//! Zeiler and Fergus, "Visualizing and Understanding Convolutional Networks" (2014): occlusion. A square of the picture's
//! mean colour moves over it; how far the predicted actions move away from those of the whole picture, in the network's
//! units, is what the place under it meant to the policy. It needs nothing of the model but predictions.

use std::sync::Arc;

use candle_core::{Device, Tensor};
use dataset::Picture;
use models::{FeatureKind, FeatureSpec, Features, ModelError, Observation};
use rollout::{Outcome, Pool};
use serde::Serialize;
use zoo::ZooError;
use zoo::entry::LoadedEntry;
use zoo::evaluation::{Subject, image};
use zoo::experiment::IMAGE_PREFIX;

use crate::episode::{Answered, Note, Noted, record};

/// Covered squares that are predicted at once.
const ROWS: usize = 32;
/// Covered squares along the longer side of a picture; they overlap by half.
const SQUARES: usize = 12;

/// What one episode's queries looked at.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Saliency {
    /// The entry, `name@version`.
    pub entry: String,
    /// The task.
    pub task: String,
    /// The episode's seed.
    pub seed: u64,
    /// Whether the task was done.
    pub success: bool,
    /// Control steps done.
    pub steps: usize,
    /// Some of its queries, in order.
    pub queries: Vec<SalientQuery>,
}

/// One query.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SalientQuery {
    /// Control steps done before it.
    pub step: usize,
    /// Its cameras, in order.
    pub cameras: Vec<SalientCamera>,
}

/// One camera's picture in a query.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SalientCamera {
    /// The simulator's name of it.
    pub camera: String,
    /// How far the actions move without the picture, mean over the chunk in the network's units.
    pub whole: f32,
    /// The most that a covered square moves them.
    pub most: f32,
    /// Row and column of the middle of that square.
    pub place: (usize, usize),
    /// What it showed.
    #[serde(skip)]
    pub picture: Picture,
    /// A value a pixel, row-major: the mean over all squares that cover it.
    #[serde(skip)]
    pub heat: Vec<f32>,
}

/// Runs the episode of `seed` as an evaluation would and looks at up to `queries` of its queries, evenly spread; nothing
/// if it was stopped. `progress` is told how many are done of how many.
///
/// # Errors
/// A policy that sees no pictures; as for an evaluation.
pub fn saliency(
    loaded: &LoadedEntry,
    subject: &Subject<'_>,
    pool: &mut Pool,
    seed: u64,
    queries: usize,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<Option<Saliency>, ZooError> {
    let task = pool.ready().task.clone();
    let note: Note<Vec<Observation>> = Arc::new(|answered: &Answered<'_>| Ok(answered.seen.to_vec()));
    let Some((outcome, observed)) = record(subject, pool, seed, &note)? else { return Ok(None) };
    let chosen = evenly(observed.len(), queries);
    let failed =
        |source| ZooError::Model { operation: "look at the images of", name: subject.entry.to_string(), source };
    let mut looked = Vec::with_capacity(chosen.len());
    for (done, &at) in chosen.iter().enumerate() {
        progress(done as u64, chosen.len() as u64);
        let Noted { step, what: history, .. } = &observed[at];
        let seen = loaded.preprocess().observation(history).map_err(failed)?;
        let last = history.last().expect("a query has an observation");
        let cameras = subject.signature.of_kind(FeatureKind::Image);
        let cameras = cameras.filter_map(|camera| Some((camera, image(camera, last)?)));
        let cameras = cameras
            .map(|(camera, image)| covered(&|x: &Features<Tensor>| loaded.model().predict(x), &seen, camera, image))
            .collect::<Result<Vec<_>, _>>()
            .map_err(failed)?;
        looked.push(SalientQuery { step: *step, cameras });
    }
    let Outcome { success, steps, .. } = outcome;
    Ok(Some(Saliency { entry: subject.entry.to_string(), task, seed, success, steps, queries: looked }))
}

/// Up to `most` of `count` places, evenly spread, the first among them.
fn evenly(count: usize, most: usize) -> Vec<usize> {
    let taken = most.min(count);
    (0..taken).map(|i| i * count / taken).collect()
}

/// What one camera's picture, the last of the history in `seen`, was to the prediction.
fn covered(
    predict: &dyn Fn(&Features<Tensor>) -> Result<Tensor, ModelError>,
    seen: &Features<Tensor>,
    camera: &FeatureSpec,
    picture: Picture,
) -> Result<SalientCamera, ModelError> {
    let (height, width) = (picture.height, picture.width);
    let stride = height.max(width).div_ceil(SQUARES).max(1);
    let side = 2 * stride;
    // what is covered is the picture as the network sees it, which may be painted; what is shown is the camera's
    let own = last_picture(seen, camera, &picture)?;
    let colour = mean_colour(&own);
    let tops = (0..height).step_by(stride);
    let squares: Vec<(usize, usize)> =
        tops.flat_map(|top| (0..width).step_by(stride).map(move |left| (top, left))).collect();
    let clipped = |(top, left): (usize, usize)| (top..(top + side).min(height), left..(left + side).min(width));
    let cover = |square: (usize, usize)| {
        let (rows, columns) = clipped(square);
        let mut rgb = own.rgb.clone();
        for row in rows {
            for pixel in rgb[(row * width + columns.start) * 3..(row * width + columns.end) * 3].chunks_exact_mut(3) {
                pixel.copy_from_slice(&colour);
            }
        }
        rgb
    };
    let moved = |pictures: &[Vec<u8>]| -> Result<Vec<f32>, ModelError> {
        let rows = pictures.len();
        let batch = seen.try_map(|name, tensor| {
            if name != camera.name {
                return repeated(tensor, rows);
            }
            let mut shape = tensor.dims().to_vec();
            shape[0] = rows;
            // of a history the last picture is covered
            let before = tensor.flatten_all()?.to_vec1::<u8>()?;
            let before = &before[..before.len() - picture.rgb.len()];
            let bytes: Vec<u8> = pictures.iter().flat_map(|last| before.iter().chain(last).copied()).collect();
            Tensor::from_vec(bytes, shape, &Device::Cpu)
        })?;
        // asked alike, as many rows at once: a policy that draws noise draws the same for the picture as it is
        let base = predict(&seen.try_map(|_, tensor| repeated(tensor, rows))?)?;
        let difference = predict(&batch)?.sub(&base)?.abs()?;
        Ok(difference.mean((1, 2))?.to_vec1()?)
    };
    let whole = moved(&[colour.repeat(height * width)])?[0];
    let mut values = Vec::with_capacity(squares.len());
    for some in squares.chunks(ROWS) {
        values.extend(moved(&some.iter().map(|&square| cover(square)).collect::<Vec<_>>())?);
    }
    let (mut heat, mut count) = (vec![0.0; height * width], vec![0.0_f32; height * width]);
    for (&square, value) in squares.iter().zip(&values) {
        let (rows, columns) = clipped(square);
        for at in rows.flat_map(|row| columns.clone().map(move |column| row * width + column)) {
            heat[at] += value;
            count[at] += 1.0;
        }
    }
    heat.iter_mut().zip(&count).for_each(|(heat, count)| *heat /= count);
    let best = (0..values.len()).max_by(|&a, &b| values[a].total_cmp(&values[b])).unwrap_or(0);
    let (rows, columns) = clipped(squares[best]);
    let place = ((rows.start + rows.end) / 2, (columns.start + columns.end) / 2);
    let name = camera.name.strip_prefix(IMAGE_PREFIX).unwrap_or(&camera.name).to_owned();
    Ok(SalientCamera { camera: name, whole, most: values[best], place, picture, heat })
}

/// The last picture of `camera` in the one row of `seen`, which is of `picture`'s size.
fn last_picture(seen: &Features<Tensor>, camera: &FeatureSpec, picture: &Picture) -> Result<Picture, ModelError> {
    let bytes = seen.require("saliency", &camera.name)?.flatten_all()?.to_vec1::<u8>()?;
    let rgb = bytes[bytes.len() - picture.rgb.len()..].to_vec();
    Ok(Picture { rgb, ..picture.clone() })
}

/// The one row of `tensor`, `rows` times.
fn repeated(tensor: &Tensor, rows: usize) -> candle_core::Result<Tensor> {
    let mut shape = tensor.dims().to_vec();
    shape[0] = rows;
    tensor.broadcast_as(shape)?.contiguous()
}

fn mean_colour(picture: &Picture) -> [u8; 3] {
    let pixels = (picture.rgb.len() / 3).max(1) as u64;
    std::array::from_fn(|c| {
        let sum: u64 = picture.rgb.iter().skip(c).step_by(3).map(|&x| u64::from(x)).sum();
        ((sum + pixels / 2) / pixels) as u8
    })
}

impl Saliency {
    /// A column a query; for each camera its picture, and below it the same in grey with what matters in red. One scale
    /// for the whole strip: full red is the most that any covered square moved the actions.
    pub fn strip(&self) -> Picture {
        let all = || self.queries.iter().flat_map(|query| &query.cameras);
        let most = all().flat_map(|camera| &camera.heat).fold(f32::MIN_POSITIVE, |most, &x| most.max(x));
        let cameras = self.queries.iter().map(|query| query.cameras.len()).max().unwrap_or(0);
        let mut rows = Vec::new();
        for camera in 0..cameras {
            let of = || self.queries.iter().filter_map(move |query| query.cameras.get(camera));
            rows.push(of().map(|camera| camera.picture.enlarged(SCALE)).collect());
            rows.push(of().map(|camera| camera.overlay(most).enlarged(SCALE)).collect());
        }
        Picture::sheet(&rows, 4)
    }
}

/// Pixels of a strip for one of a picture, in each direction.
const SCALE: usize = 2;

impl SalientCamera {
    fn overlay(&self, most: f32) -> Picture {
        let red = |(pixel, heat): (&[u8], &f32)| {
            let grey = 0.299 * f32::from(pixel[0]) + 0.587 * f32::from(pixel[1]) + 0.114 * f32::from(pixel[2]);
            let share = (heat / most).clamp(0.0, 1.0);
            let mix = |from: f32, to: f32| (from + share * (to - from)).round() as u8;
            [mix(0.6 * grey, 255.0), mix(0.6 * grey, 0.0), mix(0.6 * grey, 0.0)]
        };
        let rgb = self.picture.rgb.chunks_exact(3).zip(&self.heat).flat_map(red).collect();
        Picture { rgb, ..self.picture.clone() }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use candle_core::DType;

    /// Answers with the brightness of the picture's pixel (6, 15), whatever else there is.
    fn one_pixel(seen: &Features<Tensor>) -> Result<Tensor, ModelError> {
        let picture = seen.require("test", "observation.images.front")?;
        let pixel = picture.narrow(1, 6, 1)?.narrow(2, 15, 1)?.to_dtype(DType::F32)?;
        Ok(pixel.flatten_from(1)?.unsqueeze(1)?)
    }

    /// Draws for every row, in order, and adds nothing that it sees.
    fn noise(seen: &Features<Tensor>) -> Result<Tensor, ModelError> {
        let rows = seen.require("test", "observation.images.front")?.dim(0)?;
        let drawn: Vec<f32> = (0..rows).map(|row| (row * 7 % 5) as f32).collect();
        Ok(Tensor::from_vec(drawn, (rows, 1, 1), &Device::Cpu)?)
    }

    fn seen(bytes: &[u8]) -> Features<Tensor> {
        let mut seen = Features::new();
        let bytes = Tensor::from_vec(bytes.to_vec(), (1, 24, 24, 3), &Device::Cpu).unwrap();
        seen.insert("observation.images.front", bytes);
        seen
    }

    #[test]
    fn noise_that_a_policy_draws_is_no_answer_to_what_it_sees() {
        let camera = FeatureSpec::image("observation.images.front", 24, 24);
        let picture = Picture::plain(24, 24, [9; 3]);
        let looked = covered(&noise, &seen(&picture.rgb), &camera, picture).unwrap();
        assert_eq!((looked.whole, looked.most), (0.0, 0.0));
    }

    #[test]
    fn what_is_covered_is_what_the_network_sees() {
        let camera = FeatureSpec::image("observation.images.front", 24, 24);
        // painted in one colour: no cover of that colour changes anything, whatever the camera's picture is
        let mut picture = Picture::plain(24, 24, [0; 3]);
        picture.rgb[(6 * 24 + 15) * 3..][..3].copy_from_slice(&[200, 100, 0]);
        let looked = covered(&one_pixel, &seen(&[50; 24 * 24 * 3]), &camera, picture.clone()).unwrap();
        assert_eq!((looked.whole, looked.most, &looked.picture), (0.0, 0.0, &picture));
    }

    #[test]
    fn what_matters_is_where_it_is() {
        let camera = FeatureSpec::image("observation.images.front", 24, 24);
        let mut picture = Picture::plain(24, 24, [0; 3]);
        picture.rgb[(6 * 24 + 15) * 3..][..3].copy_from_slice(&[200, 100, 0]);
        let mut seen = Features::new();
        let bytes = Tensor::from_vec(picture.rgb.clone(), (1, 24, 24, 3), &Device::Cpu).unwrap();
        seen.insert("observation.state", Tensor::zeros((1, 2), DType::F32, &Device::Cpu).unwrap());
        seen.insert("observation.images.front", bytes);
        let looked = covered(&one_pixel, &seen, &camera, picture).unwrap();
        assert_eq!((looked.camera.as_str(), looked.whole, looked.most), ("front", 100.0, 100.0));
        // squares of 4 pixels every 2: it lies in four of them, the pixels around it in fewer
        let lit = |row: usize, column: usize| looked.heat[row * 24 + column];
        assert_eq!(lit(6, 15), 100.0);
        assert!(lit(4, 13) > 0.0 && lit(4, 13) < 100.0, "{}", lit(4, 13));
        assert_eq!(looked.heat.iter().filter(|&&x| x > 0.0).count(), 36);
        assert!(looked.place.0.abs_diff(6) <= 2 && looked.place.1.abs_diff(15) <= 2, "{:?}", looked.place);
        let query = SalientQuery { step: 0, cameras: vec![looked] };
        let saliency = Saliency {
            entry: "a@1".into(),
            task: "Lift".into(),
            seed: 1,
            success: true,
            steps: 8,
            queries: vec![query.clone(), query],
        };
        let strip = saliency.strip();
        assert_eq!((strip.height, strip.width), (2 * 48 + 4, 2 * 48 + 4));
        let red = |row: usize, column: usize| strip.rgb[(row * strip.width + column) * 3..][..3].to_vec();
        assert_eq!(red(52 + 2 * 6, 2 * 15), [255, 0, 0]);
        assert_eq!(red(52, 0), [0, 0, 0]);
    }

    #[test]
    fn queries_are_spread_evenly() {
        assert_eq!(evenly(6, 8), [0, 1, 2, 3, 4, 5]);
        assert_eq!(evenly(50, 5), [0, 10, 20, 30, 40]);
        assert_eq!(evenly(0, 5), [0_usize; 0]);
    }
}
