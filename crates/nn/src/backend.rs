//! Where tensors are, and which operations run there.

use crate::error::{ModelError, Result};
use crate::precision::Precision;
use candle_core::Device;

/// A device, and whether its operations are hand-written kernels or compositions of candle's.
#[derive(Debug, Clone)]
pub struct Backend {
    device: Device,
    composed: bool,
    precision: Precision,
}

impl Backend {
    /// Hand-written kernels on the CPU.
    pub const CPU: Self = Self { device: Device::Cpu, composed: false, precision: Precision::F32 };

    /// The fastest operations that the device has: hand-written kernels on the CPU, candle's elsewhere.
    pub fn new(device: Device) -> Self {
        Self { composed: !device.is_cpu(), device, precision: Precision::F32 }
    }

    /// Candle's operations on any device. On the CPU this is for tests.
    pub fn composed(device: Device) -> Self {
        Self { device, composed: true, precision: Precision::F32 }
    }

    /// The same with products in this precision.
    ///
    /// # Errors
    /// Another precision than f32 on the CPU.
    pub fn with_precision(self, precision: Precision) -> Result<Self> {
        if precision != Precision::F32 && self.device.is_cpu() {
            let (found, expected) = (format!("{precision:?}").to_lowercase(), "f32 on the CPU".to_string());
            return Err(ModelError::Input { operation: "device", object: "precision", found, expected });
        }
        candle_core::cuda::set_gemm_reduced_precision_f32(precision == Precision::Tf32);
        Ok(Self { precision, ..self })
    }

    /// In which precision products are computed.
    pub fn precision(&self) -> Precision {
        self.precision
    }

    /// Where tensors are.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// Whether operations are candle's.
    pub fn is_composed(&self) -> bool {
        self.composed
    }

    /// The device in words, such as `NVIDIA H200, CUDA 13.0`; nothing on the CPU.
    pub fn gpu(&self) -> Option<String> {
        match &self.device {
            #[cfg(feature = "cuda")]
            Device::Cuda(device) => {
                let context = device.cuda_stream().context().clone();
                let name = context.name().unwrap_or_else(|_| "GPU".to_owned());
                let version = candle_core::cuda_backend::cudarc::driver::sys::CUDA_VERSION;
                Some(format!("{name}, CUDA {}.{}", version / 1000, version % 1000 / 10))
            }
            _ => None,
        }
    }

    /// Bytes that are free on a GPU; nothing on the CPU.
    pub fn free_bytes(&self) -> Option<u64> {
        match &self.device {
            #[cfg(feature = "cuda")]
            Device::Cuda(_) => {
                candle_core::cuda_backend::cudarc::driver::result::mem_get_info().ok().map(|(free, _)| free as u64)
            }
            _ => None,
        }
    }

    /// Sets the seed of numbers that the device draws itself: masks of dropout. The CPU draws none.
    ///
    /// # Errors
    /// If the tensor library fails.
    pub fn seed(&self, seed: u64) -> Result<()> {
        if !self.device.is_cpu() {
            self.device.set_seed(seed)?;
        }
        Ok(())
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
