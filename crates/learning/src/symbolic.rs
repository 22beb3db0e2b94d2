//! What the symbolic model alone, on the soil that the map tells of, is off by over short rollouts, and the search that makes it less: for calibration of the
//! numbers of a card.

use nesam_model::soil_coordinates::from_raw;
use nesam_model::{GroundSource, Normalization, history_actuators};
use nesam_physics::driveline::command_wheels;
use nesam_physics::step::{StepInput, StepModel};
use nesam_physics::{Soil, Vehicle, VehicleState, WHEELS, wrap_angle};
use rayon::prelude::*;

use crate::class_soil::ClassSoil;
use crate::drives::Drive;

/// Steps of a rollout; a drive must have two samples more to be rolled out.
pub const HORIZON: usize = 16;
/// Samples from the start of one rollout to that of the next.
const STRIDE: usize = 40;
/// Samples before the first rollout of a drive.
const WARM_UP: usize = 8;
/// Smallest share by which a number is changed in a search.
const LAST_REACH: f64 = 0.02;

/// Mean absolute errors over rollouts and their steps.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SymbolicError {
    /// Horizontal distance, m.
    pub position_m: f64,
    /// Roll and pitch together, rad.
    pub tilt_rad: f64,
    /// Heading, rad.
    pub yaw_rad: f64,
    /// Length of a measured rollout, from its start to its end; no error, m.
    pub way_m: f64,
    /// Turning over a whole rollout: mean of predicted times measured and of measured squared, rad²; no error.
    pub turning_rad2: [f64; 2],
}

impl SymbolicError {
    /// Position with what the error of the heading moves it by in the mean over as long a way again, m. By the position alone a vehicle may turn too little for being in the
    /// right place a moment later.
    pub fn pose_m(&self) -> f64 {
        self.position_m + 0.5 * self.yaw_rad * self.way_m
    }
}

/// Samples of a drive of so many at which rollouts begin: every fortieth.
pub fn starts(samples: usize) -> impl Iterator<Item = usize> {
    let last = samples.saturating_sub(HORIZON + 1);
    (WARM_UP.min(last.saturating_sub(1))..last).step_by(STRIDE)
}

/// Errors of a vehicle over rollouts from every fortieth sample of drives.
pub fn symbolic_error(vehicle: &Vehicle, drives: &[&Drive], scales: &Normalization) -> SymbolicError {
    let model = StepModel::new(vehicle, scales.dt_s, scales.substeps);
    let default_soil = Soil::from_array(scales.default_soil());
    let of_drive = |drive: &&Drive| {
        starts(drive.states.len()).map(|i| rollout_error(&model, drive, i, &default_soil, scales)).fold(([0.0; 6], 0), plus)
    };
    // Summed in the order of the drives, so that calibrating again gives the same bits.
    let sums: Vec<([f64; 6], usize)> = drives.par_iter().map(of_drive).collect();
    let (sum, count) = sums.into_iter().fold(([0.0; 6], 0), |all, (sum, count)| (plus(all, sum).0, all.1 + count));
    let [position_m, tilt_rad, yaw_rad, way_m, both_rad2, measured_rad2] = sum.map(|s| s / count.max(1) as f64);
    SymbolicError { position_m, tilt_rad, yaw_rad, way_m, turning_rad2: [both_rad2, measured_rad2] }
}

/// One more rollout in a sum.
fn plus((sum, count): ([f64; 6], usize), error: [f64; 6]) -> ([f64; 6], usize) {
    (core::array::from_fn(|i| sum[i] + error[i]), count + 1)
}

/// Position (m), tilt and heading (rad), the way (m), and the products of the turning (rad²). The soil is the middle of what the map says of the class under the vehicle, or the default where it says nothing.
fn rollout_error(model: &StepModel, drive: &Drive, i: usize, default_soil: &Soil<f64>, scales: &Normalization) -> [f64; 6] {
    let mut state = drive.states[i];
    let ground = GroundSource::new(drive.map.as_deref(), model, &state);
    let mut actuators = history_actuators(model, &drive.history(i.saturating_sub(31), i), &state, &drive.controls[i], scales.dt_s);
    let way = |axis: usize| drive.states[i + HORIZON].position_m[axis] - drive.states[i].position_m[axis];
    let mut error = [0.0, 0.0, 0.0, f64::hypot(way(0), way(1)), 0.0, 0.0];
    let (mut predicted_rad, mut measured_rad) = (0.0, 0.0);
    for k in 0..HORIZON {
        let control = &drive.controls[i + k];
        let after = actuators.advance(model.vehicle(), control, state.velocity_m_s[0], scales.dt_s);
        let [x_m, y_m, _] = state.position_m;
        let class_soil = drive.map.as_deref().and_then(|map| ClassSoil::at(map, x_m, y_m));
        let input = StepInput {
            state,
            wheels: command_wheels(model.vehicle(), &actuators, &after, control),
            sinkage_log_ratio: [0.0; WHEELS],
            soil: class_soil.map_or(*default_soil, |class| Soil::from_array(from_raw(&class.mean))),
            ground: ground.under_wheels(model, &state, 0.0).0,
        };
        let increment = model.step(&input).increment;
        let before_rad = state.attitude_rad[2];
        state = VehicleState::from_array(state.advanced(&increment.to_array()));
        actuators = after;
        let measured = &drive.states[i + k + 1];
        let [x_m, y_m, _] = core::array::from_fn(|axis| state.position_m[axis] - measured.position_m[axis]);
        let [roll_rad, pitch_rad, yaw_rad] = core::array::from_fn(|axis| state.attitude_rad[axis] - measured.attitude_rad[axis]);
        error[0] += f64::hypot(x_m, y_m) / HORIZON as f64;
        error[1] += (f64::abs(roll_rad) + f64::abs(pitch_rad)) / HORIZON as f64;
        error[2] += wrap_angle(yaw_rad).abs() / HORIZON as f64;
        predicted_rad += wrap_angle(state.attitude_rad[2] - before_rad);
        measured_rad += wrap_angle(measured.attitude_rad[2] - drive.states[i + k].attitude_rad[2]);
    }
    (error[4], error[5]) = (predicted_rad * measured_rad, measured_rad * measured_rad);
    error
}

/// Searches along one number of a vehicle: takes what lowers the error most of two trials that change it by a share, again and again, and halves the share where
/// neither does. Returns the error reached, from `best`, that of the vehicle as it comes.
pub(crate) fn descend(
    vehicle: &mut Vehicle,
    mut best: f64,
    mut reach: f64,
    trials: impl Fn(&Vehicle, f64) -> [Vehicle; 2],
    error: impl Fn(&Vehicle) -> f64,
) -> f64 {
    while reach > LAST_REACH {
        let before = best;
        for trial in trials(vehicle, reach) {
            let error = error(&trial);
            if error < best {
                (best, *vehicle) = (error, trial);
            }
        }
        if best == before {
            reach *= 0.5;
        }
    }
    best
}
