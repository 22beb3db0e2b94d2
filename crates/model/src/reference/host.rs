//! Operations of our own on tensors: they run on the processor, and where the tensors are on a GPU, their values come and go.

use candle_core::backend::{BackendDevice, BackendStorage};
use candle_core::{CpuStorage, CudaStorage, Layout, Result, Shape, bail};

/// The contiguous values of a tensor's storage.
pub(super) fn values<'a>(storage: &'a CpuStorage, layout: &Layout) -> Result<&'a [f32]> {
    let Some((start, end)) = layout.contiguous_offsets() else { bail!("a custom op needs a contiguous tensor") };
    match storage {
        CpuStorage::F32(all) => Ok(&all[start..end]),
        _ => bail!("a custom op needs f32"),
    }
}

/// What an operation on the processor makes of values of a GPU, back on it.
pub(super) fn there_and_back(
    storage: &CudaStorage,
    operation: impl FnOnce(&CpuStorage) -> Result<(CpuStorage, Shape)>,
) -> Result<(CudaStorage, Shape)> {
    let (result, shape) = operation(&storage.to_cpu_storage()?)?;
    Ok((storage.device().storage_from_cpu_storage_owned(result)?, shape))
}
