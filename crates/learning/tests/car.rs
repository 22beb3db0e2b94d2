//! The drive line of a car and the ground under it, from how it moves.

mod common;

use std::f64::consts::TAU;
use std::io::Write as _;

use common::{drive_on_side, truck};
use nesam_learning::Drive;
use nesam_learning::calibrate::{Calibrated, calibrate_vehicle};
use nesam_learning::recipe::Reporter;
use nesam_learning::scales::MIDDLE_SOIL;
use nesam_learning::symbolic::symbolic_error;
use nesam_physics::{Control, HARD_GROUND, VehicleState};
use nesam_trajectories::read_vehicle_card;

/// What somebody knows of a small car.
const SHEET: &str = r#"{
    "vehicle": "small car", "mass_total": 400.0, "wheel_radius_m": 0.3, "wheel_width_m": 0.2, "track_m": 1.2, "wheelbase_m": 1.6,
    "wheel_order": ["FL", "FR", "RL", "RR"], "second": "road_wheel_angle_rad"
}"#;

/// Says nothing.
struct Silent;

impl Reporter for Silent {
    fn line(&self, _: &str) {}
    fn stage(&self, _: &str, _: usize) {}
    fn progress(&self, _: usize, _: &str) {}
}

/// A car that comes to this share of the commanded speed and steers late, 20 s at 10 Hz; its position is that of a point so far ahead of the rear axle.
fn driven(number: usize, share: f64, ahead_m: f64) -> Drive {
    let (mut states, mut controls) = (Vec::new(), Vec::new());
    let [mut x, mut y, mut yaw, mut speed, mut angle] = [0.0; 5];
    let (dt, phase) = (0.01, number as f64);
    for i in 0..2000 {
        let t = dt * f64::from(i);
        let command = [2.0 + (TAU * (0.05 + 0.02 * phase) * t + phase).sin(), 0.25 * (TAU * (0.09 - 0.01 * phase) * t + 2.0 * phase).sin()];
        let turn = speed * f64::tan(angle) / 1.6;
        if i % 10 == 0 {
            let mut state = [0.0; 12];
            (state[0], state[1], state[5], state[6], state[11]) = (x + ahead_m * yaw.cos(), y + ahead_m * yaw.sin(), yaw, speed, turn);
            state[7] = ahead_m * turn;
            states.push(VehicleState::from_array(state));
            controls.push(Control { speed_m_s: command[0], second: command[1] });
        }
        speed += dt * (share * command[0] - speed) / 0.4;
        angle += dt * (command[1] - angle) / 0.15;
        yaw += dt * turn;
        (x, y) = (x + dt * speed * yaw.cos(), y + dt * speed * yaw.sin());
    }
    Drive::new(format!("drive {number}"), None, states, controls)
}

/// Goal: a car is not made to turn too little for being in the right place a moment later. Method: drives of a bicycle, a card of its data sheet; its position and its
/// heading are both to be better with the fitted card.
#[test]
fn regress_the_heading_is_not_given_for_the_position() {
    let drives: Vec<Drive> = (0..4).map(|number| driven(number, 0.9, 0.0)).collect();
    let drives: Vec<&Drive> = drives.iter().collect();
    let mut sheet = tempfile::NamedTempFile::new().unwrap();
    sheet.write_all(SHEET.as_bytes()).unwrap();
    let card = read_vehicle_card(sheet.path()).unwrap();
    let Calibrated { vehicle: fitted, scales, .. } = calibrate_vehicle(card.clone(), &drives, 0.1, &Silent, &|| false).unwrap();
    let [before, after] = [&card, &fitted].map(|vehicle| symbolic_error(vehicle, &drives, &scales));
    println!("{before:?} -> {after:?}, coupling {}", fitted.driveline.side_coupling_n_m_s);
    assert!(after.position_m < 0.7 * before.position_m, "{before:?} -> {after:?}");
    assert!(after.yaw_rad < before.yaw_rad, "{before:?} -> {after:?}");
}

/// Goal: where no map tells of the ground, what a vehicle does on it tells loam from a floor. Method: drives of a bicycle that comes to
/// its speed and never slips, its position between the axles as the sheet has it, and of a truck on loam.
#[test]
fn analytic_ground_without_a_map_is_found() {
    let mut sheet = tempfile::NamedTempFile::new().unwrap();
    sheet.write_all(SHEET.as_bytes()).unwrap();
    let car = (read_vehicle_card(sheet.path()).unwrap(), (0..2).map(|number| driven(number, 1.0, 0.8)).collect::<Vec<Drive>>());
    let on_loam = (truck(), [-1.0, 1.0].map(|side| drive_on_side(None, 160, side)).to_vec());
    for ((vehicle, drives), [ground, other]) in [(car, [HARD_GROUND, MIDDLE_SOIL]), (on_loam, [MIDDLE_SOIL, HARD_GROUND])] {
        let drives: Vec<&Drive> = drives.iter().collect();
        let found = calibrate_vehicle(vehicle, &drives, 0.1, &Silent, &|| false).unwrap().scales.default_soil();
        let apart = |soil: &[f64]| found.iter().zip(soil).map(|(a, b)| f64::abs(a / b - 1.0)).sum::<f64>();
        assert!(apart(&ground) < 0.01 && apart(&other) > 1.0, "{found:?}");
    }
}
