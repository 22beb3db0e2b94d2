//! Goal: an operator diagnoses what a running server has recorded, over the wire: hears how far it is, gets a report whose effect can be applied, and whoever
//! leaves or asks too much ends nothing but the diagnosis. Method: the real binary records a sample drive whose velocity is measured a tenth too large, and
//! diagnoses it in a process of its own; the list of processes says when that has gone.
#![allow(clippy::unwrap_used)]

mod common;

use std::path::Path;
use std::process::{Child, Command};
use std::time::{Duration, Instant};

use common::repository;
use nesam_client::v1::diagnosis_event::Event;
use nesam_client::{Client, measurement, v1};
use nesam_trajectories::{DataRoot, SetQuery};
use serde_json::Value;

const STEP_NS: i64 = 100_000_000;
/// The velocity is measured this share too large.
const SCALE: f64 = 0.1;

/// A server in a folder, and a client of it.
async fn served(folder: &Path, options: &[&str]) -> (Child, Client) {
    let (server, lines) = common::start(folder, &[&["--no-http"], options].concat());
    let address = common::told(&lines, "grpc").expect("an address");
    (server, Client::connect(&format!("http://{address}")).await.unwrap())
}

fn stop(mut server: Child) {
    assert!(Command::new("kill").args(["-TERM", &server.id().to_string()]).status().unwrap().success());
    assert_eq!(server.wait().unwrap().code(), Some(0));
}

/// Streams a sample drive, wheels included, into two sessions: `truck` on its map, `mapless` on none.
async fn drive(client: &mut Client) {
    let root = DataRoot::open(&repository().join("tests/data/chrono_sample"), None).unwrap();
    let query = SetQuery { trajectories: Some(vec!["n0001".into()]), ..SetQuery::all("nominal") };
    let drive = root.load_set(&query).unwrap().remove(0);
    let world = root.world(drive.world.as_ref().unwrap()).unwrap();
    client.upload_map(&nesam_navigation::map_layers(&world)).await.unwrap();
    for (session, map_id) in [("truck", world.id()), ("mapless", "")] {
        let (vehicle_id, map_id) = (session.to_string(), map_id.to_string());
        client.open_session(v1::OpenSessionRequest { vehicle_id, map_id, ..Default::default() }).await.unwrap();
        let sample = |i: usize| {
            let mut state = drive.states[i].to_array();
            state[6..9].iter_mut().for_each(|v| *v *= 1.0 + SCALE);
            let control = drive.controls[i];
            let message = measurement(session, i as i64 * STEP_NS, state, [control.speed_m_s, control.second]);
            let wheels = v1::WheelMeasurement {
                speed_rad_s: drive.wheel_speed_rad_s.as_ref().unwrap()[i].to_vec(),
                road_wheel_angle_rad: drive.road_wheel_angle_rad.as_ref().unwrap()[i].to_vec(),
            };
            v1::Measurement { sequence: i as u64 + 1, wheels: Some(wheels), ..message }
        };
        let answers = client.feed((0..drive.states.len()).map(sample).collect()).await.unwrap();
        assert_eq!(answers.len(), drive.states.len());
    }
}

fn asked(session: &str) -> v1::StartDiagnosisRequest {
    v1::StartDiagnosisRequest { session_id: session.into(), without_controls: true, ..Default::default() }
}

/// Everything that a diagnosis tells, and the code and the message of what ends it otherwise.
async fn heard(client: &mut Client, asked: v1::StartDiagnosisRequest) -> (Vec<Event>, Option<(String, String)>) {
    let mut events = Vec::new();
    let mut stream = match client.diagnose(asked).await {
        Ok(stream) => stream,
        Err(error) => return (events, Some((format!("{:?}", error.code().unwrap()), error.to_string()))),
    };
    loop {
        match stream.message().await {
            Ok(Some(message)) => events.push(message.event.unwrap()),
            Ok(None) => return (events, None),
            Err(status) => return (events, Some((format!("{:?}", status.code()), status.message().into()))),
        }
    }
}

/// Asserts that a diagnosis ends with this code and these words.
async fn refused(client: &mut Client, asked: v1::StartDiagnosisRequest, code: &str, words: &str) -> Vec<Event> {
    let (events, ended) = heard(client, asked).await;
    let (ended_by, message) = ended.expect(words);
    assert!(ended_by == code && message.contains(words), "{ended_by}: {message}");
    events
}

/// Processes of the system that work on a diagnosis: its name is part of where they write.
fn at_work(diagnosis: &str) -> usize {
    let processes = std::fs::read_dir("/proc").unwrap().flatten();
    let works = |line: Vec<u8>| String::from_utf8_lossy(&line).contains(diagnosis);
    processes.filter(|process| std::fs::read(process.path().join("cmdline")).is_ok_and(works)).count()
}

/// Waits until nothing is left of a diagnosis.
async fn gone(folder: &Path, diagnosis: &str) {
    let since = Instant::now();
    while at_work(diagnosis) > 0 || folder.join("diagnoses").join(diagnosis).exists() {
        assert!(since.elapsed() < Duration::from_secs(20), "{diagnosis} goes on, or its folder is left");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

fn started(event: &Event) -> &v1::DiagnosisStarted {
    match event {
        Event::Started(started) => started,
        other => panic!("not the start: {other:?}"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_diagnosis_of_what_is_being_recorded_names_the_effect() {
    let here = tempfile::tempdir().unwrap();
    let (server, mut client) = served(here.path(), &["--record", "run"]).await;
    drive(&mut client).await;
    let window = v1::StartDiagnosisRequest { from_stamp_ns: Some(0), seed: Some(7), ..asked("truck") };
    let (events, ended) = heard(&mut client, window).await;
    assert_eq!(ended, None, "{events:?}");
    let [first, between @ .., last] = events.as_slice() else { panic!("{events:?}") };
    let started = started(first);
    assert!(started.recording.starts_with("nesam-") && !started.recording.contains(".mcap"), "{started:?}");
    assert_eq!((started.from_stamp_ns, started.to_stamp_ns), (Some(0), None));
    let stages: Vec<&str> = between
        .iter()
        .map(|event| match event {
            Event::Progress(p) if p.done <= p.total && p.total > 0 => p.stage.as_str(),
            other => panic!("no progress: {other:?}"),
        })
        .collect();
    assert!(stages.contains(&"drives as the model sees them") && stages.contains(&"hypotheses"), "{stages:?}");

    let Event::Report(report) = last else { panic!("{last:?}") };
    assert_eq!((&report.diagnosis_id, report.verdict()), (&started.diagnosis_id, v1::DiagnosisVerdict::Explained), "{}", report.reason);
    let [effect] = report.effects.as_slice() else { panic!("{:?}", report.effects) };
    let [size] = effect.parameters.as_slice() else { panic!("{effect:?}") };
    assert_eq!((effect.id.as_str(), size.name.as_str()), ("velocity_scale", "relative"));
    // A tenth was hidden; the interval of 25 s of driving is about a hundredth wide.
    assert!((size.value - SCALE).abs() < 0.02 && size.sd > 0.0 && size.sd < 0.02, "{size:?}");
    let json: Value = serde_json::from_str(&report.json).unwrap();
    assert_eq!((json["schema"].as_str(), json["verdict"].as_str()), (Some("nesam.diagnose/1"), Some("explained")));
    assert!(json["provenance"]["command"].as_str().unwrap().contains("--seed=7"), "{}", json["provenance"]);
    assert_eq!(json["bundle"].as_str(), Some(report.bundle.as_str()));
    // The patched bundle lies there, and is another one than that which is served.
    let folder = Path::new(&report.folder);
    assert!(folder.starts_with(here.path().canonicalize().unwrap()) || folder.starts_with(here.path()), "{folder:?}");
    assert!(folder.join("diagnose.html").is_file() && Path::new(&report.bundle).join("manifest.toml").is_file());
    assert!(report.bundle_hash.len() == 64 && json["provenance"]["bundle_hash"] != report.bundle_hash.as_str());
    // The bundle is that of the recording, of which there is nothing to say.
    let [of_pieces] = report.notes.as_slice() else { panic!("{:?}", report.notes) };
    assert!(of_pieces.contains("5 pieces of one recording") && json["notes"][0] == of_pieces.as_str(), "{of_pieces}");

    // What was found can be applied as it came, and taken away.
    let applied = client.apply_effects("truck", &report.diagnosis_id, report.effects.clone()).await.unwrap();
    assert_eq!((applied.effects, applied.effects_source), (report.effects.clone(), report.diagnosis_id.clone()));
    // What acts is said, and measured against the bundle alone: the same is found.
    let (events, _) = heard(&mut client, asked("truck")).await;
    let Some(Event::Report(again)) = events.last() else { panic!("{events:?}") };
    assert_eq!(again.effects[0].id, "velocity_scale");
    assert!(again.notes.iter().any(|note| note.contains("predicts with velocity_scale:relative=")), "{:?}", again.notes);
    assert_eq!(client.revert_effects("truck").await.unwrap().effects, []);

    // A drive without a map is judged in what it has.
    let (events, ended) = heard(&mut client, asked("mapless")).await;
    assert_eq!(ended, None, "{events:?}");

    refusals(&mut client, here.path()).await;
    assert!(folder.join("diagnose.json").is_file(), "the report stays");
    stop(server);
}

/// Asks for what cannot be diagnosed.
async fn refusals(client: &mut Client, folder: &Path) {
    // It is told in the words of the command, and leaves nothing.
    for (request, words) in [
        (asked("nobody"), "session `nobody` is not in it"),
        (v1::StartDiagnosisRequest { to_stamp_ns: Some(3_000_000_000), ..asked("truck") }, "has no 4 s of measurements"),
    ] {
        let events = refused(client, request, "FailedPrecondition", words).await;
        gone(folder, &started_id(&events)).await;
    }
    for (request, code, words) in [
        (v1::StartDiagnosisRequest { recording: "other".into(), ..asked("truck") }, "NotFound", "`recording`"),
        (v1::StartDiagnosisRequest { recording: "../run".into(), ..asked("truck") }, "InvalidArgument", "`recording`"),
        (v1::StartDiagnosisRequest { from_stamp_ns: Some(2), to_stamp_ns: Some(1), ..asked("truck") }, "InvalidArgument", "`to_stamp_ns`"),
        (v1::StartDiagnosisRequest { reference: 9, ..asked("truck") }, "InvalidArgument", "`reference`"),
        (asked(""), "InvalidArgument", "`session_id`"),
    ] {
        assert_eq!(refused(client, request, code, words).await, [], "nothing begins");
    }
}

fn started_id(events: &[Event]) -> String {
    started(&events[0]).diagnosis_id.clone()
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_diagnosis_ends_with_its_caller_its_time_and_its_server() {
    let here = tempfile::tempdir().unwrap();
    let (server, mut client) = served(here.path(), &["--record", "run"]).await;
    drive(&mut client).await;

    // One at a time; whoever leaves makes room.
    let mut stream = client.diagnose(asked("truck")).await.unwrap();
    let first = started(&stream.message().await.unwrap().unwrap().event.unwrap()).clone();
    let second = stream.message().await.unwrap().unwrap().event.unwrap();
    assert!(matches!(second, Event::Progress(_)), "{second:?}");
    assert_eq!(at_work(&first.diagnosis_id), 1);
    assert_eq!(refused(&mut client, asked("truck"), "ResourceExhausted", "`diagnosis.at_once`").await, []);
    drop(stream);
    gone(here.path(), &first.diagnosis_id).await;
    client.session("truck").await.unwrap();

    // The server ends, and with it what it has begun.
    let mut stream = client.diagnose(asked("truck")).await.unwrap();
    let again = started(&stream.message().await.unwrap().unwrap().event.unwrap()).clone();
    assert_ne!(again.diagnosis_id, first.diagnosis_id);
    let second = stream.message().await.unwrap().unwrap().event.unwrap();
    assert!(matches!(second, Event::Progress(_)), "{second:?}");
    stop(server);
    let ended = loop {
        match stream.message().await {
            Ok(Some(_)) => {}
            ended => break ended,
        }
    };
    assert_eq!(ended.map_err(|status| format!("{:?}", status.code())), Err("Unavailable".into()));
    gone(here.path(), &again.diagnosis_id).await;

    // Another server that records nothing finds the recording by its name, and ends what takes too long.
    std::fs::write(here.path().join("short.toml"), "[recording]\ndirectory = \"run\"\n[diagnosis]\nlimit_s = 1.0\n").unwrap();
    let (server, mut client) = served(here.path(), &["--config", "short.toml"]).await;
    refused(&mut client, asked("truck"), "FailedPrecondition", "`recording`").await;
    let named = v1::StartDiagnosisRequest { recording: first.recording.clone(), ..asked("truck") };
    let events = refused(&mut client, named, "DeadlineExceeded", "`diagnosis.limit_s`").await;
    assert_eq!(started(&events[0]).recording, first.recording);
    gone(here.path(), &started_id(&events)).await;
    stop(server);
}
