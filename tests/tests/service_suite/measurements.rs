//! Goal: every measurement gets its typed answer, and a session depends on nothing but what it accepted.

use nesam_client::{outcome_label, v1};

use crate::stage::*;

fn labels(answers: &[v1::MeasurementAnswer]) -> Vec<&'static str> {
    answers.iter().map(outcome_label).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn service_whole_recorded_drives_are_applied() {
    // Every command and state of the committed drives lies within the card and the limits.
    let (server, mut client) = start().await;
    let root = nesam_trajectories::DataRoot::open(&nesam_tests::sample_root(), None).unwrap();
    for set in root.sets() {
        for drive in root.load_set(&nesam_trajectories::SetQuery::all(set.clone())).unwrap() {
            open(&mut client, &drive.id, "").await;
            let answers = client.feed(samples(&drive.id, &drive, drive.states.len() - 1)).await.unwrap();
            let other = answers.iter().find(|a| outcome_label(a) != "APPLIED");
            assert!(answers.len() == drive.states.len() && other.is_none(), "{set} {}: {other:?}", drive.id);
        }
    }
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_resending_after_a_lost_connection_changes_nothing() {
    let (server, mut client, recorded) = start_on_map().await;
    for session in ["once", "twice"] {
        open(&mut client, session, recorded.world.id()).await;
    }
    client.feed(samples("once", &recorded.drive, 50)).await.unwrap();
    // The vehicle loses its connection half way and sends everything again over a new one.
    let stream = client.measure().await.unwrap();
    for i in 0..30 {
        stream.send(sample("twice", &recorded.drive, i)).await.unwrap();
    }
    drop(stream);
    let mut again = nesam_client::Client::connect(&format!("http://{}", server.grpc_addr)).await.unwrap();
    let answers = again.feed(samples("twice", &recorded.drive, 50)).await.unwrap();
    // What the lost connection delivered is a duplicate now, everything else is applied, in this order.
    let applied_from = labels(&answers).iter().position(|l| *l == "APPLIED").unwrap();
    assert!(
        labels(&answers)[..applied_from].iter().all(|l| *l == "DUPLICATE")
            && labels(&answers)[applied_from..].iter().all(|l| *l == "APPLIED")
    );
    let once = client.predict(candidates("once", &recorded.drive, 50, 2, 16)).await.unwrap();
    let twice = client.predict(candidates("twice", &recorded.drive, 50, 2, 16)).await.unwrap();
    assert!(bits(&once.states) == bits(&twice.states));
    assert_eq!(once.provenance, twice.provenance);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_sessions_do_not_touch_each_other() {
    let (server, mut client, recorded) = start_on_map().await;
    for session in ["alone", "a", "b"] {
        open(&mut client, session, recorded.world.id()).await;
    }
    client.feed(samples("alone", &recorded.drive, 45)).await.unwrap();
    // Two vehicles through one gateway stream, interleaved; the other one is at another place of the drive.
    let mixed = (0..=45).flat_map(|i| {
        let mut other = sample("b", &recorded.drive, i + 100);
        other.stamp_ns -= 100 * STEP_NS;
        [sample("a", &recorded.drive, i), other]
    });
    let answers = client.feed(mixed.collect()).await.unwrap();
    assert!(labels(&answers).iter().all(|l| *l == "APPLIED"));
    let alone = client.predict(candidates("alone", &recorded.drive, 45, 2, 8)).await.unwrap();
    let gateway = client.predict(candidates("a", &recorded.drive, 45, 2, 8)).await.unwrap();
    assert!(bits(&alone.states) == bits(&gateway.states));
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_dense_measurements_are_thinned_and_gaps_restart() {
    let recorded = recorded();
    let (server, mut client) = start().await;
    open(&mut client, "s", "").await;
    // 50 Hz: one in five is a step.
    let dense = (0..=20).map(|i| {
        let mut m = sample("s", &recorded.drive, i / 5);
        (m.stamp_ns, m.sequence) = (i as i64 * STEP_NS / 5, 0);
        m
    });
    let answers = client.feed(dense.collect()).await.unwrap();
    for (i, label) in labels(&answers).into_iter().enumerate() {
        assert_eq!(label, if i % 5 == 0 { "APPLIED" } else { "BUFFERED" }, "sample {i}");
    }
    let mut stream = client.measure().await.unwrap();
    // What is missing heals the gap as long as it arrives inside the window.
    for (i, expected, steps) in
        [(6, "GAP", 1), (6, "DUPLICATE", 1), (5, "APPLIED", 7), (9, "GAP", 1), (7, "TOO_OLD", 1), (10, "APPLIED", 2)]
    {
        let answer = stream.exchange(v1::Measurement { sequence: 0, ..sample("s", &recorded.drive, i) }).await.unwrap();
        assert_eq!(outcome_label(&answer), expected, "sample {i}");
        assert_eq!(client.session("s").await.unwrap().history_steps, steps);
    }
    server.shutdown().await;
}
