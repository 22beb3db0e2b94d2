//! The rim servo of a skid-steer base, found from its wheel speeds.

mod common;

use std::sync::Arc;

use common::{drive, lively_weights, measured_scales, predictor, truck};
use nesam_learning::Drive;
use nesam_learning::rims::{fit_rims, fit_rims_to_motion};
use nesam_learning::symbolic::symbolic_error;
use nesam_model::{MeasuredWheels, ModelBundle, Predictor, RolloutQuery, Variant};
use nesam_physics::driveline::DrivelineState;
use nesam_physics::{Control, RimServo, SecondCommand, SoilCorrection, Vehicle, VehicleState};

/// Goal: the servo is found again. Method: 40 drives of two seconds under drawn twists, wheel speeds from a servo with known numbers whose limits
/// are reached in some drives and not in others.
#[test]
fn analytic_a_known_servo_is_found() {
    let truth = RimServo {
        speed_gain: 1.8,
        yaw_gain: 0.8,
        yaw_limit_rad_s: 1.8,
        rim_limit_m_s: 1.0,
        speed_lag_s: 0.3,
        yaw_lag_s: 0.4,
        turn_efficiency: 0.4,
        ..RimServo::default()
    };
    let mut vehicle = Vehicle { second: SecondCommand::YawRateRadS, track_m: 0.55, ..truck() };
    vehicle.driveline.rims = truth;
    let drives: Vec<Drive> = (0..40).map(|i| made(&vehicle, f64::from(i))).collect();
    vehicle.driveline.rims = RimServo::default();
    let found = fit_rims(&vehicle, &drives.iter().collect::<Vec<_>>(), 0.1)[0];
    let close = |a: f64, b: f64| (a / b - 1.0).abs() < 0.05;
    assert!(close(found.speed_gain, truth.speed_gain) && close(found.yaw_gain, truth.yaw_gain), "{found:?}");
    assert!(close(found.yaw_limit_rad_s, truth.yaw_limit_rad_s) && close(found.rim_limit_m_s, truth.rim_limit_m_s), "{found:?}");
    assert!(close(found.speed_lag_s, truth.speed_lag_s) && close(found.yaw_lag_s, truth.yaw_lag_s), "{found:?}");
    assert!(close(found.turn_efficiency, truth.turn_efficiency), "{found:?}");
}

/// Goal: a ramp is not taken for a lag, and its limits are found. Method: the same drives from a base that leads its rims by ramps and hardly lags.
#[test]
fn analytic_rims_that_are_led_by_ramps_are_found() {
    let truth =
        RimServo { speed_lag_s: 0.05, yaw_lag_s: 0.05, acceleration_limit: [1.2, 2.0], turn_efficiency: 0.4, ..RimServo::default() };
    let mut vehicle = Vehicle { second: SecondCommand::YawRateRadS, track_m: 0.55, ..truck() };
    vehicle.driveline.rims = truth;
    let drives: Vec<Drive> = (0..40).map(|i| made(&vehicle, f64::from(i))).collect();
    vehicle.driveline.rims = RimServo::default();
    let found = fit_rims(&vehicle, &drives.iter().collect::<Vec<_>>(), 0.1)[0];
    for i in 0..2 {
        assert!((found.acceleration_limit[i] / truth.acceleration_limit[i] - 1.0).abs() < 0.05, "{found:?}");
    }
}

/// Goal: a dead time is not taken for a lag, and is found; where there is none, none is. Method: the same drives from a base that hears its commands late.
#[test]
fn analytic_a_dead_time_is_found() {
    let found_of = |dead_time_s: [f64; 2]| {
        let mut vehicle = Vehicle { second: SecondCommand::YawRateRadS, track_m: 0.55, ..truck() };
        vehicle.driveline.rims = RimServo { speed_lag_s: 0.1, yaw_lag_s: 0.1, dead_time_s, turn_efficiency: 0.4, ..RimServo::default() };
        let drives: Vec<Drive> = (0..40).map(|i| made(&vehicle, f64::from(i))).collect();
        vehicle.driveline.rims = RimServo::default();
        fit_rims(&vehicle, &drives.iter().collect::<Vec<_>>(), 0.1)
    };
    let late = found_of([0.3, 0.25]);
    let [_, late] = late[..] else { panic!("a dead time is asked for: {late:?}") };
    assert!((late.dead_time_s[0] - 0.3).abs() < 0.02 && (late.dead_time_s[1] - 0.25).abs() < 0.02, "{late:?}");
    assert!((late.speed_lag_s - 0.1).abs() < 0.02 && (late.yaw_lag_s - 0.1).abs() < 0.02, "{late:?}");
    let at_once = found_of([0.0; 2]);
    assert!(at_once.len() == 1 && at_once[0].dead_time_s == [0.0; 2], "{at_once:?}");
}

/// Goal: a base whose wheel speeds nobody measured is calibrated, too. Method: eight drives from rest that the symbolic model makes with a known servo, without
/// wheel speeds; the servo that is found drives them with a fifth of the error of one that does what it is told,
/// and its gain and lag of the speed are the known ones. (The truck hardly turns by its rims, and the network's sinkage is not in the search.)
#[test]
fn analytic_a_servo_is_found_from_the_motion_alone() {
    let sample = drive(None, 40);
    let scales = measured_scales(&sample);
    let of_the_truck = predictor(&scales, lively_weights(&scales));
    let mut vehicle = Vehicle { second: SecondCommand::YawRateRadS, ..truck() };
    let told = vehicle.driveline.rims;
    vehicle.driveline.rims = RimServo { speed_gain: 1.4, yaw_gain: 0.6, speed_lag_s: 0.3, yaw_lag_s: 0.3, ..told };
    let truth = Predictor::new(Arc::new(ModelBundle { vehicle: vehicle.clone(), ..of_the_truck.bundle().clone() })).unwrap();
    let made = |seed: f64| {
        let control = Control { speed_m_s: 1.5 + (1.7 * seed).sin(), second: (2.9 * seed + 1.0).sin() * 0.6 };
        let start = VehicleState { velocity_m_s: [0.0; 3], angular_velocity_rad_s: [0.0; 3], ..sample.states[0] };
        let controls = control.packed().repeat(25);
        let query = RolloutQuery {
            history: &[],
            start,
            controls: &controls,
            samples: 1,
            horizon: 25,
            map: None,
            soil_correction: SoilCorrection::NONE,
            variant: Variant::NoResidual,
            start_time_s: None,
            wheels: None,
        };
        let rollout = truth.rollout(&query).unwrap();
        let driven = (0..25).map(|k| rollout.state_f64(0, k));
        Drive::new("made".into(), None, std::iter::once(start).chain(driven).collect(), vec![control; 26])
    };
    let drives: Vec<Drive> = (0..8).map(|i| made(f64::from(i))).collect();
    let drives: Vec<&Drive> = drives.iter().collect();
    vehicle.driveline.rims = told;
    let before = symbolic_error(&vehicle, &drives, &scales);
    vehicle.driveline.rims = fit_rims_to_motion(&vehicle, &drives, &scales, |_, _| (), &|| false);
    let after = symbolic_error(&vehicle, &drives, &scales);
    let found = vehicle.driveline.rims;
    assert!(after.position_m < 0.2 * before.position_m && after.yaw_rad < before.yaw_rad, "{before:?} {after:?} {found:?}");
    assert!((found.speed_gain / 1.4 - 1.0).abs() < 0.05 && (found.speed_lag_s / 0.3 - 1.0).abs() < 0.2, "{found:?}");
}

fn made(vehicle: &Vehicle, seed: f64) -> Drive {
    let control = Control { speed_m_s: (1.7 * seed).sin() * 0.7, second: (2.9 * seed + 1.0).sin() * 4.0 };
    let mut state = DrivelineState::default();
    let (mut states, mut wheels) = (Vec::new(), Vec::new());
    for _ in 0..20 {
        let half = 0.5 * vehicle.track_m * state.steering;
        let [left, right] = [state.rim_speed_m_s - half, state.rim_speed_m_s + half].map(|v| v / vehicle.wheel_radius_m);
        wheels.push([left, right, left, right]);
        let yaw = vehicle.driveline.rims.turn_efficiency * state.steering;
        states.push(VehicleState { angular_velocity_rad_s: [0.0, 0.0, yaw], ..VehicleState::from_array([0.0; 12]) });
        state = state.advance(vehicle, &control, 0.0, 0.1);
    }
    let mut drive = Drive::new("made".into(), None, states, vec![control; 20]);
    drive.wheel_speed_rad_s = Some(wheels);
    drive
}

/// Goal: wheels that were measured take the place of those that follow from the commands. Method: a servo without lag that already does what it is
/// told, its rim speeds by hand; the same wheels give the same motion, faster ones another.
#[test]
fn analytic_measured_wheels_equal_to_the_commanded_ones_change_nothing() {
    let sample = drive(None, 40);
    let scales = measured_scales(&sample);
    let mut vehicle = Vehicle { second: SecondCommand::YawRateRadS, ..truck() };
    vehicle.driveline.rims = RimServo { yaw_lag_s: 0.0, ..RimServo::default() };
    let (radius, half) = (vehicle.wheel_radius_m, 0.5 * vehicle.track_m);
    let of_the_truck = predictor(&scales, lively_weights(&scales));
    let predictor = Predictor::new(Arc::new(ModelBundle { vehicle, ..of_the_truck.bundle().clone() })).unwrap();

    let start = VehicleState { velocity_m_s: [1.0, 0.0, 0.0], angular_velocity_rad_s: [0.0, 0.0, 0.4], ..sample.states[0] };
    let controls = [1.0_f32, 0.4].repeat(8);
    let wheels = |scale: f64| {
        let [left, right] = [1.0 - half * 0.4, 1.0 + half * 0.4].map(|v| scale * v / radius);
        [MeasuredWheels { speed_rad_s: [left, right, left, right], angle_rad: [0.0; 4] }; 8]
    };
    let end = |wheels: Option<&[MeasuredWheels]>| {
        let query = RolloutQuery {
            history: &[],
            start,
            controls: &controls,
            samples: 1,
            horizon: 8,
            map: None,
            soil_correction: SoilCorrection::NONE,
            variant: Variant::Full,
            start_time_s: None,
            wheels,
        };
        predictor.rollout(&query).unwrap().state(0, 7).to_array()
    };
    let (commanded, same, faster) = (end(None), end(Some(&wheels(1.0))), end(Some(&wheels(1.2))));
    let apart = |other: [f32; 12]| commanded.iter().zip(other).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(apart(same) < 1e-4, "{commanded:?} {same:?}");
    assert!(apart(faster) > 0.02, "{commanded:?} {faster:?}");
}
