//! The physics of a block of samples: sixteen vehicles step together.

use nesam_physics::step::StepModel;
use nesam_physics::{STATE_DIM, WHEELS};

use super::risk::{RiskRow, of_lanes};
use crate::fused::{Kernel, LANES, Lane, Numbers, Vector};
use crate::rollout::Variant;
use crate::step_row::{CONSTANT, DIFFERENTIABLE, step_input};
use crate::symbolic::symbolic_step;

/// One step of the symbolic half for a block of samples.
pub(super) struct PhysicsStep<'a> {
    pub(super) variant: Variant,
    pub(super) model: &'a StepModel,
    /// Differentiable columns of a step row, see `step_row`.
    pub(super) varying: &'a [Lane; DIFFERENTIABLE],
    /// Constant columns.
    pub(super) constant: &'a [Lane; CONSTANT],
    /// Whether risk is asked for.
    pub(super) risk: bool,
}

/// What the step gives.
pub(super) struct PhysicsOutput {
    /// Increment Δx of the symbolic half.
    pub(super) increment: [Lane; STATE_DIM],
    /// Sinkage of each wheel, m.
    pub(super) sinkage_m: [Lane; WHEELS],
    /// Risk of each sample, when asked for.
    pub(super) risk: Option<[RiskRow; LANES]>,
}

impl Kernel for PhysicsStep<'_> {
    type Output = PhysicsOutput;
    #[inline(always)]
    fn run<V: Vector>(self) -> PhysicsOutput {
        let mut varying = [Numbers(V::splat(0.0)); DIFFERENTIABLE];
        for (number, lane) in varying.iter_mut().zip(self.varying) {
            *number = Numbers(V::load(&lane.0));
        }
        let mut constant = [Numbers(V::splat(0.0)); CONSTANT];
        for (number, lane) in constant.iter_mut().zip(self.constant) {
            *number = Numbers(V::load(&lane.0));
        }
        let input = step_input(varying, constant);
        let output = symbolic_step(self.variant, self.model, &input);
        let mut increment = [Lane::ZERO; STATE_DIM];
        for (lane, number) in increment.iter_mut().zip(output.increment.to_array()) {
            number.0.store(&mut lane.0);
        }
        let mut sinkage_m = [Lane::ZERO; WHEELS];
        for (lane, contact) in sinkage_m.iter_mut().zip(&output.contacts) {
            contact.sinkage_m.0.store(&mut lane.0);
        }
        let risk = if self.risk { Some(of_lanes(self.model, &input, &output.contacts)) } else { None };
        PhysicsOutput { increment, sinkage_m, risk }
    }
}
