//! Laps of tests: with the kinematic model, which needs no server.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use nesam_evaluation::Kinematic;
use nesam_navigation::{
    Forecaster, KinematicForecaster, Lap, LapPlan, MppiSettings, NavigationError, PlantLink, ReferencePath, TrackingCost, run_lap,
};
use nesam_terrain::WorldMap;
use nesam_trajectories::read_vehicle_card;

pub fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

pub fn sample() -> PathBuf {
    repository().join("tests/data/chrono_sample")
}

/// A lap on a plant, driven with the map of a world.
pub fn lap_on(plant: &mut dyn PlantLink, world: &str, seed: u64) -> Result<Lap, NavigationError> {
    let vehicle = read_vehicle_card(&sample().join("vehicle_hmmwv.json")).unwrap();
    let map = Arc::new(WorldMap::load(&sample().join("worlds").join(world)).unwrap());
    let mut model = Forecaster::Kinematic(KinematicForecaster { model: Kinematic::ideal(&vehicle), vehicle: Arc::new(vehicle), map });
    let plan = LapPlan {
        world: world.into(),
        start_phi: 0.0,
        seed,
        path: ReferencePath::of_ood_soil(),
        cost: TrackingCost { speed_m_s: 3.0, lag: 0.1, tilt: 0.0 },
        mppi: MppiSettings {
            candidates: 32,
            limits: [[0.5, 4.0], [-1.0, 1.0]],
            noise_sd: [0.4, 0.16],
            noise_correlation: 0.8,
            temperature: 0.1,
        },
        horizon: 20,
        plan_every: 3,
        steering_guess: 0.4,
        caution: None,
    };
    // The kinematic model never waits for anybody.
    let waker = std::task::Waker::noop();
    let mut lap = Box::pin(run_lap(&plan, plant, &mut model));
    match lap.as_mut().poll(&mut std::task::Context::from_waker(waker)) {
        std::task::Poll::Ready(lap) => lap,
        std::task::Poll::Pending => panic!("the kinematic model waited"),
    }
}
