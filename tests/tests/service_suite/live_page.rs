//! Goal: the live page shows what the service knows, costs answers nothing and is bounded. Method: the stream of updates, read from the socket (or never
//! read) while a recorded drive is fed and asked about; the page itself is driven in a browser by `tests/tools/live_page.py`.

use std::io::{BufRead as _, BufReader, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

use nesam_client::zenoh_vehicle::ZenohVehicle;
use nesam_client::{outcome_label, v1};
use serde_json::Value;

use crate::stage::*;
use crate::zenoh_network::{PATIENCE, behind, router};

/// A stream of updates.
struct Page(BufReader<TcpStream>);

impl Page {
    /// Asks for the stream; the status line and the stream behind the head.
    fn open(address: SocketAddr) -> (String, Self) {
        let mut socket = TcpStream::connect(address).unwrap();
        socket.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        write!(socket, "GET /live/events HTTP/1.1\r\nhost: x\r\naccept: text/event-stream\r\n\r\n").unwrap();
        let mut page = Self(BufReader::new(socket));
        let status = page.line();
        while !page.line().is_empty() {}
        (status, page)
    }

    fn line(&mut self) -> String {
        let mut line = String::new();
        self.0.read_line(&mut line).unwrap();
        line.trim_end().to_string()
    }

    /// The next update: what kind, and what it tells.
    fn next(&mut self) -> (String, Value) {
        let mut kind = String::new();
        loop {
            let line = self.line();
            if let Some(event) = line.strip_prefix("event:") {
                kind = event.trim().into();
            }
            if let Some(update) = line.strip_prefix("data:").and_then(|text| serde_json::from_str(text).ok()) {
                return (kind, update);
            }
        }
    }

    /// The next update for which something holds.
    fn until(&mut self, holds: impl Fn(&Value) -> bool) -> Value {
        (0..2000).map(|_| self.next().1).find(holds).expect("an update is as expected")
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn service_the_live_page_sees_what_passes() {
    let (server, mut client, recorded) = start_on_map().await;
    open(&mut client, "s", recorded.world.id()).await;
    let mut stream = client.measure().await.unwrap();
    for i in 0..5 {
        stream.exchange(sample("s", &recorded.drive, i)).await.unwrap();
    }
    let address = server.http_addr.unwrap();
    // The session is there at once with its newest step; what passed before anybody watched is not.
    let (mut page, first) = tokio::task::spawn_blocking(move || {
        let (status, mut page) = Page::open(address);
        assert!(status.contains("200"), "{status}");
        let (kind, first) = page.next();
        assert_eq!(kind, "whole");
        (page, first)
    })
    .await
    .unwrap();
    assert_eq!((first["schema"].as_str(), first["sessions"][0]["session"].as_str()), (Some("nesam.live/1"), Some("s")));
    let begun = first["sessions"][0]["newest"]["position_m"][0].as_f64().unwrap();
    assert!((begun - recorded.drive.states[4].position_m[0]).abs() < 1e-5, "{first}");
    assert!(first["sessions"][0]["trail"].as_array().unwrap().is_empty() && first["timings"].as_array().unwrap().is_empty(), "{first}");

    let last = 44;
    for i in 5..=last {
        stream.exchange(sample("s", &recorded.drive, i)).await.unwrap();
    }
    let mut asked = candidates("s", &recorded.drive, last, 6, 20);
    let fan = client.predict(asked.clone()).await.unwrap();
    asked.samples = 1;
    asked.controls.truncate(2 * 20);
    asked.extras = Some(v1::PredictExtras { covariance: true, ..Default::default() });
    let region = client.predict(asked).await;
    let wrong = client.session("nobody").await;
    assert!(wrong.is_err());
    let (update, page) = tokio::task::spawn_blocking(move || {
        // Updates tell what is new; the drawn prediction comes once.
        let update = page.until(|update| !update["sessions"][0]["fan"].is_null());
        (update, page)
    })
    .await
    .unwrap();
    let session = &update["sessions"][0];
    let [x, y, _] = recorded.drive.states[last].position_m;
    let told = &session["newest"]["position_m"];
    assert!((told[0].as_f64().unwrap() - x).abs() < 1e-5 && (told[1].as_f64().unwrap() - y).abs() < 1e-5, "{told}");
    assert_eq!((session["fan"]["samples"].as_u64(), session["fan"]["paths"].as_array().unwrap().len()), (Some(6), 6));
    let end = session["fan"]["paths"][5].as_array().unwrap();
    let told = [end[end.len() - 2].as_f64().unwrap(), end[end.len() - 1].as_f64().unwrap()];
    let expected = fan.state(5, 19);
    assert!((told[0] - f64::from(expected[0])).abs() < 0.006 && (told[1] - f64::from(expected[1])).abs() < 0.006, "{told:?}");
    assert_eq!(session["soil"]["names"].as_array().unwrap().len(), 6);
    assert_eq!(session["map"]["id"].as_str(), Some(recorded.world.id()));
    assert_eq!(session["map"]["hash"].as_str(), Some(recorded.world.hash()));
    assert!(update["service"]["terrain_cache"]["looked_up"].as_u64().unwrap() > 0);
    let bundle_knows_its_errors = region.is_ok();
    assert!(
        !bundle_knows_its_errors || session["region"].is_null() || session["region"]["regions"].as_array().is_some_and(|r| r.len() == 8)
    );
    drop(page);
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_open_pages_are_limited_and_end_with_the_server() {
    let (server, _client) = start_with(|config| config.http.watchers_max = 1).await;
    let address = server.http_addr.unwrap();
    let (status, mut page) = tokio::task::spawn_blocking(move || Page::open(address)).await.unwrap();
    assert!(status.contains("200"), "{status}");
    let (refused, _) = tokio::task::spawn_blocking(move || Page::open(address)).await.unwrap();
    assert!(refused.contains("503"), "{refused}");
    let ended = tokio::task::spawn_blocking(move || {
        let mut text = String::new();
        while page.0.read_line(&mut text).is_ok_and(|n| n > 0) {}
        text
    });
    tokio::time::timeout(Duration::from_secs(60), server.shutdown()).await.expect("an open page does not hold the server up");
    assert!(ended.await.unwrap().contains("event: stopped"));
}

/// Recorded samples that are fed while pages are open, and every how many of them a planner asks.
const FED: usize = 60;
const ASKED_EVERY: usize = 6;

/// Feeds and asks; the last prediction. Every measurement and every question is answered in time, or this fails.
async fn drive(server: &nesam_server::RunningServer, client: &mut nesam_client::Client, recorded: &Recorded) -> Vec<f32> {
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    open(client, "s", recorded.world.id()).await;
    let mut stream = client.measure().await.unwrap();
    let mut last = Vec::new();
    for i in 0..FED {
        let answer = tokio::time::timeout(Duration::from_secs(60), stream.exchange(sample("s", &recorded.drive, i))).await;
        assert_eq!(outcome_label(&answer.expect("a measurement is answered").unwrap()), "APPLIED", "{i}");
        if i % ASKED_EVERY == ASKED_EVERY - 1 {
            let asked = client.predict(candidates("s", &recorded.drive, i, 6, 20));
            let prediction = tokio::time::timeout(Duration::from_secs(60), asked).await.expect("a prediction is answered").unwrap();
            last = (0..6).flat_map(|n| prediction.state(n, 19).to_vec()).collect();
        }
    }
    assert_eq!(server.metrics().predictions(), (FED / ASKED_EVERY) as u64);
    last
}

#[tokio::test(flavor = "multi_thread")]
async fn service_pages_that_never_read_cost_no_answer() {
    let recorded = recorded();
    let (server, mut client) = start().await;
    let alone = drive(&server, &mut client, &recorded).await;
    server.shutdown().await;

    let (server, mut client) = start_with(|config| config.http.watchers_max = 4).await;
    let address = server.http_addr.unwrap();
    // Three pages ask for the stream, with as small a window as the system allows, and read nothing, not even the head.
    let mut deaf = Vec::new();
    for _ in 0..3 {
        let socket = tokio::net::TcpSocket::new_v4().unwrap();
        socket.set_recv_buffer_size(1024).unwrap();
        let socket = socket.connect(address).await.unwrap();
        socket.writable().await.unwrap();
        socket.try_write(b"GET /live/events HTTP/1.1\r\nhost: x\r\n\r\n").unwrap();
        deaf.push(socket);
    }
    let reading =
        tokio::task::spawn_blocking(move || Page::open(address).1.until(|update| update["service"]["predictions"].as_u64() > Some(0)));
    let watched = drive(&server, &mut client, &recorded).await;
    assert_eq!(alone, watched, "a page changes no answer");
    // A page that reads is served beside them, and misses nothing.
    let update = reading.await.unwrap();
    assert_eq!(update["service"]["notes_missed"].as_u64(), Some(0));
    tokio::time::timeout(Duration::from_secs(60), server.shutdown()).await.expect("they do not hold the server up");
    drop(deaf);
}

#[tokio::test(flavor = "multi_thread")]
async fn regress_the_live_page_sees_measurements_over_zenoh() {
    let recorded = recorded();
    let (router, endpoint) = router().await;
    let (server, mut client) = start_with(|config| behind(config, &endpoint)).await;
    client.upload_map(&layers(&recorded.world)).await.unwrap();
    open(&mut client, "truck", recorded.world.id()).await;
    let address = server.http_addr.unwrap();
    let (mut page, _) = tokio::task::spawn_blocking(move || {
        let (_, mut page) = Page::open(address);
        let first = page.next();
        (page, first)
    })
    .await
    .unwrap();
    let vehicle = ZenohVehicle::connect(&endpoint, "test", "truck").await.unwrap();
    vehicle.wait_for_service(PATIENCE).await.unwrap();
    for i in 0..3 {
        vehicle.publish(&sample("", &recorded.drive, i)).await.unwrap();
        vehicle.answer(PATIENCE).await.unwrap().expect("an answer on the status key");
    }
    let seen = move || page.until(|update| update["sessions"][0]["outcomes"]["applied"].as_u64() == Some(3));
    let update = tokio::task::spawn_blocking(seen).await.unwrap();
    let told = update["sessions"][0]["newest"]["position_m"][0].as_f64().unwrap();
    assert!((told - recorded.drive.states[2].position_m[0]).abs() < 1e-5, "{update}");
    vehicle.close().await.unwrap();
    server.shutdown().await;
    drop(router);
}
