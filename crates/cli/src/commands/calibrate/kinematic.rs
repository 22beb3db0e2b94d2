//! What a kinematic fit is off by over the rollouts by which the physics is judged.

use nesam_evaluation::Kinematic;
use nesam_learning::Drive;
use nesam_learning::symbolic::{HORIZON, starts};
use nesam_model::HISTORY;
use nesam_physics::{Vehicle, wrap_angle};

use super::Errors;

/// Mean errors over the rollouts of a drive.
pub(super) fn kinematic_error(fit: &Kinematic, vehicle: &Vehicle, drive: &Drive, dt_s: f64) -> Errors {
    let mut sum = Errors::default();
    let starts: Vec<usize> = starts(drive.states.len()).collect();
    for &i in &starts {
        let (past, future) = (&drive.controls[i.saturating_sub(HISTORY)..i], &drive.controls[i..i + HORIZON]);
        let (mut predicted_rad, mut measured_rad) = (0.0, 0.0);
        let (mut before, mut yaw_before) = (&drive.states[i], drive.states[i].attitude_rad[2]);
        for ([x, y, yaw], measured) in fit.plane_path(vehicle, before, past, future, dt_s).into_iter().zip(&drive.states[i + 1..]) {
            sum.position_m += (x - measured.position_m[0]).hypot(y - measured.position_m[1]) / HORIZON as f64;
            sum.yaw_rad += wrap_angle(yaw - measured.attitude_rad[2]).abs() / HORIZON as f64;
            predicted_rad += wrap_angle(yaw - yaw_before);
            measured_rad += wrap_angle(measured.attitude_rad[2] - before.attitude_rad[2]);
            (before, yaw_before) = (measured, yaw);
        }
        let products = [predicted_rad * measured_rad, measured_rad * measured_rad];
        sum.turning_rad2 = [0, 1].map(|k| sum.turning_rad2[k] + products[k]);
    }
    let count = starts.len().max(1) as f64;
    Errors {
        position_m: sum.position_m / count,
        yaw_rad: sum.yaw_rad / count,
        tilt_rad: None,
        turning_rad2: sum.turning_rad2.map(|product| product / count),
    }
}
