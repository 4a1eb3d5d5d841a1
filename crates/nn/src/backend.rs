//! Where tensors are, and which operations run there.

use crate::error::{ModelError, Result};
use candle_core::Device;

/// A device, and whether its operations are hand-written kernels or compositions of candle's.
#[derive(Debug, Clone)]
pub struct Backend {
    device: Device,
    composed: bool,
}

impl Backend {
    /// Hand-written kernels on the CPU.
    pub const CPU: Self = Self { device: Device::Cpu, composed: false };

    /// The fastest operations that the device has: hand-written kernels on the CPU, candle's elsewhere.
    pub fn new(device: Device) -> Self {
        Self { composed: !device.is_cpu(), device }
    }

    /// Candle's operations on any device. On the CPU this is for tests.
    pub fn composed(device: Device) -> Self {
        Self { device, composed: true }
    }

    /// Where tensors are.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// Whether operations are candle's.
    pub fn is_composed(&self) -> bool {
        self.composed
    }

    /// For what runs on the CPU only.
    ///
    /// # Errors
    /// Another device, by name.
    pub fn require_cpu(&self, operation: &'static str) -> Result<()> {
        require_device(operation, &self.device, &Device::Cpu)
    }
}

/// The one check of where an operation's tensors are.
pub(crate) fn require_device(operation: &'static str, found: &Device, expected: &Device) -> Result<()> {
    if found.same_device(expected) {
        return Ok(());
    }
    let on = |device: &Device| format!("on device {:?}", device.location());
    Err(ModelError::Input { operation, object: "tensor", found: on(found), expected: on(expected) })
}
