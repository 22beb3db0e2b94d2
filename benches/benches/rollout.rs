//! Question: what does a planner's query cost, terrain warm? Budget: 100 ms for 256 × 32 on two cores until the kernels of a later stage.

use std::sync::Arc;

use criterion::{Criterion, criterion_group, criterion_main};
use nesam_model::{ModelBundle, Predictor, RolloutQuery, Variant};
use nesam_physics::{SoilCorrection, VehicleState};
use nesam_terrain::WorldMap;
use nesam_tests::{sample_root, shipped_bundle};

fn rollout(c: &mut Criterion) {
    let bundle = ModelBundle::load(&shipped_bundle()).expect("a shipped bundle");
    let predictor = Predictor::new(Arc::new(bundle)).expect("a complete bundle");
    let map = Arc::new(WorldMap::load(&sample_root().join("worlds/w05")).expect("a map of the sample"));
    let mut start = VehicleState::zero();
    start.position_m = [3.2, -4.1, map.nearest_height_m(3.2, -4.1) + 0.6];
    start.velocity_m_s[0] = 2.5;
    let mut group = c.benchmark_group("rollout of 32 steps, terrain warm");
    group.sample_size(10);
    for samples in [1, 64, 256] {
        let controls: Vec<f32> = (0..samples * 32).flat_map(|i| [2.5, 0.6 * (i as f32 * 0.01).sin()]).collect();
        let query = RolloutQuery {
            history: &[],
            start,
            controls: &controls,
            samples,
            horizon: 32,
            map: Some(&map),
            soil_correction: SoilCorrection::NONE,
            variant: Variant::Full,
            start_time_s: None,
            wheels: None,
        };
        group.bench_function(format!("{samples} candidates"), |b| b.iter(|| predictor.rollout(&query).expect("a valid query")));
    }
    group.finish();
}

criterion_group!(benches, rollout);
criterion_main!(benches);
