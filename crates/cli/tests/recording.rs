//! Goal: the field engineer's way: record with the real server, stop it gently or kill it, replay what is on the disk. Method: the real binary,
//! sockets, signals; exit codes and words are the contract.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use nesam_client::{Candidates, Client, measurement, v1};
use serde_json::Value;

const BINARY: &str = env!("CARGO_BIN_EXE_nesam");

fn bundle(name: &str) -> String {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/bundles").join(name).display().to_string()
}

fn nesam(args: &[&str], folder: &Path) -> Output {
    Command::new(BINARY).args(args).current_dir(folder).output().unwrap()
}

fn said(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

/// A recording server and the address of its gRPC.
fn serve(folder: &Path) -> (Child, String) {
    let mut server = Command::new(BINARY)
        .args(["serve", "--bundle", &bundle("hmmwv-nominal"), "--record", "run", "--grpc", "127.0.0.1:0", "--no-http", "--no-zenoh"])
        .current_dir(folder)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let lines = BufReader::new(server.stdout.take().unwrap()).lines().map(Result::unwrap);
    let told: Vec<String> = lines.take_while(|l| !l.starts_with("ready")).collect();
    let line =
        |name: &str| told.iter().find_map(|l| l.strip_prefix(name)).unwrap_or_else(|| panic!("no {name} in {told:?}")).trim().to_string();
    assert!(line("record").ends_with(".0001.mcap"), "{told:?}");
    (server, format!("http://{}", line("grpc")))
}

/// A short drive straight on.
async fn drive(address: &str) {
    let mut client = Client::connect(address).await.unwrap();
    client.open_session(v1::OpenSessionRequest { vehicle_id: "truck".into(), ..Default::default() }).await.unwrap();
    let state = |i: i64| [0.2 * i as f64, 0.0, 0.6, 0.0, 0.02, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    let measurements = (0..20).map(|i| measurement("truck", i * 100_000_000, state(i), [2.0, 0.0])).collect();
    assert_eq!(client.feed(measurements).await.unwrap().len(), 20);
    client.predict(Candidates::new("truck", 1, 4, vec![2.0, 0.1, 2.0, 0.1, 2.0, 0.1, 2.0, 0.1])).await.unwrap();
}

fn recording(folder: &Path) -> PathBuf {
    std::fs::read_dir(folder.join("run")).unwrap().next().unwrap().unwrap().path()
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_stopped_server_leaves_a_recording_that_replays() {
    let here = tempfile::tempdir().unwrap();
    let (mut server, address) = serve(here.path());
    drive(&address).await;
    assert!(Command::new("kill").args(["-TERM", &server.id().to_string()]).status().unwrap().success());
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

#[tokio::test(flavor = "multi_thread")]
async fn service_a_killed_server_leaves_what_it_had_written() {
    let here = tempfile::tempdir().unwrap();
    let (mut server, address) = serve(here.path());
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
