//! Goal: each effect moves the vehicle as mechanics says, and is nothing when scaled to zero.
//! Method: closed forms of statics and steady turns on level ground.
#![allow(clippy::unwrap_used)]

mod actuator;
#[path = "../common/mod.rs"]
mod common;
mod force;
mod map;
mod page;
mod schedule;
mod sensor;
mod soil;
mod sweep;
mod written;

use common::Drive;
use nesam_physics::effects::{Effect, Payload, SteeringOffset, WheelDrag};
use nesam_test_vehicles::truck;

const EXAMPLES: [Effect; 3] = [
    Effect::Payload(Payload { mass_kg: 600.0, at_m: [-1.4, 0.0, 0.77] }),
    Effect::WheelDrag(WheelDrag { wheel: 3, torque_n_m: 900.0 }),
    Effect::SteeringOffset(SteeringOffset { second: 0.12 }),
];

/// A drive of the truck with effects on level ground, and the loads of its wheels at the end.
fn settle(effects: &[Effect], speed: f64, second: f64, steps: usize) -> (Drive, [f64; 4]) {
    let mut drive = Drive::new(truck().with_effects(effects), speed);
    let mut loads = [0.0; 4];
    for _ in 0..steps {
        loads = drive.step(speed, second).contacts.map(|c| c.normal_n);
    }
    (drive, loads)
}

#[test]
fn property_an_effect_scaled_to_zero_changes_no_bit() {
    for effect in EXAMPLES {
        let with = settle(&[effect.scaled(0.0)], 2.0, 0.3, 20).0.state;
        let without = settle(&[], 2.0, 0.3, 20).0.state;
        assert_eq!(with.to_array().map(f64::to_bits), without.to_array().map(f64::to_bits), "{}", effect.id());
    }
}

#[test]
fn property_parameters_round_trip() {
    for effect in EXAMPLES {
        let values: Vec<f64> = effect.parameters().iter().map(|p| p.value).collect();
        assert_eq!(Effect::from_parameters(effect.id(), &values), Some(effect));
        for p in effect.parameters() {
            assert!(p.range[0] < p.value && p.value < p.range[1], "{} {}", effect.id(), p.name);
        }
    }
    assert_eq!(Effect::from_parameters("payload", &[1.0]), None);
}

#[test]
fn analytic_payload_loads_the_axles_by_the_lever_rule() {
    let (_, loads) = settle(&[EXAMPLES[0]], 0.0, 0.0, 80);
    let rear = loads[2] + loads[3];
    let total: f64 = loads.iter().sum();
    let (mass, added, g) = (2493.56, 600.0, 9.81);
    assert!((total - (mass + added) * g).abs() < 0.01 * total, "weight {total}");
    // Moments about the front axle: the rear axle carries m g (x_f - x) / L of every mass.
    let want = g * (mass * 1.5949 + added * (1.5949 + 1.4)) / (1.5949 + 1.7028);
    assert!((rear / want - 1.0).abs() < 0.03, "rear axle {rear}, lever rule {want}");
}

#[test]
fn analytic_drag_at_the_right_turns_right_at_the_commanded_speed() {
    let (dragged, _) = settle(&[EXAMPLES[1]], 2.5, 0.0, 40);
    let (free, _) = settle(&[], 2.5, 0.0, 40);
    assert!(dragged.state.attitude_rad[2] < -0.01, "yaw {}", dragged.state.attitude_rad[2]);
    let [slower, faster] = [&dragged, &free].map(|d| d.state.velocity_m_s[0]);
    assert!((slower - faster).abs() < 0.05, "{slower} {faster}");
}

/// A coupling passes torque between the wheels of an axle, never along with it: equal drags do not notice it, and a stiff one turns the vehicle
/// by far less than an open differential does.
#[test]
fn analytic_a_coupling_shares_drag_within_the_axle() {
    let run = |coupling: f64, drags: [f64; 2]| {
        let mut vehicle = truck();
        vehicle.driveline.side_coupling_n_m_s = coupling;
        let effects = [2, 3].map(|wheel| Effect::WheelDrag(WheelDrag { wheel, torque_n_m: drags[wheel - 2] }));
        let mut drive = Drive::new(vehicle.with_effects(&effects), 2.5);
        (0..40).for_each(|_| {
            drive.step(2.5, 0.0);
        });
        drive.state
    };
    let bits = |s: nesam_physics::VehicleState<f64>| s.to_array().map(f64::to_bits);
    assert_eq!(bits(run(0.0, [450.0, 450.0])), bits(run(250.0, [450.0, 450.0])));
    let [open, limited, stiff] = [0.0, 250.0, 1e6].map(|coupling| run(coupling, [0.0, 900.0]));
    let yaw = |s: &nesam_physics::VehicleState<f64>| -s.attitude_rad[2];
    assert!(yaw(&open) > 1.05 * yaw(&limited), "{} {}", yaw(&open), yaw(&limited));
    assert!(yaw(&stiff).abs() < 0.05 * yaw(&open), "{} {}", yaw(&open), yaw(&stiff));
    assert!((stiff.velocity_m_s[0] - open.velocity_m_s[0]).abs() < 0.02, "the sum of the drags stays");
}

#[test]
fn analytic_offset_steers_like_the_command_that_equals_it() {
    let (offset, _) = settle(&[EXAMPLES[2]], 2.0, 0.0, 30);
    let mut commanded = Drive::new(truck(), 2.0);
    commanded.actuators.steering = 0.12;
    for _ in 0..30 {
        commanded.step(2.0, 0.12);
    }
    assert!((offset.state.attitude_rad[2] - commanded.state.attitude_rad[2]).abs() < 1e-9);
}
