//! Images to a video file, through the encoder that comes with the harness's Python.

use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};

use tempfile::NamedTempFile;

use crate::error::RolloutError;
use crate::harness::{Python, harness_folder};
use crate::worker::Image;

/// Writes `images` as an MPEG-4 file with `rate` images a second. The file appears when it is whole.
///
/// # Errors
/// [`RolloutError::Video`] for no images, images of different sizes, or an encoder that fails.
pub fn write(python: &Python, path: &Path, images: &[Image], rate: f64) -> Result<(), RolloutError> {
    let failed = |problem: &str| RolloutError::Video { path: path.to_owned(), problem: problem.to_owned() };
    let first = images.first().ok_or_else(|| failed("no images"))?;
    let mut encoder = Encoder::start(python, path, (first.height, first.width), rate)?;
    images.iter().try_for_each(|image| encoder.push(image))?;
    encoder.finish()
}

/// A video under way, for images that come one after the other.
pub struct Encoder {
    path: PathBuf,
    size: (usize, usize),
    temporary: NamedTempFile,
    process: Child,
    stdin: Option<ChildStdin>,
}

impl Encoder {
    /// Starts the encoder of a video at `path` with images of `size` (rows, columns), `rate` of them a second.
    ///
    /// # Errors
    /// A folder that cannot be written to, an encoder that does not start.
    pub fn start(python: &Python, path: &Path, size: (usize, usize), rate: f64) -> Result<Self, RolloutError> {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let temporary = tempfile::Builder::new()
            .prefix(".video-")
            .suffix(".mp4")
            .permissions(std::os::unix::fs::PermissionsExt::from_mode(0o644))
            .tempfile_in(folder)
            .map_err(file_error(path))?;
        let (height, width) = size;
        let mut process = Command::new(&python.path)
            .args(["-m", "actrm_harness.video"])
            .arg(temporary.path())
            .args([width.to_string(), height.to_string(), rate.to_string()])
            .env("PYTHONPATH", harness_folder()?)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|source| RolloutError::Spawn { program: python.path.clone(), source })?;
        let stdin = process.stdin.take();
        Ok(Self { path: path.to_owned(), size, temporary, process, stdin })
    }

    fn failed(&self, problem: String) -> RolloutError {
        RolloutError::Video { path: self.path.clone(), problem }
    }

    /// Adds an image.
    ///
    /// # Errors
    /// An image of another size, an encoder that has ended.
    pub fn push(&mut self, image: &Image) -> Result<(), RolloutError> {
        let (height, width) = self.size;
        if (image.height, image.width) != self.size {
            let (h, w) = (image.height, image.width);
            return Err(self.failed(format!("expected images of {height}x{width}, found {h}x{w}")));
        }
        let Some(stdin) = &mut self.stdin else { return Err(self.ended()) };
        if stdin.write_all(&image.rgb).is_err() {
            // it died and says why; its words matter more than the broken pipe
            self.stdin = None;
            return Err(self.ended());
        }
        Ok(())
    }

    /// Why the encoder ended, as it says.
    fn ended(&mut self) -> RolloutError {
        match self.wait() {
            Err(error) => error,
            Ok(()) => self.failed("the encoder ended before the last image".to_owned()),
        }
    }

    fn wait(&mut self) -> Result<(), RolloutError> {
        self.stdin = None;
        let mut said = String::new();
        if let Some(mut stderr) = self.process.stderr.take() {
            let _ = stderr.read_to_string(&mut said);
        }
        let status = self.process.wait().map_err(file_error(&self.path))?;
        if !status.success() {
            let last = said.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("no message");
            return Err(self.failed(format!("the encoder failed ({status}): {last}")));
        }
        Ok(())
    }

    /// Ends the video; the file appears.
    ///
    /// # Errors
    /// An encoder that failed, a file that cannot be written.
    pub fn finish(mut self) -> Result<(), RolloutError> {
        self.wait()?;
        let Self { path, temporary, .. } = self;
        temporary.as_file().sync_all().map_err(file_error(&path))?;
        temporary.persist(&path).map_err(|error| file_error(&path)(error.error))?;
        Ok(())
    }
}

fn file_error(path: &Path) -> impl FnOnce(std::io::Error) -> RolloutError {
    let path = path.to_owned();
    move |source| RolloutError::File { operation: "writing video", path, source }
}
