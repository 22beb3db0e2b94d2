//! Goal: a second vehicle begins from what the first has learned of the ground, nothing is counted twice, and nobody shares who was not asked to.

use std::time::Duration;

use nesam_adaptation::FilterConfig;
use nesam_client::v1;
use nesam_engine::{Command, Engine, FleetSoilSettings, Limits, OpenSession, Reply};
use prost::Message as _;
use tonic::Code;

use crate::stage::*;
use crate::zenoh_network::{PATIENCE, behind, router};

#[tokio::test(flavor = "multi_thread")]
async fn service_a_second_vehicle_begins_from_what_the_first_has_learned() {
    let recorded = recorded();
    let (router, endpoint) = router().await;
    let (server, mut client) = start_with(|config| {
        config.fleet_soil.enabled = true;
        behind(config, &endpoint);
    })
    .await;
    let published = router.declare_subscriber("nesam/v1/test/soil_map").await.unwrap();
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    open(&mut client, "first", recorded.world.id()).await;
    assert!(client.fleet_soil("").await.unwrap().cells.is_empty());
    client.feed(samples("first", &recorded.drive, 70)).await.unwrap();
    let first = client.session("first").await.unwrap();
    let updates = first.provenance.unwrap().soil_epoch;
    let map = client.fleet_soil(recorded.world.id()).await.unwrap();
    let buffers: f64 = map.cells.iter().map(|cell| cell.buffers).sum();
    assert!(updates >= 4 && (buffers - updates as f64).abs() < 0.01, "{buffers} buffers of {updates} updates");
    assert!(map.cells.iter().all(|c| c.map_id == recorded.world.id() && c.information.len() == 36 && c.age_s < 60.0));
    assert!(client.fleet_soil("nowhere").await.unwrap().cells.is_empty());
    for _ in 0..updates {
        let sample = tokio::time::timeout(PATIENCE, published.recv_async()).await.expect("in time").unwrap();
        let changed = v1::FleetSoilMap::decode(sample.payload().to_bytes().as_ref()).unwrap();
        assert_eq!((changed.cells.len(), changed.cell_m), (1, map.cell_m));
    }

    // A copy that drives on brings nothing: its evidence would be that of the original.
    client.fork_session("first", "copy").await.unwrap();
    client.feed((71..=100).map(|i| sample("copy", &recorded.drive, i)).collect()).await.unwrap();
    assert_eq!(client.fleet_soil("").await.unwrap().cells.len(), map.cells.len());

    let opened = open(&mut client, "second", recorded.world.id()).await;
    let prior = opened.soil_correction.unwrap();
    let answer = client.feed(samples("second", &recorded.drive, 0)).await.unwrap().remove(0);
    let begun = answer.soil_correction.unwrap();
    assert_eq!(answer.soil_epoch, 1);
    assert_ne!(begun.delta, prior.delta);
    assert!((0..6).all(|i| begun.covariance[7 * i].is_finite() && begun.covariance[7 * i] > 0.0));
    // It is a second session of the same vehicle here, so it brings nothing either.
    client.feed((1..=30).map(|i| sample("second", &recorded.drive, i)).collect()).await.unwrap();
    let after: f64 = client.fleet_soil("").await.unwrap().cells.iter().map(|cell| cell.buffers).sum();
    assert!(after <= buffers, "{after} buffers");
    let prediction = client.predict(candidates("second", &recorded.drive, 30, 1, 4)).await.unwrap();
    assert_eq!(prediction.validity[0] & v1::Validity::SoilNotLearned as u32, 0);
    server.shutdown().await;
    router.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn service_without_the_map_every_session_begins_alone() {
    let (server, mut client, recorded) = start_on_map().await;
    for session in ["first", "second"] {
        open(&mut client, session, recorded.world.id()).await;
    }
    client.feed(samples("first", &recorded.drive, 40)).await.unwrap();
    let answer = client.feed(samples("second", &recorded.drive, 0)).await.unwrap().remove(0);
    assert_eq!(answer.soil_epoch, 0);
    assert_refused("no map", client.fleet_soil("").await, Code::FailedPrecondition, "map_id");
    tokio::time::timeout(Duration::from_secs(20), server.shutdown()).await.unwrap();
}

#[test]
fn property_a_buffer_that_tells_nothing_brings_nothing() {
    let recorded = recorded();
    let cells = |excitation_min: f64| {
        let filter = FilterConfig { excitation_min, ..filter_config() };
        let engine = Engine::new(predictor(), Limits::default()).unwrap().with_filter(filter).unwrap();
        let mut engine = engine.with_fleet_soil(FleetSoilSettings::default()).unwrap();
        let mut call = |command: Command| engine.execute(0, &command).unwrap();
        call(Command::PutMap { map: recorded.world.clone(), base: None });
        call(Command::Open(OpenSession { vehicle: "truck".into(), map: recorded.world.id().into(), ..Default::default() }));
        for i in 0..=60 {
            call(Command::Measure { session: "truck".into(), vehicle: None, measurement: engine_sample(&recorded.drive, i) });
        }
        let Reply::FleetShares(_, shares) = call(Command::TellFleetSoil) else { panic!("another reply") };
        shares.iter().map(|share| share.cells.len()).sum::<usize>()
    };
    assert!(cells(filter_config().excitation_min) > 0);
    assert_eq!(cells(1e12), 0, "the estimate stayed as it was while P was expected to widen: no difference of the two is evidence");
}
