//! The physics of a block of samples: sixteen vehicles step together.
//!
//! A step is long and calls functions of effects, so it is compiled for the target's vectors alone; the contacts, most of its work, are a kernel of their own on
//! the widest vectors.

use nesam_physics::step::StepModel;
use nesam_physics::terramechanics::WheelGeometry;
use nesam_physics::{ROLLING, Rolling, STATE_DIM, SUNK, Sunk, WHEELS, Wheels};

use super::risk::{RiskRow, of_lanes};
use crate::fused::{Kernel, LANES, Lane, Numbers, Path, Vector};
use crate::rollout::Variant;
use crate::step_row::{CONSTANT, DIFFERENTIABLE, step_input};
use crate::symbolic::symbolic_step_by;

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
    /// Instructions for the contacts.
    pub(super) path: Path,
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
        let input = step_input(from_lanes::<V, _>(self.varying), from_lanes(self.constant));
        let output = symbolic_step_by(self.variant, self.model, &input, |wheels, geometries| sink(self.path, wheels, geometries));
        let increment = to_lanes(&output.increment.to_array());
        let mut sinkage_m = [Lane::ZERO; WHEELS];
        for (lane, contact) in sinkage_m.iter_mut().zip(&output.contacts) {
            contact.sinkage_m.0.store(&mut lane.0);
        }
        let risk = if self.risk { Some(of_lanes(self.model, &input, &output.contacts)) } else { None };
        PhysicsOutput { increment, sinkage_m, risk }
    }
}

/// [`Rolling::sink_each`] for the wheels of sixteen vehicles.
struct Sink<'a> {
    wheels: &'a [[Lane; ROLLING]; WHEELS],
    geometries: Wheels<'a, WheelGeometry>,
}

impl Kernel for Sink<'_> {
    type Output = [[Lane; SUNK]; WHEELS];
    #[inline(always)]
    fn run<V: Vector>(self) -> Self::Output {
        let mut sunk = [[Lane::ZERO; SUNK]; WHEELS];
        for ((sunk, wheel), geometry) in sunk.iter_mut().zip(self.wheels).zip(self.geometries) {
            *sunk = to_lanes(&Rolling::from_array(from_lanes::<V, _>(wheel)).sink(geometry).to_array());
        }
        sunk
    }
}

/// The contacts of all wheels, worked out on a path, from vectors of another and back. All are stored before the first is loaded: a wide vector that was just stored in
/// halves has to wait until they have reached the cache.
#[inline(always)]
fn sink<V: Vector>(
    path: Path,
    wheels: Wheels<'_, Rolling<Numbers<V>>>,
    geometries: Wheels<'_, WheelGeometry>,
) -> [Sunk<Numbers<V>>; WHEELS] {
    let wheels = wheels.map(|wheel| to_lanes(&wheel.to_array()));
    let sunk = path.run(Sink { wheels: &wheels, geometries });
    sunk.each_ref().map(|wheel| Sunk::from_array(from_lanes(wheel)))
}

#[inline(always)]
fn from_lanes<V: Vector, const N: usize>(lanes: &[Lane; N]) -> [Numbers<V>; N] {
    let mut numbers = [Numbers(V::splat(0.0)); N];
    for (number, lane) in numbers.iter_mut().zip(lanes) {
        *number = Numbers(V::load(&lane.0));
    }
    numbers
}

#[inline(always)]
fn to_lanes<V: Vector, const N: usize>(numbers: &[Numbers<V>; N]) -> [Lane; N] {
    let mut lanes = [Lane::ZERO; N];
    for (lane, number) in lanes.iter_mut().zip(numbers) {
        number.0.store(&mut lane.0);
    }
    lanes
}
