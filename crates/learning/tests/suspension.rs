//! Rates and dampings of a suspension, found from how a body leans over mapped ground.

mod common;

use common::{drive, drive_on_side, hills, measured_scales, truck};
use nesam_learning::Drive;
use nesam_learning::suspension::calibrate_suspension;
use nesam_model::soil_coordinates::to_raw;
use nesam_physics::Vehicle;

/// The truck with springs that are too soft in front and too stiff behind, and dampers that are too weak.
fn mistaken() -> Vehicle {
    let true_one = truck();
    let ([front, _, rear, _], damping) = (true_one.suspension_n_m, true_one.suspension_n_s_m);
    let (front, rear) = (0.65 * front, 1.5 * rear);
    Vehicle { suspension_n_m: [front, front, rear, rear], suspension_n_s_m: damping.map(|c| 0.6 * c), ..true_one }
}

/// Goal: what a sheet has wrong by half is found from drives, rates within a quarter and dampings within a third: the two of an axle trade against each other.
/// Method: drives of the truck over hills with a wave of five metres, made by the step of the model on the soil of the calibration; a mistaken card.
#[test]
fn analytic_springs_and_dampers_are_found() {
    let map = hills();
    let whole = [-1.0, 1.0].map(|side| drive_on_side(Some(&map), 160, side));
    // Rollouts start at every fortieth sample of a drive: the same drives from later on give others.
    let later = |drive: &Drive, from: usize| {
        Drive::new(drive.id.clone(), drive.map.clone(), drive.states[from..].into(), drive.controls[from..].into())
    };
    let drives: Vec<Drive> = (0..40).step_by(4).flat_map(|from| whole.iter().map(move |drive| later(drive, from))).collect();
    let mut scales = measured_scales(&drives[0]);
    scales.default_soil_raw = to_raw(&[1.5e6, 5e3, 0.7, 1.7e3, 0.5, 0.02]);
    let mut found = mistaken();
    let [before, after] = calibrate_suspension(&mut found, &drives.iter().collect::<Vec<_>>(), &scales, |_, _, _| (), &|| false);
    assert!(after < 0.3 * before, "{before} -> {after} rad");
    for wheel in [0, 2] {
        let rate = found.suspension_n_m[wheel] / truck().suspension_n_m[wheel];
        let damping = found.suspension_n_s_m[wheel] / truck().suspension_n_s_m[wheel];
        assert!((0.75..1.25).contains(&rate) && (0.65..1.35).contains(&damping), "wheel {wheel}: {rate}, {damping} of the true ones");
    }
    assert_eq!([found.suspension_n_m[1], found.suspension_n_m[3]], [found.suspension_n_m[0], found.suspension_n_m[2]]);
}

/// Goal: without a map nothing is made up, since nobody knows what tilted the body.
#[test]
fn analytic_drives_without_a_map_change_nothing() {
    let sample = drive(None, 60);
    let mut found = mistaken();
    calibrate_suspension(&mut found, &[&sample], &measured_scales(&sample), |_, _, _| (), &|| false);
    assert_eq!(found, mistaken());
}
