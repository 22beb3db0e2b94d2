//! Goal: a training that was interrupted ends where it would have ended. Method: a few steps at a high rate, which soon makes
//! the model worse, so that a validation between two epochs would choose other weights; in one go, and interrupted after each step and resumed.

mod common;

use std::path::Path;
use std::sync::Arc;

use common::{drive, measured_scales, single_cells, truck};
use nesam_learning::initial::initial_weights;
use nesam_learning::origin::Origin;
use nesam_learning::{Objective, Trained, TrainingError, TrainingPlan, TrainingSet, train};
use nesam_model::reference::ComputeDevice;
use nesam_model::{Variant, Weights};
use nesam_physics::step::StepModel;

const HORIZON: usize = 4;
/// Steps of the runs, with an epoch in the middle that ends after four.
const STEPS: usize = 6;
const EPOCH: usize = 4;

/// `steps` steps with checkpoints in a folder, with the weights they began from; `stop` = interrupted after every step.
fn run(folder: &Path, steps: usize, resume: bool, stop: bool) -> (Result<Trained, TrainingError>, Weights) {
    run_at(0.01, folder, steps, resume, stop)
}

fn run_at(rate: f64, folder: &Path, steps: usize, resume: bool, stop: bool) -> (Result<Trained, TrainingError>, Weights) {
    run_with(&|plan| plan.rate = rate, folder, steps, resume, stop)
}

/// The same with a plan that is changed.
fn run_with(
    change: &dyn Fn(&mut TrainingPlan),
    folder: &Path,
    steps: usize,
    resume: bool,
    stop: bool,
) -> (Result<Trained, TrainingError>, Weights) {
    let learned_from = drive(None, 60);
    let scales = measured_scales(&learned_from);
    let weights = initial_weights(7, &scales);
    let set = TrainingSet {
        train: vec![&learned_from],
        validation: vec![&learned_from],
        model: Arc::new(StepModel::new(&truck(), scales.dt_s, scales.substeps)),
        scales: &scales,
        pooling: single_cells(),
    };
    let mut plan = TrainingPlan {
        steps,
        batch: 2,
        rate: 0.01,
        horizon: HORIZON,
        seed: 1,
        epoch: EPOCH,
        device: ComputeDevice::Cpu,
        shards: 1,
        dropout: 0.0,
        decay: 0.0,
        objective: Objective { variant: Variant::Full, sustained: 0.0, soil_prior: 0.0 },
        folder: folder.into(),
        origin: Origin::new(),
    };
    change(&mut plan);
    (train(&set, &weights, &plan, resume, &|| stop, |_, _, _| {}, |_| {}), weights)
}

/// Runs to the end, interrupted after each of the steps.
fn in_pieces(folder: &Path) -> Trained {
    for step in 1..=STEPS {
        match run(folder, STEPS, step > 1, true).0 {
            Err(TrainingError::Interrupted(at)) => assert_eq!(at, step),
            other => panic!("step {step} was to be interrupted: {:?}", other.map(|trained| trained.steps)),
        }
    }
    run(folder, STEPS, true, false).0.expect("the run is complete")
}

#[test]
fn regress_a_training_that_was_interrupted_gives_the_weights_of_one_that_was_not() {
    let [folder, other] = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
    let whole = run(folder.path(), STEPS, false, false).0.expect("a run in one go");
    let resumed = in_pieces(other.path());
    assert_eq!(whole.curve.iter().map(|line| line.step).collect::<Vec<_>>(), [EPOCH, STEPS]);
    assert_eq!((resumed.steps, resumed.curve.len()), (whole.steps, whole.curve.len()));
    for (a, b) in whole.curve.iter().zip(&resumed.curve) {
        assert_eq!((a.step, a.loss.to_bits(), a.diverged), (b.step, b.loss.to_bits(), b.diverged), "{a:?} {b:?}");
        // A number that went through JSON may lack its last bit.
        for (a, b) in a.validation.iter().zip(b.validation) {
            assert!((a - b).abs() <= 1e-12 * a.abs() || (a.is_nan() && b.is_nan()), "{a} {b}");
        }
        assert!(b.step_s.is_finite() && b.step_s > 0.0, "{b:?}");
    }
    assert!(resumed.weights == whole.weights, "the weights differ");
}

#[test]
fn regress_an_interruption_before_the_first_epoch_leaves_what_was_trained() {
    let folder = tempfile::tempdir().expect("a folder");
    assert!(matches!(run(folder.path(), STEPS, false, true).0, Err(TrainingError::Interrupted(1))));
    let (ended, weights) = run(folder.path(), 1, true, false);
    let ended = ended.expect("a plan of no further steps");
    assert_eq!((ended.steps, ended.curve.len()), (1, 0));
    assert!(ended.weights != weights, "the running mean after the step");
}

#[test]
fn property_weights_that_are_no_numbers_are_an_error_and_no_result() {
    let folder = tempfile::tempdir().expect("a folder");
    let error = run_at(f64::NAN, folder.path(), STEPS, false, false).0.err().expect("nothing can come of it");
    assert!(matches!(error, TrainingError::Diverged(STEPS)) && error.to_string().contains("lower --lr"), "{error}");
}

/// Goal: a run goes on from a checkpoint of the same run alone, and says what differs. Method: interrupted after a step, then one thing of the plan is another; a
/// checkpoint that does not say what it was begun with; nothing is written meanwhile.
#[test]
fn property_a_checkpoint_of_another_run_is_refused_by_what_differs() {
    let folder = tempfile::tempdir().expect("a folder");
    let drives = |hash: &'static str| move |plan: &mut TrainingPlan| drop(plan.origin.insert("data".into(), hash.into()));
    assert!(matches!(run_with(&drives("one"), folder.path(), STEPS, false, true).0, Err(TrainingError::Interrupted(1))));
    let state = folder.path().join("state.json");
    let kept = std::fs::read(&state).expect("saved");
    type Change = &'static dyn Fn(&mut TrainingPlan);
    let changes: [(Change, &str); 6] = [
        (&|plan| plan.seed = 2, "--seed 1, now 2"),
        (&|plan| plan.rate = 0.02, "--lr 0.01, now 0.02"),
        (&|plan| plan.batch = 3, "--batch-size 2, now 3"),
        (&|plan| plan.steps = STEPS + 1, "--epochs times --batches 6, now 7"),
        (&|plan| drop(plan.origin.insert("data".into(), "two".into())), "data one, now two"),
        (&|plan| plan.origin.clear(), "data one, now nothing"),
    ];
    for (change, told) in changes {
        let both = |plan: &mut TrainingPlan| {
            drives("one")(plan);
            change(plan);
        };
        let error = run_with(&both, folder.path(), STEPS, true, false).0.err().unwrap_or_else(|| panic!("{told}: it went on"));
        assert!(matches!(error, TrainingError::Foreign { .. }) && error.to_string().contains(told), "{told}: {error}");
        assert!(!error.to_string().contains("; --"), "one thing differs: {error}");
        assert_eq!(std::fs::read(&state).expect("still there"), kept, "{told}");
    }
    let mut old: serde_json::Value = serde_json::from_slice(&kept).expect("JSON");
    old.as_object_mut().expect("an object").remove("begun_with");
    std::fs::write(&state, old.to_string()).expect("written");
    let error = run_with(&drives("one"), folder.path(), STEPS, true, false).0.err().expect("it says nothing").to_string();
    assert!(error.contains("older versions"), "{error}");
    std::fs::write(&state, &kept).expect("written");
    assert_eq!(run_with(&drives("one"), folder.path(), STEPS, true, false).0.expect("the same run").steps, STEPS);
}
