//! Images to a video file, through the encoder that comes with the harness's Python.

use std::io::{Read, Write};
use std::path::Path;
use std::process::{Command, Stdio};

use super::error::RolloutError;
use super::harness::{Python, harness_folder};
use super::worker::Image;

/// Writes `images` as an MPEG-4 file with `rate` images a second. The file appears when it is whole.
///
/// # Errors
/// [`RolloutError::Video`] for no images, images of different sizes, or an encoder that fails.
pub fn write(python: &Python, path: &Path, images: &[Image], rate: f64) -> Result<(), RolloutError> {
    let failed = |problem: String| RolloutError::Video { path: path.to_owned(), problem };
    let first = images.first().ok_or_else(|| failed("no images".to_owned()))?;
    let (height, width) = (first.height, first.width);
    if let Some(other) = images.iter().find(|image| (image.height, image.width) != (height, width)) {
        let (h, w) = (other.height, other.width);
        return Err(failed(format!("expected images of {height}x{width}, found {h}x{w}")));
    }
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let file = |source| RolloutError::File { operation: "writing video", path: path.to_owned(), source };
    let temporary = tempfile::Builder::new().prefix(".video-").suffix(".mp4").tempfile_in(folder).map_err(file)?;
    let mut encoder = Command::new(&python.path)
        .args(["-m", "actrm_harness.video"])
        .arg(temporary.path())
        .args([width.to_string(), height.to_string(), rate.to_string()])
        .env("PYTHONPATH", harness_folder()?)
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|source| RolloutError::Spawn { program: python.path.clone(), source })?;
    let mut stdin = encoder.stdin.take().expect("stdin is piped");
    let written = images.iter().try_for_each(|image| stdin.write_all(&image.rgb));
    drop(stdin);
    let mut said = String::new();
    // an encoder that died says why; its words matter more than the broken pipe
    let _ = encoder.stderr.take().expect("stderr is piped").read_to_string(&mut said);
    let status = encoder.wait().map_err(file)?;
    if !status.success() {
        let last = said.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("no message");
        return Err(failed(format!("the encoder failed ({status}): {last}")));
    }
    written.and_then(|()| temporary.as_file().sync_all()).map_err(file)?;
    temporary.persist(path).map_err(|error| file(error.error))?;
    Ok(())
}
