//! Images of a simulator to a video that browsers play: AV1 in MP4.

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use rollout::Image;
use video::{EncodeOptions, Encoder, Muxer, Rate};

/// For people who look, not for training: fewer key frames than data sets have, finer pictures.
const OPTIONS: EncodeOptions = EncodeOptions { speed: 10, quantizer: 60, key_interval: 20 };

/// A video under way, for images that come one after the other.
pub struct VideoWriter {
    path: PathBuf,
    size: (usize, usize),
    rate: Rate,
    encoder: Encoder,
}

impl VideoWriter {
    /// Starts a video at `path` with images of `size` (rows, columns), `rate` of them a second.
    ///
    /// # Errors
    /// A size or a rate that no video has.
    pub fn begin(path: &Path, size: (usize, usize), rate: f64) -> Result<Self> {
        let shown = crate::shown(path);
        let Some(rate) = Rate::of(rate) else {
            bail!(
                "video {shown}: frames per second: expected a fraction with a denominator of 1 to 100 or 1001, found {rate}"
            )
        };
        let encoder = Encoder::new(size.1, size.0, rate, &OPTIONS).with_context(|| format!("video {shown}"))?;
        Ok(Self { path: path.to_owned(), size, rate, encoder })
    }

    /// Adds a picture.
    ///
    /// # Errors
    /// A picture of another size, an encoder that fails.
    pub fn push(&mut self, image: &Image) -> Result<()> {
        let (height, width) = self.size;
        if (image.height, image.width) != self.size {
            let (h, w) = (image.height, image.width);
            bail!("video {}: expected images of {height}x{width}, found {h}x{w}", crate::shown(&self.path));
        }
        self.encoder.push(&image.rgb).with_context(|| format!("video {}", crate::shown(&self.path)))
    }

    /// Ends the video; the file appears when it is whole.
    ///
    /// # Errors
    /// No pictures, an encoder that fails, a file that cannot be written.
    pub fn finish(self) -> Result<()> {
        let Self { path, size: (height, width), rate, encoder } = self;
        let shown = crate::shown(&path);
        let samples = encoder.finish().with_context(|| format!("video {shown}"))?;
        if samples.is_empty() {
            bail!("video {shown}: no images");
        }
        let mut muxer = Muxer::new(u16::try_from(width)?, u16::try_from(height)?, rate);
        samples.iter().try_for_each(|sample| muxer.push(sample)).with_context(|| format!("video {shown}"))?;
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let _parents = crate::make_parent(&path)?;
        let written = || -> std::io::Result<()> {
            let mut file = tempfile::Builder::new()
                .prefix(".video-")
                .permissions(std::os::unix::fs::PermissionsExt::from_mode(0o644))
                .tempfile_in(folder)?;
            file.write_all(&muxer.header())?;
            samples.iter().try_for_each(|sample| file.write_all(&sample.bytes))?;
            file.as_file().sync_all()?;
            file.persist(&path)?;
            Ok(())
        };
        written().with_context(|| format!("writing video {shown}"))
    }
}

/// Writes images of one size as a video, `rate` of them a second.
///
/// # Errors
/// As [`VideoWriter`].
pub fn write_video(path: &Path, images: &[Image], rate: f64) -> Result<()> {
    let Some(first) = images.first() else { bail!("video {}: no images", crate::shown(path)) };
    let mut video = VideoWriter::begin(path, (first.height, first.width), rate)?;
    images.iter().try_for_each(|image| video.push(image))?;
    video.finish()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use video::{Codec, Video};

    #[test]
    fn a_video_is_av1_that_our_reader_opens() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mp4");
        let image = |k: u8| Image { height: 32, width: 48, rgb: [k * 20, 100, 200 - k * 20].repeat(32 * 48) };
        let images: Vec<Image> = (0..5).map(image).collect();
        write_video(&path, &images, 20.0).unwrap();
        let video = Video::open(&path).unwrap();
        let info = video.info();
        assert_eq!((info.codec, info.width, info.height, info.frames), (Codec::Av1, 48, 32, 5));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
        let error = |result: Result<()>| format!("{:#}", result.unwrap_err());
        assert!(error(write_video(&path, &[], 20.0)).contains("no images"));
        let other = Image { height: 16, width: 16, rgb: vec![0; 768] };
        assert!(error(write_video(&path, &[image(0), other], 20.0)).contains("expected images of 32x48"));
        let odd = Image { height: 33, width: 48, rgb: vec![0; 33 * 48 * 3] };
        assert!(error(write_video(&path, &[odd], 20.0)).contains("odd"));
        assert!(error(write_video(&path, &images, 23.987_65)).contains("1 to 100 or 1001, found 23.98765"));
    }
}
