//! Goal: sessions end when nobody uses them, and copies go their own way.

use std::time::{Duration, Instant};

use nesam_client::v1;
use nesam_engine::{Command, Engine, EngineError, Limits, OpenSession, Reply};
use tonic::Code;

use crate::stage::*;

#[tokio::test(flavor = "multi_thread")]
async fn service_idle_sessions_are_closed_and_used_ones_stay() {
    let recorded = recorded();
    let (server, mut client) = start_with(|config| config.limits.session_idle_s = 2.0).await;
    for session in ["fed", "asked", "idle"] {
        open(&mut client, session, "").await;
    }
    client.feed(samples("asked", &recorded.drive, 3)).await.unwrap();
    let mut watch = client.watch_soil("idle").await.unwrap();
    watch.message().await.unwrap().unwrap();
    let started = Instant::now();
    // Looking at a session is no use of it.
    for i in 0.. {
        if client.session("idle").await.is_err() {
            break;
        }
        assert!(started.elapsed() < Duration::from_secs(60), "still open");
        client.feed(vec![sample("fed", &recorded.drive, i % 90)]).await.unwrap();
        client.predict(candidates("asked", &recorded.drive, 3, 1, 1)).await.unwrap();
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    assert!(started.elapsed() >= Duration::from_millis(1900), "{:?}", started.elapsed());
    assert!(watch.message().await.unwrap().is_none(), "its soil watch ended");
    assert_refused("idle", client.session("idle").await, Code::NotFound, "session_id");
    let open: Vec<String> = client.list_sessions().await.unwrap().into_iter().map(|s| s.session_id).collect();
    assert_eq!(open, ["asked", "fed"]);
    assert!(server.metrics().render(0, 0).lines().any(|l| l == "nesam_events_total{event=\"session_expired\"} 1"));
    server.shutdown().await;
}

#[test]
fn property_the_idle_limit_holds_at_the_edge() {
    let mut engine = Engine::new(predictor(), Limits { session_idle_s: 2.0, ..Limits::default() }).unwrap();
    let second = 1_000_000_000;
    let open = |vehicle: &str| Command::Open(OpenSession { vehicle: vehicle.into(), ..Default::default() });
    engine.execute(0, &open("a")).unwrap();
    engine.execute(second, &open("b")).unwrap();
    let mut expired = |now_ns: u64| match engine.execute(now_ns, &Command::Expire) {
        Ok(Reply::Expired(sessions)) => sessions,
        other => panic!("{other:?}"),
    };
    assert!(expired(2 * second).is_empty());
    assert_eq!(expired(2 * second + 1), ["a"]);
    // A refused use is a use: somebody is there.
    let copied = engine.execute(3 * second, &Command::Fork { session: "b".into(), copy: "b".into() });
    assert_eq!(copied.unwrap_err(), EngineError::SessionExists { session: "b".into(), field: "new_session_id" });
    let mut expired = |now_ns: u64| engine.execute(now_ns, &Command::Expire);
    assert!(matches!(expired(5 * second), Ok(Reply::Expired(sessions)) if sessions.is_empty()));
    assert!(matches!(expired(5 * second + 1), Ok(Reply::Expired(sessions)) if sessions == ["b"]));
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_fork_has_everything_and_leaves_the_original_alone() {
    let recorded = recorded();
    let (server, mut client) = start_with(|config| config.limits.sessions_max = 2).await;
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    open(&mut client, "s", recorded.world.id()).await;
    client.feed(samples("s", &recorded.drive, 64)).await.unwrap();
    let before = client.session("s").await.unwrap();
    for (what, session, copy, code, field) in [
        ("unknown", "nobody", "t", Code::NotFound, "session_id"),
        ("no name", "s", "", Code::InvalidArgument, "new_session_id"),
        ("a path", "s", "../t", Code::InvalidArgument, "new_session_id"),
        ("long name", "s", &"x".repeat(65), Code::InvalidArgument, "new_session_id"),
        ("open already", "s", "s", Code::AlreadyExists, "new_session_id"),
    ] {
        assert_refused(what, client.fork_session(session, copy).await, code, field);
        assert_eq!(client.list_sessions().await.unwrap(), std::slice::from_ref(&before), "{what}");
    }
    let copy = client.fork_session("s", "t").await.unwrap();
    assert_eq!(v1::Session { session_id: "s".into(), ..copy }, before);
    assert_refused("third session", client.fork_session("s", "u").await, Code::ResourceExhausted, "new_session_id");
    // The copy drives on; it predicts what a session that was never copied predicts.
    client.feed((65..=80).map(|i| sample("t", &recorded.drive, i)).collect()).await.unwrap();
    assert_eq!(client.session("s").await.unwrap(), before);
    let query = candidates("t", &recorded.drive, 80, 2, 16);
    let prediction = client.predict(query.clone()).await.unwrap();
    assert_same(&prediction, &offline(&recorded, 80, &query, 31, learned(&recorded, 80).0));
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_one_vehicle_does_not_take_all_sessions() {
    let recorded = recorded();
    let (server, mut client) = start_with(|config| config.limits.sessions_per_vehicle_max = 2).await;
    open(&mut client, "a", "").await;
    client.feed(samples("a", &recorded.drive, 3)).await.unwrap();
    open(&mut client, "b", "").await;
    let request = |vehicle: &str| v1::OpenSessionRequest { vehicle_id: vehicle.into(), session_id: "c".into(), ..Default::default() };
    assert_refused("a third one", client.open_session(request("truck")).await, Code::ResourceExhausted, "session_id");
    assert_refused("a copy", client.fork_session("a", "c").await, Code::ResourceExhausted, "new_session_id");
    let image = client.export_session("a").await.unwrap();
    assert_refused("an imported one", client.import_session(image.clone(), "c").await, Code::ResourceExhausted, "session_id");
    // Another vehicle has room, and so has this one when it closes a session.
    client.open_session(request("other")).await.unwrap();
    client.close_session("b").await.unwrap();
    client.import_session(image, "b").await.unwrap();
    server.shutdown().await;
}
