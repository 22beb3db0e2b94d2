//! Stored terrain features of the samples of a batch, as tensors where the network is.

use candle_core::{DType, Device, Result, Tensor};
use half::f16;
use half::slice::HalfFloatSliceExt;
use rayon::prelude::*;

/// A sample: number of its window in the batch, and of the sample in its drive.
pub(crate) type At = (usize, usize);

/// (samples, `width`) of f32: the features that `of` finds for each sample, times the factors of its window where it has some.
///
/// # Errors
/// A candle error.
pub(crate) fn gather<'d>(
    samples: &[At],
    width: usize,
    of: impl Fn(At) -> &'d [f16] + Sync,
    factors: &[Option<Vec<f32>>],
    device: &Device,
) -> Result<Tensor> {
    if device.is_cpu() {
        let mut values = vec![0f32; samples.len() * width];
        values.par_chunks_exact_mut(width).zip(samples).for_each(|(row, at)| {
            of(*at).convert_to_f32_slice(row);
            if let Some(factors) = factors.get(at.0).and_then(Option::as_ref) {
                row.iter_mut().zip(factors).for_each(|(value, factor)| *value *= factor);
            }
        });
        return Tensor::from_vec(values, (samples.len(), width), device);
    }
    // Halves are half as much to bring to a GPU, and the factors of a window are brought once.
    let mut halves = vec![f16::ZERO; samples.len() * width];
    halves.par_chunks_exact_mut(width).zip(samples).for_each(|(row, at)| row.copy_from_slice(of(*at)));
    let values = Tensor::from_vec(halves, (samples.len(), width), device)?.to_dtype(DType::F32)?;
    if factors.iter().all(Option::is_none) {
        return Ok(values);
    }
    let table: Vec<f32> = factors.iter().flat_map(|own| own.clone().unwrap_or_else(|| vec![1.0; width])).collect();
    let window: Vec<u32> = samples.iter().map(|at| at.0 as u32).collect();
    let table = Tensor::from_vec(table, (factors.len(), width), device)?;
    values.mul(&table.index_select(&Tensor::from_vec(window, samples.len(), device)?, 0)?)
}
