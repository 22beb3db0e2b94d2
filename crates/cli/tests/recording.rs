//! Goal: the field engineer's way: record with the real server, stop it gently or kill it, replay what is on the disk. Method: the real binary,
//! sockets, signals; exit codes and words are the contract.
#![allow(clippy::unwrap_used)]

mod common;

use std::path::{Path, PathBuf};
use std::process::Child;
use std::time::Duration;

use common::{bundle, nesam, said, send};
use nesam_client::{Candidates, Client, measurement, v1};
use serde_json::Value;

/// A recording server and the address of its gRPC.
fn serve(folder: &Path, more: &[&str]) -> (Child, String) {
    let (server, lines) = common::start(folder, &[&["--no-http", "--record", "run"], more].concat());
    assert!(common::told(&lines, "record").is_some_and(|file| file.ends_with(".0001.mcap")), "{lines:?}");
    let address = common::told(&lines, "grpc").expect("an address");
    (server, format!("http://{address}"))
}

/// A short drive straight on.
async fn drive(address: &str) {
    drive_as("truck", address).await;
}

async fn drive_as(vehicle: &str, address: &str) {
    let mut client = Client::connect(address).await.unwrap();
    client.open_session(v1::OpenSessionRequest { vehicle_id: vehicle.into(), ..Default::default() }).await.unwrap();
    let state = |i: i64| [0.2 * i as f64, 0.0, 0.6, 0.0, 0.02, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    let measurements = (0..20).map(|i| measurement(vehicle, i * 100_000_000, state(i), [2.0, 0.0])).collect();
    assert_eq!(client.feed(measurements).await.unwrap().len(), 20);
    client.predict(Candidates::new(vehicle, 1, 4, vec![2.0, 0.1, 2.0, 0.1, 2.0, 0.1, 2.0, 0.1])).await.unwrap();
}

fn recording(folder: &Path) -> PathBuf {
    std::fs::read_dir(folder.join("run")).unwrap().next().unwrap().unwrap().path()
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_stopped_server_leaves_a_recording_that_replays() {
    let here = tempfile::tempdir().unwrap();
    let (mut server, address) = serve(here.path(), &[]);
    drive(&address).await;
    send("-TERM", &server);
    assert_eq!(server.wait().unwrap().code(), Some(0));
    let output = nesam(&["replay", "run", "--json", "out.json"], here.path());
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    assert!(!said(&output).contains("note:"), "{}", said(&output));
    let json: Value = serde_json::from_str(&std::fs::read_to_string(here.path().join("out.json")).unwrap()).unwrap();
    assert_eq!((json["schema"].as_str(), json["all_equal"].as_bool()), (Some("nesam.replay/1"), Some(true)));
    assert_eq!((json["kinds"]["measure"]["equal"].as_u64(), json["total"]["different"].as_u64()), (Some(20), Some(0)));
    assert_eq!(json["ending"]["kind"].as_str(), Some("finished"));

    // Another bundle is refused with the way out; forced, it differs.
    let other = bundle("clearpath-husky");
    let refused = nesam(&["replay", "run", "--bundle", &other], here.path());
    assert_eq!(refused.status.code(), Some(2), "{}", said(&refused));
    assert!(said(&refused).contains("was made with bundle hmmwv-nominal") && said(&refused).contains("--force"), "{}", said(&refused));
    let forced = nesam(&["replay", "run", "--bundle", &other, "--force"], here.path());
    assert_eq!(forced.status.code(), Some(1), "{}", said(&forced));
    assert!(said(&forced).contains("first difference"), "{}", said(&forced));

    // Bits that fell over on the way.
    let file = recording(here.path());
    let mut bytes = std::fs::read(&file).unwrap();
    let inside = bytes.len() / 4;
    bytes[inside] ^= 1;
    std::fs::write(here.path().join("bad.mcap"), bytes).unwrap();
    let damaged = nesam(&["replay", "bad.mcap"], here.path());
    assert!(matches!(damaged.status.code(), Some(1 | 2)) && said(&damaged).contains("damaged"), "{}", said(&damaged));
    std::fs::write(here.path().join("text.mcap"), "hello hello hello").unwrap();
    for (args, words) in [
        (vec!["replay", "text.mcap"], "not an MCAP file"),
        (vec!["replay", "none.mcap"], "none.mcap"),
        (vec!["replay"], "nothing to replay"),
    ] {
        let output = nesam(&args, here.path());
        assert_eq!(output.status.code(), Some(2), "{}", said(&output));
        assert!(said(&output).contains(words) && !said(&output).contains("panicked"), "{}", said(&output));
    }
}

/// A server that is started again records into the same folder: all of it is replayed, and a diagnosis finds the run that has the session.
#[tokio::test(flavor = "multi_thread")]
async fn service_recordings_of_one_folder_are_read_one_after_the_other() {
    let here = tempfile::tempdir().unwrap();
    for vehicle in ["truck", "other"] {
        let (mut server, address) = serve(here.path(), &[]);
        drive_as(vehicle, &address).await;
        send("-TERM", &server);
        assert_eq!(server.wait().unwrap().code(), Some(0));
    }
    let output = nesam(&["replay", "run", "--json", "out.json"], here.path());
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    let json: Value = serde_json::from_str(&std::fs::read_to_string(here.path().join("out.json")).unwrap()).unwrap();
    assert_eq!((json["schema"].as_str(), json["all_equal"].as_bool()), (Some("nesam.replays/1"), Some(true)));
    let runs = json["runs"].as_array().unwrap();
    let measured: Vec<_> = runs.iter().map(|run| run["kinds"]["measure"]["equal"].as_u64()).collect();
    assert_eq!(measured, [Some(20); 2], "{json}");

    // Two seconds are too few for a diagnosis, of whichever run.
    for (session, words) in
        [("truck", vec!["is diagnosed", "no 4 s"]), ("other", vec!["is diagnosed", "no 4 s"]), ("nobody", vec!["not in it"])]
    {
        let output = nesam(&["diagnose", "--recording", "run", "--session", session], here.path());
        let said = said(&output);
        assert!(output.status.code() == Some(2) && words.iter().all(|word| said.contains(word)), "{session}: {said}");
        let run = runs[usize::from(session == "other")]["run"].as_str().unwrap();
        assert!(session == "nobody" || said.contains(&format!("note: {run} is diagnosed")), "{session}: {said}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_killed_server_leaves_what_it_had_written() {
    let here = tempfile::tempdir().unwrap();
    let (mut server, address) = serve(here.path(), &[]);
    drive(&address).await;
    // What a crash may lose is half a second; wait for three.
    tokio::time::sleep(Duration::from_millis(1500)).await;
    server.kill().unwrap();
    server.wait().unwrap();
    let output = nesam(&["replay", "run", "--json", "out.json"], here.path());
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    assert!(said(&output).contains("was not finished"), "{}", said(&output));
    let json: Value = serde_json::from_str(&std::fs::read_to_string(here.path().join("out.json")).unwrap()).unwrap();
    assert_eq!((json["kinds"]["measure"]["equal"].as_u64(), json["ending"]["kind"].as_str()), (Some(20), Some("cut_off")));
    assert_eq!(json["kinds"]["predict"]["equal"].as_u64(), Some(1));
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_run_in_bf16_replays_in_bf16() {
    let here = tempfile::tempdir().unwrap();
    let checked = nesam(&["serve", "--check", "--bf16"], here.path());
    if checked.status.code() == Some(2) {
        // A processor without the instructions says so before anything is served.
        assert!(said(&checked).contains("workers.bf16") && said(&checked).contains("AVX-512 BF16"), "{}", said(&checked));
        return;
    }
    assert!(said(&checked).contains("path   a"), "{}", said(&checked));
    let (mut server, address) = serve(here.path(), &["--bf16"]);
    drive(&address).await;
    send("-TERM", &server);
    assert_eq!(server.wait().unwrap().code(), Some(0));
    let output = nesam(&["replay", "run", "--json", "out.json"], here.path());
    assert_eq!(output.status.code(), Some(0), "{}", said(&output));
    assert!(said(&output).contains("bf16-"), "{}", said(&output));
    let json: Value = serde_json::from_str(&std::fs::read_to_string(here.path().join("out.json")).unwrap()).unwrap();
    assert_eq!((json["kinds"]["predict"]["equal"].as_u64(), json["total"]["different"].as_u64()), (Some(1), Some(0)));
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_diagnosis_takes_the_bundle_of_the_recording() {
    let here = tempfile::tempdir().unwrap();
    // A bundle that is not shipped: the shipped one under another name.
    let own = here.path().join("own");
    common::copy_folder(bundle("hmmwv-nominal").as_ref(), &own);
    let manifest = std::fs::read_to_string(own.join("manifest.toml")).unwrap();
    std::fs::write(own.join("manifest.toml"), manifest.replace("name = \"hmmwv-nominal\"", "name = \"own\"")).unwrap();
    let (mut server, lines) = common::start_on(here.path(), "own", &["--no-http", "--record", "run"]);
    drive(&format!("http://{}", common::told(&lines, "grpc").expect("an address"))).await;
    send("-TERM", &server);
    assert_eq!(server.wait().unwrap().code(), Some(0));

    // Two seconds are too few for a diagnosis, which is said once the bundle is right.
    let (shipped, other) = (bundle("hmmwv-nominal"), bundle("clearpath-husky"));
    for (given, words) in [
        (None, vec!["was made with bundle own", "not in deploy/bundles", "--bundle DIR"]),
        (Some(other.as_str()), vec!["was trained for `Clearpath Husky", "the recording is of `HMMWV"]),
        (Some(shipped.as_str()), vec!["note: the recording was made with bundle own", "no 4 s"]),
        (Some("own"), vec!["no 4 s"]),
    ] {
        let more = given.map_or(Vec::new(), |dir| vec!["--bundle", dir]);
        let output = nesam(&[&["diagnose", "--recording", "run", "--session", "truck"][..], more.as_slice()].concat(), here.path());
        let said = said(&output);
        assert!(output.status.code() == Some(2) && words.iter().all(|word| said.contains(word)), "{given:?}: {said}");
        assert_eq!(said.contains("note:"), given == Some(shipped.as_str()), "{said}");
    }
}
