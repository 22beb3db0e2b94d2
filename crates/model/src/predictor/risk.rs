//! Risk outputs of a block of samples.

use nesam_physics::WHEELS;
use nesam_physics::risk::load_transfer_ratio;
use nesam_physics::scalar::f32x8;
use nesam_physics::step::{StepInput, StepModel, WheelContact};

use crate::rollout::RiskOutputs;

/// Risk of one sample in one step.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct RiskRow {
    load_n: [f32; WHEELS],
    slip: [f32; WHEELS],
    load_transfer_ratio: f32,
    traction_reserve: f32,
}

/// Risk of eight lanes from the step that they have made.
pub(super) fn of_lanes(model: &StepModel, input: &StepInput<f32x8>, contacts: &[WheelContact<f32x8>; WHEELS]) -> [RiskRow; 8] {
    let load = contacts.map(|contact| contact.normal_n);
    let ratio = load_transfer_ratio(&load).to_array();
    let reserve = model.traction_reserve(input, contacts).to_array();
    let (load, slip) = (load.map(f32x8::to_array), contacts.map(|contact| contact.slip.to_array()));
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
