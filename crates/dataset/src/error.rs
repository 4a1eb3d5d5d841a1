//! What can go wrong: one enum for the library, one for everything that is wrong with an input file.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// Why an operation on a data set failed.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The demonstrations file that was given cannot be used; the text says what is wrong and where.
    #[error(transparent)]
    Input(#[from] InputError),

    /// The output path exists; nothing is ever overwritten.
    #[error("{path}: exists already; choose another path or remove it first", path = path.display())]
    OutputExists {
        /// The path that exists.
        path: PathBuf,
    },

    /// Whoever asked for a conversion wanted no more of it.
    #[error("{path}: the conversion was stopped", path = path.display())]
    Stopped {
        /// What was to be converted.
        path: PathBuf,
    },

    /// Pictures could not be encoded.
    #[error(transparent)]
    Video(#[from] video::VideoError),

    /// FFmpeg is to encode and cannot.
    #[error("FFmpeg cannot be used: {reason}; --video-encoder builtin needs none")]
    Ffmpeg {
        /// Which program, and why.
        reason: String,
    },

    /// A file operation failed.
    #[error("{path}: cannot {operation}", path = path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What was attempted, as a verb phrase.
        operation: &'static str,
        /// The system's answer.
        source: std::io::Error,
    },

    /// libhdf5 refused to write an object.
    #[error("{path}: cannot write {object}", path = path.display())]
    Hdf5Write {
        /// The file being written.
        path: PathBuf,
        /// The group, dataset or attribute inside it.
        object: String,
        /// The library's answer.
        source: ::hdf5::Error,
    },

    /// A Parquet file could not be written or read.
    #[error("{path}: cannot {operation}", path = path.display())]
    Parquet {
        /// The file.
        path: PathBuf,
        /// What was attempted, as a verb phrase.
        operation: &'static str,
        /// The Parquet library's answer.
        source: parquet::errors::ParquetError,
    },

    /// A JSON file could not be written or read.
    #[error("{path}: not the JSON that belongs there", path = path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// The parser's answer, with line and column.
        source: serde_json::Error,
    },

    /// Something in a data set is not as it must be.
    #[error("{path}: {object}: expected {expected}, found {found}", path = path.display())]
    BadDataset {
        /// The data set, or a file of it.
        path: PathBuf,
        /// The column, episode or entry.
        object: String,
        /// What belongs there.
        expected: String,
        /// What is there.
        found: String,
    },

    /// An argument asks for something that a data set does not have.
    #[error("{path}: no {wanted}; there is {found}", path = path.display())]
    NotInDataset {
        /// The data set.
        path: PathBuf,
        /// What was asked for.
        wanted: String,
        /// What there is.
        found: String,
    },

    /// A tree that was handed over for writing contradicts itself.
    #[error("{path}: {object} cannot be written: {reason}", path = path.display())]
    BadTree {
        /// The file being written.
        path: PathBuf,
        /// The group, dataset or attribute inside it.
        object: String,
        /// What does not fit, with the expected and the found value.
        reason: String,
    },
}

/// What is wrong with an input file. Plain data, so that it crosses from the reading process unchanged.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
pub enum InputError {
    /// There is nothing at the path.
    #[error("{path}: no such file or folder", path = path.display())]
    NotFound {
        /// The path that was given.
        path: PathBuf,
    },

    /// The system would not let us read.
    #[error("{path}: cannot read: {reason}", path = path.display())]
    Unreadable {
        /// The path that was given.
        path: PathBuf,
        /// The system's words.
        reason: String,
    },

    /// The file has no HDF5 signature.
    #[error("{path}: not an HDF5 file: expected the HDF5 signature, found {found}", path = path.display())]
    NotHdf5 {
        /// The file.
        path: PathBuf,
        /// Its first bytes, or that it is empty.
        found: String,
    },

    /// git-lfs left a pointer where the file belongs.
    #[error("{path}: a git-lfs pointer, not the file itself; run `git lfs pull` to download it", path = path.display())]
    LfsPointer {
        /// The file.
        path: PathBuf,
    },

    /// The file ends before the length that its own header states.
    #[error("{path}: truncated: its header states {expected} bytes, the file has {found}", path = path.display())]
    Truncated {
        /// The file.
        path: PathBuf,
        /// Bytes that the header states.
        expected: u64,
        /// Bytes that there are.
        found: u64,
    },

    /// The HDF5 library could not make sense of an object.
    #[error("{path}: damaged: cannot {operation} {object}: {reason}", path = path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The group, dataset or attribute.
        object: String,
        /// What was attempted.
        operation: String,
        /// The library's words.
        reason: String,
    },

    /// HDF5, but of no layout that is known here.
    #[error("{path}: no known layout of demonstrations: expected {expected}; found {found}", path = path.display())]
    UnknownLayout {
        /// The file or folder.
        path: PathBuf,
        /// What would have been recognised.
        expected: String,
        /// What is there.
        found: String,
    },

    /// The group `data` holds no demonstration.
    #[error("{path}: group data holds no demo_<number>; found {found}", path = path.display())]
    NoDemos {
        /// The file.
        path: PathBuf,
        /// What is there.
        found: String,
    },

    /// A demo lacks a dataset or a group.
    #[error("{path}: {demo}: no {key}; found {found}", path = path.display())]
    MissingKey {
        /// The file.
        path: PathBuf,
        /// The demo's id.
        demo: String,
        /// The missing key.
        key: String,
        /// The keys that are there.
        found: String,
    },

    /// A list of observation keys that cannot become a column.
    #[error("{path}: {column}: {reason}", path = path.display())]
    ObservationKeys {
        /// The file.
        path: PathBuf,
        /// The column.
        column: String,
        /// What is wrong.
        reason: String,
    },

    /// A dataset of a demo has another length than the demo.
    #[error("{path}: {demo}: {key}: expected {expected} steps, found {found}", path = path.display())]
    WrongLength {
        /// The file.
        path: PathBuf,
        /// The demo's id.
        demo: String,
        /// The dataset.
        key: String,
        /// The demo's length, and where it was read.
        expected: String,
        /// The dataset's shape.
        found: String,
    },

    /// A dataset has an unexpected rank or element type.
    #[error("{path}: {demo}: {key}: expected {expected}, found {found}", path = path.display())]
    WrongShape {
        /// The file.
        path: PathBuf,
        /// The demo's id.
        demo: String,
        /// The dataset.
        key: String,
        /// What is needed.
        expected: String,
        /// What is there.
        found: String,
    },

    /// A value is NaN, infinite or, where it goes into a float32 column, too large for one.
    #[error("{path}: {demo}: {key}: step {step}, dimension {dimension}: expected a finite number, found {found}", path = path.display())]
    NotFinite {
        /// The file.
        path: PathBuf,
        /// The demo's id.
        demo: String,
        /// The dataset.
        key: String,
        /// The step, from 0.
        step: usize,
        /// The dimension, from 0.
        dimension: usize,
        /// The value.
        found: String,
    },

    /// An attribute is missing or has a value that cannot be used.
    #[error("{path}: {object}: attribute {attribute}: expected {expected}, found {found}", path = path.display())]
    BadAttribute {
        /// The file.
        path: PathBuf,
        /// The group or dataset.
        object: String,
        /// The attribute.
        attribute: String,
        /// What is needed.
        expected: String,
        /// What is there.
        found: String,
    },

    /// An element type, link or storage that is not read.
    #[error("{path}: {object}: {what} is not supported", path = path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// The group, dataset or attribute.
        object: String,
        /// The type, link or storage in words.
        what: String,
    },

    /// A dataset or a link that cannot be followed to its values.
    #[error("{path}: {object} cannot be read: {reason}", path = path.display())]
    Unavailable {
        /// The file.
        path: PathBuf,
        /// The dataset or link.
        object: String,
        /// Why, and what to do.
        reason: String,
    },

    /// A size that cannot be right, or that is beyond what one call may return.
    #[error("{path}: {object}: {bytes} bytes stated, at most {limit} can be right", path = path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// The group, dataset or attribute.
        object: String,
        /// Bytes that the file states.
        bytes: u64,
        /// The bound.
        limit: u64,
    },

    /// A video cannot be used; the text names the file, what was expected and what was found.
    #[error("{text}")]
    Video {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        text: String,
    },

    /// A demo, key or range that was asked for does not exist.
    #[error("{path}: no {wanted}; there is {found}", path = path.display())]
    NoSuch {
        /// The file.
        path: PathBuf,
        /// What was asked for.
        wanted: String,
        /// What there is.
        found: String,
    },

    /// The demonstrations have no observations.
    #[error("{path}: no observations: {advice}", path = path.display())]
    NoObservations {
        /// The file.
        path: PathBuf,
        /// How to get them.
        advice: String,
    },

    /// The reading process ended without an answer: the file crashed the library that reads its kind, or took more than it may.
    #[error("{path}: the process that reads it {how} while it was to {during}", path = path.display())]
    ReaderDied {
        /// The file.
        path: PathBuf,
        /// What it was doing.
        during: String,
        /// Its exit code or signal in words.
        how: String,
    },

    /// The reading process gave no answer in time.
    #[error("{path}: damaged or on a device that does not answer: no answer in {seconds} s while it was to {during}", path = path.display())]
    ReaderSilent {
        /// The file.
        path: PathBuf,
        /// What it was doing.
        during: String,
        /// How long was waited.
        seconds: u64,
    },

    /// The reading process could not be started, or it is not ours.
    #[error("{path}: cannot start the reading process: {reason}", path = path.display())]
    ReaderStart {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
}

impl InputError {
    /// The demo that is at fault, where it is one.
    pub fn demo(&self) -> Option<&str> {
        match self {
            Self::MissingKey { demo, .. }
            | Self::WrongLength { demo, .. }
            | Self::WrongShape { demo, .. }
            | Self::NotFinite { demo, .. } => Some(demo),
            _ => None,
        }
    }
}

/// Result of this library.
pub type Result<T, E = DatasetError> = std::result::Result<T, E>;
