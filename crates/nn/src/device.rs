//! The device that a user asks for.

use crate::backend::Backend;
use crate::error::{ModelError, Result};
use candle_core::Device;
use std::fmt;
use std::str::FromStr;

/// Whether this program can use a GPU: it was built with CUDA.
const HAS_CUDA: bool = cfg!(feature = "cuda");

/// Where operations run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DeviceChoice {
    /// the first GPU, or the CPU where there is none
    Auto,
    /// the CPU
    #[default]
    Cpu,
    /// this GPU, counted from 0
    Cuda(usize),
}

impl FromStr for DeviceChoice {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let wrong = || format!("device {text:?}: expected auto, cpu, cuda or cuda:N");
        match text {
            "auto" => Ok(Self::Auto),
            "cpu" => Ok(Self::Cpu),
            "cuda" => Ok(Self::Cuda(0)),
            _ => text.strip_prefix("cuda:").and_then(|n| n.parse().ok()).map(Self::Cuda).ok_or_else(wrong),
        }
    }
}

impl fmt::Display for DeviceChoice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Cpu => f.write_str("cpu"),
            Self::Cuda(n) => write!(f, "cuda:{n}"),
        }
    }
}

/// A device that is ready.
#[derive(Debug, Clone)]
pub struct Opened {
    /// its operations
    pub backend: Backend,
    /// what a user should know: `auto` found no GPU
    pub note: Option<String>,
}

impl DeviceChoice {
    /// Opens it.
    ///
    /// # Errors
    /// A GPU that is asked for by name and cannot be used, with the reason.
    pub fn open(self) -> Result<Opened> {
        let on = |backend: Backend| Opened { backend, note: None };
        match self {
            Self::Cpu => Ok(on(Backend::CPU)),
            Self::Auto if !HAS_CUDA => Ok(on(Backend::CPU)),
            Self::Auto => Ok(match cuda(0) {
                Ok(device) => on(Backend::new(device)),
                Err(error) => Opened {
                    backend: Backend::CPU,
                    note: Some(format!("on the CPU, because CUDA found no GPU: {error}")),
                },
            }),
            Self::Cuda(n) => cuda(n).map(|device| on(Backend::new(device))).map_err(|reason| ModelError::Input {
                operation: "device",
                object: "GPU",
                found: reason,
                expected: format!("{self}, or --device cpu"),
            }),
        }
    }
}

#[cfg(feature = "cuda")]
fn cuda(n: usize) -> std::result::Result<Device, String> {
    Device::new_cuda(n).map_err(|e| e.to_string())
}

#[cfg(not(feature = "cuda"))]
fn cuda(_: usize) -> std::result::Result<Device, String> {
    Err("not usable: this program was built without CUDA (`make cuda` builds one with it)".to_owned())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn devices_are_read_as_they_are_written() {
        for (text, device) in [
            ("auto", DeviceChoice::Auto),
            ("cpu", DeviceChoice::Cpu),
            ("cuda", DeviceChoice::Cuda(0)),
            ("cuda:3", DeviceChoice::Cuda(3)),
        ] {
            assert_eq!(text.parse::<DeviceChoice>().unwrap(), device);
            assert_eq!(device.to_string().parse::<DeviceChoice>().unwrap(), device);
        }
        for text in ["", "gpu", "cuda:", "cuda:x", "cuda:-1", "CPU"] {
            assert!(text.parse::<DeviceChoice>().unwrap_err().contains("cuda:N"), "{text}");
        }
    }

    #[test]
    fn a_device_that_is_not_there_is_refused_and_auto_takes_the_cpu() {
        assert!(DeviceChoice::Cpu.open().unwrap().note.is_none());
        if !HAS_CUDA {
            assert!(DeviceChoice::Auto.open().unwrap().backend.device().is_cpu());
            let error = DeviceChoice::Cuda(1).open().unwrap_err().to_string();
            assert!(error.contains("built without CUDA") && error.contains("cuda:1"), "{error}");
        }
    }
}
