//! Goal: signals end a server as whoever sends them expects, and a lack of file descriptors costs no more than the connections that need them. Method: the real
//! binary, `kill` and `prlimit`; exit code 0 says that everything was written.
#![allow(clippy::unwrap_used)]

mod common;

use std::io::{BufRead as _, BufReader, Write as _};
use std::net::{TcpListener, TcpStream};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use common::{BINARY, bundle, start, told};
use nesam_client::Client;

/// Longest time that a server may take to end, on a machine that does much else.
const PATIENCE: Duration = Duration::from_secs(30);

fn send(signal: &str, server: &Child) {
    assert!(Command::new("kill").args([signal, &server.id().to_string()]).status().unwrap().success());
}

/// Sends a signal, every tenth of a second once more where that is asked for; the exit code.
fn end(mut server: Child, signal: &str, again: bool) -> Option<i32> {
    let begun = Instant::now();
    send(signal, &server);
    loop {
        if let Some(status) = server.try_wait().unwrap() {
            return status.code();
        }
        if begun.elapsed() > PATIENCE {
            server.kill().unwrap();
            panic!("{signal} did not end it in {PATIENCE:?}");
        }
        std::thread::sleep(Duration::from_millis(100));
        if again && server.try_wait().unwrap().is_none() {
            send(signal, &server);
        }
    }
}

#[test]
fn service_a_closed_terminal_stops_a_server_in_order() {
    let here = tempfile::tempdir().unwrap();
    for signal in ["-HUP", "-TERM", "-INT"] {
        let (server, _) = start(here.path(), &["--no-http", "--store", "store"]);
        assert_eq!(end(server, signal, false), Some(0), "{signal}");
    }
}

#[test]
fn service_nohup_keeps_a_server_running() {
    let mut server = Command::new("nohup")
        .args([BINARY, "serve", "--bundle", &bundle("hmmwv-nominal"), "--grpc", "127.0.0.1:0", "--no-zenoh", "--no-http"])
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let lines = BufReader::new(server.stdout.take().unwrap()).lines().map(Result::unwrap);
    assert!(lines.take_while(|line| !line.starts_with("ready")).count() > 0);
    send("-HUP", &server);
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(server.try_wait().unwrap(), None);
    assert_eq!(end(server, "-TERM", false), Some(0));
}

#[test]
fn service_a_second_ctrl_c_does_not_wait() {
    let here = tempfile::tempdir().unwrap();
    std::fs::write(here.path().join("nesam.toml"), "[grpc]\ndrain_s = 300.0\n").unwrap();
    let (server, lines) = start(here.path(), &["--no-http", "--config", "nesam.toml"]);
    // A client that begins HTTP/2 with no settings and says no more: a server that stops waits for it to hear so, for as long as keep-alive lets it.
    let mut socket = TcpStream::connect(told(&lines, "grpc").unwrap()).unwrap();
    socket.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\0\0\0\x04\0\0\0\0\0").unwrap();
    std::thread::sleep(Duration::from_millis(300));
    assert_eq!(end(server, "-INT", true), Some(1));
}

#[test]
fn service_a_server_that_is_starting_can_be_stopped() {
    let here = tempfile::tempdir().unwrap();
    // Takes the connection and never answers.
    let etcd = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}", etcd.local_addr().unwrap());
    let server = Command::new(BINARY)
        .args(["serve", "--bundle", &bundle("hmmwv-nominal"), "--grpc", "127.0.0.1:0", "--no-zenoh", "--no-http", "--etcd", &url])
        .current_dir(here.path())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let (_socket, _) = etcd.accept().unwrap();
    assert_eq!(end(server, "-TERM", false), Some(0));
}

/// Time that a process has computed, s, with the 100 ticks in a second that Linux tells it in.
fn computed_s(process: &Child) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{}/stat", process.id())).unwrap();
    let fields: Vec<&str> = stat.rsplit_once(')').unwrap().1.split_whitespace().collect();
    [11, 12].map(|i| fields[i].parse::<f64>().unwrap()).iter().sum::<f64>() / 100.0
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_lack_of_file_descriptors_costs_no_processor() {
    let here = tempfile::tempdir().unwrap();
    std::fs::write(here.path().join("nesam.toml"), "[tls]\nhandshake_s = 60.0\n").unwrap();
    let (server, lines) = start(here.path(), &["--no-http", "--config", "nesam.toml"]);
    let address = told(&lines, "grpc").unwrap();
    let open = std::fs::read_dir(format!("/proc/{}/fd", server.id())).unwrap().count();
    let limit = Command::new("prlimit").args(["--pid", &server.id().to_string(), &format!("--nofile={}:", open + 8)]).status();
    assert!(limit.unwrap().success());
    let sockets: Vec<TcpStream> = (0..64).map(|_| TcpStream::connect(address).unwrap()).collect();
    std::thread::sleep(Duration::from_millis(500));
    let before_s = computed_s(&server);
    std::thread::sleep(Duration::from_secs(2));
    let computed_s = computed_s(&server) - before_s;
    // Trying without a pause takes all of a processor; twenty times a second takes nothing that could be counted.
    assert!(computed_s < 0.2, "{computed_s} s of 2 s");
    drop(sockets);
    let mut client = Client::connect(&format!("http://{address}")).await.unwrap();
    assert!(client.list_sessions().await.unwrap().is_empty(), "connections are taken again");
    drop(client);
    assert_eq!(end(server, "-TERM", false), Some(0));
}
