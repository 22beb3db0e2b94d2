//! Goal: a vehicle behind a Zenoh router gets the same service as one on gRPC. The router is the `zenoh` crate in router mode.

use std::time::Duration;

use nesam_client::zenoh_vehicle::ZenohVehicle;
use nesam_client::{outcome_label, v1};
use nesam_server::{Config, ZenohMode};
use prost::Message as _;

use crate::stage::*;
use crate::zenoh_security::free_endpoint;

pub const PATIENCE: Duration = Duration::from_secs(20);

/// A router on a free port, and its endpoint.
pub async fn router() -> (zenoh::Session, String) {
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let endpoint = format!("tcp/127.0.0.1:{port}");
    let mut config = zenoh::Config::default();
    config.insert_json5("mode", "\"router\"").unwrap();
    config.insert_json5("scouting/multicast/enabled", "false").unwrap();
    config.insert_json5("listen/endpoints", &format!("[{endpoint:?}]")).unwrap();
    (zenoh::open(config).await.unwrap(), endpoint)
}

/// The configuration of a server of the fleet `test` behind a router.
pub fn behind(config: &mut Config, endpoint: &str) {
    config.zenoh.enabled = true;
    config.zenoh.mode = ZenohMode::Client;
    config.zenoh.listen.clear();
    config.zenoh.connect = vec![endpoint.into()];
    config.zenoh.fleet = "test".into();
}

#[tokio::test(flavor = "multi_thread")]
async fn service_measurements_over_a_zenoh_router_give_the_identical_prediction() {
    let recorded = recorded();
    let (router, endpoint) = router().await;
    let (server, mut client) = start_with(|config| behind(config, &endpoint)).await;
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    open(&mut client, "grpc", recorded.world.id()).await;
    open(&mut client, "truck", recorded.world.id()).await;
    let vehicle = ZenohVehicle::connect(&endpoint, "test", "truck").await.unwrap();
    vehicle.wait_for_service(PATIENCE).await.unwrap();
    let soil = router.declare_subscriber("nesam/v1/test/truck/soil").await.unwrap();

    let last = 50;
    let answered = client.feed(samples("grpc", &recorded.drive, last)).await.unwrap();
    for i in 0..=last {
        // Without a session id: the session named like the vehicle of the key.
        vehicle.publish(&sample("", &recorded.drive, i)).await.unwrap();
        let answer = vehicle.answer(PATIENCE).await.unwrap().expect("an answer on the status key");
        assert_eq!((outcome_label(&answer), answer.sequence, answer.session_id.as_str()), ("APPLIED", i as u64 + 1, "truck"));
        assert_eq!(answer.soil_correction, answered[i].soil_correction, "sample {i}");
    }
    // Each change was published: those of both sessions, as both belong to the vehicle; the order is that of the updates.
    for session in ["grpc", "truck"] {
        let mut epoch = 0;
        for answer in answered.iter().filter(|answer| answer.soil_epoch > 0) {
            if answer.soil_epoch == epoch {
                continue;
            }
            epoch = answer.soil_epoch;
            let published = tokio::time::timeout(PATIENCE, soil.recv_async()).await.expect("in time").unwrap();
            let estimate = v1::SoilEstimate::decode(published.payload().to_bytes().as_ref()).unwrap();
            assert_eq!(
                (estimate.session_id.as_str(), estimate.soil_epoch, estimate.stamp_ns),
                (session, epoch, Some(answer.stamp_ns - OPEN_STEPS as i64 * STEP_NS))
            );
            assert_eq!(estimate.correction, answer.soil_correction);
            let named = (estimate.history_epoch, estimate.map_version, &estimate.bundle_hash);
            assert_eq!(named, (answer.history_epoch, 1, &answer.bundle_hash));
        }
    }
    // What is refused before the engine sees it says where the session stands, too.
    vehicle.publish(&v1::Measurement { state: None, ..sample("", &recorded.drive, last + 1) }).await.unwrap();
    let refused = vehicle.answer(PATIENCE).await.unwrap().expect("an answer on the status key");
    assert_eq!((outcome_label(&refused), refused.history_epoch, refused.map_version), ("REJECTED", last as u64 + 1, 1));
    assert_eq!(refused.bundle_hash, predictor().bundle().hash);
    // The posterior is the same to the last bit, the covariance included.
    let (one, other) = (client.session("grpc").await.unwrap(), client.session("truck").await.unwrap());
    assert!(one.provenance.as_ref().unwrap().soil_epoch >= 2 && one.provenance == other.provenance);
    assert_eq!((one.soil_correction, one.history_steps, one.state), (other.soil_correction, other.history_steps, other.state));
    let by_grpc = client.predict(candidates("grpc", &recorded.drive, last, 3, 32)).await.unwrap();
    let by_zenoh = client.predict(candidates("truck", &recorded.drive, last, 3, 32)).await.unwrap();
    assert!(bits(&by_grpc.states) == bits(&by_zenoh.states));
    assert_same(&by_zenoh, &offline(&recorded, last, &candidates("truck", &recorded.drive, last, 3, 32), 31, learned(&recorded, last).0));
    // The queryable gives the same bytes.
    let queried = vehicle.predict(&candidates("", &recorded.drive, last, 3, 32)).await.unwrap();
    assert!(bits(&queried.states) == bits(&by_zenoh.states));
    assert_eq!(queried.provenance, by_zenoh.provenance);

    refuses_random_bytes(&router, &vehicle, &recorded, &mut client).await;
    refuses_bad_payloads(&vehicle, &recorded, &mut client).await;
    vehicle.close().await.unwrap();
    server.shutdown().await;
    router.close().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn service_large_replies_are_the_same_through_memory_and_through_the_socket() {
    let recorded = recorded();
    let (router, endpoint) = router().await;
    let (server, mut client) = start_with(|config| behind(config, &endpoint)).await;
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    open(&mut client, "truck", recorded.world.id()).await;
    client.feed(samples("truck", &recorded.drive, 50)).await.unwrap();
    let question = candidates("truck", &recorded.drive, 50, 256, 32);
    let by_grpc = client.predict(question.clone()).await.unwrap();
    for socket_only in [true, false] {
        let connected = if socket_only {
            ZenohVehicle::connect_through_socket(&endpoint, "test", "truck").await
        } else {
            ZenohVehicle::connect(&endpoint, "test", "truck").await
        };
        let vehicle = connected.unwrap();
        vehicle.wait_for_service(PATIENCE).await.unwrap();
        for _ in 0..3 {
            let answer = vehicle.predict(&question).await.unwrap();
            assert!(bits(&answer.states) == bits(&by_grpc.states), "socket only: {socket_only}");
        }
        vehicle.close().await.unwrap();
    }
    // All sides are in this process, so what they share is mapped here.
    let mapped = std::fs::read_to_string("/proc/self/maps").unwrap_or_default();
    assert!(cfg!(not(target_os = "linux")) || mapped.contains(".zenoh"), "no segment of Zenoh is mapped");
    server.shutdown().await;
    router.close().await.unwrap();
}

/// Random and truncated payloads on every key that the service listens to are answered as such and change nothing.
async fn refuses_random_bytes(network: &zenoh::Session, vehicle: &ZenohVehicle, recorded: &Recorded, client: &mut nesam_client::Client) {
    let before = client.list_sessions().await.unwrap();
    let measurement = sample("", &recorded.drive, 51).encode_to_vec();
    let truncated = (0..measurement.len()).map(|length| measurement[..length].to_vec());
    for payload in truncated.chain(garbage(11, 40).into_iter().map(Vec::from)) {
        vehicle.publish_bytes(payload.clone()).await.unwrap();
        let answer = vehicle.answer(PATIENCE).await.unwrap().expect("an answer");
        let Some(v1::measurement_answer::Outcome::Rejected(rejected)) = answer.outcome else { panic!("{payload:?}: {answer:?}") };
        assert!([3, 5].contains(&rejected.code) && rejected.message.len() > 10, "{payload:?}: {rejected:?}");
    }
    // A key that is deleted carries no measurement.
    network.delete("nesam/v1/test/truck/measurement").await.unwrap();
    let answer = vehicle.answer(PATIENCE).await.unwrap().expect("an answer");
    assert!(
        matches!(&answer.outcome, Some(v1::measurement_answer::Outcome::Rejected(r)) if r.message.starts_with("a key that is deleted")),
        "{answer:?}"
    );

    let query = candidates("", &recorded.drive, 50, 2, 3).to_message().encode_to_vec();
    let truncated = (0..query.len()).step_by(5).map(|length| query[..length].to_vec());
    let mut refused = 0;
    for payload in truncated.chain(garbage(13, 40).into_iter().map(Vec::from)).chain([vec![0; 1 << 20]]) {
        let replies = network.get("nesam/v1/test/truck/predict").payload(payload.clone()).await.unwrap();
        let reply = tokio::time::timeout(PATIENCE, replies.recv_async()).await.expect("in time").expect("a reply");
        let Err(error) = reply.result() else { continue };
        let error = v1::PredictError::decode(error.payload().to_bytes().as_ref()).unwrap();
        assert!(error.code == 3 && error.message.len() > 10, "{payload:?}: {error:?}");
        refused += 1;
    }
    assert!(refused > 40, "{refused} queries were refused");
    assert_eq!(client.list_sessions().await.unwrap(), before);
}

/// Payloads that are no measurement, are spoofed, or are a bad query are answered and change nothing.
async fn refuses_bad_payloads(vehicle: &ZenohVehicle, recorded: &Recorded, client: &mut nesam_client::Client) {
    let before = (client.session("truck").await.unwrap(), client.session("grpc").await.unwrap());
    let mut not_finite = sample("", &recorded.drive, 51);
    not_finite.state.as_mut().unwrap().position_m.as_mut().unwrap().z = f64::NAN;
    let missing = v1::Measurement { command: None, ..sample("", &recorded.drive, 51) };
    let nobody = v1::Measurement { session_id: "nobody".into(), ..sample("", &recorded.drive, 51) };
    for (what, payload, label, field, code) in [
        ("garbage", vec![0xff; 40], "REJECTED", "", 3),
        ("oversize", vec![0; 1 << 17], "REJECTED", "", 3),
        ("truncated", sample("", &recorded.drive, 51).encode_to_vec()[..60].to_vec(), "REJECTED", "", 3),
        ("not finite", not_finite.encode_to_vec(), "NOT_FINITE", "", 0),
        ("without command", missing.encode_to_vec(), "REJECTED", "command", 3),
        ("unknown session", nobody.encode_to_vec(), "REJECTED", "session_id", 5),
        ("late", sample("", &recorded.drive, 3).encode_to_vec(), "DUPLICATE", "", 0),
    ] {
        vehicle.publish_bytes(payload).await.unwrap();
        let answer = vehicle.answer(PATIENCE).await.unwrap().expect(what);
        assert_eq!(outcome_label(&answer), label, "{what}");
        if let Some(v1::measurement_answer::Outcome::Rejected(rejected)) = answer.outcome {
            assert_eq!((rejected.field.as_str(), rejected.code), (field, code), "{what}: {}", rejected.message);
            assert!(!rejected.message.starts_with("``"), "{what}: {}", rejected.message);
        }
    }
    refuses_sessions_of_others(vehicle, recorded, client).await;

    let refused = vehicle.predict(&candidates("nobody", &recorded.drive, 50, 1, 1)).await;
    assert_refused("query of an unknown session", refused, tonic::Code::NotFound, "session_id");
    let mut long = candidates("", &recorded.drive, 50, 1, 33);
    assert_refused("query with K = 33", vehicle.predict(&long).await, tonic::Code::InvalidArgument, "horizon");
    long.horizon = 32;
    assert_refused("query with too many numbers", vehicle.predict(&long).await, tonic::Code::InvalidArgument, "controls");
    assert_eq!((client.session("truck").await.unwrap(), client.session("grpc").await.unwrap()), before);

    // Fields that this version does not know are ignored: field 1000, varint 1.
    let mut newer = sample("", &recorded.drive, 51).encode_to_vec();
    newer.extend([0xc0, 0x3e, 0x01]);
    vehicle.publish_bytes(newer).await.unwrap();
    let answer = vehicle.answer(PATIENCE).await.unwrap().unwrap();
    assert_eq!(outcome_label(&answer), "APPLIED");
    assert_ne!(answer.run, 0, "of its own session a vehicle is told the run");
}

/// The session of another vehicle is neither fed nor asked through this vehicle's key, and what is answered says neither whose it is nor where it stands.
async fn refuses_sessions_of_others(vehicle: &ZenohVehicle, recorded: &Recorded, client: &mut nesam_client::Client) {
    let other = v1::OpenSessionRequest { vehicle_id: "neighbour".into(), session_id: "theirs".into(), ..Default::default() };
    client.open_session(other).await.unwrap();
    client.feed(samples("theirs", &recorded.drive, 2)).await.unwrap();
    let before = client.session("theirs").await.unwrap();
    let valid = sample("theirs", &recorded.drive, 51);
    for (what, measurement, field) in [
        ("valid", valid.clone(), "session_id"),
        ("meant for another run", v1::Measurement { run: 1, ..valid.clone() }, "session_id"),
        ("without a state", v1::Measurement { state: None, ..valid }, "state"),
    ] {
        vehicle.publish(&measurement).await.unwrap();
        let answer = vehicle.answer(PATIENCE).await.unwrap().expect(what);
        assert_eq!((answer.run, answer.durable_place, answer.history_epoch, answer.map_version), (0, 0, 0, 0), "{what}");
        let Some(v1::measurement_answer::Outcome::Rejected(rejected)) = answer.outcome else { panic!("{what}: {answer:?}") };
        assert_eq!((rejected.field.as_str(), rejected.code), (field, 3), "{what}: {}", rejected.message);
        assert!(!rejected.message.contains("neighbour"), "{what}: {}", rejected.message);
    }
    let asked = vehicle.predict(&candidates("theirs", &recorded.drive, 2, 1, 1)).await;
    let message = asked.as_ref().err().map(ToString::to_string).unwrap_or_default();
    assert!(!message.contains("neighbour"), "{message}");
    assert_refused("query of another vehicle's session", asked, tonic::Code::InvalidArgument, "session_id");
    assert_eq!(client.session("theirs").await.unwrap(), before);
}

/// Goal: nobody fills the memory of a server that others connect to. Method: messages below and above the limit from one connection, which goes on after both; the
/// small one is refused by the measurement's own limit, so it is answered, and of the large one nothing arrives.
#[tokio::test(flavor = "multi_thread")]
async fn service_messages_beyond_the_limit_are_dropped_and_the_vehicle_goes_on() {
    const LIMIT: usize = 2 << 20;
    let (recorded, endpoint) = (recorded(), free_endpoint().replace("tls/localhost", "tcp/127.0.0.1"));
    let (server, mut client) = start_with(|config| {
        behind(config, "");
        (config.zenoh.mode, config.zenoh.listen) = (ZenohMode::Router, vec![endpoint.clone()]);
        config.zenoh.connect.clear();
        config.zenoh.message_bytes_max = LIMIT;
    })
    .await;
    open(&mut client, "truck", "").await;
    let vehicle = ZenohVehicle::connect_through_socket(&endpoint, "test", "truck").await.unwrap();
    vehicle.wait_for_service(PATIENCE).await.unwrap();
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"client\"".into()),
        ("scouting/multicast/enabled", "false".into()),
        ("transport/shared_memory/enabled", "false".into()),
        ("connect/endpoints", format!("[{endpoint:?}]")),
    ] {
        config.insert_json5(key, &value).unwrap();
    }
    let sender = zenoh::open(config).await.unwrap();
    let key = "nesam/v1/test/truck/measurement";
    let put =
        async |bytes: usize| sender.put(key, vec![0xff; bytes]).congestion_control(zenoh::qos::CongestionControl::Block).await.unwrap();
    for _ in 0..3 {
        put(LIMIT / 2).await;
        let answer = vehicle.answer(PATIENCE).await.unwrap().expect("an answer on the status key");
        assert_eq!(outcome_label(&answer), "REJECTED");
        put(2 * LIMIT).await;
        assert!(vehicle.answer(Duration::from_millis(500)).await.unwrap().is_none(), "it is dropped on its way");
    }
    vehicle.publish(&sample("", &recorded.drive, 0)).await.unwrap();
    assert_eq!(outcome_label(&vehicle.answer(PATIENCE).await.unwrap().unwrap()), "APPLIED");
    // The sender is not cut off either.
    sender.put(key, sample("", &recorded.drive, 1).encode_to_vec()).await.unwrap();
    assert_eq!(outcome_label(&vehicle.answer(PATIENCE).await.unwrap().unwrap()), "APPLIED");
    vehicle.close().await.unwrap();
    sender.close().await.unwrap();
    server.shutdown().await;
}
