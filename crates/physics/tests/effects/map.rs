//! Goal: a tilted or raised map tilts and raises the vehicle on it. Method: a vehicle that settles on the plane that the effect makes.

use nesam_physics::effects::*;
use nesam_test_vehicles::truck;

use crate::common::Drive;

#[test]
fn analytic_a_tilted_map_tilts_the_vehicle_in_the_sense_of_its_angles() {
    let mut terms = EffectTerms::default();
    Effect::MapTilt(MapTilt { pitch_rad: 0.05, roll_rad: 0.03 }).add_to(&mut terms);
    let (_, slope) = terms.map.raised(0.0, 0.0, (0.0, [0.0; 2]));
    let settled = |slope: [f64; 2]| {
        let mut drive = Drive::new(truck(), 0.0);
        drive.slope = slope;
        (0..60).for_each(|_| {
            drive.step(0.0, 0.0);
        });
        drive.state.attitude_rad
    };
    let (tilted, level) = (settled(slope), settled([0.0; 2]));
    assert!((tilted[1] - level[1] - 0.05).abs() < 0.008, "pitch {}", tilted[1]);
    assert!((tilted[0] - level[0] - 0.03).abs() < 0.008, "roll {}", tilted[0]);
}

#[test]
fn analytic_heights_of_a_tilted_and_raised_map() {
    let mut terms = EffectTerms::default();
    Effect::MapOffset(MapOffset { z_m: 0.2 }).add_to(&mut terms);
    Effect::MapTilt(MapTilt { pitch_rad: 0.1, roll_rad: -0.05 }).add_to(&mut terms);
    let (height, slope) = terms.map.raised(10.0, -20.0, (1.0, [0.3, 0.4]));
    assert!((height - (1.0 + 0.2 - 10.0 * 0.1f64.tan() + 20.0 * 0.05f64.tan())).abs() < 1e-12);
    assert!((slope[0] - (0.3 - 0.1f64.tan())).abs() < 1e-12 && (slope[1] - (0.4 - 0.05f64.tan())).abs() < 1e-12);
}
