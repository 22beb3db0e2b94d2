//! Risk outputs of a block of samples.

use nesam_physics::WHEELS;
use nesam_physics::risk::load_transfer_ratio;
use nesam_physics::step::{StepInput, StepModel, WheelContact};

use crate::fused::{LANES, Lane, Numbers, Vector};
use crate::rollout::RiskOutputs;

/// Risk of one sample in one step.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct RiskRow {
    load_n: [f32; WHEELS],
    slip: [f32; WHEELS],
    load_transfer_ratio: f32,
    traction_reserve: f32,
}

/// Risk of sixteen lanes from the step that they have made.
#[inline(always)]
pub(super) fn of_lanes<V: Vector>(
    model: &StepModel,
    input: &StepInput<Numbers<V>>,
    contacts: &[WheelContact<Numbers<V>>; WHEELS],
) -> [RiskRow; LANES] {
    let mut loads = [Numbers(V::splat(0.0)); WHEELS];
    let (mut load, mut slip) = ([Lane::ZERO; WHEELS], [Lane::ZERO; WHEELS]);
    for (i, contact) in contacts.iter().enumerate() {
        loads[i] = contact.normal_n;
        contact.normal_n.0.store(&mut load[i].0);
        contact.slip.0.store(&mut slip[i].0);
    }
    let (mut ratio, mut reserve) = (Lane::ZERO, Lane::ZERO);
    load_transfer_ratio(&loads).0.store(&mut ratio.0);
    model.traction_reserve(input, contacts).0.store(&mut reserve.0);
    core::array::from_fn(|lane| RiskRow {
        load_n: load.map(|wheel| wheel[lane]),
        slip: slip.map(|wheel| wheel[lane]),
        load_transfer_ratio: ratio[lane],
        traction_reserve: reserve[lane],
    })
}

impl RiskOutputs {
    /// Room for so many rows.
    pub(super) fn zero(rows: usize) -> Self {
        Self {
            wheel_load_n: vec![0.0; rows * WHEELS],
            wheel_slip: vec![0.0; rows * WHEELS],
            load_transfer_ratio: vec![0.0; rows],
            traction_reserve: vec![0.0; rows],
        }
    }

    /// Fills one row.
    pub(super) fn put(&mut self, row: usize, risk: &RiskRow) {
        self.wheel_load_n[row * WHEELS..(row + 1) * WHEELS].copy_from_slice(&risk.load_n);
        self.wheel_slip[row * WHEELS..(row + 1) * WHEELS].copy_from_slice(&risk.slip);
        self.load_transfer_ratio[row] = risk.load_transfer_ratio;
        self.traction_reserve[row] = risk.traction_reserve;
    }
}
