//! A whole recorded episode: what it is, and its form as one piece of bytes.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::frame::{Frame, FrameError, FrameTensor};

/// A whole episode as the harness recorded or replayed it.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordedEpisode {
    /// Whether the task was done in it.
    pub success: bool,
    /// Its length in control steps.
    pub steps: usize,
    /// The demo's attributes, such as `model_file`.
    pub attrs: BTreeMap<String, serde_json::Value>,
    /// Arrays by their name in a robomimic demo, such as `actions` or `obs/object`.
    pub tensors: BTreeMap<String, FrameTensor>,
}

/// What goes beside the arrays.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    success: bool,
    steps: usize,
    attrs: BTreeMap<String, serde_json::Value>,
}

impl RecordedEpisode {
    /// The episode as safetensors, the same bytes for the same episode.
    ///
    /// # Errors
    /// Arrays whose bytes do not fit their shape.
    pub fn into_bytes(self) -> Result<Vec<u8>, FrameError> {
        let Self { success, steps, attrs, tensors } = self;
        let mut frame = Frame::new(&Header { success, steps, attrs })?;
        frame.tensors = tensors;
        Ok(frame.encode()?.split_off(Frame::PREFIX))
    }

    /// The episode that [`Self::into_bytes`] made bytes of.
    ///
    /// # Errors
    /// Bytes that are something else.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, FrameError> {
        let frame = Frame::decode(bytes)?;
        let Header { success, steps, attrs } = frame.parse()?;
        Ok(Self { success, steps, attrs, tensors: frame.tensors })
    }
}
