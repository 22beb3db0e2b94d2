//! Numbers as the `bytes` fields of the messages hold them: f32, little-endian, one after the other.

use bytes::Bytes;

/// Packs numbers.
pub fn pack(values: &[f32]) -> Bytes {
    if cfg!(target_endian = "big") {
        return values.iter().flat_map(|value| value.to_le_bytes()).collect();
    }
    Bytes::copy_from_slice(bytemuck::cast_slice(values))
}

/// Packs numbers where they lie: the bytes keep `owner`, of which `numbers` gives them.
pub fn lend<T: Send + Sync + 'static>(owner: T, numbers: fn(&T) -> &[f32]) -> Bytes {
    struct Lender<T> {
        owner: T,
        numbers: fn(&T) -> &[f32],
    }
    impl<T> AsRef<[u8]> for Lender<T> {
        fn as_ref(&self) -> &[u8] {
            bytemuck::cast_slice((self.numbers)(&self.owner))
        }
    }
    if cfg!(target_endian = "big") {
        return pack(numbers(&owner));
    }
    Bytes::from_owner(Lender { owner, numbers })
}

/// The numbers again; bytes at the end that make no whole number are left out.
pub fn unpack(packed: &[u8]) -> Vec<f32> {
    const WIDTH: usize = size_of::<f32>();
    let mut values = vec![0.0_f32; packed.len() / WIDTH];
    bytemuck::cast_slice_mut(&mut values).copy_from_slice(&packed[..packed.len() / WIDTH * WIDTH]);
    // Nothing to do on a little-endian machine.
    values.iter_mut().for_each(|value| *value = f32::from_bits(u32::from_le(value.to_bits())));
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn published_little_endian_binary32_of_ieee_754() {
        let bytes = [0, 0, 0x80, 0x3f, 0, 0, 0x20, 0xc1, 1, 0, 0, 0];
        let values = [1.0, -10.0, f32::from_bits(1)];
        assert_eq!(pack(&values).as_ref(), bytes);
        assert_eq!(lend(values.to_vec(), |v| v).as_ref(), bytes);
        assert_eq!(unpack(&bytes), values);
        assert_eq!(unpack(&bytes[..7]), values[..1]);
        // Messages are not aligned.
        let shifted: Vec<u8> = core::iter::once(7).chain(bytes).collect();
        assert_eq!(unpack(&shifted[1..]), values);
        assert!(unpack(&pack(&[f32::NAN]))[0].is_nan() && unpack(&[]).is_empty());
    }
}
