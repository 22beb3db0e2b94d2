//! Goal: what mechanics demands of every step, whatever the input: symmetry, no dependence on place and direction, no energy from
//! nothing, no pull of the ground, stability.
//! Method: proptest with a fixed seed over plausible steps (`common::spread`) and over drives on planes.

mod common;

use common::{Drive, INPUTS, spread, unflatten};
use nesam_physics::driveline::{road_wheel_angles, steering_command_of};
use nesam_physics::step::{Ground, StepInput, StepModel};
use nesam_physics::vec3::{Tilt, attitude_of_quaternion, cross, dot};
use nesam_physics::{DT_S, SecondCommand, Vehicle, VehicleState};
use nesam_test_vehicles::{robot, truck};
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

fn seeded(cases: u32) -> ProptestConfig {
    ProptestConfig { cases, rng_seed: RngSeed::Fixed(20_262), failure_persistence: None, ..ProptestConfig::default() }
}

/// The truck with its left-right differences of a tenth of a millimetre removed, or the robot.
fn vehicle(truck_wanted: bool) -> Vehicle {
    let mut vehicle = if truck_wanted { truck() } else { robot() };
    for (left, right) in [(0, 1), (2, 3)] {
        let [x, y, z] = vehicle.wheel_centre_m[left];
        vehicle.wheel_centre_m[right] = [x, -y, z];
    }
    vehicle
}

fn input(vehicle: &Vehicle, unit: &[f64]) -> StepInput<f64> {
    unflatten(vehicle, &spread(vehicle, unit))
}

/// Front left becomes front right, rear left becomes rear right.
fn swapped<A: Copy>(four: [A; 4]) -> [A; 4] {
    [four[1], four[0], four[3], four[2]]
}

/// Reflection in the x-z plane: y, roll, yaw, v_y, ω_x, ω_z change sign.
fn mirrored_state(state: &VehicleState<f64>) -> VehicleState<f64> {
    const SIGN: [f64; 12] = [1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0];
    let x = state.to_array();
    VehicleState::from_array(core::array::from_fn(|i| SIGN[i] * x[i]))
}

fn mirrored(input: &StepInput<f64>) -> StepInput<f64> {
    let mut wheels = input.wheels;
    wheels.angle_rad = swapped(input.wheels.angle_rad).map(|angle| -angle);
    wheels.rim_base_m_s = swapped(input.wheels.rim_base_m_s);
    StepInput {
        state: mirrored_state(&input.state),
        wheels,
        sinkage_log_ratio: swapped(input.sinkage_log_ratio),
        ground: swapped(input.ground).map(|g| Ground { slope_left: -g.slope_left, ..g }),
        ..*input
    }
}

fn kinetic_energy_j(vehicle: &Vehicle, state: &VehicleState<f64>) -> f64 {
    let (v, w) = (state.velocity_m_s, state.angular_velocity_rad_s);
    0.5 * vehicle.mass_kg * dot(v, v) + 0.5 * dot(w, vehicle.inertia_kg_m2.map(|row| dot(row, w)))
}

/// Horizontal distance between two states, m.
fn distance_m(a: &VehicleState<f64>, b: &VehicleState<f64>) -> f64 {
    (a.position_m[0] - b.position_m[0]).hypot(a.position_m[1] - b.position_m[1])
}

proptest! {
    #![proptest_config(seeded(256))]

    #[test]
    fn property_a_mirrored_step_is_the_mirror_image(truck_wanted: bool, unit in vec(0.0..1.0f64, INPUTS)) {
        let model = StepModel::new(&vehicle(truck_wanted), DT_S, 2);
        let input = input(model.vehicle(), &unit);
        let (step, mirror) = (model.step(&input), model.step(&mirrored(&input)));
        let (want, got) = (mirrored_state(&step.increment).to_array(), mirror.increment.to_array());
        for i in 0..12 {
            // Sums over the wheels run in another order: rounding, amplified by the stiffness of the contact.
            prop_assert!((got[i] - want[i]).abs() < 1e-9, "component {i}: {} and {}", got[i], want[i]);
        }
        for (a, b) in swapped(step.contacts).iter().zip(&mirror.contacts) {
            prop_assert!((a.normal_n - b.normal_n).abs() < 1e-9 * (1.0 + a.normal_n));
            prop_assert!((a.left_n + b.left_n).abs() < 1e-6 * (1.0 + a.normal_n));
        }
    }

    #[test]
    fn property_a_step_does_not_read_place_and_heading(truck_wanted: bool, unit in vec(0.0..1.0f64, INPUTS), x in -1e6..1e6f64, y in -1e6..1e6f64, yaw in -3.2..3.2f64) {
        let model = StepModel::new(&vehicle(truck_wanted), DT_S, 2);
        let here = input(model.vehicle(), &unit);
        let mut there = here;
        (there.state.position_m[0], there.state.position_m[1], there.state.attitude_rad[2]) = (x, y, yaw);
        let bits = |input: &StepInput<f64>| model.step(input).increment.to_array().map(f64::to_bits);
        prop_assert_eq!(bits(&here), bits(&there));
    }

    #[test]
    fn property_ground_never_pulls(truck_wanted: bool, unit in vec(0.0..1.0f64, INPUTS)) {
        let model = StepModel::new(&vehicle(truck_wanted), DT_S, 2);
        for contact in model.step(&input(model.vehicle(), &unit)).contacts {
            prop_assert!(contact.normal_n >= 0.0 && contact.sinkage_m > 0.0, "{contact:?}");
        }
    }

    #[test]
    fn property_airborne_wheels_carry_next_to_nothing(truck_wanted: bool, unit in vec(0.0..1.0f64, INPUTS), height in 0.5..3.0f64) {
        let model = StepModel::new(&vehicle(truck_wanted), DT_S, 2);
        let mut input = input(model.vehicle(), &unit);
        input.state.position_m[2] += height;
        let static_load = model.vehicle().static_load_n();
        for (contact, load) in model.step(&input).contacts.iter().zip(static_load) {
            prop_assert!(contact.normal_n < 1e-3 * load, "{contact:?}");
            prop_assert!(contact.forward_n.abs() < 5e-3 * load && contact.left_n.abs() < 5e-3 * load, "{contact:?}");
        }
    }
}

proptest! {
    #![proptest_config(seeded(96))]

    #[test]
    fn property_coasting_on_flat_ground_gains_no_energy(truck_wanted: bool, share in 0.0..1.0f64, second in -1.0..1.0f64) {
        let vehicle = vehicle(truck_wanted);
        let [slowest, fastest] = vehicle.command_range[0];
        let speed = slowest + (fastest - slowest) * share;
        let mut drive = Drive::new(vehicle, speed);
        for _ in 0..20 {
            drive.step(speed, 0.5 * second);
        }
        // The creep of a parked vehicle (see `analytic_weight_is_carried_at_rest`) is the floor of what can be told from rest.
        let floor = 0.5 * drive.model.vehicle().mass_kg * 0.1 * 0.1;
        let mut energy = kinetic_energy_j(drive.model.vehicle(), &drive.state);
        for k in 0..40 {
            drive.step(0.0, 0.0);
            let after = kinetic_energy_j(drive.model.vehicle(), &drive.state);
            prop_assert!(after <= 1.001 * energy + floor, "step {k}: {energy} J to {after} J");
            energy = after;
        }
    }

    #[test]
    fn property_parked_on_a_slope_slides_less_than_a_free_body(truck_wanted: bool, slope_deg in 0.0..10.0f64, uphill in -3.2..3.2f64) {
        let mut drive = Drive::new(vehicle(truck_wanted), 0.0);
        let rise = slope_deg.to_radians().tan();
        drive.slope = [rise * uphill.cos(), rise * uphill.sin()];
        let (start, seconds) = (drive.state, 3.0);
        for _ in 0..(seconds / DT_S) as usize {
            drive.step(0.0, 0.0);
        }
        let free_m = 0.5 * 9.81 * slope_deg.to_radians().sin() * seconds * seconds;
        let slid_m = distance_m(&start, &drive.state);
        prop_assert!(drive.state.to_array().iter().all(|x| x.is_finite()));
        // The suspension settles by a few centimetres and the contact creeps; 13 cm were the most on ten degrees.
        prop_assert!(slid_m < 0.05 + 0.05 * free_m, "slid {slid_m} m of {free_m} m, {:?}", drive.state);
    }

    #[test]
    fn property_a_skid_steer_robot_turns_on_the_spot(rate in 0.5..4.0f64, left: bool) {
        let rate = if left { rate } else { -rate };
        let mut drive = Drive::new(robot(), 0.0);
        let start = drive.state;
        for _ in 0..30 {
            drive.step(0.0, rate);
        }
        let turned = drive.state.attitude_rad[2] / (rate * 3.0);
        // On deformable soil a third of the rotation of the rims turns the robot, the rest is slip.
        prop_assert!(turned > 0.25 && turned < 0.6, "turned {turned} of the command");
        prop_assert!(distance_m(&start, &drive.state) < 0.02, "moved {} m", distance_m(&start, &drive.state));
    }

    #[test]
    fn property_stable_over_the_whole_range_of_commands(truck_wanted: bool, unit in vec((0.0..1.0f64, 0.0..1.0f64), 8), slope in -0.15..0.15f64) {
        let vehicle = vehicle(truck_wanted);
        let range = vehicle.command_range;
        let skid = vehicle.second == SecondCommand::YawRateRadS;
        let mut drive = Drive::new(vehicle, 0.0);
        drive.slope = [slope, 0.0];
        for (speed, second) in unit {
            let [speed, second] = [(speed, range[0]), (second, range[1])].map(|(u, [low, high])| low + (high - low) * u);
            // Eight steps of each command, from one end of the range to the other at once.
            for _ in 0..8 {
                drive.step(speed, second);
                let s = &drive.state;
                prop_assert!(s.to_array().iter().all(|x| x.is_finite()), "{s:?}");
                prop_assert!(s.velocity_m_s.iter().all(|v| v.abs() < 1.5 * range[0][1] + 2.0), "{s:?}");
                prop_assert!(s.attitude_rad[0].abs() < 0.6 && s.attitude_rad[1].abs() < 0.6, "{s:?}");
                let turn = if skid { 1.5 * range[1][1] } else { 3.0 };
                prop_assert!(s.angular_velocity_rad_s.iter().all(|w| w.abs() < turn), "{s:?}");
            }
        }
    }
}

#[test]
fn property_the_steering_command_of_an_angle_makes_that_angle() {
    let truck = truck();
    for i in 0..=60 {
        let command = -1.2 + 0.04 * f64::from(i);
        let [left, right, ..] = road_wheel_angles(&truck, command);
        let found = steering_command_of(&truck, 0.5 * (left + right)).expect("a steered vehicle");
        assert!((found - command).abs() < 1e-12, "{command}: {found}");
    }
    assert_eq!(steering_command_of(&robot(), 0.1), None);
}

/// Goal: a quaternion and the angles of R = Rz Ry Rx are one rotation. Method: both turn the axes of Body; a negated quaternion is the same rotation.
#[test]
fn property_angles_of_quaternions_are_the_same_rotation() {
    let mut runner = proptest::test_runner::TestRunner::new(seeded(200));
    runner
        .run(&[-1.0..1.0f64, -1.0..1.0, -1.0..1.0, -1.0..1.0], |quaternion| {
            let length = quaternion.iter().map(|v| v * v).sum::<f64>().sqrt();
            prop_assume!(length > 0.2);
            let [x, y, z, w] = quaternion.map(|v| v / length);
            let angles = attitude_of_quaternion([x, y, z, w]).expect("a rotation");
            prop_assert_eq!(attitude_of_quaternion([-x, -y, -z, -w]), Some(angles));
            let [roll, pitch, yaw] = angles;
            let (sin, cos) = yaw.sin_cos();
            for axis in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]] {
                let [ahead, left, up] = Tilt::new(roll, pitch).to_heading(axis);
                // v + 2 w (q x v) + 2 q x (q x v).
                let q = [x, y, z];
                let turned = cross(q, axis);
                let twice = cross(q, turned);
                let expected: [f64; 3] = core::array::from_fn(|i| axis[i] + 2.0 * (w * turned[i] + twice[i]));
                for (found, expected) in [cos * ahead - sin * left, sin * ahead + cos * left, up].into_iter().zip(expected) {
                    prop_assert!((found - expected).abs() < 1e-9, "{:?}: {} {}", quaternion, found, expected);
                }
            }
            Ok(())
        })
        .expect("holds");
    assert_eq!(attitude_of_quaternion([0.0; 4]), None);
    assert_eq!(attitude_of_quaternion([f64::NAN, 0.0, 0.0, 1.0]), None);
}
