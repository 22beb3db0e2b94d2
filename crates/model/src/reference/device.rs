//! Where the reference's tensors live: this processor, or a GPU where the build has the feature `cuda`.

use std::fmt;
use std::str::FromStr;

use candle_core::Device;

use crate::ModelError;

/// A device that runs the reference. The physics stays on the processor wherever the tensors are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ComputeDevice {
    /// This processor.
    #[default]
    Cpu,
    /// The GPU of this number.
    Cuda(usize),
}

impl ComputeDevice {
    /// The device, ready for tensors.
    ///
    /// # Errors
    /// `ModelError::Device` when the build has no CUDA, or the machine no such GPU.
    pub fn open(self) -> Result<Device, ModelError> {
        let Self::Cuda(number) = self else { return Ok(Device::Cpu) };
        let fail = |reason: String| ModelError::Device { device: self, reason };
        if !candle_core::utils::cuda_is_available() {
            return Err(fail(
                "this program was built without CUDA; `cargo build --release --features nesam/cuda` makes one that has it".into(),
            ));
        }
        Device::new_cuda(number).map_err(|error| fail(error.to_string()))
    }
}

impl fmt::Display for ComputeDevice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cpu => f.write_str("cpu"),
            Self::Cuda(number) => write!(f, "cuda:{number}"),
        }
    }
}

impl FromStr for ComputeDevice {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let unknown = || format!("`{text}` is no device; `cpu`, `cuda` or `cuda:1`");
        match text.split_once(':') {
            None if text == "cpu" => Ok(Self::Cpu),
            None if text == "cuda" => Ok(Self::Cuda(0)),
            Some(("cuda", number)) => number.parse().map(Self::Cuda).map_err(|_| unknown()),
            _ => Err(unknown()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn example_names_are_read_as_they_are_written() {
        for (text, device) in [("cpu", ComputeDevice::Cpu), ("cuda:0", ComputeDevice::Cuda(0)), ("cuda:3", ComputeDevice::Cuda(3))] {
            assert_eq!(text.parse(), Ok(device));
            assert_eq!(device.to_string(), text);
        }
        assert_eq!("cuda".parse(), Ok(ComputeDevice::Cuda(0)));
        for text in ["", "gpu", "cuda:", "cuda:-1", "cpu:0"] {
            assert!(text.parse::<ComputeDevice>().is_err_and(|error| error.contains("is no device")), "{text}");
        }
    }
}
