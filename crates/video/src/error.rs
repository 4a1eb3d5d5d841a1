//! What can go wrong, with the file, the part of it, what was expected and what was found.

/// Why a video could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum VideoError {
    /// A file operation failed.
    #[error("{name}: cannot {operation}")]
    Io {
        /// The file.
        name: String,
        /// What was attempted, as a verb phrase.
        operation: &'static str,
        /// The system's answer.
        source: std::io::Error,
    },

    /// The file does not begin as MP4 files do.
    #[error("{name}: not an MP4 file: expected a box ftyp first, found {found}")]
    NotMp4 {
        /// The file.
        name: String,
        /// Its first bytes, or that it is empty.
        found: String,
    },

    /// Something reaches beyond the end of the file.
    #[error("{name}: truncated: {object} ends at byte {expected}, the file has {found}")]
    Truncated {
        /// The file.
        name: String,
        /// The box or sample.
        object: String,
        /// Bytes that there should be.
        expected: u64,
        /// Bytes that there are.
        found: u64,
    },

    /// A part of the file is not as it must be.
    #[error("{name}: damaged: {object}: expected {expected}, found {found}")]
    Malformed {
        /// The file.
        name: String,
        /// The box, sample or header.
        object: String,
        /// What belongs there.
        expected: String,
        /// What is there.
        found: String,
    },

    /// A sound file of a kind that is not read.
    #[error("{name}: {what} is not read; AV1 and H.264 with 8 bits and 4:2:0 are")]
    Unsupported {
        /// The file.
        name: String,
        /// The codec, layout or feature by name.
        what: String,
    },

    /// A size that cannot be right, or that is beyond what is read.
    #[error("{name}: {object}: {found} stated, at most {limit} can be read")]
    TooLarge {
        /// The file.
        name: String,
        /// The box, sample or size.
        object: String,
        /// What the file states.
        found: u64,
        /// The bound.
        limit: u64,
    },

    /// The decoder could not make a picture of a sample.
    #[error("{name}: damaged: frame {frame} cannot be decoded: {reason}")]
    Decode {
        /// The file.
        name: String,
        /// The frame, from 0, in the order of the file.
        frame: usize,
        /// The decoder's words.
        reason: String,
    },

    /// A frame that was asked for does not exist.
    #[error("{name}: no {wanted}; there is {found}")]
    NoSuchFrame {
        /// The file.
        name: String,
        /// What was asked for.
        wanted: String,
        /// What there is.
        found: String,
    },

    /// A stretch that cannot be taken out without being encoded again.
    #[error("{name}: frames {from} to {to} cannot be cut out as they are: {reason}")]
    Cut {
        /// The file.
        name: String,
        /// The first frame of the stretch, from 0.
        from: usize,
        /// Its last frame.
        to: usize,
        /// Why.
        reason: String,
    },

    /// Pictures that cannot be encoded.
    #[error("images of {width} x {height} at {fps} frames a second cannot be encoded: {reason}")]
    Encode {
        /// Pixels in a row.
        width: usize,
        /// Rows.
        height: usize,
        /// Frames a second.
        fps: f64,
        /// What does not fit.
        reason: String,
    },
}

/// Result of this library.
pub type Result<T, E = VideoError> = std::result::Result<T, E>;
