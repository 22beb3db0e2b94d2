//! Goal: candidates over a local map with the holes of a lidar are as good as over the whole map. Method: the shipped bundle on waves of ground, 24 candidates
//! that turn from one side to the other, over the whole map, with 5 % of its cells missing, and with a large hole in the way of some.

use std::path::Path;
use std::sync::Arc;

use nesam_model::{ModelBundle, Predictor, Rollout, RolloutQuery, Variant, flag};
use nesam_physics::{STATE_DIM, SoilCorrection, VehicleState, WHEELS};
use nesam_terrain::{GridGeometry, WorldMap};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const SAMPLES: usize = 24;
const HORIZON: usize = 32;

/// Waves of 13 m by 16 m, 0.6 m from crest to trough, on 40 m by 40 m.
fn map(mut hole: impl FnMut(f64, f64) -> bool) -> Arc<WorldMap> {
    let grid = GridGeometry { origin_m: [-20.0, -20.0], resolution_m: 0.1, width: 401, height: 401 };
    let points = (0..grid.cells()).map(|i| grid.to_world(i % grid.width, i / grid.width));
    let height = |x: f64, y: f64| (0.15 * ((0.5 * x).sin() + (0.4 * y).cos())) as f32;
    let elevation_m = points.map(|[x, y]| if hole(x, y) { f32::NAN } else { height(x, y) }).collect();
    Arc::new(WorldMap::from_layers("local", 1, grid, elevation_m, None).expect("a valid map"))
}

/// Candidates at 3 m/s eastwards from 5 m west of the middle, the first hard to the left, the last hard to the right.
fn rollout(predictor: &Predictor, map: &Arc<WorldMap>) -> Rollout {
    let mut start = VehicleState::zero();
    start.position_m = [-5.0, 0.0, map.nearest_height_m(-5.0, 0.0) + 0.6];
    start.velocity_m_s[0] = 3.0;
    let turn = |n: usize| 0.8 * (1.0 - 2.0 * n as f32 / (SAMPLES - 1) as f32);
    let controls: Vec<f32> = (0..SAMPLES).flat_map(|n| [3.0, turn(n)].repeat(HORIZON)).collect();
    let query = RolloutQuery {
        history: &[],
        start,
        controls: &controls,
        samples: SAMPLES,
        horizon: HORIZON,
        map: Some(map),
        soil_correction: SoilCorrection::NONE,
        variant: Variant::Full,
        start_time_s: None,
        wheels: None,
    };
    predictor.rollout(&query).expect("a valid query")
}

#[test]
fn property_candidates_over_small_holes_are_on_the_map() {
    let bundle = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/bundles/hmmwv-nominal");
    let predictor = Predictor::new(Arc::new(ModelBundle::load(&bundle).expect("the shipped bundle"))).expect("a predictor");
    let whole = rollout(&predictor, &map(|_, _| false));
    let mut random = ChaCha8Rng::seed_from_u64(76);
    let scattered = rollout(&predictor, &map(|_, _| random.random::<f64>() < 0.05));
    assert_eq!(scattered.flags, whole.flags);
    assert!(whole.flags.iter().all(|flags| flags & flag::OFF_MAP == 0), "{:?}", whole.flags);
    // Filled heights are off by less than 1 mm on these waves, and a wheel seldom stands on one.
    let entries = scattered.states.iter().zip(&whole.states).enumerate();
    let worst = entries.filter(|(i, _)| i % STATE_DIM < 6).fold(0.0, |worst: f32, (_, (a, b))| worst.max((a - b).abs()));
    println!("largest difference of a pose, m or rad: {worst}");
    assert!(worst < 1e-3, "{worst}");

    // A round hole of 4 m across, 7 m ahead and 2 m to the left: its middle, 3 m across, is further than 0.5 m from known ground. Steps are 0.3 m long: a wheel
    // that is 0.2 m inside of that at a step is off the map, a candidate whose wheels are never nearer to it than 0.4 m is not.
    let holed = rollout(&predictor, &map(|x, y| (x - 2.0).hypot(y - 2.0) < 2.0));
    let mut counts = [0; 2];
    for n in 0..SAMPLES {
        let nearest = (0..HORIZON - 1)
            .flat_map(|k| wheels(&predictor, &holed.state_f64(n, k)))
            .map(|[x, y]| (x - 2.0).hypot(y - 2.0))
            .fold(9.0, f64::min);
        if nearest < 1.3 {
            counts[0] += 1;
            assert!(holed.flags[n] & flag::OFF_MAP != 0, "candidate {n}, {nearest} m from the middle");
        } else if nearest > 1.9 {
            counts[1] += 1;
            assert_eq!(holed.flags[n], whole.flags[n], "candidate {n}, {nearest} m from the middle");
        }
    }
    assert!(counts.iter().all(|n| *n >= 4), "{counts:?}");
}

/// Points of World under the wheels, (x, y) each, m.
fn wheels(predictor: &Predictor, state: &VehicleState<f64>) -> [[f64; 2]; WHEELS] {
    let [roll, pitch, yaw] = state.attitude_rad;
    let (sin, cos) = yaw.sin_cos();
    let offsets = predictor.step_model().wheel_offsets_heading(roll, pitch);
    offsets.map(|[x, y, _]| [state.position_m[0] + cos * x - sin * y, state.position_m[1] + sin * x + cos * y])
}
