//! Goal: risk outputs say what statics says. Method: vehicles that come to rest on planes; loads, ratio and reserve against the laws of statics.

mod common;

use common::Drive;
use nesam_physics::DT_S;
use nesam_physics::effects::{Effect, FrictionCap, Grousers, RollingResistance, Tow};
use nesam_physics::risk::load_transfer_ratio;
use nesam_physics::step::{StepModel, WheelContact};
use nesam_test_vehicles::{robot, truck};

/// A vehicle that has come to rest on a plane, and its contacts.
fn at_rest(vehicle: nesam_physics::Vehicle, slope: [f64; 2]) -> (Drive, [WheelContact<f64>; 4]) {
    let mut drive = Drive::new(vehicle, 0.0);
    drive.slope = slope;
    let mut contacts = drive.step(0.0, 0.0).contacts;
    for _ in 0..80 {
        contacts = drive.step(0.0, 0.0).contacts;
    }
    (drive, contacts)
}

#[test]
fn analytic_at_rest_on_level_ground_nothing_is_transferred_and_the_weight_is_carried() {
    // Less than a percent: on the card one front wheel of the truck hangs 0.1 mm lower, and a parked vehicle creeps.
    for vehicle in [truck(), robot()] {
        let weight = vehicle.mass_kg * vehicle.gravity_m_s2;
        let (_, contacts) = at_rest(vehicle, [0.0; 2]);
        let loads = contacts.map(|c| c.normal_n);
        assert!(load_transfer_ratio(&loads) < 0.01, "{loads:?}");
        assert!((loads.iter().sum::<f64>() - weight).abs() < 1e-3 * weight, "{loads:?}");
    }
}

/// On a side slope of angle β the loads of a rigid vehicle with its centre of mass at height h and track t differ by 2 h tan β / t of their sum; the
/// suspension lets the body lean and moves the centre a little further. Within a quarter.
#[test]
fn analytic_on_a_side_slope_the_lower_side_carries_more() {
    let vehicle = truck();
    let height = vehicle.wheel_radius_m - vehicle.wheel_centre_m[0][2];
    let (slope, track) = (0.15, 2.0 * vehicle.wheel_centre_m[0][1]);
    let (_, contacts) = at_rest(vehicle, [0.0, slope]);
    let loads = contacts.map(|c| c.normal_n);
    assert!(loads[1] > loads[0] && loads[3] > loads[2], "left is up, right carries: {loads:?}");
    let (ratio, rigid) = (load_transfer_ratio(&loads), 2.0 * height * slope / track);
    assert!((ratio / rigid - 1.0).abs() < 0.25, "{ratio}, rigid {rigid}");
}

/// The reserve loses the sine of the climb when the vehicle drives up, gains it when it drives down, and is smaller on softer ground; a soil without
/// strength leaves none.
#[test]
fn analytic_traction_reserve_loses_the_slope_and_the_strength_of_the_soil() {
    let (mut drive, contacts) = at_rest(truck(), [0.0; 2]);
    drive.state.velocity_m_s[0] = 2.0;
    let reserve = |drive: &Drive, pitch: f64| {
        let (mut input, _) = drive.input(&nesam_physics::Control { speed_m_s: 2.0, second: 0.0 });
        input.state.attitude_rad[1] = pitch;
        drive.model.traction_reserve(&input, &contacts)
    };
    let level = reserve(&drive, 0.0);
    assert!(level > 0.1 && level < 1.0, "{level}");
    assert!((reserve(&drive, -0.2) - (level - 0.2_f64.sin())).abs() < 1e-9, "nose up");
    assert!((reserve(&drive, 0.2) - (level + 0.2_f64.sin())).abs() < 1e-9, "nose down");
    drive.soil.k_phi *= 0.3;
    let softer = reserve(&drive, 0.0);
    assert!(softer < level, "{softer} on softer ground, {level}");
    (drive.soil.c, drive.soil.phi) = (60.0, 0.1);
    assert!(reserve(&drive, 0.0) < 0.0, "no strength: {}", reserve(&drive, 0.0));
}

/// The slope is held against where the vehicle is told to go, also at rest and while it slides back: on 35 degrees of loam, more than its friction angle, a
/// truck cannot start upwards. Without a command its motion tells the direction; at 2 m/s that is 1 to 3e-4.
#[test]
fn analytic_traction_reserve_is_held_against_where_the_vehicle_is_told_to_go() {
    let (mut drive, contacts) = at_rest(truck(), [0.0; 2]);
    let climb = 35_f64.to_radians();
    let mut reserve = |command_m_s: f64, speed_m_s: f64, pitch: f64| {
        drive.state.velocity_m_s[0] = speed_m_s;
        let (mut input, _) = drive.input(&nesam_physics::Control { speed_m_s: command_m_s, second: 0.0 });
        input.state.attitude_rad[1] = pitch;
        drive.model.traction_reserve(&input, &contacts)
    };
    let level = reserve(2.0, 0.0, 0.0);
    for speed_m_s in [2.0, 0.0, -1.0] {
        let upwards = reserve(2.0, speed_m_s, -climb);
        assert!(upwards < 0.0 && (upwards - (level - climb.sin())).abs() < 1e-9, "{upwards} at {speed_m_s} m/s");
        assert!((reserve(-2.0, speed_m_s, -climb) - (level + climb.sin())).abs() < 1e-9, "backwards is downwards");
    }
    assert!((reserve(0.0, 0.0, -climb) - level).abs() < 1e-9, "parked");
    assert!((reserve(0.0, 2.0, -climb) - (level - climb.sin())).abs() < 1e-3, "rolling out upwards");
    assert!((reserve(0.0, -2.0, -climb) - (level + climb.sin())).abs() < 1e-3, "rolling back");
}

/// A pull backwards and a resistance of the wheels are missing from the reserve over the weight, no wheel pulls beyond a cap on its friction, and soil that
/// effects make stronger holds more; an effect of no size changes no bit.
#[test]
fn analytic_traction_reserve_is_that_of_the_vehicle_with_its_effects() {
    let (mut drive, contacts) = at_rest(truck(), [0.0; 2]);
    drive.state.velocity_m_s[0] = 2.0;
    drive.state.attitude_rad[1] = 0.0;
    let (input, _) = drive.input(&nesam_physics::Control { speed_m_s: 2.0, second: 0.0 });
    let reserve = |effects: &[Effect]| StepModel::new(&truck().with_effects(effects), DT_S, 2).traction_reserve(&input, &contacts);
    let (level, weight) = (reserve(&[]), truck().mass_kg * truck().gravity_m_s2);

    let tow = Effect::Tow(Tow { force_n: 800.0, z_m: 0.0 });
    assert!((level - reserve(&[tow]) - 800.0 / weight).abs() < 1e-4, "{} of {level}", reserve(&[tow]));
    assert_eq!(reserve(&[tow.scaled(0.0)]).to_bits(), level.to_bits());
    // Loads and weight agree within a thousandth, as above.
    let resisted = reserve(&[Effect::RollingResistance(RollingResistance { coefficient: 0.03 })]);
    assert!((level - resisted - 0.03).abs() < 1e-4, "{resisted} of {level}");
    let capped = reserve(&[Effect::FrictionCap(FrictionCap { mu: 0.06 })]);
    assert!((0.059..0.0601).contains(&capped) && capped < level, "{capped} of {level}");
    let grousers = reserve(&[Effect::Grousers(Grousers { metres: 0.03 })]);
    assert!(grousers > level + 0.01, "{grousers} of {level}");
}
