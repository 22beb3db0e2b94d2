//! Goal: a mirrored drive is a true drive of a vehicle whose sides are alike.
//! Method: the symbolic model drives the mirrored commands over the mirrored hills.
#![allow(clippy::unwrap_used)]

mod common;

use std::sync::Arc;

use common::{drive, drive_on_side, hills};

#[test]
fn property_the_image_of_a_drive_is_the_drive_on_the_image_of_the_map() {
    let map = hills();
    let image = Arc::new(map.mirrored());
    let (expected, mirrored) = (drive_on_side(Some(&image), 60, -1.0), drive(Some(&map), 60).mirrored(Some(image.clone())));
    for (k, (a, b)) in expected.states.iter().zip(&mirrored.states).enumerate() {
        // Heights are f32 and slopes are sums in another order: both grow along the drive.
        let apart = a.to_array().iter().zip(b.to_array()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(apart < 1e-4, "sample {k}: {a:?} and {b:?}");
    }
    assert_eq!(mirrored.controls[20].second, expected.controls[20].second);
    assert!(expected.states[50].attitude_rad[2].abs() > 0.1, "the drive must turn to show anything");
}
