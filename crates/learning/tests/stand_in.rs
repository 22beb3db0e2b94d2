//! Goal: ground whose colours no map shows looks to a network like the mean of what it was trained on. Method: a drive over coloured stripes and the same map
//! without them.

mod common;

use std::sync::Arc;

use common::{drive, hills, lively_weights, measured_scales, predictor};
use nesam_learning::{Drive, stand_in};
use nesam_model::dims::HIDDEN;
use nesam_model::{ModelBundle, Predictor, TerrainToken};
use nesam_terrain::{Pose2, WorldMap};

/// An untrained bundle of the vehicle of a drive.
fn bundle_of(drive: &Drive) -> ModelBundle {
    let scales = measured_scales(drive);
    predictor(&scales, lively_weights(&scales)).bundle().clone()
}

/// Mean of the tokens at every twentieth sample.
fn mean(predictor: &Predictor, map: Option<&Arc<WorldMap>>, drive: &Drive) -> [f64; size_of::<TerrainToken>() / 4] {
    let poses: Vec<Pose2> = (0..drive.states.len()).step_by(20).map(|i| drive.pose(i)).collect();
    let tokens = predictor.exactly().terrain_tokens(map, &poses);
    core::array::from_fn(|i| tokens.iter().map(|token| f64::from(token[i])).sum::<f64>() / tokens.len() as f64)
}

#[test]
fn property_unseen_ground_looks_like_the_mean_of_what_was_seen() {
    let map = hills();
    let drive = drive(Some(&map), 100);
    let mut bundle = bundle_of(&drive);
    let found = stand_in::measure(&bundle, &[&drive]).expect("all arrays are there").expect("the drive saw colours");
    let bare = Arc::new(map.without_colours());
    let plain = Predictor::new(Arc::new(bundle.clone())).expect("all arrays are there");
    let [seen, grey] = [&map, &bare].map(|map| mean(&plain, Some(map), &drive));
    bundle.normalization.stand_in = Some(found.clone());
    let filled = Predictor::new(Arc::new(bundle.clone())).expect("all arrays are there");
    let (unseen, nowhere) = (mean(&filled, Some(&bare), &drive), mean(&filled, None, &drive));
    let apart = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(apart(&seen, &grey) > 0.01, "colours matter: {}", apart(&seen, &grey));
    assert!(apart(&seen, &unseen) < 1e-4 && apart(&seen, &nowhere) < 1e-4, "{} {}", apart(&seen, &unseen), apart(&seen, &nowhere));
    assert_eq!(mean(&filled, Some(&map), &drive), seen, "what is seen stays as it was");
    // Measured again, of a bundle that has it already, it is the same.
    assert_eq!(stand_in::measure(&bundle, &[&drive]).expect("all arrays are there"), Some(found.clone()));
    assert_eq!(bundle.normalization.check(), Ok(()));
    assert!(found.soil_sd.iter().all(|sd| *sd > 0.0), "{:?}", found.soil_sd);
    assert_eq!([&map, &bare].map(|map| filled.unseen_soil_sd(map).is_some()), [false, true]);
    // The pose grid between its nodes is the mean too.
    let pose = Pose2 { x_m: -11.93, y_m: -5.88, yaw_rad: 0.21 };
    let [grid, exact] = [filled.terrain_tokens(Some(&bare), &[pose])[0], plain.terrain_tokens(Some(&bare), &[pose])[0]];
    for i in 0..HIDDEN {
        assert!((grid[i] - exact[i] - found.colours[i]).abs() < 1e-4, "{i}");
    }
}

#[test]
fn property_who_has_trained_without_colours_needs_no_stand_in() {
    let map = hills();
    let (seen, bare) = (drive(Some(&map), 60), drive(Some(&Arc::new(map.without_colours())), 60));
    let bundle = bundle_of(&seen);
    let of = |drives: &[&Drive]| stand_in::measure(&bundle, drives).expect("all arrays are there");
    assert!(of(&[&seen]).is_some());
    assert_eq!(of(&[&seen, &bare]), None);
    assert_eq!(of(&[&drive(None, 60)]), None);
    assert_eq!(of(&[]), None);
}
