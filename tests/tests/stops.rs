//! Goal: a car that is told to stop is predicted to stop where it does, and to stand there.
//! Method: the simulated vehicle of `nesam-plant`, which shares no code with the physics, drives straight ahead at 3 m/s on four recorded worlds, or stands there, and is
//! told 0; the shipped bundle predicts the next 3.2 s from its motion until then.
#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use nesam_model::{HistoryStep, ModelBundle, Predictor, RolloutQuery, Variant};
use nesam_physics::{Control, SoilCorrection, VehicleState};
use nesam_plant::{Command, Ground, HiddenEffects, Plant, PlantVehicle};
use nesam_terrain::WorldMap;
use nesam_tests::{sample_root, shipped_bundle};

const WORLDS: [&str; 4] = ["w01", "w05", "w16", "w25"];
const HORIZON: usize = 32;

fn shipped() -> Predictor {
    Predictor::new(Arc::new(ModelBundle::load(&shipped_bundle()).unwrap())).unwrap()
}

/// Forward speeds (m/s) after each step in which a car at this speed is told 0, and the way (m): of the plant, and predicted.
fn stop_on(world: &str, speed_m_s: f64, predictor: &Predictor) -> [(Vec<f64>, f64); 2] {
    let folder = sample_root().join("worlds").join(world);
    let (map, ground) = (Arc::new(WorldMap::load(&folder).unwrap()), Arc::new(Ground::read(&folder).unwrap()));
    let vehicle = Arc::new(PlantVehicle::of_root(&sample_root()).unwrap());
    let mut plant = Plant::at_rest(vehicle, ground, HiddenEffects::default(), -15.0, 0.0, 0.0);
    let mut drive = |speed_m_s: f64, steps: usize| -> Vec<HistoryStep> {
        let step = |_| {
            let state = VehicleState::from_array(plant.truth().state);
            plant.advance(Command { speed_m_s, steering: 0.0 });
            HistoryStep { state, control: Control { speed_m_s, second: 0.0 } }
        };
        (0..steps).map(step).collect()
    };
    drive(0.0, 10);
    let history = drive(speed_m_s, 60);
    let stop: Vec<VehicleState<f64>> = drive(0.0, HORIZON + 1).iter().map(|step| step.state).collect();
    let way = |to: [f64; 2], from: &VehicleState<f64>| (to[0] - from.position_m[0]).hypot(to[1] - from.position_m[1]);

    let query = RolloutQuery {
        history: &history[history.len() - 31..],
        start: stop[0],
        controls: &[0.0; 2 * HORIZON],
        samples: 1,
        horizon: HORIZON,
        map: Some(&map),
        soil_correction: SoilCorrection::NONE,
        variant: Variant::Full,
        start_time_s: None,
        wheels: None,
    };
    let predicted: Vec<[f64; 12]> =
        predictor.rollout(&query).unwrap().states.chunks(12).map(|state| std::array::from_fn(|i| f64::from(state[i]))).collect();
    let [x, y, ..] = predicted[HORIZON - 1];
    let end = stop[HORIZON].position_m;
    [
        (stop[1..].iter().map(|s| s.velocity_m_s[0]).collect(), way([end[0], end[1]], &stop[0])),
        (predicted.iter().map(|s| s[6]).collect(), way([x, y], &stop[0])),
    ]
}

#[test]
fn simulation_a_stop_is_predicted_as_long_as_it_is() {
    let predictor = shipped();
    for world in WORLDS {
        let [(speeds, way_m), (predicted, predicted_m)] = stop_on(world, 3.0, &predictor);
        let says = format!("{world}: {predicted_m:.2} m predicted, {way_m:.2} m driven; {predicted:.2?} and {speeds:.2?} m/s");
        println!("{says}");
        assert!(speeds[HORIZON - 1].abs() < 0.05, "the plant stands. {says}");
        assert!((predicted_m - way_m).abs() < 0.35 * way_m, "{says}");
        assert!(predicted.iter().all(|v| *v > -0.03), "nobody goes back. {says}");
    }
}

#[test]
fn simulation_who_stands_and_is_told_to_is_predicted_to_stand() {
    let predictor = shipped();
    for world in WORLDS {
        let [(speeds, way_m), (predicted, predicted_m)] = stop_on(world, 0.0, &predictor);
        let says = format!("{world}: {predicted_m:.3} m predicted, {way_m:.3} m driven; {predicted:.3?} and {speeds:.3?} m/s");
        println!("{says}");
        assert!(predicted_m < 0.05 && predicted.iter().all(|v| v.abs() < 0.03), "{says}");
    }
}
