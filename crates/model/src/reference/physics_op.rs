//! The bridge from candle to the physics: one fused op for the whole step, forward in lanes, backward by duals over lanes.

use std::sync::Arc;

use candle_core::{CpuStorage, CudaStorage, CustomOp1, Layout, Result, Shape, Tensor, bail};
use nesam_physics::scalar::{Dual, f32x8};
use nesam_physics::step::StepModel;
use rayon::prelude::*;

use super::host::{from_values, there_and_back, values};
use crate::rollout::Variant;
use crate::step_row::{COLUMNS, CONSTANT, DIFFERENTIABLE, OUTPUTS, step_input};
use crate::symbolic::symbolic_step;

const LANES: usize = 8;

struct Step(Variant, Arc<StepModel>);

/// Columns `from..from + N` of eight rows as lanes; rows past the end repeat the last one.
fn lanes<const N: usize>(packed: &[f32], base: usize, from: usize) -> [f32x8; N] {
    let last = packed.len() / COLUMNS - 1;
    core::array::from_fn(|k| f32x8::from(core::array::from_fn::<f32, LANES, _>(|l| packed[(base + l).min(last) * COLUMNS + from + k])))
}

/// `N` columns of every row; `of` computes those of the eight rows from one on. Eights are shared among the threads of the pool this runs in.
fn by_eights<const N: usize>(rows: usize, of: impl Fn(usize) -> [f32x8; N] + Sync) -> Vec<f32> {
    let mut out = vec![0f32; rows * N];
    out.par_chunks_mut(LANES * N).enumerate().for_each(|(eight, out)| {
        let columns = of(eight * LANES).map(f32x8::to_array);
        for (lane, row) in out.chunks_exact_mut(N).enumerate() {
            row.iter_mut().zip(&columns).for_each(|(value, column)| *value = column[lane]);
        }
    });
    out
}

impl CustomOp1 for Step {
    fn name(&self) -> &'static str {
        "physics-step"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let packed = values(storage, layout)?;
        let rows = packed.len() / COLUMNS;
        let increments = by_eights::<OUTPUTS>(rows, |base| {
            let input = step_input::<f32x8>(lanes(packed, base, 0), lanes::<CONSTANT>(packed, base, DIFFERENTIABLE));
            symbolic_step(self.0, &self.1, &input).increment.to_array()
        });
        Ok((CpuStorage::F32(increments), Shape::from((rows, OUTPUTS))))
    }

    fn cuda_fwd(&self, storage: &CudaStorage, layout: &Layout) -> Result<(CudaStorage, Shape)> {
        there_and_back(storage, |storage| self.cpu_fwd(storage, layout))
    }

    fn bwd(&self, arg: &Tensor, _res: &Tensor, grad: &Tensor) -> Result<Option<Tensor>> {
        from_values([arg, grad], arg.shape(), |[packed, upstream]| self.gradient(packed, upstream)).map(Some)
    }
}

impl Step {
    /// Gradient by packed inputs (rows, `COLUMNS`), given that by the increments (rows, 12).
    fn gradient(&self, packed: &[f32], upstream: &[f32]) -> Vec<f32> {
        let rows = packed.len() / COLUMNS;
        by_eights::<COLUMNS>(rows, |base| {
            let varying = lanes::<DIFFERENTIABLE>(packed, base, 0);
            let varying: [Dual<f32x8, DIFFERENTIABLE>; DIFFERENTIABLE] = core::array::from_fn(|k| Dual::variable(varying[k], k));
            let constant = lanes::<CONSTANT>(packed, base, DIFFERENTIABLE).map(Dual::constant);
            let increment = symbolic_step(self.0, &self.1, &step_input(varying, constant)).increment.to_array();
            let weight: [f32x8; OUTPUTS] = core::array::from_fn(|o| {
                f32x8::from(core::array::from_fn::<f32, LANES, _>(|l| upstream[(base + l).min(rows - 1) * OUTPUTS + o]))
            });
            core::array::from_fn(|column| match column {
                0..DIFFERENTIABLE => (0..OUTPUTS).fold(f32x8::ZERO, |sum, o| sum + increment[o].eps[column] * weight[o]),
                _ => f32x8::ZERO,
            })
        })
    }
}

/// Increment of the symbolic half of a form (rows, 12) of packed step inputs (rows, `COLUMNS`), differentiable in the first `DIFFERENTIABLE` columns.
///
/// # Errors
/// A candle error when the tensor is not (rows, `COLUMNS`) of f32.
pub fn physics_increment(packed: &Tensor, variant: Variant, model: &Arc<StepModel>) -> Result<Tensor> {
    let (_, columns) = packed.dims2()?;
    if columns != COLUMNS {
        bail!("physics step: {columns} columns, expected {COLUMNS}");
    }
    packed.contiguous()?.apply_op1(Step(variant, model.clone()))
}
