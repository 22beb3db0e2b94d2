//! Question: what does one update of the soil filter cost, network along the buffer included and apart? Budget: 1 ms on one core for the update.

use std::hint::black_box;
use std::sync::Arc;

use criterion::{Criterion, criterion_group, criterion_main};
use nesam_adaptation::{BufferedTransition, CalibratedFilter, FilterConfig, SoilFilter};
use nesam_model::{HistoryStep, ModelBundle, Predictor, SoilByClass};
use nesam_tests::{sample_root, shipped_bundle};
use nesam_trajectories::{DataRoot, SetQuery, SplitFilter};

/// Sample of the drive at which the buffer begins.
const START: usize = 60;

fn soil_update(c: &mut Criterion) {
    let bundle = ModelBundle::load(&shipped_bundle()).expect("a shipped bundle");
    let carried =
        bundle.soil_filter_json.as_deref().map(|json| CalibratedFilter::from_json(json).expect("settings of a shipped bundle").config());
    let config = carried.unwrap_or_default();
    let predictor = Predictor::new(Arc::new(bundle)).expect("a complete bundle");
    let root = DataRoot::open(&sample_root(), None).expect("the sample");
    let query = SetQuery { set: "nominal".into(), split: SplitFilter::All, trajectories: None, dt_s: 0.1, ground_truth: false };
    let drive = root.load_set(&query).expect("drives of the sample").into_iter().next().expect("one drive");
    let map = root.world(drive.world.as_deref().expect("a world")).expect("its map");
    let steps: Vec<HistoryStep> =
        drive.states.iter().zip(&drive.controls).map(|(&state, &control)| HistoryStep { state, control }).collect();
    let along = SoilByClass::new(Some(&map), Vec::new());
    let transitions = || {
        predictor.measured_transitions(&steps, START..START + config.buffer, Some(&along), &map).expect("a drive on its map").into_iter()
    };
    let buffer: Vec<BufferedTransition> = transitions()
        .zip(&steps[START + 1..])
        .map(|(t, end)| {
            let [x, y, _] = t.input.state.position_m;
            let ground_class = SoilByClass::class_at(Some(&map), [x, y]);
            BufferedTransition { ground_class, ..BufferedTransition::new(t.input, t.residual, &end.state) }
        })
        .collect();
    let mut group = c.benchmark_group("soil filter");
    group.bench_function("network along one buffer", |b| b.iter(|| black_box(transitions().count())));
    // The literal algorithm pushes the same transitions: what it costs does not depend on where they start.
    for (name, settings) in [("one update", config.clone()), ("one update, literal Algorithm 1", FilterConfig::literal())] {
        let fresh = SoilFilter::new(settings).expect("usable settings");
        let update = |mut filter: SoilFilter| {
            for transition in &buffer {
                black_box(filter.push(predictor.step_model(), *transition).expect("finite numbers"));
            }
        };
        group.bench_function(name, |b| b.iter_batched(|| fresh.clone(), update, criterion::BatchSize::SmallInput));
    }
    group.finish();
}

criterion_group!(benches, soil_update);
criterion_main!(benches);
