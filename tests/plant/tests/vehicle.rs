//! Goal: the plant obeys the laws that need no simulator to be known, and comes close to the one that made the recorded drives.
//! Method: level ground of one soil with closed-form answers; a recorded drive of the sample with the record's own figures as limits is the
//! command `nesam plant check`.
#![allow(clippy::unwrap_used)]

use std::path::Path;
use std::sync::Arc;

use nesam_plant::{Command, DriveRecorder, Ground, HiddenEffects, Plant, PlantVehicle, Sensors, SoilParameters, Truth, write_set};

/// Firm dirt in the middle of its class.
const FIRM: SoilParameters = SoilParameters { k_phi: 3.5e6, k_c: 4e4, n: 0.9, cohesion_pa: 8e3, friction_rad: 0.6, shear_m: 0.02 };
/// Softer than any class of the worlds.
const SOFT: SoilParameters = SoilParameters { k_phi: 4e5, k_c: 1e3, n: 1.0, cohesion_pa: 1.5e3, friction_rad: 0.35, shear_m: 0.04 };

fn vehicle() -> Arc<PlantVehicle> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../data/chrono_sample");
    Arc::new(PlantVehicle::of_root(&root).unwrap())
}

fn on_level(soil: SoilParameters, effects: &[&str]) -> Plant {
    let effects = HiddenEffects::parse(effects.iter().copied()).unwrap();
    Plant::at_rest(vehicle(), Arc::new(Ground::plane(20.0, [0.0; 2], soil)), effects, -10.0, 0.0, 0.0)
}

fn drive(plant: &mut Plant, seconds: f64, speed_m_s: f64, steering: f64) -> Truth {
    (0..(10.0 * seconds) as usize).for_each(|_| plant.advance(Command { speed_m_s, steering }));
    plant.truth()
}

/// m g of the data sheet, N.
const WEIGHT_N: f64 = 2493.56 * 9.81;

#[test]
fn analytic_wheel_loads_add_up_to_the_weight_and_a_payload_to_its_own() {
    let load = |truth: &Truth| truth.force_n.iter().map(|f| f[2]).sum::<f64>();
    let empty = drive(&mut on_level(FIRM, &[]), 3.0, 0.0, 0.0);
    assert!((load(&empty) / WEIGHT_N - 1.0).abs() < 0.01, "{} N", load(&empty));
    let loaded = drive(&mut on_level(FIRM, &["payload=600"]), 3.0, 0.0, 0.0);
    assert!((load(&loaded) - load(&empty) - 600.0 * 9.81).abs() < 0.02 * WEIGHT_N);
    // Behind the axle's middle: the rear wheels take more than half, the vehicle is nose up.
    let rear = |t: &Truth| t.force_n[2][2] + t.force_n[3][2];
    assert!(rear(&loaded) - rear(&empty) > 0.6 * 600.0 * 9.81 && loaded.state[4] < empty.state[4]);
}

/// The static trim of the data sheet: pitch +0.0215 rad on level rigid ground; soil adds what the wheels sink.
#[test]
fn published_static_trim() {
    let at_rest = drive(&mut on_level(FIRM, &[]), 3.0, 0.0, 0.0);
    assert!((at_rest.state[4] - 0.0215).abs() < 0.006 && at_rest.state[3].abs() < 1e-3, "{:?}", at_rest.state);
    let sinkage = at_rest.sinkage_max_m.iter().sum::<f64>() / 4.0;
    assert!((at_rest.state[2] - (0.616 - sinkage)).abs() < 0.01, "{:?}", at_rest.state);
}

#[test]
fn analytic_turning_radius_of_a_slow_car_on_firm_ground() {
    let mut plant = on_level(FIRM, &[]);
    drive(&mut plant, 4.0, 1.5, 0.5);
    let turning = drive(&mut plant, 2.0, 1.5, 0.5);
    // Mean road-wheel angle at 0.5 is 0.1837 rad, the wheelbase 3.2977 m.
    let expected = turning.state[6] * 0.1837_f64.tan() / 3.2977;
    assert!((turning.state[11] / expected - 1.0).abs() < 0.15, "{} rad/s against {expected}", turning.state[11]);
    assert!((turning.state[6] - 1.5).abs() < 0.3);
}

#[test]
fn property_soft_ground_means_deeper_ruts_and_more_slip() {
    let (firm, soft) = (drive(&mut on_level(FIRM, &[]), 4.0, 2.0, 0.0), drive(&mut on_level(SOFT, &[]), 4.0, 2.0, 0.0));
    let mean = |v: [f64; 4]| v.iter().sum::<f64>() / 4.0;
    assert!(mean(soft.sinkage_max_m) > 1.5 * mean(firm.sinkage_max_m), "{soft:?} {firm:?}");
    assert!(mean(soft.slip) > mean(firm.slip) && soft.state[6] > 0.5);
}

#[test]
fn property_a_steering_offset_turns_and_a_tow_slows() {
    let straight = drive(&mut on_level(FIRM, &[]), 4.0, 2.0, 0.0);
    let turned = drive(&mut on_level(FIRM, &["steering_offset=0.12"]), 4.0, 2.0, 0.0);
    assert!(straight.state[5].abs() < 0.01 && turned.state[5] > 0.05, "{} {}", straight.state[5], turned.state[5]);
    let towed = drive(&mut on_level(FIRM, &["tow=3000"]), 4.0, 2.0, 0.0);
    assert!(towed.state[0] < straight.state[0] - 0.1);
}

#[test]
fn property_same_seed_same_bytes_and_sensors_have_the_stated_noise() {
    let record = |seed: u64| {
        let mut plant = on_level(FIRM, &[]);
        let (mut sensors, mut recorder) = (Sensors::new(seed, plant.effects()), DriveRecorder::default());
        for _ in 0..200 {
            let truth = plant.truth();
            recorder.sample(&sensors.read(&truth), &truth, Command::default());
            if truth.time_s < 2.0 {
                plant.advance(Command::default());
            }
        }
        recorder.finish("p1", "plane", "test")
    };
    let drive = record(1);
    assert_eq!(drive, record(1));
    assert_ne!(drive, record(2));
    let column = |name: &str| &drive.columns.iter().find(|(n, _)| n == name).unwrap().1;
    let errors: Vec<f64> = column("x").iter().zip(column("gt_x")).map(|(a, b)| a - b).collect();
    let sd = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
    assert!((0.012..0.018).contains(&sd), "{sd} m, 0.015 m are stated");
    let folder = std::env::temp_dir().join(format!("nesam-plant-{}", std::process::id()));
    write_set(&folder, &[drive]).unwrap();
    assert!(folder.join("samples.parquet").exists() && folder.join("index.parquet").exists());
    std::fs::remove_dir_all(&folder).unwrap();
}
