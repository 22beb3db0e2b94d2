//! Goal: a planner may ask from now. Method: what the service rolls forward is what the offline rollout gives with the same commands, bit for bit.

use nesam_client::v1;
use tonic::Code;

use crate::stage::*;

/// Commands of the drive in steps `i..i + steps`, as sent with the stamps of these steps.
fn sent(recorded: &Recorded, i: usize, steps: usize) -> Vec<(i64, [f64; 2])> {
    (i..i + steps).map(|j| (j as i64 * STEP_NS, [recorded.drive.controls[j].speed_m_s, recorded.drive.controls[j].second])).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn service_prediction_from_now_equals_the_offline_rollout_behind_the_sent_commands() {
    let (server, mut client, recorded) = start_on_map().await;
    open(&mut client, "s", recorded.world.id()).await;
    let newest = 45;
    client.feed(samples("s", &recorded.drive, newest)).await.unwrap();
    let before = client.session("s").await.unwrap();
    let (soil, _) = learned(&recorded, newest);
    for (steps, horizon) in [(0, 32), (1, 31), (4, 20), (31, 1)] {
        let now_ns = (newest + steps) as i64 * STEP_NS;
        let query = candidates("s", &recorded.drive, newest + steps, 3, horizon);
        // The command of the newest step is known from its measurement; those after it are named.
        let asked = query.clone().starting_at(now_ns, sent(&recorded, newest + 1, steps.saturating_sub(1)));
        let prediction = client.predict(asked).await.unwrap();
        let mut whole = candidates("s", &recorded.drive, newest, 3, steps + horizon);
        for n in 0..3 {
            for k in 0..steps {
                let control = recorded.drive.controls[newest + k];
                let at = 2 * (n * whole.horizon + k);
                whole.controls[at..at + 2].copy_from_slice(&[control.speed_m_s as f32, control.second as f32]);
            }
        }
        let rollout = offline(&recorded, newest, &whole, 31, soil);
        for n in 0..3 {
            let (got, want) = (12 * n * horizon, 12 * (n * whole.horizon + steps));
            let expected = bits(&rollout.states[want..want + 12 * horizon]);
            assert!(bits(&prediction.states[got..got + 12 * horizon]) == expected, "{steps} steps, sample {n}");
        }
        let start = steps.checked_sub(1).map_or(recorded.drive.states[newest], |k| {
            nesam_physics::VehicleState::from_array(rollout.state(0, k).to_array().map(f64::from))
        });
        assert_eq!(prediction.start, start.to_array(), "{steps} steps");
        assert_eq!((prediction.rolled_forward_steps, prediction.start_stamp_ns), (steps, Some(now_ns)));
        assert_eq!((prediction.steps, prediction.provenance.history_epoch), (horizon, newest as u64 + 1));
    }
    assert_eq!(client.session("s").await.unwrap(), before, "a prediction changes nothing");
    server.shutdown().await;
}

/// Goal: a question that measurements overtook is answered from the instant that it was asked from. Method: the offline rollout from that measured step, with the
/// steps that are held before it.
#[tokio::test(flavor = "multi_thread")]
async fn service_a_question_that_measurements_overtook_is_answered_from_its_instant() {
    let (server, mut client, recorded) = start_on_map().await;
    open(&mut client, "s", recorded.world.id()).await;
    let newest = 45;
    client.feed(samples("s", &recorded.drive, newest)).await.unwrap();
    let (soil, _) = learned(&recorded, newest);
    for back in [1, 5, 31] {
        let asked_from = newest - back;
        let query = candidates("s", &recorded.drive, asked_from, 3, 32);
        let prediction = client.predict(query.clone().starting_at(asked_from as i64 * STEP_NS, Vec::new())).await.unwrap();
        let rollout = offline(&recorded, asked_from, &query, 31 - back, soil);
        assert!(bits(&prediction.states) == bits(&rollout.states), "{back} steps");
        assert_eq!(prediction.start, recorded.drive.states[asked_from].to_array(), "{back} steps");
        assert_eq!(prediction.start_stamp_ns, Some(asked_from as i64 * STEP_NS));
        assert_eq!((prediction.rolled_forward_steps, prediction.history_steps), (0, 31 - back));
    }
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_bad_instants_and_sent_commands_are_refused() {
    let recorded = recorded();
    let (server, mut client) = start().await;
    open(&mut client, "s", "").await;
    open(&mut client, "fresh", "").await;
    let newest = 10;
    client.feed(samples("s", &recorded.drive, newest)).await.unwrap();
    let before = client.list_sessions().await.unwrap();
    let newest_ns = newest as i64 * STEP_NS;
    let good = || {
        let query = candidates("s", &recorded.drive, newest, 2, 8);
        query.starting_at(newest_ns + 3 * STEP_NS, sent(&recorded, newest + 1, 2)).to_message()
    };
    let at = |stamp_ns: i64| v1::PredictRequest { start_stamp_ns: Some(stamp_ns), ..good() };
    let second = |change: &dyn Fn(&mut v1::SentCommand)| {
        let mut request = good();
        change(&mut request.sent[1]);
        request
    };
    let control = |speed_m_s, second| Some(v1::Control { speed_m_s, second });
    let start = Some(nesam_client::state_message(recorded.drive.states[newest].to_array()));
    let many = (0..257).map(|i| v1::SentCommand { stamp_ns: newest_ns + i, command: control(1.0, 0.0) }).collect();
    use Code::{FailedPrecondition, InvalidArgument};
    for (what, request, code, field) in [
        ("before the history", at(newest_ns - 40 * STEP_NS), InvalidArgument, "start_stamp_ns"),
        ("the oldest instant", at(i64::MIN), InvalidArgument, "start_stamp_ns"),
        ("the last instant", at(i64::MAX), FailedPrecondition, "start_stamp_ns"),
        ("beyond the positions", at(newest_ns + 25 * STEP_NS), FailedPrecondition, "start_stamp_ns"),
        ("with a start", v1::PredictRequest { start, ..good() }, InvalidArgument, "start"),
        ("without an instant", v1::PredictRequest { start_stamp_ns: None, ..good() }, InvalidArgument, "start_stamp_ns"),
        ("without a command", second(&|s| s.command = None), InvalidArgument, "sent[1].command"),
        ("NaN", second(&|s| s.command = control(f64::NAN, 0.0)), InvalidArgument, "sent[1].command.speed_m_s"),
        ("infinite", second(&|s| s.command = control(1.0, f64::INFINITY)), InvalidArgument, "sent[1].command.second"),
        ("speed off the card", second(&|s| s.command = control(99.0, 0.0)), InvalidArgument, "sent[1].command.speed_m_s"),
        ("second off the card", second(&|s| s.command = control(1.0, -1.5)), InvalidArgument, "sent[1].command.second"),
        ("time standing", second(&|s| s.stamp_ns -= STEP_NS), InvalidArgument, "sent[1].stamp_ns"),
        ("time going backwards", second(&|s| s.stamp_ns = i64::MIN), InvalidArgument, "sent[1].stamp_ns"),
        ("257 commands", v1::PredictRequest { sent: many, ..good() }, InvalidArgument, "sent"),
        ("no measurement", v1::PredictRequest { session_id: "fresh".into(), ..good() }, FailedPrecondition, "start"),
    ] {
        assert_refused(what, client.predict_message(request).await, code, field);
        assert_eq!(client.list_sessions().await.unwrap(), before, "{what}");
    }
    client.predict_message(at(newest_ns + 24 * STEP_NS)).await.unwrap();
    client.predict_message(good()).await.unwrap();
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_half_precision_is_half_the_bytes_and_rounding_only() {
    let (server, mut client, recorded) = driven("s", 40).await;
    let mut query = candidates("s", &recorded.drive, 40, 4, 32);
    query.output.stride = 4;
    let whole = client.predict(query.clone()).await.unwrap();
    let bytes = client.predict_message(query.to_message()).await.unwrap();
    query.output.precision = v1::Precision::F16.into();
    let half = client.predict(query.clone()).await.unwrap();
    let half_bytes = client.predict_message(query.to_message()).await.unwrap();
    assert_eq!((2 * half_bytes.states.len(), 2 * half_bytes.sinkage_m.len()), (bytes.states.len(), bytes.sinkage_m.len()));
    assert_eq!((bytes.precision(), half_bytes.precision()), (v1::Precision::F32, v1::Precision::F16));
    // binary16 rounds to 2^-11 of a number; of a position, to 2^-11 of the offset from the start.
    for (i, (got, want)) in half.states.iter().zip(&whole.states).enumerate() {
        let (origin, rounding) = if i % 12 < 3 { (whole.start[i % 12] as f32, 1e-4) } else { (0.0, 1e-6) };
        assert!((got - want).abs() <= (want - origin).abs() * 2_f32.powi(-11) + rounding, "number {i}: {got} for {want}");
    }
    assert!(half.sinkage_m.iter().zip(&whole.sinkage_m).all(|(got, want)| (got - want).abs() <= want.abs() * 2_f32.powi(-11) + 1e-6));
    query.output.precision = 7;
    assert_refused("precision 7", client.predict(query).await, Code::InvalidArgument, "output.precision");
    server.shutdown().await;
}
