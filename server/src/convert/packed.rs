//! Packed arrays of numbers.

use bytes::Bytes;
use half::f16;
use nesam_engine::EngineError;
use nesam_proto::packed::{pack, unpack};
use nesam_proto::v1 as pb;

/// Width of the numbers of a reply.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Precision {
    /// IEEE 754 binary32.
    #[default]
    F32,
    /// IEEE 754 binary16; positions are offsets from the start.
    F16,
}

impl Precision {
    /// The precision that a field asks for.
    ///
    /// # Errors
    /// `Invalid` naming the field and what is allowed.
    pub fn of_message(field: &str, value: i32) -> Result<Self, EngineError> {
        match pb::Precision::try_from(value) {
            Ok(pb::Precision::Unspecified | pb::Precision::F32) => Ok(Self::F32),
            Ok(pb::Precision::F16) => Ok(Self::F16),
            Err(_) => Err(EngineError::invalid(field, format!("is {value}, allowed are 0, 1 (f32) and 2 (f16)"))),
        }
    }

    /// The same as message.
    pub fn to_message(self) -> pb::Precision {
        match self {
            Self::F32 => pb::Precision::F32,
            Self::F16 => pb::Precision::F16,
        }
    }
}

/// A packed array of little-endian f32.
///
/// # Errors
/// `Invalid` naming `field` when the length is not 4 `count` bytes.
pub fn decode_f32(field: &str, packed: &[u8], count: usize) -> Result<Vec<f32>, EngineError> {
    if packed.len() != 4 * count {
        let reason = format!("has {} bytes, {count} packed f32 take {}", packed.len(), 4 * count);
        return Err(EngineError::invalid(field, reason));
    }
    Ok(unpack(packed))
}

/// Packs an array in little-endian order.
pub fn encode(values: &[f32], precision: Precision) -> Bytes {
    match precision {
        Precision::F32 => pack(values),
        Precision::F16 => {
            let mut packed = vec![0; 2 * values.len()];
            for (bytes, value) in packed.chunks_exact_mut(2).zip(values) {
                bytes.copy_from_slice(&f16::from_f32(*value).to_le_bytes());
            }
            packed.into()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_packed_f32_round_trip() {
        let values = [0.0, -1.5, f32::MAX, f32::MIN_POSITIVE];
        assert_eq!(decode_f32("x", &encode(&values, Precision::F32), 4).unwrap(), values);
        assert_eq!(decode_f32("x", &[0; 15], 4).unwrap_err().field(), "x");
    }

    #[test]
    fn published_binary16_of_ieee_754() {
        // Sign, five bits of exponent biased by 15, ten bits of significand; round to nearest even; overflow to infinity.
        for (value, bits) in [
            (0.0, 0x0000_u16),
            (-2.0, 0xc000),
            (1.0 / 3.0, 0x3555),
            (65504.0, 0x7bff),
            (65520.0, 0x7c00),
            (2.0_f32.powi(-24), 0x0001),
            (2048.0 + 1.0, 0x6800),
            (2048.0 + 3.0, 0x6802),
        ] {
            assert_eq!(encode(&[value], Precision::F16).as_ref(), bits.to_le_bytes(), "{value}");
        }
        assert!(f16::from_le_bytes(encode(&[f32::NAN], Precision::F16).as_ref().try_into().unwrap()).is_nan());
    }
}
