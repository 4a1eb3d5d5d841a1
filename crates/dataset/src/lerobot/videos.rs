//! Videos of a data set that is being written: a file a camera holds many episodes, as LeRobot has it.

use super::features::{Column, VideoOptions};
use super::info::{FILES_PER_FOLDER, Features};
use super::shards::{HashingFile, WrittenFile, create_parent};
use crate::error::{DatasetError, Result};
use crate::ffmpeg::{self, Encoding};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::path::Path;
use video::{EncodeOptions, Encoder, Muxer, Rate, Sample, Video, VideoError};

/// Where videos lie, in Python's format language, as the format wants it.
pub(crate) const VIDEO_PATH: &str = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4";

/// What encodes, as it is recorded.
pub(crate) const ENCODER: &str = "rav1e 0.8.1";

/// Where an episode's video went.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Stretch {
    pub folder: usize,
    pub file: usize,
    /// Seconds within the file.
    pub from: f64,
    pub to: f64,
}

/// Encodes pictures one after the other; a stretch of them can be decoded by itself.
pub(crate) struct Camera {
    size: (usize, usize),
    rate: Rate,
    encoder: Making,
}

enum Making {
    Builtin(Box<Encoder>),
    Ffmpeg(Encoding),
}

impl Camera {
    pub fn new(column: &Column, fps: f64, options: &VideoOptions) -> Result<Self> {
        let (height, width) = (column.feature.shape[0], column.feature.shape[1]);
        let rate = rate(fps, width, height)?;
        let encoder = match ffmpeg::chosen(options.encoder)? {
            Some(chosen) => Making::Ffmpeg(Encoding::new(chosen, (width, height), rate, options)?),
            None => {
                let &VideoOptions { speed, quantizer, key_interval, .. } = options;
                let settings = EncodeOptions { speed, quantizer, key_interval };
                Making::Builtin(Box::new(Encoder::new(width, height, rate, &settings)?))
            }
        };
        Ok(Self { size: (height, width), rate, encoder })
    }

    pub fn push(&mut self, rgb: &[u8]) -> Result<()> {
        match &mut self.encoder {
            Making::Builtin(encoder) => Ok(encoder.push(rgb)?),
            Making::Ffmpeg(encoding) => encoding.push(rgb),
        }
    }

    /// The samples, and sha256 of each picture as a reader will get it.
    pub fn finish(self) -> Result<(Vec<Sample>, Vec<[u8; 32]>)> {
        let samples = match self.encoder {
            Making::Builtin(encoder) => encoder.finish()?,
            Making::Ffmpeg(encoding) => encoding.finish()?,
        };
        let (height, width) = self.size;
        let mut muxer = Muxer::new(width as u16, height as u16, self.rate);
        samples.iter().try_for_each(|s| muxer.push(s))?;
        let mut file = muxer.header();
        samples.iter().for_each(|s| file.extend_from_slice(&s.bytes));
        let mut digests = Vec::with_capacity(samples.len());
        if !samples.is_empty() {
            for frame in Video::from_bytes("what was just encoded", file)?.frames() {
                digests.push(Sha256::digest(frame?.rgb).into());
            }
        }
        Ok((samples, digests))
    }
}

/// The rate as a fraction that a file can count in.
pub(crate) fn rate(fps: f64, width: usize, height: usize) -> Result<Rate> {
    let reason = "the rate is no fraction with a denominator up to 100 or 1001".to_owned();
    Ok(Rate::of(fps).ok_or(VideoError::Encode { width, height, fps, reason })?)
}

/// The files that are open: one a camera.
pub(crate) struct VideoWriter<'a> {
    root: &'a Path,
    limit: u64,
    cameras: BTreeMap<usize, Open>,
    finished: Vec<WrittenFile>,
}

struct Open {
    name: String,
    size: (u16, u16),
    rate: Rate,
    number: usize,
    muxer: Muxer,
    /// The samples, until it is known what stands before them.
    spool: File,
}

impl Open {
    fn relative(&self) -> String {
        let (folder, file) = (self.number / FILES_PER_FOLDER, self.number % FILES_PER_FOLDER);
        format!("videos/{}/chunk-{folder:03}/file-{file:03}.mp4", self.name)
    }
}

impl<'a> VideoWriter<'a> {
    /// `limit` is the size in bytes at which a file is closed.
    pub fn new(root: &'a Path, limit: u64, features: &Features, fps: f64) -> Result<Self> {
        let mut cameras = BTreeMap::new();
        for (index, (name, feature)) in features.0.iter().enumerate().filter(|(_, (_, f))| f.dtype == "video") {
            let (height, width) = (feature.shape[0], feature.shape[1]);
            let rate = rate(fps, width, height)?;
            // the encoder refuses sides that do not fit
            let size = (width as u16, height as u16);
            let muxer = Muxer::new(size.0, size.1, rate);
            cameras.insert(index, Open { name: name.clone(), size, rate, number: 0, muxer, spool: spool(root)? });
        }
        Ok(Self { root, limit, cameras, finished: Vec::new() })
    }

    /// Appends the video of an episode of the camera in column `index`.
    pub fn append(&mut self, index: usize, samples: &[Sample]) -> Result<Stretch> {
        let camera = self.cameras.get_mut(&index).expect("every column of videos has its writer");
        let bytes: u64 = samples.iter().map(|s| s.bytes.len() as u64).sum();
        if camera.muxer.frames() > 0 && camera.muxer.bytes() + bytes >= self.limit {
            self.finished.push(close(self.root, camera)?);
            camera.number += 1;
            camera.muxer = Muxer::new(camera.size.0, camera.size.1, camera.rate);
            camera.spool = spool(self.root)?;
        }
        let from = camera.rate.seconds(camera.muxer.frames());
        for sample in samples {
            camera.muxer.push(sample)?;
            camera.spool.write_all(&sample.bytes).map_err(failed(self.root, "write a temporary file in it"))?;
        }
        let to = camera.rate.seconds(camera.muxer.frames());
        Ok(Stretch { folder: camera.number / FILES_PER_FOLDER, file: camera.number % FILES_PER_FOLDER, from, to })
    }

    /// Closes the last files; returns all of them.
    pub fn finish(mut self) -> Result<Vec<WrittenFile>> {
        for camera in self.cameras.values_mut() {
            self.finished.push(close(self.root, camera)?);
        }
        Ok(self.finished)
    }
}

fn failed(path: &Path, operation: &'static str) -> impl FnOnce(io::Error) -> DatasetError {
    let path = path.to_path_buf();
    move |source| DatasetError::Io { path, operation, source }
}

fn spool(root: &Path) -> Result<File> {
    tempfile::tempfile_in(root).map_err(failed(root, "create a temporary file in it"))
}

fn close(root: &Path, camera: &mut Open) -> Result<WrittenFile> {
    let relative = camera.relative();
    let path = root.join(&relative);
    create_parent(&path)?;
    let mut file = HashingFile::create(&path)?;
    let mut copy = || {
        file.write_all(&camera.muxer.header())?;
        camera.spool.seek(SeekFrom::Start(0))?;
        io::copy(&mut camera.spool, &mut file)
    };
    copy().map_err(failed(&path, "write it"))?;
    Ok(file.written(&relative))
}
