//! Goal: certificates are renewed and rights withdrawn while the service runs; what cannot be used changes nothing. Method: the files of a running server are
//! replaced.

use std::time::Duration;

use nesam_client::{Client, Tls, v1};
use tonic::Code;

use crate::authority::{Authority, FLEET, dns, secured_with, uri};
use crate::stage::*;

/// Time until a changed file must have been noticed.
const NOTICED: Duration = Duration::from_secs(20);

#[tokio::test(flavor = "multi_thread")]
async fn service_rights_and_certificates_change_without_a_restart() {
    let stage = secured_with(|config| config.tls.reload_s = 0.1).await;
    let address = format!("https://{}", stage.server.grpc_addr);
    let (truck, other) = (stage.client("nesam:vehicle:truck").await, stage.client("nesam:vehicle:other").await);
    open(&mut truck.clone(), "truck", "").await;
    let request = v1::OpenSessionRequest { vehicle_id: "other".into(), ..Default::default() };
    other.clone().open_session(request).await.unwrap();
    // Watches that only listen: each has told what holds now.
    let mut watches = Vec::new();
    for (client, session) in [(&truck, "truck"), (&other, "other")] {
        let mut soil = client.clone().watch_soil(session).await.unwrap();
        soil.message().await.unwrap().expect("the present soil");
        watches.push((soil, client.clone().watch_alarms(session).await.unwrap()));
    }

    // Taken out of the fleet file, in which a planner still names it: the next request on an open connection is refused; nobody else notices.
    let revoked = FLEET.replace("[vehicles.other]\n", "").replace("vehicles = [\"truck\"]", "vehicles = [\"truck\", \"other\"]");
    stage.replace("fleet.toml", revoked.as_bytes());
    eventually(NOTICED, "revoked", || async {
        other.clone().list_sessions().await.is_err_and(|error| error.code() == Some(Code::PermissionDenied))
    })
    .await;
    truck.clone().list_sessions().await.unwrap();
    let (mut soil, mut alarms) = watches.remove(1);
    assert_eq!(soil.message().await.unwrap_err().code(), Code::PermissionDenied);
    assert_eq!(alarms.message().await.unwrap_err().code(), Code::PermissionDenied);
    let (mut soil, _) = watches.remove(0);
    assert!(tokio::time::timeout(Duration::from_millis(300), soil.message()).await.is_err(), "the truck goes on watching");

    // Files that cannot be used are counted and change nothing, for new connections either.
    stage.replace("server.key", b"half a ke");
    eventually(NOTICED, "counted", || async {
        stage.server.metrics().render(0, 0).contains("nesam_credentials_reloads_total{part=\"certificate\",result=\"failed\"} 1")
    })
    .await;
    stage.client("nesam:vehicle:truck").await.list_sessions().await.unwrap();

    // They keep no right in force either, and a fleet file that cannot be used changes none.
    let without_mission = revoked.replace("[planners.mission]", "[planners.relay]");
    let mission = stage.client("nesam:planner:mission").await;
    mission.clone().list_sessions().await.unwrap();
    stage.replace("fleet.toml", without_mission.as_bytes());
    eventually(NOTICED, "revoked beside half a key", || async {
        mission.clone().list_sessions().await.is_err_and(|error| error.code() == Some(Code::PermissionDenied))
    })
    .await;
    let unusable = |part: &str| format!("nesam_credentials_unusable{{part=\"{part}\"}} 1");
    assert!(stage.server.metrics().render(0, 0).contains(&unusable("certificate")));
    stage.replace("fleet.toml", b"[vehicle.x]\n");
    eventually(NOTICED, "an unusable fleet file", || async { stage.server.metrics().render(0, 0).contains(&unusable("rights")) }).await;
    truck.clone().list_sessions().await.unwrap();

    // Nor does a certificate that has expired, which nobody would accept.
    let expires =
        || stage.server.metrics().render(0, 0).lines().find(|line| line.starts_with("nesam_certificate_expires")).map(str::to_string);
    let expires_before = expires();
    let (certificate, key) = stage.authority.sign(&[dns("localhost"), uri("nesam:server:alpha")], true);
    stage.replace("server.pem", &certificate);
    stage.replace("server.key", &key);
    eventually(NOTICED, "expired", || async {
        stage.server.metrics().render(0, 0).contains("nesam_credentials_reloads_total{part=\"certificate\",result=\"failed\"} 2")
    })
    .await;
    stage.client("nesam:vehicle:truck").await.list_sessions().await.unwrap();
    assert!(expires_before.is_some() && expires() == expires_before, "{expires_before:?}, {:?}", expires());

    // A certificate and an authority that have nothing to do with those before; the fleet file is still unusable.
    let successor = Authority::new();
    let (certificate, key) = successor.sign(&[dns("localhost"), uri("nesam:server:alpha")], false);
    stage.replace("server.pem", &certificate);
    stage.replace("server.key", &key);
    stage.replace("ca.pem", successor.pem.as_bytes());
    let connect = |tls: Tls| {
        let address = address.clone();
        async move { Client::connect_tls(&address, &tls).await?.list_sessions().await }
    };
    eventually(NOTICED, "renewed", || async { connect(successor.tls("nesam:vehicle:truck")).await.is_ok() }).await;
    assert!(connect(stage.authority.tls("nesam:vehicle:truck")).await.is_err(), "certificates of the authority before are strangers now");
    truck.clone().list_sessions().await.expect("open connections go on");
    let text = stage.server.metrics().render(0, 0);
    assert!(!text.contains(&unusable("certificate")) && text.contains(&unusable("rights")), "{text}");
    drop((truck, other));
    stage.server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn regress_a_server_with_tls_gives_its_port_back() {
    let stage = secured_with(|_| {}).await;
    let address = stage.server.grpc_addr;
    stage.server.shutdown().await;
    start_with(|config| config.grpc.listen = address).await.0.shutdown().await;
}
