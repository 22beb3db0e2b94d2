//! Goal: `doubts` is silent about the simulated drives as they are, noise and soil included, and speaks where one thing in them is wrong.
#![allow(clippy::unwrap_used)]

use nesam_import::doubts;
use nesam_trajectories::{DataRoot, SetQuery, Trajectory};

fn sample() -> DataRoot {
    DataRoot::open(concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/data/chrono_sample").as_ref(), None).unwrap()
}

/// The first seconds of a drive.
fn begin(drive: &Trajectory, samples: usize) -> Trajectory {
    let mut drive = drive.clone();
    drive.time_s.truncate(samples);
    drive.states.truncate(samples);
    drive.controls.truncate(samples);
    drive.wheel_speed_rad_s.iter_mut().for_each(|wheels| wheels.truncate(samples));
    drive.road_wheel_angle_rad.iter_mut().for_each(|angles| angles.truncate(samples));
    drive
}

/// Method: every set whole, every drive alone, and the first 2 to 10 s of each.
#[test]
fn chrono_sound_drives_raise_no_doubt_however_few_and_short() {
    let root = sample();
    for set in root.sets() {
        let drives = root.load_set(&SetQuery::all(&set)).unwrap();
        assert_eq!(doubts(&drives, root.vehicle()), [], "{set}");
        for drive in &drives {
            assert_eq!(doubts(std::slice::from_ref(drive), root.vehicle()), [], "{}", drive.id);
            for samples in [20, 40, 60, 80, 100] {
                assert_eq!(doubts(&[begin(drive, samples)], root.vehicle()), [], "{samples} samples of {}", drive.id);
            }
        }
    }
}

/// Method: one mistake in all drives of `nominal`, or one bad moment in the first; what is told must name it and nothing else.
#[test]
fn chrono_one_mistake_is_told_and_no_other() {
    let root = sample();
    let drives = root.load_set(&SetQuery::all("nominal")).unwrap();
    let told = |change: &dyn Fn(&mut Trajectory), some: usize| -> String {
        let mut drives = drives.clone();
        drives.iter_mut().take(some).for_each(change);
        doubts(&drives, root.vehicle()).iter().map(|d| format!("{}; {}\n", d.what, d.advice)).collect()
    };
    let wheels = |change: fn([f64; 4]) -> [f64; 4]| {
        told(&|drive| drive.wheel_speed_rad_s.iter_mut().flatten().for_each(|wheels| *wheels = change(*wheels)), usize::MAX)
    };
    let angles = |change: fn(f64) -> f64| {
        told(&|drive| drive.road_wheel_angle_rad.iter_mut().flatten().for_each(|angles| *angles = angles.map(change)), usize::MAX)
    };
    let frozen = |drive: &mut Trajectory| {
        let held = drive.states[100].position_m;
        drive.states[100..150].iter_mut().for_each(|s| s.position_m = held);
    };
    let rear_m = root.vehicle().wheel_centre_m[2][0];
    let of_rear_axle = |drive: &mut Trajectory| drive.states.iter_mut().for_each(|s| *s = s.at_point([rear_m, 0.0, 0.0]));
    let late = |drive: &mut Trajectory| {
        let old: Vec<_> = drive.states.iter().map(|s| s.position_m).collect();
        // Before it began it went on as it begins.
        let begun = |k: usize| std::array::from_fn(|i| old[0][i] - (8 - k) as f64 * (old[1][i] - old[0][i]));
        drive.states.iter_mut().enumerate().for_each(|(k, s)| s.position_m = if k < 8 { begun(k) } else { old[k - 8] });
    };
    for (expected, told) in [
        ("positions are of the rear axle", told(&of_rear_axle, usize::MAX)),
        ("positions come 0.8 s after velocities", told(&late, usize::MAX)),
        ("rim speed of FL", wheels(|[fl, fr, rl, rr]| [-fl, fr, rl, rr])),
        ("rim speed of RR", wheels(|[fl, fr, rl, rr]| [fl, fr, rl, 9.55 * rr])),
        ("the left and right wheels turn against the yaw", wheels(|[fl, fr, rl, rr]| [fr, fl, rr, rl])),
        ("road-wheel angle against the steering command: -0.99", angles(|a| -a)),
        ("degrees instead of radians", angles(f64::to_degrees)),
        ("positions are frozen in 1 of 6 drives", told(&frozen, 1)),
        ("positions jump 1 times", told(&|drive| drive.states[120..].iter_mut().for_each(|s| s.position_m[1] += 10.0), 1)),
    ] {
        assert!(told.contains(expected) && told.lines().count() == 1, "`{expected}` is not all of\n{told}");
    }
}
