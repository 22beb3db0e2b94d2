//! Goal: on Zenoh nobody is heard in another one's name, and nobody hears what is not for him. Method: once a router with the configuration of
//! `nesam router-config` in front of the server, once the server as its own router; members and strangers of a fleet come with real certificates.

use std::path::Path;
use std::time::Duration;

use nesam_client::zenoh_vehicle::ZenohVehicle;
use nesam_client::{Client, Tls, outcome_label, v1};
use nesam_server::access::FleetFile;
use nesam_server::{Config, LinkFiles, RunningServer, ZenohMode, router_config};
use prost::Message as _;

use crate::authority::{Authority, FLEET, Stage, dns, secured_with, uri, written};
use crate::stage::*;
use crate::zenoh_network::{PATIENCE, behind};
use crate::zenoh_presence::until_alive;

type Subscriber = zenoh::pubsub::Subscriber<zenoh::handlers::FifoChannelHandler<zenoh::sample::Sample>>;

/// Time in which something that is allowed would long have happened.
pub const SILENCE: Duration = Duration::from_millis(1500);

pub fn free_endpoint() -> String {
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    format!("tls/localhost:{port}")
}

/// What members may do, and what neither they nor strangers may.
async fn guarded(stage: &Stage, endpoint: &str, mut operator: Client) {
    let recorded = recorded();
    let authority = &stage.authority;
    operator.upload_map(&layers(&recorded.world)).await.unwrap();
    for vehicle in ["truck", "other"] {
        let map_id = recorded.world.id().to_string();
        operator.open_session(v1::OpenSessionRequest { vehicle_id: vehicle.into(), map_id, ..Default::default() }).await.unwrap();
    }

    // The vehicle that it says it is: heard, answered, seen, predicted.
    let truck = ZenohVehicle::connect_tls(endpoint, "test", "truck", &authority.tls("nesam:vehicle:truck")).await.unwrap();
    truck.wait_for_service(PATIENCE).await.unwrap();
    for measurement in samples("", &recorded.drive, 20) {
        truck.publish(&measurement).await.unwrap();
        let answer = truck.answer(PATIENCE).await.unwrap().expect("an answer");
        assert_eq!(outcome_label(&answer), "APPLIED");
    }
    let query = candidates("truck", &recorded.drive, 20, 2, 8);
    let predicted = truck.predict(&query).await.unwrap();
    assert_eq!(bits(&predicted.states), bits(&operator.predict(query.clone()).await.unwrap().states));

    // A planner asks for its vehicle; asking for another one, it hears nothing, as nobody is asked.
    let planner = authority.tls("nesam:planner:mission");
    let of_truck = ZenohVehicle::connect_tls(endpoint, "test", "truck", &planner).await.unwrap();
    assert_eq!(bits(&of_truck.predict(&query).await.unwrap().states), bits(&predicted.states));
    let of_other = ZenohVehicle::connect_tls(endpoint, "test", "other", &planner).await.unwrap();
    let unheard = tokio::time::timeout(SILENCE, of_other.predict(&candidates("other", &recorded.drive, 20, 2, 8))).await;
    assert!(!matches!(unheard, Ok(Ok(_))));

    // Neither a planner nor another vehicle is heard in the vehicle's name.
    let before = operator.session("truck").await.unwrap();
    let spoofing = ZenohVehicle::connect_tls(endpoint, "test", "truck", &authority.tls("nesam:vehicle:other")).await.unwrap();
    for thief in [&spoofing, &of_truck] {
        thief.publish(&sample("", &recorded.drive, 21)).await.unwrap();
    }
    // Nor does another vehicle hear what the truck is answered.
    assert!(spoofing.answer(SILENCE).await.unwrap().is_none());
    assert!(!matches!(tokio::time::timeout(SILENCE, spoofing.predict(&query)).await, Ok(Ok(_))));
    assert_eq!(operator.session("truck").await.unwrap(), before, "no trace");
    truck.publish(&sample("", &recorded.drive, 21)).await.unwrap();
    assert_eq!(outcome_label(&truck.answer(PATIENCE).await.unwrap().unwrap()), "APPLIED", "the truck itself is heard");
    assert!(spoofing.answer(SILENCE).await.unwrap().is_none(), "what the truck is told is not for others");

    // Who is not in the fleet file, whom another authority has signed, who shows nothing.
    let stranger = Authority::new();
    let trusting = |name: &str, signed_by: &Authority| Tls { authority: authority.pem.clone().into_bytes(), ..signed_by.tls(name) };
    let nothing = Tls { identity: None, ..trusting("nesam:vehicle:truck", authority) };
    for (what, tls) in [
        ("sold", authority.tls("nesam:vehicle:sold")),
        ("foreign", trusting("nesam:vehicle:truck", &stranger)),
        ("without a certificate", nothing),
    ] {
        let connected = tokio::time::timeout(SILENCE, ZenohVehicle::connect_tls(endpoint, "test", "truck", &tls)).await;
        let Ok(Ok(vehicle)) = connected else { continue };
        assert!(what == "sold", "{what}: is let in");
        vehicle.publish(&sample("", &recorded.drive, 22)).await.unwrap();
        assert!(vehicle.answer(SILENCE).await.unwrap().is_none(), "{what}");
    }
    assert_eq!(operator.session("truck").await.unwrap().history_steps, before.history_steps + 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_router_with_the_written_configuration_guards_the_fleet() {
    let endpoint = free_endpoint();
    // The router has a certificate of the same authority, which is made with the server's.
    let (authority, files) = (Authority::new(), tempfile::tempdir().unwrap());
    let write = |name: &str, bytes: &[u8]| written(files.path(), name, bytes);
    let (certificate, key) = authority.sign(&[dns("localhost")], false);
    let (certificate, key) = (write("router.pem", &certificate), write("router.key", &key));
    let ca = write("ca.pem", authority.pem.as_bytes());
    let members = FleetFile::parse(FLEET).unwrap();
    let listen = [endpoint.clone()];
    let config =
        router_config(&members, "test", &Config::default(), &listen, LinkFiles { certificate: &certificate, key: &key, authority: &ca });
    let router = zenoh::open(zenoh::Config::from_json5(&config.to_string()).unwrap()).await.unwrap();

    let server = async |authority: &Authority, name: &str| {
        let (certificate, key) = authority.sign(&[dns("localhost"), uri(&format!("nesam:server:{name}"))], false);
        let (certificate, key) = (write(&format!("{name}.pem"), &certificate), write(&format!("{name}.key"), &key));
        secured_with(|config| {
            (config.tls.certificate, config.tls.key, config.tls.client_ca) = (certificate, key, ca.clone());
            behind(config, &endpoint);
            config.zenoh.name = name.into();
            (config.fleet_soil.enabled, config.fleet_soil.exchange_s) = (true, 1.0);
        })
        .await
    };
    let mut stage = server(&authority, "alpha").await;
    stage.authority = authority;
    let mut operator = stage.client("nesam:operator:control").await;
    guarded(&stage, &endpoint, operator.clone()).await;

    let beta = server(&stage.authority, "beta").await.server;
    // Servers tell each other what they learn of the soil, and nobody else is heard on that key.
    let soil = async |server: &RunningServer| {
        let tls = stage.authority.tls("nesam:operator:control");
        let mut client = Client::connect_tls(&format!("https://{}", server.grpc_addr), &tls).await.unwrap();
        client.fleet_soil("").await.unwrap().cells.iter().map(|cell| cell.buffers).sum::<f64>()
    };
    operator.feed((22..=70).map(|i| sample("truck", &recorded().drive, i)).collect()).await.unwrap();
    let known = soil(&stage.server).await;
    assert!(known > 3.0, "{known} buffers");
    let told = async |server: &RunningServer| (soil(server).await - known).abs() < 0.01;
    eventually(PATIENCE, "what alpha published", async || told(&beta).await).await;
    let forged = v1::FleetSoilShares {
        bundle_hash: predictor().bundle().hash.clone(),
        cell_m: 10.0,
        shares: vec![v1::FleetSoilShare { service: "stranger".into(), cells: vec![some_evidence()] }],
    };
    let (certificate, key) = stage.authority.sign(&[uri("nesam:vehicle:truck")], false);
    let (certificate, key) = (write("truck.pem", &certificate), write("truck.key", &key));
    let of_truck = zenoh::open(zenoh::Config::from_json5(&joining(&endpoint, &certificate, &key, &ca)).unwrap()).await.unwrap();
    of_truck.put("nesam/v1/test/server/beta/soil_map", forged.encode_to_vec()).await.unwrap();
    tokio::time::sleep(SILENCE).await;
    assert!(told(&stage.server).await && told(&beta).await, "a vehicle is no server");
    // What a vehicle hears of a server names nobody; what names sessions and vehicles is for operators.
    let about = of_truck.declare_subscriber("nesam/v1/test/server/alpha/about").await.unwrap();
    let status = of_truck.declare_subscriber("nesam/v1/test/server/*/status").await.unwrap();
    let (certificate, key) = stage.authority.sign(&[uri("nesam:operator:control")], false);
    let (certificate, key) = (write("operator.pem", &certificate), write("operator.key", &key));
    let of_operator = zenoh::open(zenoh::Config::from_json5(&joining(&endpoint, &certificate, &key, &ca)).unwrap()).await.unwrap();
    let whole = of_operator.declare_subscriber("nesam/v1/test/server/alpha/status").await.unwrap();
    let heard = async |subscriber: &Subscriber| {
        let sample = tokio::time::timeout(PATIENCE, subscriber.recv_async()).await.expect("in time").unwrap();
        v1::ServerStatus::decode(sample.payload().to_bytes().as_ref()).unwrap()
    };
    // Each round is one of the server's, which tells both.
    for _ in 0..2 {
        let (told, whole) = (heard(&about).await, heard(&whole).await);
        assert_eq!((told.name.as_str(), told.sessions.len(), told.vehicles_alive.len()), ("alpha", 0, 0));
        assert!(whole.sessions.iter().any(|session| session.vehicle_id == "other"), "{whole:?}");
    }
    assert!(status.try_recv().unwrap().is_none(), "a vehicle hears of other vehicles");
    // A server that comes late asks.
    beta.shutdown().await;
    let beta = server(&stage.authority, "beta").await.server;
    eventually(PATIENCE, "what beta asked for", async || told(&beta).await).await;
    // The same message from a server is taken: it was the key that was not the vehicle's.
    let (certificate, key) = stage.authority.sign(&[uri("nesam:server:beta")], false);
    let (certificate, key) = (write("second.pem", &certificate), write("second.key", &key));
    let of_server = zenoh::open(zenoh::Config::from_json5(&joining(&endpoint, &certificate, &key, &ca)).unwrap()).await.unwrap();
    of_server.put("nesam/v1/test/server/beta/soil_map", forged.encode_to_vec()).await.unwrap();
    eventually(PATIENCE, "a server's message", async || soil(&stage.server).await > known + 0.9).await;
    beta.shutdown().await;
    stage.server.shutdown().await;
    router.close().await.unwrap();
}

/// One buffer of evidence on a cell.
fn some_evidence() -> v1::SharedSoilCell {
    let information = (0..36).map(|i| if i % 7 == 0 { 1.0 } else { 0.0 }).collect();
    let vector = Some(v1::SoilVector { n: 1.0, ..Default::default() });
    let cell = v1::FleetSoilCell { map_id: "m".into(), information, vector, buffers: 1.0, ..Default::default() };
    v1::SharedSoilCell { cell: Some(cell), votes: 0.0, revision: 1 }
}

/// Configuration of a Zenoh client with a certificate.
pub fn joining(endpoint: &str, certificate: &Path, key: &Path, authority: &Path) -> String {
    serde_json::json!({
        "mode": "client",
        "connect": { "endpoints": [endpoint] },
        "scouting": { "multicast": { "enabled": false } },
        "transport": { "shared_memory": { "enabled": false }, "link": { "tls": {
            "root_ca_certificate": authority, "enable_mtls": true, "connect_certificate": certificate, "connect_private_key": key,
        } } },
    })
    .to_string()
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_server_that_listens_with_tls_guards_its_fleet_itself() {
    let endpoint = free_endpoint();
    let stage = secured_with(|config| {
        config.zenoh.enabled = true;
        config.zenoh.mode = ZenohMode::Router;
        config.zenoh.listen = vec![endpoint.clone()];
        (config.zenoh.fleet, config.zenoh.name) = ("test".into(), "alpha".into());
    })
    .await;
    let operator = stage.client("nesam:operator:control").await;
    guarded(&stage, &endpoint, operator).await;
    stage.server.shutdown().await;
}

/// A vehicle that connects like this and reports until it is answered; says how.
async fn reports(endpoint: &str, tls: &Tls, measurement: &v1::Measurement) -> Option<String> {
    let vehicle = tokio::time::timeout(SILENCE, ZenohVehicle::connect_tls(endpoint, "test", "truck", tls)).await.ok()?.ok()?;
    vehicle.publish(measurement).await.ok()?;
    let answer = vehicle.answer(SILENCE).await.ok()??;
    Some(outcome_label(&answer).into())
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_server_that_listens_with_tls_takes_new_certificates_and_rights() {
    let (endpoint, recorded) = (free_endpoint(), recorded());
    let stage = secured_with(|config| {
        config.tls.reload_s = 0.1;
        config.zenoh.enabled = true;
        config.zenoh.mode = ZenohMode::Router;
        config.zenoh.listen = vec![endpoint.clone()];
        (config.zenoh.fleet, config.zenoh.name) = ("test".into(), "alpha".into());
    })
    .await;
    let mut operator = stage.client("nesam:operator:control").await;
    operator.open_session(v1::OpenSessionRequest { vehicle_id: "truck".into(), ..Default::default() }).await.unwrap();
    let old = stage.authority.tls("nesam:vehicle:truck");
    assert_eq!(reports(&endpoint, &old, &sample("", &recorded.drive, 0)).await.as_deref(), Some("APPLIED"));
    let heard = async |tls: &Tls, expected: bool, i: usize| {
        let what = format!("sample {i}: heard is not {expected}");
        let as_expected = async || reports(&endpoint, tls, &sample("", &recorded.drive, i)).await.is_some() == expected;
        eventually(2 * PATIENCE, &what, as_expected).await;
    };

    // Taken out of the fleet file, and in again.
    stage.replace(
        "fleet.toml",
        FLEET.replace("[vehicles.truck]\nmaps = [\"local\"]\n", "").replace("vehicles = [\"truck\"]", "vehicles = []").as_bytes(),
    );
    heard(&old, false, 1).await;
    stage.replace("fleet.toml", FLEET.as_bytes());
    heard(&old, true, 2).await;

    // An authority that has nothing to do with the one before. A vehicle that was there cannot come back, and is not taken to be there.
    let held = ZenohVehicle::connect_tls(&endpoint, "test", "truck", &old).await.unwrap();
    until_alive(&operator, true).await;
    let successor = Authority::new();
    let (certificate, key) = successor.sign(&[dns("localhost"), uri("nesam:server:alpha")], false);
    stage.replace("server.pem", &certificate);
    stage.replace("server.key", &key);
    stage.replace("ca.pem", successor.pem.as_bytes());
    heard(&successor.tls("nesam:vehicle:truck"), true, 3).await;
    let stranger = Tls { authority: successor.pem.clone().into_bytes(), ..old };
    assert!(reports(&endpoint, &stranger, &sample("", &recorded.drive, 4)).await.is_none(), "signed by the authority before");
    until_alive(&operator, false).await;
    drop((operator, held));
    stage.server.shutdown().await;
}
