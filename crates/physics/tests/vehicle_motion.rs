//! Goal: the step moves a vehicle as mechanics demands, stably at Δt = 0.1 s, for a truck and for a small robot.
//! Method: force balance at rest, slopes, turns and falls against closed forms; refinement of the sub-step.

mod common;

use common::Drive;
use nesam_physics::step::StepModel;
use nesam_test_vehicles::{robot, torque_truck, truck};

#[test]
fn analytic_weight_is_carried_at_rest() {
    for vehicle in [truck(), torque_truck(), robot()] {
        let weight = vehicle.mass_kg * vehicle.gravity_m_s2;
        let mut drive = Drive::new(vehicle, 0.0);
        let mut load = 0.0;
        for _ in 0..60 {
            load = drive.step(0.0, 0.0).contacts.iter().map(|c| c.normal_n).sum();
        }
        let speed = drive.state.velocity_m_s.iter().map(|v| v.abs()).fold(0.0, f64::max);
        assert!((load - weight).abs() < 1e-3 * weight, "load {load}, weight {weight}");
        // Wong-Reece pulls a little at zero slip, so a parked vehicle creeps below the regularising speed of the slip.
        assert!(speed < 0.1, "creep {speed} m/s");
    }
}

#[test]
fn property_commanded_speed_is_approached_and_held() {
    for (vehicle, speed) in [(truck(), 3.0), (torque_truck(), 3.0), (robot(), 0.8)] {
        let mut drive = Drive::new(vehicle, 0.0);
        for _ in 0..150 {
            drive.step(speed, 0.0);
        }
        let reached = drive.state.velocity_m_s[0];
        // Under torque the demand that holds the usual resistance may hold a little more than this ground asks for.
        let over = if drive.model.vehicle().driveline.torque.is_some() { 1.03 } else { 1.0 };
        assert!((0.6 * speed..=over * speed).contains(&reached), "{reached} of {speed} m/s");
        assert!(drive.state.position_m[1].abs() < 0.05, "straight on");
    }
}

#[test]
fn property_left_is_left_and_sides_are_mirror_images() {
    for vehicle in [truck(), torque_truck(), robot()] {
        let turn = |second: f64| {
            let mut drive = Drive::new(vehicle.clone(), 1.0);
            for _ in 0..40 {
                drive.step(1.0, second);
            }
            drive.state
        };
        let (left, right) = (turn(0.5), turn(-0.5));
        assert!(left.attitude_rad[2] > 0.1 && left.position_m[1] > 0.0, "{left:?}");
        assert!((left.attitude_rad[2] + right.attitude_rad[2]).abs() < 2e-3, "{} {}", left.attitude_rad[2], right.attitude_rad[2]);
    }
}

#[test]
fn analytic_turn_follows_the_bicycle_when_slow() {
    // Firm ground, 1 m/s: yaw rate close to v tan(δ) / wheelbase (small side slip).
    let mut drive = Drive::new(truck(), 1.0);
    drive.soil.k_phi *= 5.0;
    drive.soil.k_shear = 0.008;
    for _ in 0..60 {
        drive.step(1.0, 0.5);
    }
    let kinematic = drive.state.velocity_m_s[0] * (0.185f64).tan() / 3.2977;
    let rate = drive.state.angular_velocity_rad_s[2];
    assert!((rate / kinematic - 1.0).abs() < 0.15, "yaw rate {rate}, bicycle {kinematic}");
}

#[test]
fn analytic_attitude_follows_the_slope() {
    let mut drive = Drive::new(truck(), 1.0);
    let climb = 0.1f64;
    drive.slope = [climb, 0.0];
    for _ in 0..100 {
        drive.step(2.0, 0.0);
    }
    // Nose up is negative pitch; a little squat is left to the suspension and the soil.
    assert!((drive.state.attitude_rad[1] + climb.atan()).abs() < 0.03, "pitch {}", drive.state.attitude_rad[1]);
    let speed_uphill = drive.state.velocity_m_s[0];
    assert!(speed_uphill > 0.5 && speed_uphill < 2.0, "speed {speed_uphill}");
}

#[test]
fn analytic_free_fall_before_touching_ground() {
    let mut drive = Drive::new(truck(), 0.0);
    drive.state.position_m[2] += 5.0;
    for _ in 0..5 {
        drive.step(0.0, 0.0);
    }
    let fallen = -drive.state.velocity_m_s[2];
    assert!((fallen - 9.81 * 0.5).abs() < 0.02, "fell at {fallen} m/s");
}

#[test]
fn property_hard_starts_stay_finite() {
    for vehicle in [truck(), robot()] {
        let command = vehicle.command_range[0];
        for (height, roll, speed) in [(0.5, 0.3, 6.0), (-0.2, -0.2, -2.0), (0.0, 0.0, 10.0)] {
            let mut drive = Drive::new(vehicle.clone(), speed);
            drive.state.position_m[2] += height;
            drive.state.attitude_rad[0] = roll;
            for k in 0..64 {
                drive.step(command[k % 2], if k % 7 < 3 { 1.0 } else { -1.0 });
                assert!(drive.state.to_array().iter().all(|x| x.is_finite() && x.abs() < 1e3), "{:?}", drive.state);
            }
        }
    }
}

#[test]
fn property_two_substeps_are_close_to_many() {
    let run = |substeps| {
        let mut drive = Drive::new(truck(), 2.0);
        drive.model = StepModel::new(&truck(), 0.1, substeps);
        for k in 0..32 {
            drive.step(2.5, (k as f64 * 0.15).sin() * 0.6);
        }
        drive.state
    };
    let (coarse, fine) = (run(2), run(32));
    let error = (0..2).map(|i| (coarse.position_m[i] - fine.position_m[i]).abs()).fold(0.0, f64::max);
    assert!(error < 0.05, "position differs by {error} m over 3.2 s");
    assert!((coarse.attitude_rad[2] - fine.attitude_rad[2]).abs() < 0.02);
}
