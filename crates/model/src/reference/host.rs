//! Operations of our own on tensors: they run on the processor, and where the tensors are on a GPU, their values come and go.

use std::borrow::Cow;

use candle_core::backend::{BackendDevice, BackendStorage};
use candle_core::{CpuStorage, CudaStorage, Layout, Result, Shape, Storage, Tensor, bail};

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

/// What `of` makes of the values of tensors, where the first of them is: no node of the graph, as backward passes need none.
pub(super) fn from_values<const N: usize>(
    tensors: [&Tensor; N],
    shape: impl Into<Shape>,
    of: impl FnOnce([&[f32]; N]) -> Vec<f32>,
) -> Result<Tensor> {
    let contiguous = tensors.iter().map(|tensor| tensor.contiguous()).collect::<Result<Vec<_>>>()?;
    let held: Vec<_> = contiguous.iter().map(Tensor::storage_and_layout).collect();
    let mut storages = Vec::with_capacity(N);
    for (storage, _) in &held {
        storages.push(match &**storage {
            Storage::Cpu(storage) => Cow::Borrowed(storage),
            Storage::Cuda(storage) => Cow::Owned(storage.to_cpu_storage()?),
            Storage::Metal(storage) => Cow::Owned(storage.to_cpu_storage()?),
        });
    }
    let mut all = [&[][..]; N];
    for ((own, storage), (_, layout)) in all.iter_mut().zip(&storages).zip(&held) {
        *own = values(storage, layout)?;
    }
    Tensor::from_vec(of(all), shape, tensors[0].device())
}
