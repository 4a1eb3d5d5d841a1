//! Where models' tensors are made.

use std::sync::LazyLock;

use candle_core::Device;

/// The device of parameters, batches and all that is composed of them. Steps written by
/// hand read the processor's memory, and say so where they do not find it.
pub static HERE: LazyLock<Device> = LazyLock::new(|| Device::Cpu);
