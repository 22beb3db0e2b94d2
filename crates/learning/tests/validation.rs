//! Goal: a run keeps weights that it trained, whatever becomes of its validation. Method: two steps on a drive over level ground, validated on drives that are
//! too short, or that were measured to be nowhere.

mod common;

use std::sync::Arc;

use common::{drive, measured_scales, single_cells, truck};
use nesam_learning::initial::initial_weights;
use nesam_learning::origin::Origin;
use nesam_learning::{Drive, Objective, Trained, TrainingPlan, TrainingSet, train};
use nesam_model::reference::ComputeDevice;
use nesam_model::{Variant, Weights};
use nesam_physics::step::StepModel;

const HORIZON: usize = 4;

/// What two steps make of weights, and these weights.
fn two_steps(validation: &[&Drive]) -> (Trained, Weights) {
    let learned_from = drive(None, 60);
    let scales = measured_scales(&learned_from);
    let weights = initial_weights(7, &scales);
    let set = TrainingSet {
        train: vec![&learned_from],
        validation: validation.to_vec(),
        model: Arc::new(StepModel::new(&truck(), scales.dt_s, scales.substeps)),
        scales: &scales,
        pooling: single_cells(),
    };
    let folder = tempfile::tempdir().expect("a folder");
    let plan = TrainingPlan {
        steps: 2,
        batch: 2,
        rate: 1e-3,
        horizon: HORIZON,
        seed: 1,
        epoch: 1,
        device: ComputeDevice::Cpu,
        shards: 1,
        dropout: 0.0,
        decay: 0.0,
        objective: Objective { variant: Variant::Full, sustained: 0.0, soil_prior: 0.0 },
        folder: folder.path().into(),
        origin: Origin::new(),
    };
    let trained = train(&set, &weights, &plan, false, &|| false, |_, _, _| {}, |_| {}).expect("two steps");
    (trained, weights)
}

/// A drive of one window, whose end was measured at `x_m` more than it was.
fn of_one_window(x_m: f64) -> Drive {
    let mut made = drive(None, 32 + HORIZON);
    made.states[31 + HORIZON].position_m[0] += x_m;
    made
}

#[test]
fn regress_validation_drives_without_a_window_leave_the_choice_to_those_that_train() {
    let (trained, weights) = two_steps(&[&drive(None, HORIZON)]);
    for line in &trained.curve {
        assert!(line.validation.iter().all(|e| e.is_finite()) && line.diverged == 0, "{line:?}");
    }
    assert_ne!(trained.weights, weights);
}

#[test]
fn regress_a_window_that_diverges_is_left_out_and_counted() {
    let (sound, broken) = (of_one_window(0.0), of_one_window(f64::NAN));
    let (alone, _) = two_steps(&[&sound]);
    let (beside, _) = two_steps(&[&sound, &broken]);
    for (alone, beside) in alone.curve.iter().zip(&beside.curve) {
        assert_eq!((alone.diverged, beside.diverged), (0, 1));
        for (a, b) in alone.validation.iter().zip(beside.validation) {
            // Sums of another batch: the last bits may differ.
            assert!((a - b).abs() < 1e-5, "{alone:?} {beside:?}");
        }
    }
    let (none, weights) = two_steps(&[&broken]);
    assert!(none.curve.iter().all(|line| line.validation[0].is_nan()), "{:?}", none.curve);
    assert_ne!(none.weights, weights, "the running mean after the last step");
}
