//! Goal: vehicles and servers know of each other. Method: liveliness tokens and the published status, through a Zenoh router.

use nesam_client::zenoh_vehicle::ZenohVehicle;
use nesam_client::{Client, outcome_label, v1};
use prost::Message as _;
use zenoh::sample::SampleKind;

use crate::stage::*;
use crate::zenoh_network::{PATIENCE, behind, router};

/// Waits until the session listing says this of the vehicle.
pub async fn until_alive(client: &Client, expected: bool) {
    let says = async || client.clone().list_sessions().await.unwrap()[0].vehicle_alive == Some(expected);
    eventually(PATIENCE, &format!("the session never said that the vehicle is {expected}"), says).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_liveliness_and_status_follow_vehicles_and_servers() {
    let recorded = recorded();
    let (router, endpoint) = router().await;
    let tokens = router.liveliness().declare_subscriber("nesam/v1/test/server/*/alive").history(true).await.unwrap();
    let status = router.declare_subscriber("nesam/v1/test/server/alpha/status").await.unwrap();
    let about = router.declare_subscriber("nesam/v1/test/server/alpha/about").await.unwrap();
    // A vehicle that was there before the server is seen too.
    let early = ZenohVehicle::connect(&endpoint, "test", "early").await.unwrap();
    let (server, mut client) = start_with(|config| {
        behind(config, &endpoint);
        (config.zenoh.name, config.zenoh.status_interval_s) = ("alpha".into(), 0.2);
    })
    .await;
    let token = tokio::time::timeout(PATIENCE, tokens.recv_async()).await.expect("in time").unwrap();
    assert_eq!((token.kind(), token.key_expr().as_str()), (SampleKind::Put, "nesam/v1/test/server/alpha/alive"));

    open(&mut client, "truck", "").await;
    until_alive(&client, false).await;
    let vehicle = ZenohVehicle::connect(&endpoint, "test", "truck").await.unwrap();
    until_alive(&client, true).await;
    vehicle.wait_for_service(PATIENCE).await.unwrap();
    for i in 0..3 {
        vehicle.publish(&sample("", &recorded.drive, i)).await.unwrap();
        assert_eq!(outcome_label(&vehicle.answer(PATIENCE).await.unwrap().unwrap()), "APPLIED");
    }
    let published = loop {
        let sample = tokio::time::timeout(PATIENCE, status.recv_async()).await.expect("in time").unwrap();
        let status = v1::ServerStatus::decode(sample.payload().to_bytes().as_ref()).unwrap();
        if status.sessions.first().is_some_and(|s| s.history_epoch == 3 && s.vehicle_alive) {
            break status;
        }
    };
    assert_eq!((published.name.as_str(), published.vehicles_alive.as_slice()), ("alpha", &["early".to_string(), "truck".into()][..]));
    assert_eq!((published.sessions[0].session_id.as_str(), published.sessions[0].last_stamp_ns), ("truck", Some(2 * STEP_NS)));
    assert_eq!(published.bundle_hash, predictor().bundle().hash);
    // What everybody hears is the same without sessions and vehicles, since long before there were any.
    for _ in 0..about.len().max(1) {
        let sample = tokio::time::timeout(PATIENCE, about.recv_async()).await.expect("in time").unwrap();
        let told = v1::ServerStatus::decode(sample.payload().to_bytes().as_ref()).unwrap();
        assert!((0.0..=published.uptime_s + 60.0).contains(&told.uptime_s), "{told:?}");
        let known = v1::ServerStatus { sessions: Vec::new(), vehicles_alive: Vec::new(), uptime_s: told.uptime_s, ..published.clone() };
        assert_eq!(told, known);
    }
    about.undeclare().await.unwrap();

    vehicle.close().await.unwrap();
    until_alive(&client, false).await;
    early.close().await.unwrap();
    server.shutdown().await;
    let token = tokio::time::timeout(PATIENCE, tokens.recv_async()).await.expect("in time").unwrap();
    assert_eq!((token.kind(), token.key_expr().as_str()), (SampleKind::Delete, "nesam/v1/test/server/alpha/alive"));
    router.close().await.unwrap();
}
