//! Goal: a prediction through the service is the offline rollout, whatever else happens around it.

use nesam_client::{Candidates, v1};
use nesam_physics::SoilCorrection;

use crate::stage::*;

#[tokio::test(flavor = "multi_thread")]
async fn service_prediction_equals_offline_rollout_bit_for_bit() {
    let recorded = recorded();
    let (server, mut client) = start().await;
    let description = client.upload_map(&layers(&recorded.world)).await.unwrap();
    assert_eq!(description.hash, recorded.world.hash(), "the uploaded map has the layers of the file");
    open(&mut client, "s", recorded.world.id()).await;
    for (i, history_steps) in [(10, 10), (40, 31), (101, 31)] {
        let fed = client.feed(samples("s", &recorded.drive, i)).await.unwrap();
        assert_eq!(fed.len(), i + 1);
        let candidates = candidates("s", &recorded.drive, i, 5, 32);
        let prediction = client.predict(candidates.clone()).await.unwrap();
        let (soil, updates) = learned(&recorded, i);
        assert_same(&prediction, &offline(&recorded, i, &candidates, history_steps, soil));
        assert!(prediction.states.iter().all(|v| v.is_finite()));
        assert_eq!(prediction.history_steps, history_steps);
        assert_eq!(prediction.start, recorded.drive.states[i].to_array());
        assert!(prediction.measurement_age_s.is_some_and(|age| (0.0..60.0).contains(&age)));
        let provenance = &prediction.provenance;
        assert_eq!((provenance.history_epoch, provenance.soil_epoch, provenance.map_version), (i as u64 + 1, updates, 1));
        assert_eq!((provenance.map_hash.as_str(), &provenance.bundle_hash), (recorded.world.hash(), &predictor().bundle().hash));
    }
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_batch_row_equals_row_alone() {
    let (server, mut client, recorded) = driven("s", 60).await;
    let batch = candidates("s", &recorded.drive, 60, 19, 8);
    let together = client.predict(batch.clone()).await.unwrap();
    for n in [0, 7, 15, 16, 18] {
        let mut alone = batch.clone();
        alone.samples = 1;
        alone.controls = batch.controls[n * 16..(n + 1) * 16].to_vec();
        let alone = client.predict(alone).await.unwrap();
        assert!(bits(&alone.states) == bits(&together.states[n * 96..(n + 1) * 96]), "row {n}");
        assert_eq!(alone.validity[0], together.validity[n]);
    }
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_given_start_history_use_and_selection() {
    let (server, mut client, recorded) = start_on_map().await;
    open(&mut client, "s", recorded.world.id()).await;
    let i = 50;
    let mut query = candidates("s", &recorded.drive, i, 3, 9);
    // No measurement yet: a start must be given.
    assert_refused("no start", client.predict(query.clone()).await, tonic::Code::FailedPrecondition, "start");
    query.start = Some(recorded.drive.states[i].to_array());
    let alone = client.predict(query.clone()).await.unwrap();
    assert_same(&alone, &offline(&recorded, i, &query, 0, SoilCorrection::NONE));
    assert_eq!(alone.measurement_age_s, None);

    client.feed(samples("s", &recorded.drive, i)).await.unwrap();
    let before = client.session("s").await.unwrap();
    let full = client.predict(query.clone()).await.unwrap();
    let (soil, _) = learned(&recorded, i);
    assert_same(&full, &offline(&recorded, i, &query, 31, soil));
    query.use_history = false;
    assert_same(&client.predict(query.clone()).await.unwrap(), &offline(&recorded, i, &query, 0, soil));

    query.use_history = true;
    query.output = v1::OutputSelection { channels: 0b10_0011, stride: 4, ..Default::default() };
    let part = client.predict(query).await.unwrap();
    assert_eq!((part.steps, part.channels.as_slice(), part.sinkage_m.len()), (2, &[0, 1, 5][..], 0));
    for n in 0..3 {
        for (step, k) in [(0, 3), (1, 7)] {
            let whole = full.state(n, k);
            assert_eq!(part.state(n, step), [whole[0], whole[1], whole[5]]);
        }
    }
    assert_eq!(client.session("s").await.unwrap(), before, "a prediction changes nothing");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_stream_of_requests_equals_single_requests_and_survives_bad_ones() {
    let (server, mut client, recorded) = driven("s", 40).await;
    let good = |tag| v1::PredictRequest { tag, ..candidates("s", &recorded.drive, 40, 2, 4).to_message() };
    let requests = vec![
        good(1),
        v1::PredictRequest { horizon: 33, ..good(2) },
        v1::PredictRequest { session_id: "x".into(), ..good(3) },
        // Each number is allowed, their product is not.
        v1::PredictRequest { samples: 4096, horizon: 32, controls: vec![0; 8 * 4096 * 32].into(), ..good(5) },
        good(4),
    ];
    let single = client.predict_message(good(9)).await.unwrap();
    let replies = client.predict_stream(requests).await.unwrap();
    let mut seen = Vec::new();
    for reply in replies {
        match reply.outcome.unwrap() {
            v1::predict_stream_reply::Outcome::Reply(reply) => {
                assert_eq!((&reply.states, &reply.validity), (&single.states, &single.validity));
                seen.push((reply.tag, 0, String::new()));
            }
            v1::predict_stream_reply::Outcome::Error(error) => seen.push((error.tag, error.code, error.field)),
        }
    }
    let expected: [(u64, i32, &str); 5] = [(1, 0, ""), (2, 3, "horizon"), (3, 5, "session_id"), (5, 3, "samples"), (4, 0, "")];
    assert_eq!(seen, expected.map(|(tag, code, field)| (tag, code, String::from(field))));
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_each_request_of_a_stream_has_a_deadline() {
    let (server, mut client, recorded) = driven("s", 40).await;
    let within = |samples: usize, budget_s: f64| v1::PredictRequest {
        budget_s: Some(budget_s),
        ..candidates("s", &recorded.drive, 40, samples, 32).to_message()
    };
    // 2048 candidates take longer than a millisecond everywhere; an answer that comes later than the service waits for any is none.
    let replies = client.predict_stream(vec![within(2048, 1e-3), within(1, 60.0), within(1, f64::INFINITY)]).await.unwrap();
    let code = |reply: &v1::PredictStreamReply| match &reply.outcome {
        Some(v1::predict_stream_reply::Outcome::Error(error)) => error.code,
        _ => 0,
    };
    let codes: Vec<i32> = replies.iter().map(code).collect();
    assert_eq!(codes, [4, 0, 0], "DEADLINE_EXCEEDED, and two answers");
    server.shutdown().await;
}

/// Found from outside: starts at 20 m/s and 3 m below the ground carried no flag.
#[tokio::test(flavor = "multi_thread")]
async fn service_a_start_far_from_what_was_trained_says_so() {
    let (server, mut client, recorded) = driven("s", 40).await;
    let from = |start: [f64; 12]| Candidates { start: Some(start), ..Candidates::new("s", 1, 8, [2.0, 0.0].repeat(8)) };
    let measured = recorded.drive.states[40].to_array();
    let (mut fast, mut below) = (measured, measured);
    fast[6] += 15.0;
    below[2] -= 3.0;
    let [speed, ground] = [v1::Validity::SpeedUntrained, v1::Validity::StartOffGround].map(|flag| flag as u32);
    for (start, flag, raised) in
        [(measured, speed, false), (measured, ground, false), (fast, speed, true), (fast, ground, false), (below, ground, true)]
    {
        let validity = client.predict(from(start)).await.unwrap().validity[0];
        assert_eq!(validity & flag != 0, raised, "{validity} of {start:?}");
    }
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_without_a_map_says_so() {
    let recorded = recorded();
    let (server, mut client) = start().await;
    open(&mut client, "s", "").await;
    client.feed(samples("s", &recorded.drive, 20)).await.unwrap();
    let prediction = client.predict(candidates("s", &recorded.drive, 20, 2, 5)).await.unwrap();
    assert!(prediction.validity.iter().all(|v| v & v1::Validity::NoMap as u32 != 0));
    assert_eq!(prediction.provenance.map_id, "");
    server.shutdown().await;
}
