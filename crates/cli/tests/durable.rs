//! Goal: a server that is killed loses no measurement that it called durable, and the estimate goes on as if nothing had happened. Method: the real
//! binary, SIGKILL in the middle of a recorded drive, a restart on the same store; a second server that is never killed is the oracle, bit for bit.
#![allow(clippy::unwrap_used)]

mod common;

use std::path::Path;
use std::process::{Child, Command};
use std::time::Duration;

use common::{BINARY, bundle, repository};
use nesam_client::{Candidates, Client, MapLayers, Outbox, measurement, outcome_label, v1};
use nesam_trajectories::{DataRoot, SetQuery, Trajectory};

const STEP_NS: i64 = 100_000_000;
/// Samples of the drive that are sent, and those after which the server is killed.
const SENT: usize = 120;
const KILLS: [usize; 3] = [7, 52, 88];
/// Measurements on their way when the server is killed.
const IN_FLIGHT: usize = 12;

/// Starts a server and gives its process and gRPC address; `None` when it ends instead.
fn serve(folder: &Path, options: &[&str]) -> Option<(Child, String)> {
    let (mut server, lines) = common::start(folder, &[&["--no-http"], options].concat());
    let address = common::told(&lines, "grpc").map(|address| format!("http://{address}"));
    if address.is_none() {
        assert_eq!(server.wait().unwrap().code(), Some(2), "{lines:?}");
    }
    Some((server, address?))
}

fn kill(mut server: Child) {
    server.kill().unwrap();
    server.wait().unwrap();
}

struct Drive {
    drive: Trajectory,
    map: MapLayers,
}

fn recorded() -> Drive {
    let root = DataRoot::open(&repository().join("tests/data/chrono_sample"), None).unwrap();
    let drive = root.load_set(&SetQuery { trajectories: Some(vec!["n0005".into()]), ..SetQuery::all("nominal") }).unwrap().remove(0);
    let world = root.world(drive.world.as_ref().unwrap()).unwrap();
    let map = MapLayers { version: 3, ..nesam_navigation::map_layers(&world) };
    Drive { drive, map }
}

impl Drive {
    fn sample(&self, i: usize) -> v1::Measurement {
        let control = self.drive.controls[i];
        let message = measurement("truck", i as i64 * STEP_NS, self.drive.states[i].to_array(), [control.speed_m_s, control.second]);
        v1::Measurement { sequence: i as u64 + 1, boot_id: 77, ..message }
    }

    async fn open(&self, client: &mut Client) {
        client.upload_map(&self.map).await.unwrap();
        let request = v1::OpenSessionRequest { vehicle_id: "truck".into(), map_id: self.map.id.clone(), ..Default::default() };
        client.open_session(request).await.unwrap();
    }

    /// What the session knows at the end, and a prediction from it.
    async fn end(&self, client: &mut Client) -> (v1::Session, Vec<u32>) {
        let session = client.session("truck").await.unwrap();
        let controls = (0..20).flat_map(|k| [self.drive.controls[SENT + k].speed_m_s as f32, self.drive.controls[SENT + k].second as f32]);
        let prediction = client.predict(Candidates::new("truck", 1, 20, controls.collect())).await.unwrap();
        (v1::Session { durable_place: 0, run: 0, ..session }, prediction.states.iter().map(|v| v.to_bits()).collect())
    }
}

/// Asks a server to stop; its exit code.
fn stop(mut server: Child) -> Option<i32> {
    assert!(Command::new("kill").args(["-TERM", &server.id().to_string()]).status().unwrap().success());
    server.wait().unwrap().code()
}

/// Largest size of the files that a server writes, bytes or `unlimited`: writes beyond it fail as on a full disk.
fn limit_files(server: &Child, bytes: &str) {
    let limit = Command::new("prlimit").args(["--pid", &server.id().to_string(), &format!("--fsize={bytes}:")]).status();
    assert!(limit.unwrap().success());
}

/// Sends what the outbox holds until `stop` answers have come, with some measurements always on their way; gives the last durable place.
async fn send(client: &mut Client, outbox: &mut Outbox, stop: usize) -> u64 {
    let mut stream = client.measure().await.unwrap();
    let (mut answered, mut on_the_way, mut durable) = (0, 0, 0);
    while answered < stop {
        while on_the_way < IN_FLIGHT
            && let Some(measurement) = outbox.next_unsent()
        {
            stream.send(measurement).await.unwrap();
            on_the_way += 1;
        }
        if on_the_way == 0 {
            break;
        }
        let answer = stream.answer().await.unwrap().unwrap();
        assert!(["APPLIED", "GATED", "DUPLICATE"].contains(&outcome_label(&answer)), "{answer:?}");
        assert!(answer.durable_place >= durable, "{answer:?}");
        durable = answer.durable_place;
        assert_eq!(outbox.answered(&answer), None, "a measurement is lost");
        (answered, on_the_way) = (answered + 1, on_the_way - 1);
    }
    durable
}

/// Waits until everything in the outbox is durable.
async fn settle(client: &mut Client, outbox: &mut Outbox) {
    for _ in 0..600 {
        let session = client.session("truck").await.unwrap();
        outbox.durable(session.run, session.durable_place);
        if outbox.is_empty() {
            return;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    panic!("{} measurements did not become durable", outbox.len());
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_killed_server_goes_on_bit_for_bit() {
    let here = tempfile::tempdir().unwrap();
    let recorded = recorded();
    let (oracle, address) = serve(here.path(), &[]).unwrap();
    let mut client = Client::connect(&address).await.unwrap();
    recorded.open(&mut client).await;
    let answers = client.feed((0..SENT).map(|i| recorded.sample(i)).collect()).await.unwrap();
    assert!(answers.len() == SENT && answers.iter().all(|a| a.durable_place == 0));
    let expected = recorded.end(&mut client).await;
    assert!(expected.0.provenance.as_ref().unwrap().soil_epoch >= 5);
    kill(oracle);

    // The same drive, sent by somebody who keeps what is not durable.
    let mut outbox = Outbox::default();
    let (mut sent, mut durable, mut resent) = (0, 0, 0);
    for until in KILLS.into_iter().chain([SENT]) {
        let (server, address) = serve(here.path(), &["--store", "store"]).unwrap();
        assert!(serve(here.path(), &["--store", "store"]).is_none(), "one server has the store");
        let mut client = Client::connect(&address).await.unwrap();
        if sent == 0 {
            recorded.open(&mut client).await;
        }
        let restored = client.session("truck").await.unwrap();
        assert!(restored.accepted >= durable && restored.durable_place == restored.accepted, "{durable} were durable: {restored:?}");
        outbox.reconnected();
        let again = outbox.len();
        resent += again;
        (sent..until).for_each(|i| outbox.push(recorded.sample(i)).unwrap());
        // Without a pause before the kill, so that measurements are on their way and commits in the making.
        let last = until == SENT;
        durable = send(&mut client, &mut outbox, if last { usize::MAX } else { until - sent + again - IN_FLIGHT.min(until - sent) }).await;
        sent = until;
        if last {
            settle(&mut client, &mut outbox).await;
            assert_eq!(recorded.end(&mut client).await, expected, "after {} kills", KILLS.len());
        }
        kill(server);
    }
    assert!(resent > 0, "every kill came when everything was durable: the test shows nothing");

    // All of it is there once more, and a gentle stop changes nothing.
    let (server, address) = serve(here.path(), &["--store", "store"]).unwrap();
    let mut client = Client::connect(&address).await.unwrap();
    assert_eq!(recorded.end(&mut client).await, expected);
    client.close_session("truck").await.unwrap();
    assert_eq!(stop(server), Some(0));
    let (server, address) = serve(here.path(), &["--store", "store"]).unwrap();
    let mut client = Client::connect(&address).await.unwrap();
    assert!(client.list_sessions().await.unwrap().is_empty(), "a closed session stays closed");
    assert_eq!(client.list_maps().await.unwrap().len(), 1);
    kill(server);

    // The store belongs to its bundle: a session of another one is not silently forgotten.
    let (server, address) = serve(here.path(), &["--store", "store"]).unwrap();
    let mut client = Client::connect(&address).await.unwrap();
    client.open_session(v1::OpenSessionRequest { vehicle_id: "truck".into(), ..Default::default() }).await.unwrap();
    kill(server);
    let refused = Command::new(BINARY)
        .args(["serve", "--bundle", &bundle("clearpath-husky"), "--store", "store", "--grpc", "127.0.0.1:0", "--no-http", "--no-zenoh"])
        .current_dir(here.path())
        .output()
        .unwrap();
    let words = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert_eq!(refused.status.code(), Some(2), "{words}");
    assert!(words.contains("session `truck`") && words.contains("bundle"), "{words}");
}

/// Goal: a disk that is full costs what was changed meanwhile and nothing after it, and whoever stops the server meanwhile is told. Method: a limit on the size of
/// files, which the store reaches with a map of 9 MB.
#[tokio::test(flavor = "multi_thread")]
async fn service_a_full_disk_is_told_and_survived() {
    let here = tempfile::tempdir().unwrap();
    std::fs::write(here.path().join("nesam.toml"), "[grpc]\ndeadline_s = 2.0\n").unwrap();
    let options = ["--store", "store", "--config", "nesam.toml"];
    let recorded = recorded();
    let side = 1500;
    let big = MapLayers {
        id: "big".into(),
        width: side,
        height: side,
        elevation_m: vec![0.0; side * side],
        semantic_rgb: None,
        ..recorded.map.clone()
    };
    let refused = async |server: &Child, client: &mut Client| {
        let size = std::fs::metadata(here.path().join("store/sessions.redb")).unwrap().len();
        limit_files(server, &size.to_string());
        let words = client.upload_map(&big).await.unwrap_err().to_string();
        assert!(words.contains("not durable yet"), "{words}");
    };

    let (server, address) = serve(here.path(), &options).unwrap();
    let mut client = Client::connect(&address).await.unwrap();
    recorded.open(&mut client).await;
    refused(&server, &mut client).await;
    assert_eq!(stop(server), Some(1), "what was not written is told");

    let (server, address) = serve(here.path(), &options).unwrap();
    let mut client = Client::connect(&address).await.unwrap();
    assert_eq!((client.list_sessions().await.unwrap().len(), client.list_maps().await.unwrap().len()), (1, 1), "the map was not durable");
    refused(&server, &mut client).await;
    limit_files(&server, "unlimited");
    let late = v1::OpenSessionRequest { vehicle_id: "late".into(), ..Default::default() };
    client.open_session(late).await.expect("there is room again");
    assert_eq!(stop(server), Some(0));

    let (server, address) = serve(here.path(), &options).unwrap();
    let mut client = Client::connect(&address).await.unwrap();
    assert_eq!((client.list_sessions().await.unwrap().len(), client.list_maps().await.unwrap().len()), (2, 2));
    kill(server);
}
