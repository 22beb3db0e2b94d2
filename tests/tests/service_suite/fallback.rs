//! Goal: a planner that asks for it gets a prediction in every cycle, and is told when the service did not make it. Method: deadlines that cannot be met, servers
//! that are gone, a connection that never comes about; what the numbers are is held against the Python client in the client's own tests.

use std::time::Duration;

use nesam_client::{Candidates, Client, ClientError, ComputedBy, KinematicFallback, Prediction};
use tonic::Code;
use tonic::transport::{Endpoint, Uri};

use crate::stage::*;

async fn fallback_of(client: &mut Client, session: &str) -> KinematicFallback {
    KinematicFallback::new(client.session(session).await.unwrap().vehicle.unwrap())
}

/// Whether a fallback may stand in for this.
fn is_late(code: Option<Code>) -> bool {
    matches!(code, Some(Code::DeadlineExceeded | Code::ResourceExhausted | Code::Unavailable))
}

fn assert_fallback(answered: Result<Prediction, ClientError>, start: [f64; 12]) -> Prediction {
    let prediction = answered.unwrap();
    assert_eq!((prediction.computed_by, prediction.start), (ComputedBy::KinematicFallback, start));
    assert!(is_late(prediction.fallback_reason.as_ref().map(|reason| reason.code)), "{:?}", prediction.fallback_reason);
    assert!(prediction.provenance.bundle_hash.is_empty() && prediction.soil.iter().all(|value| value.is_nan()));
    prediction
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_late_answer_falls_back_and_says_so() {
    let (server, mut client, recorded) = driven("s", 40).await;
    let fallback = fallback_of(&mut client, "s").await;
    let newest = recorded.drive.states[40].to_array();
    let (heavy, at_once) = (candidates("s", &recorded.drive, 40, 2048, 32), Some(Duration::from_millis(2)));
    // Off unless asked for.
    let refused = client.predict_within(heavy.clone(), at_once).await.expect_err("there is no time");
    assert!(is_late(refused.code()), "{refused}");
    let mut asked = heavy.or_fall_back(fallback.clone());
    (asked.output.channels, asked.output.stride) = (0b11, 8);
    let late = assert_fallback(client.predict_within(asked, at_once).await, newest);
    assert_eq!((late.samples, late.steps, late.channels, late.states.len()), (2048, 4, vec![0, 1], 2048 * 4 * 2));
    // In time, the service answers although a fallback is there, with the same bits as without.
    let light = candidates("s", &recorded.drive, 40, 2, 8);
    let without = client.predict(light.clone()).await.unwrap();
    let within = client.predict_within(light.clone().or_fall_back(fallback.clone()), Some(Duration::from_secs(60))).await.unwrap();
    assert_eq!((within.computed_by, &within.fallback_reason), (ComputedBy::Service, &None));
    assert!(bits(&within.states) == bits(&without.states));
    // A wrong question is not answered by the fallback.
    let wrong = Candidates::new("s", 1, 33, vec![1.0; 66]).or_fall_back(fallback.clone());
    assert_refused("33 steps", client.predict(wrong).await, Code::InvalidArgument, "horizon");
    let unknown = Candidates { session: "nobody".into(), start: Some(newest), ..light.or_fall_back(fallback) };
    assert_refused("unknown session", client.predict(unknown).await, Code::NotFound, "session_id");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_server_that_is_gone_falls_back_to_the_newest_known_state() {
    let recorded = recorded();
    let (server, mut client) = start().await;
    for session in ["fed", "streamed", "predicted"] {
        open(&mut client, session, "").await;
    }
    client.feed(samples("fed", &recorded.drive, 3)).await.unwrap();
    let mut stream = client.measure().await.unwrap();
    for measurement in samples("streamed", &recorded.drive, 4) {
        stream.exchange(measurement).await.unwrap();
    }
    // Somebody else feeds this one; where a prediction of it began is known all the same.
    let mut other = Client::connect(&format!("http://{}", server.grpc_addr)).await.unwrap();
    other.feed(samples("predicted", &recorded.drive, 5)).await.unwrap();
    client.predict(candidates("predicted", &recorded.drive, 5, 1, 1)).await.unwrap();
    let fallback = fallback_of(&mut client, "fed").await;
    server.shutdown().await;
    for (session, newest) in [("fed", 3), ("streamed", 4), ("predicted", 5)] {
        let asked = candidates(session, &recorded.drive, newest, 3, 5);
        let refused = client.predict(asked.clone()).await.expect_err("nobody is there");
        assert_eq!(refused.code(), Some(Code::Unavailable), "{refused}");
        // A clone knows what the client knows.
        let answered = client.clone().predict(asked.or_fall_back(fallback.clone())).await;
        let prediction = assert_fallback(answered, recorded.drive.states[newest].to_array());
        assert_eq!((prediction.samples, prediction.steps, prediction.channels.len()), (3, 5, 12));
    }
    // Nothing is known of this one, and nothing is made up.
    let strange = candidates("strange", &recorded.drive, 0, 1, 1).or_fall_back(fallback);
    assert_eq!(client.predict(strange.clone()).await.expect_err("no state is known").code(), Some(Code::Unavailable));
    assert_fallback(client.predict(Candidates { start: Some([1.0; 12]), ..strange }).await, [1.0; 12]);
}

/// A planner that only asks from now knows the session by where its predictions began.
#[tokio::test(flavor = "multi_thread")]
async fn service_a_planner_that_only_asks_from_now_falls_back() {
    let (server, mut vehicle, recorded) = driven("s", 40).await;
    let fallback = fallback_of(&mut vehicle, "s").await;
    let newest_ns = vehicle.session("s").await.unwrap().last_stamp_ns.unwrap();
    let mut planner = Client::connect(&format!("http://{}", server.grpc_addr)).await.unwrap();
    let (asked_ns, step_ns) = (newest_ns + 200_000_000, 100_000_000);
    let command = recorded.drive.controls[40];
    let sent = vec![(newest_ns, [command.speed_m_s, command.second])];
    let first = planner.predict(candidates("s", &recorded.drive, 40, 2, 8).starting_at(asked_ns, sent.clone())).await.unwrap();
    assert_eq!((first.rolled_forward_steps, first.start_stamp_ns), (2, Some(asked_ns)));
    server.shutdown().await;
    let next = candidates("s", &recorded.drive, 40, 3, 5).starting_at(asked_ns + step_ns, sent);
    let expected = fallback.rollout(&first.start, &[command.speed_m_s as f32, command.second as f32], 1);
    let answered = planner.predict(next.or_fall_back(fallback)).await.unwrap();
    assert_eq!((answered.computed_by, answered.rolled_forward_steps), (ComputedBy::KinematicFallback, 3), "two of them the service rolled");
    assert_eq!(answered.start_stamp_ns, Some(asked_ns + step_ns));
    // Single precision of positions and commands.
    for (start, expected) in answered.start.iter().zip(&expected) {
        assert!((start - f64::from(*expected)).abs() < 1e-4, "{start} for {expected}");
    }
}

/// A connection that is being made, to a machine that does not answer, must not take longer than the deadline.
#[tokio::test(flavor = "multi_thread")]
async fn service_a_deadline_holds_without_a_connection() {
    let never = tower::service_fn(|_: Uri| std::future::pending::<std::io::Result<hyper_util::rt::TokioIo<tokio::net::TcpStream>>>());
    let mut client = Client::over(Endpoint::from_static("http://nobody").connect_with_connector_lazy(never));
    let asked = Candidates { start: Some([0.0; 12]), ..Candidates::new("s", 1, 2, vec![1.0, 0.0, 1.0, 0.0]) };
    let deadline = Some(Duration::from_millis(30));
    let patience = Duration::from_secs(20);
    let refused = tokio::time::timeout(patience, client.predict_within(asked.clone(), deadline)).await.expect("the deadline holds");
    assert_eq!(refused.expect_err("nobody is there").code(), Some(Code::DeadlineExceeded));
    let card = nesam_client::v1::VehicleCard { wheelbase_m: 2.0, speed_max_m_s: 1.0, ..Default::default() };
    let answered = client.predict_within(asked.or_fall_back(KinematicFallback::new(card)), deadline);
    let prediction = assert_fallback(tokio::time::timeout(patience, answered).await.expect("the deadline holds"), [0.0; 12]);
    assert!((prediction.state(0, 1)[0] - 0.2).abs() < 1e-6, "straight ahead at 1 m/s");
}
