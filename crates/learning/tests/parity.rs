//! Goal: the fast path and the candle reference are one model; a row of a batch is the row alone; the cache changes nothing.
//! Method: the same weights, drive and terrain tokens through both; exact comparison where bits must agree.

mod common;

use std::sync::Arc;

use candle_core::{Device, Tensor};
use common::{drive, from_sample_33, hills, lively_weights, measured_scales, predictor};
use nesam_learning::Drive;
use nesam_model::dims::HIDDEN;
use nesam_model::reference::{ComputeDevice, KvCache, Network, ReferencePredictor, causal_mask};
use nesam_model::{
    CacheCounts, MeasuredWheels, ModelBundle, Normalization, Order, Path, Precision, Predictor, RolloutQuery, Variant, Weights,
};
use nesam_physics::{Control, STATE_DIM, SoilCorrection, VehicleState};
use nesam_terrain::{Pose2, WorldMap};

fn pose(s: &VehicleState<f64>) -> Pose2 {
    Pose2 { x_m: s.position_m[0], y_m: s.position_m[1], yaw_rad: s.attitude_rad[2] }
}

fn compare(map: Option<&Arc<WorldMap>>, history: usize, variant: Variant) {
    let drive = drive(map, 80);
    let scales = measured_scales(&drive);
    compare_weights(map, history, variant, &drive, &scales, lively_weights(&scales));
}

fn compare_weights(map: Option<&Arc<WorldMap>>, history: usize, variant: Variant, drive: &Drive, scales: &Normalization, weights: Weights) {
    let predictor = predictor(scales, weights.clone());
    let start = 33;
    let past = drive.history(start - history, start);
    let controls: Vec<f32> = drive.controls[start..start + 32].iter().flat_map(Control::packed).collect();
    let query = RolloutQuery {
        history: &past,
        start: drive.states[start],
        controls: &controls,
        samples: 1,
        horizon: 32,
        map,
        soil_correction: SoilCorrection::NONE,
        variant,
        start_time_s: None,
        wheels: None,
    };
    let fast = predictor.rollout(&query).expect("a valid query");

    let reference = ReferencePredictor::new(&predictor, ComputeDevice::Cpu).and_then(|reference| reference.rollout(&query));
    for (k, slow) in reference.expect("the reference runs").chunks_exact(STATE_DIM).enumerate() {
        for (i, (a, b)) in fast.state(0, k).to_array().iter().zip(slow).enumerate() {
            // 32 steps of f32 with two orders of summation: a millimetre, a tenth of a milliradian.
            assert!((a - b).abs() < 1.5e-3, "step {k}, entry {i}: fast {a}, reference {b} ({variant:?}, history {history})");
        }
    }
}

#[test]
fn property_fast_path_equals_the_reference() {
    let map = hills();
    for variant in Variant::ALL {
        compare(Some(&map), 31, variant);
    }
    compare(Some(&map), 5, Variant::Full);
    compare(Some(&map), 0, Variant::Full);
    compare(None, 31, Variant::Full);
}

#[test]
fn property_fast_path_equals_the_reference_on_shipped_weights() {
    let shipped = concat!(env!("CARGO_MANIFEST_DIR"), "/../../deploy/bundles/hmmwv-nominal");
    let bundle = ModelBundle::load(shipped.as_ref()).expect("a shipped bundle");
    let map = hills();
    let mut driven = drive(Some(&map), 80);
    compare_weights(Some(&map), 31, Variant::Full, &driven, &bundle.normalization, bundle.weights.clone());
    // Told to creep, slower than anything in training, where the residual counts in part.
    driven.controls.iter_mut().for_each(|control| control.speed_m_s *= 0.2);
    compare_weights(Some(&map), 31, Variant::Full, &driven, &bundle.normalization, bundle.weights.clone());
}

/// Commands that differ from candidate to candidate and from step to step, (samples, horizon, 2).
fn wavy_controls(samples: usize, horizon: usize) -> Vec<f32> {
    (0..samples * horizon).flat_map(|i| [2.0 + (i as f32 * 0.37).sin(), (i as f32 * 0.11).cos()]).collect()
}

/// With two threads 37 candidates are more than sixteen for each, and go in blocks of thirty-two.
fn on_two_threads<R: Send>(work: impl FnOnce() -> R + Send) -> R {
    rayon::ThreadPoolBuilder::new().num_threads(2).build().expect("two threads").install(work)
}

#[test]
fn property_every_path_gives_the_same_bytes() {
    let map = hills();
    let drive = drive(Some(&map), 80);
    let scales = measured_scales(&drive);
    let fastest = predictor(&scales, lively_weights(&scales));
    let past = drive.history(2, 33);
    let (samples, horizon) = (37, 12);
    let controls = wavy_controls(samples, horizon);
    let query = from_sample_33(&drive, &past, &controls, samples, &map);
    let expected = on_two_threads(|| fastest.rollout(&query)).expect("a valid query");
    // Without a fused multiply-add in the target the portable path rounds otherwise.
    for path in Path::available().into_iter().filter(|path| cfg!(target_feature = "fma") || *path == fastest.path()) {
        assert_eq!(on_two_threads(|| fastest.on_path(path).rollout(&query)).expect("a valid query"), expected, "on {}", path.as_str());
    }
    // A repeated query meets a warm cache, and other threads.
    assert_eq!(fastest.rollout(&query).expect("a valid query"), expected);
}

/// Both orders of summation in bf16.
const IN_BF16: [Precision; 2] = [Precision::Bf16(Order::Tiles), Precision::Bf16(Order::Pairs)];

#[test]
fn property_bf16_gives_the_same_bytes_on_every_path_and_touches_rollouts_alone() {
    let map = hills();
    let drive = drive(Some(&map), 80);
    let scales = measured_scales(&drive);
    let in_f32 = predictor(&scales, lively_weights(&scales));
    let past = drive.history(2, 33);
    let (samples, horizon) = (37, 12);
    let controls = wavy_controls(samples, horizon);
    let query = from_sample_33(&drive, &past, &controls, samples, &map);
    let exact = in_f32.rollout(&query).expect("a valid query");
    for precision in IN_BF16 {
        let rounded = in_f32.in_precision(precision);
        let expected = on_two_threads(|| rounded.rollout(&query)).expect("a valid query");
        assert_ne!(expected.states, exact.states, "{}", precision.as_str());
        // Products of two bf16 are exact in f32, so that even a path without fused multiply-add gives the same sums; what is not rounded may differ there.
        for path in Path::available().into_iter().filter(|_| cfg!(target_feature = "fma")) {
            let on_path = rounded.on_path(path);
            assert_eq!(on_path.precision(), precision);
            assert_eq!(
                on_two_threads(|| on_path.rollout(&query)).expect("a valid query"),
                expected,
                "{} on {}",
                precision.as_str(),
                path.as_str()
            );
        }
        let own = &controls[7 * horizon * 2..8 * horizon * 2];
        let alone = rounded.rollout(&RolloutQuery { controls: own, samples: 1, ..query.clone() }).expect("a valid query");
        for k in 0..horizon {
            assert_eq!(expected.state(7, k), alone.state(0, k), "row 7, step {k}, {}", precision.as_str());
        }
        let back = rounded.in_precision(Precision::F32);
        assert_eq!(back.rollout(&query).expect("a valid query"), exact);
        let seen_by_the_filter = |predictor: &Predictor| {
            let commands = &drive.controls[33..40];
            format!("{:?}", predictor.transitions_along(&past, &drive.states[33], commands, Some(&map), &SoilCorrection::NONE))
        };
        assert_eq!(seen_by_the_filter(&rounded), seen_by_the_filter(&in_f32));
    }
}

#[test]
fn property_bf16_stays_near_f32_on_shipped_weights() {
    let shipped = concat!(env!("CARGO_MANIFEST_DIR"), "/../../deploy/bundles/hmmwv-nominal");
    let bundle = Arc::new(ModelBundle::load(shipped.as_ref()).expect("a shipped bundle"));
    let in_f32 = Predictor::new(bundle).expect("a usable bundle");
    let map = hills();
    let drive = drive(Some(&map), 80);
    let past = drive.history(2, 33);
    let (samples, horizon) = (64, 32);
    let controls = wavy_controls(samples, horizon);
    let query = from_sample_33(&drive, &past, &controls, samples, &map);
    let exact = in_f32.rollout(&query).expect("a valid query");
    for precision in IN_BF16 {
        let rounded = in_f32.in_precision(precision).rollout(&query).expect("a valid query");
        let apart_m = |n: usize, k: usize| {
            let [a, b] = [&exact, &rounded].map(|rollout| rollout.state(n, k).position_m);
            (a[0] - b[0]).hypot(a[1] - b[1])
        };
        let mean_m = (0..samples).map(|n| (0..horizon).map(|k| apart_m(n, k)).sum::<f32>()).sum::<f32>() / (samples * horizon) as f32;
        // The model errs by 0.12 m in the mean over such a horizon; rounding may add a hundredth of that.
        assert!(mean_m > 0.0 && mean_m < 1.2e-3, "{}: {mean_m} m", precision.as_str());
    }
}

#[test]
fn property_row_of_a_batch_equals_the_row_alone() {
    let map = hills();
    let drive = drive(Some(&map), 80);
    let scales = measured_scales(&drive);
    let predictor = predictor(&scales, lively_weights(&scales));
    let past = drive.history(2, 33);
    let (samples, horizon) = (37, 16);
    let controls = wavy_controls(samples, horizon);
    let query = from_sample_33(&drive, &past, &controls, samples, &map);
    // Without a history the actuators begin as each row's own first command says.
    for query in [query.clone(), RolloutQuery { history: &[], ..query }] {
        let batch = on_two_threads(|| predictor.rollout(&query)).expect("a valid query");
        for n in [0, 7, 16, 31, 36] {
            let own = &controls[n * horizon * 2..(n + 1) * horizon * 2];
            let alone = predictor.rollout(&RolloutQuery { controls: own, samples: 1, ..query.clone() }).expect("a valid query");
            for k in 0..horizon {
                assert_eq!(batch.state(n, k), alone.state(0, k), "row {n}, step {k}, history of {}", query.history.len());
                assert_eq!(batch.sinkage(n, k), alone.sinkage(0, k));
            }
        }
    }
}

#[test]
fn property_looking_at_the_soil_prior_encodes_nothing() {
    let map = hills();
    let drive = drive(Some(&map), 40);
    let scales = measured_scales(&drive);
    let predictor = predictor(&scales, lively_weights(&scales));
    let at = pose(&drive.states[33]);
    assert_eq!(predictor.known_soil_prior(Some(&map), at), None);
    assert_eq!(predictor.terrain_cache(&map), CacheCounts::default());
    let prior = predictor.soil_prior(Some(&map), at);
    let counts = predictor.terrain_cache(&map);
    assert_eq!(predictor.known_soil_prior(Some(&map), at), Some(prior));
    assert_eq!(predictor.terrain_cache(&map), counts);
    assert_eq!(predictor.known_soil_prior(None, at), Some(predictor.soil_prior(None, at)));
}

#[test]
fn analytic_cached_attention_equals_attention_over_everything() {
    let drive = drive(None, 40);
    let scales = measured_scales(&drive);
    let network = Network::from_weights(&lively_weights(&scales), &Device::Cpu).expect("all arrays are there");
    let x = Tensor::randn(0f32, 1f32, (3, 20, HIDDEN), &Device::Cpu).expect("a tensor");
    let whole = network.transformer(&x, &mut KvCache::new(), Some(&causal_mask(20, &Device::Cpu).expect("a mask"))).expect("runs");
    let mut cache = KvCache::new();
    let first = x.narrow(1, 0, 12).and_then(|t| t.contiguous()).expect("a slice");
    network.transformer(&first, &mut cache, Some(&causal_mask(12, &Device::Cpu).expect("a mask"))).expect("runs");
    for t in 12..20 {
        let token = x.narrow(1, t, 1).and_then(|t| t.contiguous()).expect("a slice");
        let step = network.transformer(&token, &mut cache, None).expect("runs");
        let error =
            (step - whole.narrow(1, t, 1).expect("a slice")).and_then(|d| d.abs()?.max_all()?.to_scalar::<f32>()).expect("a number");
        assert!(error < 1e-4, "token {t}: {error}");
    }
}

#[test]
fn published_soil_prior_has_the_papers_parameters() {
    let drive = drive(None, 40);
    assert_eq!(lively_weights(&measured_scales(&drive)).parameters("soil."), 28_262);
}

#[test]
fn property_what_the_reference_does_not_know_is_refused_by_name() {
    let map = hills();
    let drive = drive(Some(&map), 80);
    let scales = measured_scales(&drive);
    let reference =
        ReferencePredictor::new(&predictor(&scales, lively_weights(&scales)), ComputeDevice::Cpu).expect("a bundle without effects");
    let (past, controls) = (drive.history(2, 33), wavy_controls(2, 4));
    let wheels = [MeasuredWheels { speed_rad_s: [5.0; 4], angle_rad: [0.0; 4] }; 4];
    let sound = from_sample_33(&drive, &past, &controls, 2, &map);
    assert_eq!(reference.rollout(&sound).expect("a valid query").len(), 2 * 4 * STATE_DIM);
    let wrong = [
        ("horizon", RolloutQuery { horizon: 0, ..sound.clone() }),
        ("controls", RolloutQuery { samples: 3, ..sound.clone() }),
        ("soil_correction", RolloutQuery { soil_correction: SoilCorrection { delta: [0.1; 6], ..SoilCorrection::NONE }, ..sound.clone() }),
        ("wheels", RolloutQuery { wheels: Some(&wheels), ..sound }),
    ];
    for (field, query) in wrong {
        let refused = reference.rollout(&query).expect_err(field).to_string();
        assert!(refused.contains(field), "{field}: {refused}");
    }
}
