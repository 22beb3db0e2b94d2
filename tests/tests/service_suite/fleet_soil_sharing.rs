//! Goal: what is brought to one server is known to all of a fleet, once; nothing that a stranger says is taken; it outlives the server that it was brought to.
//! Method: servers of one fleet behind a real Zenoh router, held against one server that everything is brought to.

use std::path::Path;
use std::time::Duration;

use nesam_client::{Client, v1};
use nesam_server::{Config, RunningServer};
use prost::Message as _;

use crate::recording::replayed;
use crate::stage::*;
use crate::zenoh_network::{PATIENCE, behind, router};

/// A server of the fleet that holds the recorded map.
async fn server(endpoint: &str, name: &str, change: impl FnOnce(&mut Config)) -> (RunningServer, Client) {
    let (server, mut client) = server_without_map(endpoint, name, change).await;
    client.upload_map(&layers(&recorded().world)).await.unwrap();
    (server, client)
}

/// A server of the fleet.
async fn server_without_map(endpoint: &str, name: &str, change: impl FnOnce(&mut Config)) -> (RunningServer, Client) {
    start_with(|config| {
        (config.fleet_soil.enabled, config.fleet_soil.exchange_s) = (true, 1.0);
        behind(config, endpoint);
        config.zenoh.name = name.into();
        change(config);
    })
    .await
}

/// A session of a vehicle that has driven to a sample.
async fn drives(client: &mut Client, vehicle: &str, last: usize) {
    let recorded = recorded();
    let request = v1::OpenSessionRequest { vehicle_id: vehicle.into(), map_id: recorded.world.id().into(), ..Default::default() };
    client.open_session(request).await.unwrap();
    client.feed(samples(vehicle, &recorded.drive, last)).await.unwrap();
}

/// The map without what the clock makes of it.
async fn known(client: &Client) -> Vec<v1::FleetSoilCell> {
    let cells = client.clone().fleet_soil("").await.unwrap().cells;
    cells.into_iter().map(|cell| v1::FleetSoilCell { age_s: 0.0, ..cell }).collect()
}

/// Whether two maps say the same, but for the seconds by which the evidence of one is older (it halves in a day).
fn alike(a: &[v1::FleetSoilCell], b: &[v1::FleetSoilCell]) -> bool {
    let near = |x: f64, y: f64| (x - y).abs() <= 1e-3 * (1.0 + x.abs());
    let same = |(a, b): (&v1::FleetSoilCell, &v1::FleetSoilCell)| {
        let places = (&a.map_id, a.colour_rgb, a.column, a.row) == (&b.map_id, b.colour_rgb, b.column, b.row);
        places && near(a.buffers, b.buffers) && a.information.iter().zip(&b.information).all(|(x, y)| near(*x, *y))
    };
    a.len() == b.len() && a.iter().zip(b).all(same)
}

async fn until_alike(client: &Client, expected: &[v1::FleetSoilCell], what: &str) {
    eventually(PATIENCE, what, async || alike(&known(client).await, expected)).await;
}

fn buffers(cells: &[v1::FleetSoilCell]) -> f64 {
    cells.iter().map(|cell| cell.buffers).sum()
}

async fn recorded_server(endpoint: &str, name: &str, folder: &Path) -> (RunningServer, Client) {
    server(endpoint, name, |config| (config.recording.enabled, config.recording.directory) = (true, folder.into())).await
}

#[tokio::test(flavor = "multi_thread")]
async fn service_what_is_brought_to_one_server_is_known_to_all_and_outlives_it() {
    let (recorded, folder) = (recorded(), tempfile::tempdir().unwrap());
    // What one server would know that both vehicles drive on.
    let (single, mut only) = start_with(|config| config.fleet_soil.enabled = true).await;
    only.upload_map(&layers(&recorded.world)).await.unwrap();
    drives(&mut only, "truck", 70).await;
    let of_first = known(&only).await;
    drives(&mut only, "lorry", 60).await;
    let of_both = known(&only).await;
    assert!(buffers(&of_first) > 3.0 && buffers(&of_both) > buffers(&of_first) + 2.0);

    let (router, endpoint) = router().await;
    let (alpha, mut at_alpha) = server(&endpoint, "alpha", |_| {}).await;
    let (beta, mut at_beta) = recorded_server(&endpoint, "beta", folder.path()).await;
    drives(&mut at_alpha, "truck", 70).await;
    until_alike(&at_beta, &of_first, "what was published").await;
    // A vehicle that begins at the other server begins as it would have at the one that everything was brought to.
    drives(&mut at_beta, "lorry", 60).await;
    let (begun, expected) = (at_beta.session("lorry").await.unwrap(), only.session("lorry").await.unwrap());
    let delta = |session: &v1::Session| session.soil_correction.as_ref().unwrap().delta.unwrap();
    let apart = |a: f64, b: f64| (a - b).abs() / (1.0 + b.abs());
    assert!(apart(delta(&begun).n, delta(&expected).n) < 1e-3, "{:?} and {:?}", delta(&begun), delta(&expected));
    until_alike(&at_alpha, &of_both, "what the second vehicle brought").await;
    until_alike(&at_beta, &of_both, "both at beta").await;

    // A server that comes late asks, and hears of one that is gone from the one that is left. One that comes back hears what it knew.
    alpha.shutdown().await;
    let (gamma, at_gamma) = server(&endpoint, "gamma", |_| {}).await;
    until_alike(&at_gamma, &of_both, "a server that comes late").await;
    let (alpha, mut at_alpha) = server(&endpoint, "alpha", |_| {}).await;
    until_alike(&at_alpha, &of_both, "a server that comes back").await;
    // What is brought to it in its new life adds to what was brought in the one before.
    drives(&mut at_alpha, "van", 40).await;
    let more = known(&at_alpha).await;
    assert!(buffers(&more) > buffers(&of_both) + 1.0);
    until_alike(&at_gamma, &more, "what was brought after the return").await;

    for server in [alpha, beta, gamma, single] {
        server.shutdown().await;
    }
    // What was heard is a command like any other: a recording of it comes out bit for bit.
    let report = replayed(&[folder.path().into()]);
    assert!(report.all_equal(), "{:?}", report.first_difference);
    assert!(report.kinds["hear_fleet_soil"].equal >= 5, "{:?}", report.kinds);
    router.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn service_what_a_store_holds_of_the_soil_comes_back_once() {
    let folder = tempfile::tempdir().unwrap();
    let (router, endpoint) = router().await;
    let alone = |config: &mut Config| (config.store.enabled, config.store.directory) = (true, folder.path().into());
    let (beta, at_beta) = server(&endpoint, "beta", |_| {}).await;
    let (alpha, mut at_alpha) = server(&endpoint, "alpha", alone).await;
    drives(&mut at_alpha, "truck", 70).await;
    let brought = known(&at_alpha).await;
    assert!(buffers(&brought) > 3.0);
    until_alike(&at_beta, &brought, "what was published").await;
    alpha.shutdown().await;

    // It is there before anybody could have told it, and what the other server tells of its former life is the same evidence.
    let (alpha, at_alpha) = server_without_map(&endpoint, "alpha", alone).await;
    assert!(alike(&known(&at_alpha).await, &brought));
    tokio::time::sleep(Duration::from_millis(1500)).await;
    assert!(alike(&known(&at_alpha).await, &brought), "heard again, not added");
    assert!(alike(&known(&at_beta).await, &brought), "nor there");
    alpha.shutdown().await;
    beta.shutdown().await;

    // The next life brings more; a server that keeps no map leaves the rows; after all of them everything is there once.
    let (alpha, mut at_alpha) = server_without_map(&endpoint, "alpha", alone).await;
    drives(&mut at_alpha, "lorry", 60).await;
    let more = known(&at_alpha).await;
    assert!(buffers(&more) > buffers(&brought) + 2.0);
    alpha.shutdown().await;
    let (without, _) = start_with(|config| alone(config)).await;
    without.shutdown().await;
    let (alpha, at_alpha) = server_without_map(&endpoint, "alpha", alone).await;
    assert!(alike(&known(&at_alpha).await, &more));
    alpha.shutdown().await;

    // What has faded is neither recalled nor kept.
    let short = |config: &mut Config| {
        alone(config);
        config.fleet_soil.half_life_s = 0.01;
    };
    for change in [&short as &dyn Fn(&mut Config), &alone] {
        tokio::time::sleep(Duration::from_millis(300)).await;
        let (alpha, at_alpha) = server_without_map(&endpoint, "alpha", change).await;
        assert!(known(&at_alpha).await.is_empty());
        alpha.shutdown().await;
    }
    router.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn service_what_a_server_cannot_use_changes_nothing() {
    let (router, endpoint) = router().await;
    let (alpha, mut at_alpha) = server(&endpoint, "alpha", |_| {}).await;
    let told = router.declare_subscriber("nesam/v1/test/server/alpha/soil_map").await.unwrap();
    drives(&mut at_alpha, "truck", 40).await;
    let sample = tokio::time::timeout(PATIENCE, told.recv_async()).await.expect("in time").unwrap();
    let good = v1::FleetSoilShares::decode(sample.payload().to_bytes().as_ref()).unwrap();
    let before = known(&at_alpha).await;
    let forged = |change: fn(&mut v1::FleetSoilShares)| {
        let mut message = good.clone();
        message.shares[0].service = "stranger".into();
        change(&mut message);
        message.encode_to_vec()
    };
    let wrong = [
        b"not a message".to_vec(),
        forged(|message| message.bundle_hash = "another".into()),
        forged(|message| message.cell_m = 5.0),
        forged(|message| message.shares[0].service = "../..".into()),
        forged(|message| message.shares[0].cells[0].cell.as_mut().unwrap().information[3] = f64::NAN),
        forged(|message| message.shares[0].cells[0].cell.as_mut().unwrap().information.truncate(35)),
        forged(|message| message.shares[0].cells[0].cell = None),
        forged(|message| message.shares[0].cells[0].cell.as_mut().unwrap().age_s = f64::INFINITY),
        forged(|message| message.shares[0].cells[0].cell.as_mut().unwrap().colour_rgb = 1 << 24),
        // Its own evidence from another mouth.
        good.encode_to_vec(),
    ];
    for payload in wrong {
        router.put("nesam/v1/test/server/beta/soil_map", payload).await.unwrap();
    }
    // Messages of one publisher arrive in their order: once the last one is there, the others have been looked at.
    router.put("nesam/v1/test/server/beta/soil_map", forged(|_| {})).await.unwrap();
    eventually(PATIENCE, "the one that is right", async || buffers(&known(&at_alpha).await) > buffers(&before) + 0.9).await;
    let after = buffers(&known(&at_alpha).await);
    assert!((after - buffers(&before) - 1.0).abs() < 1e-3, "{after} buffers");

    // A server that is to keep to itself neither tells nor hears.
    let (quiet, mut at_quiet) = server(&endpoint, "quiet", |config| config.fleet_soil.exchange_s = 0.0).await;
    drives(&mut at_quiet, "lorry", 40).await;
    tokio::time::sleep(Duration::from_millis(500)).await;
    let alone = known(&at_quiet).await;
    assert!(buffers(&alone) > 1.0 && buffers(&alone) < after);
    assert!((buffers(&known(&at_alpha).await) - after).abs() < 1e-3);
    alpha.shutdown().await;
    quiet.shutdown().await;
    router.close().await.unwrap();
}
