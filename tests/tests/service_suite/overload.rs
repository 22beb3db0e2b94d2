//! Goal: too much is refused at once and typed, measurements still get through, and the server lives on.

use std::time::{Duration, Instant};

use nesam_client::{outcome_label, v1};
use tonic::Code;

use crate::stage::*;

#[tokio::test(flavor = "multi_thread")]
async fn service_overload_is_resource_exhausted_and_measurements_get_through() {
    let recorded = recorded();
    let (server, mut client) = start_with(|config| config.limits.waiting_predictions_max = 2).await;
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    open(&mut client, "s", recorded.world.id()).await;
    client.feed(samples("s", &recorded.drive, 40)).await.unwrap();
    let heavy = candidates("s", &recorded.drive, 40, 512, 32);
    let asked: Vec<_> = (0..40)
        .map(|_| {
            let (mut client, heavy) = (client.clone(), heavy.clone());
            tokio::spawn(async move { client.predict(heavy).await })
        })
        .collect();
    // While the planners hammer, the vehicle reports.
    let answers = client.feed((41..60).map(|i| sample("s", &recorded.drive, i)).collect()).await.unwrap();
    assert!(answers.iter().all(|a| outcome_label(a) == "APPLIED"));
    let (mut answered, mut refused) = (0, 0);
    for task in asked {
        match task.await.unwrap() {
            Ok(_) => answered += 1,
            Err(error) => {
                assert_eq!(error.code(), Some(Code::ResourceExhausted), "{error}");
                refused += 1;
            }
        }
    }
    assert!(answered >= 1 && refused >= 1 && answered + refused == 40, "{answered} answered, {refused} refused");
    let after = client.predict(candidates("s", &recorded.drive, 59, 2, 4)).await.unwrap();
    assert_eq!(after.provenance.history_epoch, 60);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_deadlines_are_honoured_and_abandoned_requests_are_skipped() {
    let recorded = recorded();
    let (server, mut client) = start().await;
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    open(&mut client, "s", recorded.world.id()).await;
    client.feed(samples("s", &recorded.drive, 40)).await.unwrap();
    let heavy = candidates("s", &recorded.drive, 40, 2048, 32);
    let busy = {
        let (mut client, heavy) = (client.clone(), heavy.clone());
        tokio::spawn(async move { client.predict(heavy).await })
    };
    tokio::time::sleep(Duration::from_millis(30)).await;
    // Behind a prediction that takes longer than the deadline. Whoever notices first answers: the server with DEADLINE_EXCEEDED or the
    // client's own timer, which tonic reports as CANCELLED.
    let started = Instant::now();
    let late: Vec<_> = (0..8)
        .map(|_| {
            let (mut client, heavy) = (client.clone(), heavy.clone());
            tokio::spawn(async move { client.predict_within(heavy, Some(Duration::from_millis(40))).await })
        })
        .collect();
    for task in late {
        let code = task.await.unwrap().expect_err("the engine is busy").code();
        assert!(matches!(code, Some(Code::DeadlineExceeded | Code::Cancelled)), "{code:?}");
    }
    assert!(started.elapsed() < Duration::from_secs(2));
    busy.await.unwrap().unwrap();
    // None of the late ones was computed.
    client.predict(candidates("s", &recorded.drive, 40, 1, 1)).await.unwrap();
    assert_eq!(server.metrics().predictions(), 2);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_limits_hold_at_the_edge() {
    let recorded = recorded();
    let (server, mut client) = start_with(|config| {
        config.limits.sessions_max = 3;
        config.limits.maps_max = 2;
        config.limits.map_cells_total_max = 700;
        config.limits.sample_steps_max = 64;
    })
    .await;
    for session in ["a", "b", "c"] {
        open(&mut client, session, "").await;
    }
    let fourth = v1::OpenSessionRequest { vehicle_id: "d".into(), ..Default::default() };
    assert_refused("fourth session", client.open_session(fourth.clone()).await, Code::ResourceExhausted, "session_id");
    client.close_session("b").await.unwrap();
    client.open_session(fourth).await.unwrap();

    let mut map = layers(&recorded.world);
    (map.width, map.height, map.semantic_rgb) = (20, 20, None);
    map.elevation_m = vec![1.0; 400];
    client.upload_map(&map).await.unwrap();
    map.id = "second".into();
    assert_refused("cells of all maps", client.upload_map(&map).await, Code::ResourceExhausted, "map_id");
    (map.height, map.elevation_m) = (10, vec![1.0; 200]);
    client.upload_map(&map).await.unwrap();
    (map.id, map.height, map.elevation_m) = ("third".into(), 2, vec![1.0; 40]);
    assert_refused("third map", client.upload_map(&map).await, Code::ResourceExhausted, "map_id");

    client.feed(samples("a", &recorded.drive, 3)).await.unwrap();
    client.predict(candidates("a", &recorded.drive, 3, 2, 32)).await.unwrap();
    client.predict(candidates("a", &recorded.drive, 3, 64, 1)).await.unwrap();
    assert_refused("N K", client.predict(candidates("a", &recorded.drive, 3, 65, 1)).await, Code::InvalidArgument, "samples");
    server.shutdown().await;
}
