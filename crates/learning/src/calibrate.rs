//! Calibration of the drive line on measured drives, with the symbolic model alone.

use nesam_model::{GroundSource, Normalization, history_actuators};
use nesam_physics::driveline::command_wheels;
use nesam_physics::step::{StepInput, StepModel};
use nesam_physics::{SecondCommand, Soil, Vehicle, VehicleState, WHEELS};
use rayon::prelude::*;

use crate::drives::Drive;
use crate::rims::fit_rims;

/// Steps of a calibration rollout.
const HORIZON: usize = 16;

/// A number of the drive line that is calibrated, with its range.
type Knob = (&'static str, fn(&mut Vehicle) -> &mut f64, [f64; 2]);

const KNOBS: [Knob; 4] = [
    ("speed_gain", |v| &mut v.driveline.speed_gain, [0.01, 1.0]),
    ("speed_integral_gain_per_s", |v| &mut v.driveline.speed_integral_gain_per_s, [0.0, 0.5]),
    ("overspeed_limit_m_s", |v| &mut v.driveline.overspeed_limit_m_s, [0.05, 3.0]),
    ("steering_lag_s", |v| &mut v.driveline.steering_lag_s, [0.0, 0.5]),
];

/// Mean position error (m) over short rollouts of the symbolic model from every `stride`-th sample.
pub fn symbolic_error(vehicle: &Vehicle, drives: &[&Drive], scales: &Normalization, stride: usize) -> f64 {
    let model = StepModel::new(vehicle, scales.dt_s, scales.substeps);
    let soil = Soil::from_array(scales.default_soil());
    let (sum, count) = drives
        .par_iter()
        .map(|drive| {
            let (mut sum, mut count) = (0.0, 0usize);
            let last = drive.states.len().saturating_sub(HORIZON + 1);
            for i in (8.min(last.saturating_sub(1))..last).step_by(stride) {
                sum += rollout_error(&model, drive, i, &soil, scales);
                count += 1;
            }
            (sum, count)
        })
        .reduce(|| (0.0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
    sum / count.max(1) as f64
}

fn rollout_error(model: &StepModel, drive: &Drive, i: usize, soil: &Soil<f64>, scales: &Normalization) -> f64 {
    let mut state = drive.states[i];
    let ground = GroundSource::new(drive.map.as_deref(), model, &state);
    let mut actuators = history_actuators(model, &drive.history(i.saturating_sub(31), i), &state, &drive.controls[i], scales.dt_s);
    let mut error = 0.0;
    for k in 0..HORIZON {
        let control = &drive.controls[i + k];
        let after = actuators.advance(model.vehicle(), control, state.velocity_m_s[0], scales.dt_s);
        let input = StepInput {
            state,
            wheels: command_wheels(model.vehicle(), &actuators, &after, control),
            sinkage_log_ratio: [0.0; WHEELS],
            soil: *soil,
            ground: ground.under_wheels(model, &state, 0.0).0,
        };
        let increment = model.step(&input).increment;
        state = VehicleState::from_array(state.advanced(&increment.to_array()));
        actuators = after;
        let measured = drive.states[i + k + 1].position_m;
        error += (state.position_m[0] - measured[0]).hypot(state.position_m[1] - measured[1]) / HORIZON as f64;
    }
    error
}

/// Fits the drive line by coordinate search (each number in turn, shrinking steps) and returns the error before and after, m.
pub fn calibrate_driveline(
    vehicle: &mut Vehicle,
    drives: &[&Drive],
    scales: &Normalization,
    mut progress: impl FnMut(&str, f64, f64),
) -> [f64; 2] {
    let before = symbolic_error(vehicle, drives, scales, 40);
    if vehicle.second == SecondCommand::YawRateRadS {
        if let Some(servo) = fit_rims(vehicle, drives, scales.dt_s) {
            vehicle.driveline.rims = servo;
            progress("rims", servo.speed_gain, servo.turn_efficiency);
        }
        return [before, symbolic_error(vehicle, drives, scales, 40)];
    }
    let mut best = before;
    for round in 0..3 {
        for (name, knob, [low, high]) in KNOBS {
            let mut reach = if round == 0 { 0.5 } else { 0.5 / f64::from(2 << round) };
            while reach > 0.02 {
                let current = *knob(vehicle);
                let span = high - low;
                let trials = [current * (1.0 - reach) - 1e-3 * span * reach, current * (1.0 + reach) + 0.05 * span * reach];
                let mut improved = false;
                for trial in trials.map(|t| t.clamp(low, high)) {
                    let mut candidate = vehicle.clone();
                    *knob(&mut candidate) = trial;
                    let error = symbolic_error(&candidate, drives, scales, 40);
                    if error < best {
                        best = error;
                        *vehicle = candidate;
                        improved = true;
                    }
                }
                if !improved {
                    reach *= 0.5;
                }
            }
            progress(name, *knob(vehicle), best);
        }
    }
    [before, best]
}
