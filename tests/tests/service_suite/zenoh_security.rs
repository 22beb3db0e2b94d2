//! Goal: on Zenoh nobody is heard in another one's name, and nobody hears what is not for him. Method: once a router with the configuration of
//! `nesam router-config` in front of the server, once the server as its own router; members and strangers of a fleet come with real certificates.

use std::time::Duration;

use nesam_client::zenoh_vehicle::ZenohVehicle;
use nesam_client::{Client, Tls, outcome_label, v1};
use nesam_server::access::FleetFile;
use nesam_server::{LinkFiles, ZenohMode, router_config};

use crate::authority::{Authority, FLEET, Stage, dns, secured_with, uri, written};
use crate::stage::*;
use crate::zenoh_network::{PATIENCE, behind};
use crate::zenoh_presence::until_alive;

/// Time in which something that is allowed would long have happened.
const SILENCE: Duration = Duration::from_millis(1500);

fn free_endpoint() -> String {
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
    let config = router_config(&members, "test", &listen, LinkFiles { certificate: &certificate, key: &key, authority: &ca });
    let router = zenoh::open(zenoh::Config::from_json5(&config.to_string()).unwrap()).await.unwrap();

    let (server_certificate, server_key) = authority.sign(&[dns("localhost"), uri("nesam:server:alpha")], false);
    let (server_certificate, server_key) = (write("alpha.pem", &server_certificate), write("alpha.key", &server_key));
    let mut stage = secured_with(|config| {
        (config.tls.certificate, config.tls.key, config.tls.client_ca) = (server_certificate, server_key, ca.clone());
        behind(config, &endpoint);
        config.zenoh.name = "alpha".into();
    })
    .await;
    stage.authority = authority;
    let operator = stage.client("nesam:operator:control").await;
    guarded(&stage, &endpoint, operator).await;
    stage.server.shutdown().await;
    router.close().await.unwrap();
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
