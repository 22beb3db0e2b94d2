//! Goal: what happens to measurements on their way (reordering, loss, repetition) and to the vehicle's clock and software is told apart, through real sockets.

use nesam_client::{Client, outcome_label, v1};

use crate::stage::*;

/// Sends these over one stream and gives what became of each, with the steps in the history after the last.
async fn outcomes(client: &mut Client, session: &str, measurements: Vec<v1::Measurement>) -> (Vec<&'static str>, u32) {
    let answers = client.feed(measurements).await.unwrap();
    (answers.iter().map(outcome_label).collect(), client.session(session).await.unwrap().history_steps)
}

#[tokio::test(flavor = "multi_thread")]
async fn service_reordered_measurements_give_the_posterior_and_prediction_of_the_ordered_ones() {
    let (server, mut client, recorded) = start_on_map().await;
    for session in ["ordered", "swapped"] {
        open(&mut client, session, recorded.world.id()).await;
    }
    client.feed(samples("ordered", &recorded.drive, 59)).await.unwrap();
    let mut swapped = samples("swapped", &recorded.drive, 59);
    swapped.chunks_exact_mut(2).for_each(|pair| pair.swap(0, 1));
    // Everything is sent twice, as over a link that repeats.
    let answers = client.feed(swapped.iter().flat_map(|m| [m.clone(), m.clone()]).collect()).await.unwrap();
    for (i, answer) in answers.iter().enumerate() {
        let expected = if i % 2 == 1 { "DUPLICATE" } else { "APPLIED" };
        let label = outcome_label(answer);
        // The first of all is no gap although the second precedes it; a later one that leaves one out is a gap until that arrives.
        assert!(label == expected || i % 4 == 0 && label == "GAP" || label == "GATED", "{i}: {label}");
        assert_eq!(answer.reordered, i % 4 == 2, "{i}");
    }
    let [one, other] = [client.session("ordered").await.unwrap(), client.session("swapped").await.unwrap()];
    assert!(one.provenance.as_ref().unwrap().soil_epoch >= 3);
    assert_eq!((&one.soil_correction, one.state, one.history_steps), (&other.soil_correction, other.state, other.history_steps));
    let by_order = client.predict(candidates("ordered", &recorded.drive, 59, 2, 16)).await.unwrap();
    let by_swap = client.predict(candidates("swapped", &recorded.drive, 59, 2, 16)).await.unwrap();
    assert!(bits(&by_order.states) == bits(&by_swap.states));
    assert_eq!(by_order.start, by_swap.start);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_restarts_of_the_vehicle_begin_a_history_and_keep_the_soil() {
    let (server, mut client, recorded) = start_on_map().await;
    open(&mut client, "s", recorded.world.id()).await;
    let boot = |boot_id: u64, i: usize, at: usize| {
        let mut m = sample("s", &recorded.drive, i);
        (m.boot_id, m.sequence, m.stamp_ns) = (boot_id, at as u64 + 1, at as i64 * STEP_NS);
        m
    };
    client.feed((0..50).map(|i| boot(900, i, 7000 + i)).collect()).await.unwrap();
    let before = client.session("s").await.unwrap();
    assert_eq!((before.boot_id, before.last_sequence), (Some(900), Some(7050)));
    // Stamps that begin again are believed the second time.
    let (labels, steps) = outcomes(&mut client, "s", vec![boot(31, 50, 0), boot(31, 51, 1), boot(900, 50, 7050), boot(31, 52, 2)]).await;
    assert_eq!((labels, steps), (vec!["TOO_OLD", "RESTARTED", "TOO_OLD", "APPLIED"], 2));
    let after = client.session("s").await.unwrap();
    // What was open became final with the restart: at most one more buffer.
    let epochs = [&before, &after].map(|s| s.provenance.as_ref().unwrap().soil_epoch);
    assert!(epochs[0] >= 3 && epochs[1] >= epochs[0] && epochs[1] <= epochs[0] + 1, "{epochs:?}");
    assert_ne!(after.soil_correction.unwrap().delta, Some(v1::SoilVector::default()));
    assert_eq!((after.boot_id, after.last_sequence, after.last_stamp_ns), (Some(31), Some(3), Some(2 * STEP_NS)));
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_clock_jumps_gaps_and_late_stamps_are_told_apart() {
    let recorded = recorded();
    let (server, mut client) = start().await;
    open(&mut client, "s", "").await;
    let hour = 36_000;
    let at = |number: usize, step: i64| v1::Measurement {
        sequence: number as u64,
        stamp_ns: step * STEP_NS,
        ..sample("s", &recorded.drive, number)
    };
    let (labels, steps) = outcomes(
        &mut client,
        "s",
        vec![
            at(1, 0),
            at(2, 1),
            at(3, 4), // two lost
            at(4, 5),
            at(5, hour), // one wrong stamp
            at(6, 7),    // one lost with it
            at(7, 8),
            at(8, hour + 9), // the clock was set
            at(9, hour + 10),
            at(10, hour + 11),
            at(9, hour + 10), // repeated
            at(3, 6),         // from long ago
            at(11, 20),       // the clock was set back
            at(12, 21),
            at(13, 22),
            at(14, 21), // and again, onto stamps that are known
            at(15, 22),
            at(16, 23),
        ],
    )
    .await;
    let expected = [
        "APPLIED",
        "APPLIED",
        "GAP",
        "APPLIED",
        "FUTURE",
        "GAP",
        "APPLIED",
        "FUTURE",
        "CLOCK_JUMP",
        "APPLIED",
        "DUPLICATE",
        "TOO_OLD",
        "TOO_OLD",
        "CLOCK_JUMP",
        "APPLIED",
        "TOO_OLD",
        "CLOCK_JUMP",
        "APPLIED",
    ];
    assert_eq!((labels.as_slice(), steps), (expected.as_slice(), 2));
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_every_rate_gives_the_steps_of_the_model() {
    let recorded = recorded();
    let (server, mut client) = start().await;
    for rate_hz in [10_i64, 13, 30, 50, 120, 200] {
        let session = format!("s{rate_hz}");
        open(&mut client, &session, "").await;
        let stamps = (0..5 * rate_hz).map(|k| k * 1_000_000_000 / rate_hz);
        let measurements = stamps.clone().map(|stamp_ns| v1::Measurement {
            sequence: 0,
            stamp_ns,
            ..sample(&session, &recorded.drive, (stamp_ns / STEP_NS) as usize)
        });
        let (labels, steps) = outcomes(&mut client, &session, measurements.collect()).await;
        let applied = labels.iter().filter(|l| **l == "APPLIED").count();
        assert!(
            (49..=50).contains(&applied) && labels.iter().all(|l| ["APPLIED", "BUFFERED"].contains(l)),
            "{rate_hz} Hz: {applied} steps"
        );
        assert_eq!(steps, 32);
    }
    server.shutdown().await;
}
