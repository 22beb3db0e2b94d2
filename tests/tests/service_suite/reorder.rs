//! Goal: the order in which measurements arrive does not matter, as long as each arrives inside the reorder window. Method: random delays, random rates, random losses; the same
//! measurements in the order of their stamps are the oracle. Posterior, history and prediction have to be the same to the last bit.

use std::cell::Cell;

use nesam_engine::{Command, Engine, Limits, Measurement, OpenSession, Reply, WheelMeasurement};
use nesam_physics::VehicleState;
use proptest::prelude::*;
use proptest::test_runner::{Config, RngAlgorithm, TestRng, TestRunner};

use crate::stage::*;

/// The drive as a vehicle of this rate measures it: linear between the recorded samples.
fn measured(recorded: &Recorded, rate_hz: i64, seconds: i64) -> Vec<Measurement> {
    let period_ns = 1_000_000_000 / rate_hz;
    (0..seconds * rate_hz)
        .map(|k| {
            let stamp_ns = k * period_ns;
            let (i, weight) = ((stamp_ns / STEP_NS) as usize, (stamp_ns % STEP_NS) as f64 / STEP_NS as f64);
            let [a, b] = [i, i + 1].map(|i| recorded.drive.states[i].to_array());
            let state = VehicleState::from_array(core::array::from_fn(|c| a[c] + weight * (b[c] - a[c])));
            let command = recorded.drive.controls[i];
            Measurement { sequence: Some(k as u64 + 1), boot: None, stamp_ns, state, command, wheels: WheelMeasurement::default() }
        })
        .collect()
}

/// An engine with a session on the map.
fn engine(recorded: &Recorded) -> Engine {
    let mut engine = Engine::new(predictor(), Limits::default()).unwrap();
    engine.execute(0, &Command::PutMap { map: recorded.world.clone(), base: None }).unwrap();
    engine
        .execute(0, &Command::Open(OpenSession { vehicle: "truck".into(), map: recorded.world.id().into(), ..Default::default() }))
        .unwrap();
    engine
}

/// Everything that the session shows after these arrivals, with every digit: soil and covariance, newest step, a prediction over the whole history. The epoch of the history is left out: it
/// counts how often the history changed, which is a matter of the order.
fn shown(recorded: &Recorded, arrivals: &[Measurement]) -> (String, u64, Vec<&'static str>) {
    let mut engine = engine(recorded);
    let mut outcomes = Vec::new();
    for measurement in arrivals {
        let command = Command::Measure { session: "truck".into(), vehicle: None, measurement: *measurement };
        let Reply::Measured(answer) = engine.execute(0, &command).unwrap() else { panic!("another reply") };
        outcomes.push(answer.outcome.label());
    }
    let Reply::Session(view) = engine.execute(0, &Command::Get { session: "truck".into() }).unwrap() else { panic!("another reply") };
    let query = engine_query("truck", &recorded.drive, 60, 1, 16);
    let Reply::Predicted(prediction) = engine.execute(0, &Command::Predict(query)).unwrap() else { panic!("another reply") };
    let text = format!(
        "{:?} {:?} {:?} {:?}",
        view.soil,
        view.newest,
        prediction.rollout,
        (view.history_steps, view.last_stamp_ns, view.last_sequence)
    );
    (text, view.soil.state.epoch, outcomes)
}

#[test]
fn property_any_order_of_arrival_inside_the_window_gives_the_same_posterior_and_history() {
    let recorded = recorded();
    let window_ns = Limits::default().reorder_window_ns();
    // One delay for each measurement: it arrives before anything with a stamp of a whole window later.
    let case = (
        prop::sample::select(vec![10_i64, 12, 25, 33, 50, 100, 200]),
        prop::collection::vec((0..window_ns, 0..40_u8), 1200),
        any::<bool>(),
    );
    let mut runner =
        TestRunner::new_with_rng(Config { cases: 14, ..Config::default() }, TestRng::from_seed(RngAlgorithm::ChaCha, &[7; 32]));
    let (reordered, updates) = (Cell::new(0), Cell::new(0));
    let outcome = runner.run(&case, |(rate_hz, fate, lossy)| {
        let mut sent: Vec<(i64, Measurement)> = measured(&recorded, rate_hz, 6)
            .into_iter()
            .zip(&fate)
            .filter(|(_, (_, luck))| !lossy || *luck > 0)
            .map(|(m, (delay_ns, _))| (m.stamp_ns + delay_ns, m))
            .collect();
        let in_order: Vec<Measurement> = sent.iter().map(|(_, m)| *m).collect();
        sent.sort_by_key(|(arrival_ns, m)| (*arrival_ns, m.stamp_ns));
        let shuffled: Vec<Measurement> = sent.into_iter().map(|(_, m)| m).collect();
        let (expected, epoch, _) = shown(&recorded, &in_order);
        let (got, _, outcomes) = shown(&recorded, &shuffled);
        reordered.set(reordered.get() + shuffled.windows(2).filter(|w| w[1].stamp_ns < w[0].stamp_ns).count());
        updates.set(updates.get() + epoch);
        prop_assert!(outcomes.iter().all(|o| ["applied", "buffered", "gap", "gated"].contains(o)), "{rate_hz} Hz: {outcomes:?}");
        prop_assert!(got == expected, "{rate_hz} Hz, lossy: {lossy}");
        Ok(())
    });
    outcome.unwrap();
    let (reordered, updates) = (reordered.get(), updates.get());
    assert!(reordered > 500 && updates > 30, "{reordered} measurements overtaken, {updates} updates");
}

#[test]
fn property_measurements_between_the_grid_points_do_not_change_the_steps_of_a_divisor() {
    // The drive is linear between its samples, so every rate sees the same states at the grid points.
    let recorded = recorded();
    let at = |rate_hz: i64| {
        let mut arrivals = measured(&recorded, rate_hz, 6);
        arrivals.retain(|m| m.stamp_ns <= 59 * STEP_NS);
        arrivals.iter_mut().for_each(|m| m.sequence = None);
        shown(&recorded, &arrivals).0
    };
    let ten = at(10);
    for rate_hz in [20, 50, 100, 200] {
        assert!(at(rate_hz) == ten, "{rate_hz} Hz");
    }
}
