//! One frame of the pipe between a worker and us: a little-endian `u64` byte length, then that many
//! bytes of safetensors whose metadata holds one key, `actrm`, with the message as JSON.
//!
//! Parsing trusts nothing: a length beyond [`MAX_FRAME_BYTES`], a body that is not safetensors, a
//! header that is not the one key, or JSON that does not parse is an error, never a panic and never
//! an allocation larger than the limit.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};

use safetensors::tensor::View;
use safetensors::{Dtype, SafeTensors};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// The largest body that either side may send: 2 GiB, an episode of 2700 steps with two 256 x 256 images.
pub const MAX_FRAME_BYTES: u64 = 2 << 30;

/// The key of the message in the safetensors metadata.
pub const MESSAGE_KEY: &str = "actrm";

/// Why bytes are not a frame.
#[derive(Debug, thiserror::Error)]
pub enum FrameError {
    /// The announced length is beyond the limit: usually text printed into the pipe.
    #[error("frame announces {found} bytes, expected at most {limit} (first bytes: {head:?})")]
    TooLong {
        /// Announced length.
        found: u64,
        /// Largest length allowed.
        limit: u64,
        /// The eight bytes read as a length, as text.
        head: String,
    },
    /// The body is not safetensors.
    #[error("frame of {bytes} bytes is not safetensors")]
    Body {
        /// Length of the body.
        bytes: usize,
        /// What the parser said.
        source: safetensors::SafeTensorError,
    },
    /// The metadata is not the single key `actrm`.
    #[error("frame metadata: expected the one key \"actrm\", found {found:?}")]
    Metadata {
        /// The keys that are there, sorted.
        found: Vec<String>,
    },
    /// The message is not the JSON that the protocol defines.
    #[error("frame message is not valid: {message}")]
    Message {
        /// The message's first 200 characters.
        message: String,
        /// What the parser said.
        source: serde_json::Error,
    },
    /// A tensor that the message needs is absent.
    #[error("frame lacks tensor {name:?}, found {found:?}")]
    MissingTensor {
        /// Name of the tensor.
        name: String,
        /// Names that are there.
        found: Vec<String>,
    },
    /// A tensor has another type or shape than the protocol says.
    #[error("tensor {name:?}: expected {expected}, found {found}")]
    Misshapen {
        /// Name of the tensor.
        name: String,
        /// Expected type and shape.
        expected: String,
        /// Found type and shape.
        found: String,
    },
}

/// A named array of a frame: little-endian, row-major, owned.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameTensor {
    /// Element type.
    pub dtype: Dtype,
    /// Extents, outermost first; empty for a scalar.
    pub shape: Vec<usize>,
    /// Little-endian elements, row-major.
    pub bytes: Vec<u8>,
}

impl FrameTensor {
    /// A tensor of `f64` values.
    pub fn from_f64(shape: &[usize], values: &[f64]) -> Self {
        debug_assert_eq!(shape.iter().product::<usize>(), values.len());
        let bytes = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        Self { dtype: Dtype::F64, shape: shape.to_vec(), bytes }
    }

    /// The values, if the element type is `f64`.
    ///
    /// # Errors
    /// [`FrameError::Misshapen`] for any other element type.
    pub fn to_f64(&self, name: &str) -> Result<Vec<f64>, FrameError> {
        Ok(self.words(name, Dtype::F64)?.iter().map(|word| f64::from_le_bytes(*word)).collect())
    }

    /// The values, if the element type is `i64`.
    ///
    /// # Errors
    /// [`FrameError::Misshapen`] for any other element type.
    pub fn to_i64(&self, name: &str) -> Result<Vec<i64>, FrameError> {
        Ok(self.words(name, Dtype::I64)?.iter().map(|word| i64::from_le_bytes(*word)).collect())
    }

    /// The elements of eight bytes, if they are of this type.
    fn words(&self, name: &str, expected: Dtype) -> Result<&[[u8; 8]], FrameError> {
        if self.dtype != expected {
            return Err(FrameError::Misshapen {
                name: name.to_owned(),
                expected: format!("{expected:?}"),
                found: format!("{:?}", self.dtype),
            });
        }
        Ok(self.bytes.as_chunks::<8>().0)
    }
}

struct Borrowed<'a>(&'a FrameTensor);

impl View for Borrowed<'_> {
    fn dtype(&self) -> Dtype {
        self.0.dtype
    }
    fn shape(&self) -> &[usize] {
        &self.0.shape
    }
    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Borrowed(&self.0.bytes)
    }
    fn data_len(&self) -> usize {
        self.0.bytes.len()
    }
}

/// A message with its tensors.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Frame {
    /// The message, JSON.
    pub message: String,
    /// Tensors by name.
    pub tensors: BTreeMap<String, FrameTensor>,
}

impl Frame {
    /// Bytes of the length before the body.
    pub const PREFIX: usize = 8;

    /// A frame of a message without tensors.
    ///
    /// # Errors
    /// [`FrameError::Message`] if the message cannot be written as JSON.
    pub fn new<M: Serialize>(message: &M) -> Result<Self, FrameError> {
        let message =
            serde_json::to_string(message).map_err(|source| FrameError::Message { message: String::new(), source })?;
        Ok(Self { message, tensors: BTreeMap::new() })
    }

    /// Length prefix and body, ready for the pipe.
    ///
    /// # Errors
    /// [`FrameError::Body`] if a tensor's bytes do not match its shape,
    /// [`FrameError::TooLong`] beyond [`MAX_FRAME_BYTES`].
    pub fn encode(&self) -> Result<Vec<u8>, FrameError> {
        let metadata = HashMap::from([(MESSAGE_KEY.to_owned(), self.message.clone())]);
        let views = self.tensors.iter().map(|(name, tensor)| (name.as_str(), Borrowed(tensor)));
        let body =
            safetensors::serialize(views, Some(metadata)).map_err(|source| FrameError::Body { bytes: 0, source })?;
        let length = checked_length((body.len() as u64).to_le_bytes())?;
        let mut bytes = Vec::with_capacity(8 + length);
        bytes.extend_from_slice(&(length as u64).to_le_bytes());
        bytes.extend_from_slice(&body);
        Ok(bytes)
    }

    /// Parses a body (without its length prefix).
    ///
    /// # Errors
    /// [`FrameError::Body`] or [`FrameError::Metadata`].
    pub fn decode(body: &[u8]) -> Result<Self, FrameError> {
        let broken = |source| FrameError::Body { bytes: body.len(), source };
        let (length, header) = SafeTensors::read_metadata(body).map_err(broken)?;
        let mut keys: Vec<String> = header.metadata().iter().flat_map(|map| map.keys().cloned()).collect();
        keys.sort();
        let message = match header.metadata().as_ref().and_then(|map| map.get(MESSAGE_KEY)) {
            Some(message) if keys.len() == 1 => message.clone(),
            _ => return Err(FrameError::Metadata { found: keys }),
        };
        // the header was checked against the body's length: its offsets lie inside
        let data = &body[8 + length..];
        let tensors = header
            .tensors()
            .into_iter()
            .map(|(name, info)| {
                let (begin, end) = info.data_offsets;
                let bytes = data[begin..end].to_vec();
                (name, FrameTensor { dtype: info.dtype, shape: info.shape.clone(), bytes })
            })
            .collect();
        Ok(Self { message, tensors })
    }

    /// The message as a type of the protocol.
    ///
    /// # Errors
    /// [`FrameError::Message`] if it is something else.
    pub fn parse<M: DeserializeOwned>(&self) -> Result<M, FrameError> {
        serde_json::from_str(&self.message)
            .map_err(|source| FrameError::Message { message: self.message.chars().take(200).collect(), source })
    }

    /// A tensor by name.
    ///
    /// # Errors
    /// [`FrameError::MissingTensor`], with the names that are there.
    pub fn tensor(&self, name: &str) -> Result<&FrameTensor, FrameError> {
        self.tensors.get(name).ok_or_else(|| FrameError::MissingTensor {
            name: name.to_owned(),
            found: self.tensors.keys().cloned().collect(),
        })
    }
}

/// The body length that a prefix announces.
///
/// # Errors
/// [`FrameError::TooLong`] beyond [`MAX_FRAME_BYTES`].
pub fn checked_length(prefix: [u8; 8]) -> Result<usize, FrameError> {
    let found = u64::from_le_bytes(prefix);
    if found > MAX_FRAME_BYTES {
        return Err(FrameError::TooLong {
            found,
            limit: MAX_FRAME_BYTES,
            head: String::from_utf8_lossy(&prefix).into_owned(),
        });
    }
    Ok(usize::try_from(found).expect("2 GiB fit a usize"))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use proptest::prelude::*;

    use super::*;

    fn tensors() -> impl Strategy<Value = BTreeMap<String, FrameTensor>> {
        let tensor = (
            prop::sample::select(vec![Dtype::F64, Dtype::F32, Dtype::I64, Dtype::U8]),
            prop::collection::vec(0usize..4, 0..3),
            any::<u64>(),
        )
            .prop_map(|(dtype, shape, fill)| {
                let count = shape.iter().product::<usize>() * dtype.bitsize() / 8;
                let bytes = fill.to_le_bytes().into_iter().cycle().take(count).collect();
                FrameTensor { dtype, shape, bytes }
            });
        prop::collection::btree_map("[a-z_/0-9é]{1,12}", tensor, 0..5)
    }

    proptest! {
        #[test]
        fn encoding_then_decoding_gives_the_frame_back(message in ".{0,80}", tensors in tensors()) {
            let frame = Frame { message, tensors };
            let bytes = frame.encode().unwrap();
            let length = checked_length(bytes[..8].try_into().unwrap()).unwrap();
            prop_assert_eq!(length, bytes.len() - 8);
            prop_assert_eq!(Frame::decode(&bytes[8..]).unwrap(), frame.clone());
            prop_assert_eq!(frame.encode().unwrap(), bytes);
        }

        #[test]
        fn garbage_is_an_error_and_never_a_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            prop_assert!(Frame::decode(&bytes).is_err());
        }

        #[test]
        fn a_truncated_frame_is_an_error(tensors in tensors(), cut in any::<prop::sample::Index>()) {
            let bytes = Frame { message: "{}".into(), tensors }.encode().unwrap();
            let body = &bytes[8..];
            prop_assert!(Frame::decode(&body[..cut.index(body.len())]).is_err());
        }

        #[test]
        fn a_damaged_byte_never_panics(tensors in tensors(), at in any::<prop::sample::Index>(), with in 1u8..) {
            let bytes = Frame { message: "{\"type\":\"step\"}".into(), tensors }.encode().unwrap();
            let mut body = bytes[8..].to_vec();
            let at = at.index(body.len());
            body[at] ^= with;
            if let Ok(frame) = Frame::decode(&body) {
                prop_assert!(frame.encode().is_ok());
            }
        }
    }

    #[test]
    fn printed_text_is_refused_by_its_length() {
        let error = checked_length(*b"Hello wo").unwrap_err().to_string();
        assert!(error.contains("Hello wo"), "{error}");
        assert!(checked_length(MAX_FRAME_BYTES.to_le_bytes()).is_ok());
    }

    #[test]
    fn a_second_metadata_key_is_refused() {
        let metadata = HashMap::from([("actrm".into(), "{}".into()), ("other".into(), "x".into())]);
        let none: [(&str, Borrowed<'_>); 0] = [];
        let body = safetensors::serialize(none, Some(metadata)).unwrap();
        let error = Frame::decode(&body).unwrap_err().to_string();
        assert!(error.contains("[\"actrm\", \"other\"]"), "{error}");
    }

    #[test]
    fn values_come_back_as_they_were() {
        let values = [0.1, -0.0, f64::MIN_POSITIVE, 1e300];
        let tensor = FrameTensor::from_f64(&[2, 2], &values);
        assert_eq!(tensor.to_f64("x").unwrap(), values);
        let other = FrameTensor { dtype: Dtype::U8, ..tensor };
        assert!(other.to_f64("x").is_err());
    }
}
