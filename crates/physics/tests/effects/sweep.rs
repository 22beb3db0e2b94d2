//! Goal: what every effect of the catalogue owes. Method: the same drive of truck and robot with each, through actuators, ground, soil and sensors.

use nesam_physics::driveline::{DrivelineState, command_wheels};
use nesam_physics::effects::*;
use nesam_physics::step::{Ground, StepInput, StepModel};
use nesam_physics::{Control, DT_S, Soil, Vehicle, VehicleState};
use nesam_test_vehicles::{robot, truck};

use crate::common::loam;

/// The measured state after a drive of `steps` on level ground, speeding up while it turns by `turn` · (a growing second command).
fn drive(base: &Vehicle, effects: &[Effect], turn: f64, steps: usize) -> VehicleState<f64> {
    let vehicle = base.with_effects(effects);
    let (model, terms) = (StepModel::new(&vehicle, DT_S, 2), &vehicle.effects);
    let fast = 0.5 * base.command_range[0][1].min(6.0);
    let mut state = VehicleState::zero();
    state.position_m[2] = vehicle.wheel_radius_m - vehicle.wheel_centre_m[0][2];
    state.velocity_m_s[0] = 0.5 * fast;
    let mut actuators = DrivelineState::settled(&Control { speed_m_s: 0.5 * fast, second: 0.0 });
    for k in 0..steps {
        let time_s = k as f64 * DT_S;
        let control = Control { speed_m_s: fast * (0.5 + 0.5 * (k as f64 / 10.0).min(1.0)), second: turn * (k as f64 / 10.0).min(1.0) };
        let after = actuators.advance(&vehicle, &control, state.velocity_m_s[0], model.dt_s());
        let [roll, pitch, yaw] = state.attitude_rad;
        let (sin, cos) = yaw.sin_cos();
        let ground = model.wheel_offsets_heading(roll, pitch).map(|offset| {
            let x = state.position_m[0] + cos * offset[0] - sin * offset[1];
            let y = state.position_m[1] + sin * offset[0] + cos * offset[1];
            let (height_m, [east, north]) = terms.map.raised(x, y, (0.0, [0.0; 2]));
            Ground { height_m, slope_ahead: cos * east + sin * north, slope_left: cos * north - sin * east }
        });
        let input = StepInput {
            state,
            wheels: command_wheels(&vehicle, &actuators, &after, &control),
            sinkage_log_ratio: [0.0; 4],
            soil: Soil::from_array(terms.soil.drifted(loam().to_array(), Some(10.0 + time_s))),
            ground,
        };
        state = VehicleState::from_array(state.advanced(&model.step(&input).increment.to_array()));
        actuators = after;
    }
    terms.sensor.to_measured(&state)
}

/// The effect of the mirror image.
fn mirrored(effect: &Effect) -> Effect {
    let flip = |(q, value): (&Quantity, f64)| match q.name {
        "wheel" => f64::from((value as u32) ^ 1),
        _ if q.odd => -value,
        _ => value,
    };
    let values: Vec<f64> = effect.quantities().iter().zip(effect.values()).map(flip).collect();
    Effect::from_parameters(effect.id(), &values).unwrap()
}

#[test]
fn property_ids_are_unique_and_parameters_round_trip_within_their_ranges() {
    assert_eq!(Effect::IDS.len(), 54);
    for (i, effect) in Effect::examples().iter().enumerate() {
        assert_eq!(Effect::IDS[i], effect.id());
        assert_eq!(Effect::IDS.iter().filter(|id| **id == effect.id()).count(), 1);
        assert_eq!(Effect::from_parameters(effect.id(), &effect.values()), Some(*effect));
        assert_eq!(Effect::from_parameters(effect.id(), &[0.0; 9]), None);
        for p in effect.parameters() {
            assert!(p.range[0] <= p.value && p.value <= p.range[1], "{} {} = {}", effect.id(), p.name, p.value);
        }
    }
}

#[test]
fn analytic_a_share_is_what_scaling_made_of_a_unit() {
    for scaling in [Scaling::Size, Scaling::Factor, Scaling::Limit] {
        assert!((scaling.share(0.4, scaling.apply(0.4, 2.5)) - 2.5).abs() < 1e-12, "{scaling:?}");
    }
}

#[test]
fn property_every_effect_scaled_to_zero_changes_no_bit() {
    for vehicle in [truck(), robot()] {
        let bits = |effects: &[Effect]| drive(&vehicle, effects, 0.4, 12).to_array().map(f64::to_bits);
        let without = bits(&[]);
        for effect in Effect::examples() {
            assert_eq!(bits(&[effect.scaled(0.0)]), without, "{} on {}", effect.id(), vehicle.name);
        }
    }
}

#[test]
fn property_the_ends_of_every_range_stay_finite() {
    for effect in Effect::examples() {
        for (p, parameter) in effect.parameters().iter().enumerate() {
            for end in parameter.range {
                let mut values = effect.values();
                values[p] = end;
                let x = drive(&truck(), &[Effect::from_parameters(effect.id(), &values).unwrap()], 0.6, 20).to_array();
                assert!(x.iter().all(|v| v.is_finite() && v.abs() < 1e3), "{} {} = {end}: {x:?}", effect.id(), parameter.name);
            }
        }
    }
}

#[test]
fn property_the_mirror_image_of_every_effect_mirrors_the_drive() {
    // Sizes are those of a car: a robot of 50 kg gets a tenth.
    for (mut vehicle, share) in [(truck(), 1.0), (robot(), 0.1)] {
        // The card's wheels are not quite symmetric, nor is its inertia.
        for i in [1, 3] {
            let [x, y, z] = vehicle.wheel_centre_m[i - 1];
            vehicle.wheel_centre_m[i] = [x, -y, z];
        }
        for effect in Effect::examples().iter().map(|e| e.scaled(share)) {
            let left = drive(&vehicle, &[effect], 0.5, 20).to_array();
            let right = drive(&vehicle, &[mirrored(&effect)], -0.5, 20).to_array();
            for (i, (l, r)) in left.iter().zip(right).enumerate() {
                let sign = if [1, 3, 5, 7, 9, 11].contains(&i) { -1.0 } else { 1.0 };
                assert!((l - sign * r).abs() < 1e-6, "{} on {}, channel {i}: {l} {r}", effect.id(), vehicle.name);
            }
        }
    }
}

#[test]
fn property_every_effect_moves_the_measured_motion_the_way_it_should() {
    // Channel of the state (x y z roll pitch yaw v ω) and direction, in a left turn while speeding up.
    const EXPECTED: [(&str, usize, f64); 46] = [
        ("payload", 2, -1.0),
        ("cg_forward", 4, 1.0),
        ("cg_lateral", 3, -1.0),
        ("cg_height", 3, 1.0),
        ("linear_drag", 6, -1.0),
        ("quadratic_drag", 6, -1.0),
        ("tow", 6, -1.0),
        ("wind", 0, 1.0),
        ("rolling_resistance", 6, -1.0),
        ("wheel_drag", 5, 1.0),
        ("torque_limit", 6, -1.0),
        ("speed_lag", 0, -1.0),
        ("speed_delay", 0, -1.0),
        ("steering_lag", 5, -1.0),
        ("steering_delay", 5, -1.0),
        ("steering_offset", 5, 1.0),
        ("steering_ratio", 5, 1.0),
        ("steering_backlash", 5, -1.0),
        ("steering_compliance", 5, -1.0),
        ("speed_gain", 6, 1.0),
        ("tyre_radius", 2, 1.0),
        ("tyre_radius_front", 4, -1.0),
        ("tyre_radius_rear", 4, 1.0),
        ("locked_differential", 5, -1.0),
        ("slip_sinkage", 2, -1.0),
        ("multi_pass", 4, 1.0),
        ("elastic_recovery", 2, 1.0),
        ("theta_m_shift", 2, 1.0),
        ("grousers", 6, 1.0),
        ("front_bulldozing", 6, -1.0),
        ("side_bulldozing", 5, 1.0),
        ("roll_stiffness", 3, -1.0),
        ("pitch_stiffness", 4, -1.0),
        ("map_tilt", 4, 1.0),
        ("map_offset", 2, 1.0),
        ("soil_drift", 2, -1.0),
        ("gyro_bias", 11, 1.0),
        ("gyro_scale", 11, 1.0),
        ("velocity_scale", 6, 1.0),
        ("position_latency", 0, -1.0),
        ("lever_arm", 0, 1.0),
        ("mount_angle", 5, 1.0),
        ("clock_drift", 0, -1.0),
        ("friction_cap", 5, -1.0),
        ("soil_crust", 2, -1.0),
        ("free_form", 6, -1.0),
    ];
    let plain = drive(&truck(), &[], 0.6, 30).to_array();
    let mut wrong = Vec::new();
    for (id, channel, sign) in EXPECTED {
        let moved = drive(&truck(), &[Effect::example(id).unwrap()], 0.6, 30).to_array()[channel] - plain[channel];
        if moved * sign < 1e-5 {
            wrong.push(format!("{id}: channel {channel} moved by {moved:+.2e}"));
        }
    }
    for (id, sign) in [("skid_steer_track", 1.0), ("turn_limit", -1.0), ("turning_resistance", -1.0), ("wheel_speed_limit", -1.0)] {
        let heading = |effects: &[Effect]| drive(&robot(), effects, 2.0, 30).attitude_rad[2];
        if (heading(&[Effect::example(id).unwrap()]) - heading(&[])) * sign < 1e-5 {
            wrong.push(id.into());
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}
