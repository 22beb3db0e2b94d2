//! What effects make of the ride of a vehicle.

use nesam_physics::effects::{Effect, GyroBias, Payload, RollStiffness};
use nesam_physics::step::StepModel;
use nesam_physics::{Ride, Soil, UsualRide, Vehicle, VehicleState};
use nesam_test_vehicles::torque_truck;

const FIRM: Soil<f64> = Soil { k_phi: 2e9, k_c: 5e4, n: 1.0, c: 4e3, phi: 0.6, k_shear: 0.01 };
const SOFT: Soil<f64> = Soil { k_phi: 4e5, k_c: 5e3, n: 0.8, c: 3e3, phi: 0.4, k_shear: 0.02 };

fn shift(effects: &[Effect], soil: &Soil<f64>) -> Ride {
    let vehicle = torque_truck().with_effects(effects);
    *StepModel::new(&vehicle, 0.1, 4).riding_as(|| UsualRide::of(&vehicle, 0.1, 4, soil)).ride_shift()
}

/// Goal: on firm ground a load shifts the ride by what the springs give way. Method: statics of a beam on two springs, by hand.
#[test]
fn analytic_a_load_presses_springs() {
    let (load, x_m) = (600.0, -1.2);
    let [up_m, roll_rad, pitch_rad] = shift(&[Effect::Payload(Payload { mass_kg: load, at_m: [x_m, 0.0, 0.8] })], &FIRM);
    let Vehicle { wheel_centre_m: at, suspension_n_m: rate, gravity_m_s2: g, .. } = torque_truck();
    let (front, rear) = (at[0][0], at[2][0]);
    let to_rear = (front - x_m) / (front - rear);
    let (lower_front_m, lower_rear_m) = (load * g * (1.0 - to_rear) / (2.0 * rate[0]), load * g * to_rear / (2.0 * rate[2]));
    let pitch = (lower_front_m - lower_rear_m) / (front - rear);
    let up = -lower_rear_m - (lower_front_m - lower_rear_m) * (0.0 - rear) / (front - rear);
    // Soil gives way a little too, and the drive tilts the body.
    assert!((up_m / up - 1.0).abs() < 0.15 && (pitch_rad / pitch - 1.0).abs() < 0.2, "{up_m} m of {up}, {pitch_rad} rad of {pitch}");
    assert!(roll_rad.abs() < 1e-5, "{roll_rad} rad");
}

/// Goal: wheels that carry more sink deeper. Method: the same load on soft soil.
#[test]
fn analytic_a_load_sinks_on_soft_soil() {
    let load = [Effect::Payload(Payload { mass_kg: 600.0, at_m: [-1.2, 0.0, 0.8] })];
    let (firm, soft) = (shift(&load, &FIRM), shift(&load, &SOFT));
    assert!(soft[0] < 2.0 * firm[0] && soft[2] < firm[2], "{soft:?} {firm:?}");
}

/// Goal: nothing is shifted by what does not act on the ride, and taking the shift away is exact. Method: effects of another layer, and of a tilt that level
/// ground does not have.
#[test]
fn analytic_what_does_not_press_shifts_nothing() {
    assert_eq!(shift(&[], &SOFT), [0.0; 3]);
    assert_eq!(shift(&[Effect::GyroBias(GyroBias { rad_s: 0.1 })], &SOFT), [0.0; 3]);
    assert_eq!(shift(&[Effect::Payload(Payload { mass_kg: 0.0, at_m: [-1.2, 0.0, 0.8] })], &SOFT), [0.0; 3]);
    let stiffer = shift(&[Effect::RollStiffness(RollStiffness { relative: 0.3 })], &SOFT);
    assert!(stiffer.iter().all(|s| s.abs() < 1e-3), "{stiffer:?}");

    let vehicle = torque_truck().with_effects(&[Effect::Payload(Payload { mass_kg: 600.0, at_m: [-1.2, 0.3, 0.8] })]);
    let model = StepModel::new(&vehicle, 0.1, 4);
    let state = VehicleState::from_array([1.0, 2.0, 0.6, 0.1, 0.05, 0.3, 2.0, 0.1, 0.0, 0.0, 0.0, 0.2]);
    assert_eq!(model.as_known(&state), state, "without a usual soil the shift is not known");
    let model = model.riding_as(|| UsualRide::of(&vehicle, 0.1, 4, &SOFT));
    let [up_m, roll_rad, pitch_rad] = *model.ride_shift();
    let known = model.as_known(&state);
    assert_eq!(known.position_m, [1.0, 2.0, 0.6 - up_m]);
    assert_eq!(known.attitude_rad, [0.1 - roll_rad, 0.05 - pitch_rad, 0.3]);
    assert_eq!(known.velocity_m_s, state.velocity_m_s);
}
