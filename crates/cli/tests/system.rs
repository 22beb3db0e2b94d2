//! Goal: signals end a server as whoever sends them expects, and a lack of file descriptors costs no more than the connections that need them. Method: the real
//! binary, `kill` and `prlimit`; exit code 0 says that everything was written. And what its log tells.
#![allow(clippy::unwrap_used)]

mod common;

use std::fs::{File, read_to_string, write};
use std::io::{BufRead as _, BufReader, Write as _};
use std::net::{TcpListener, TcpStream};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use common::{BINARY, bundle, send, start, told};
use nesam_client::{Client, Tls, v1};
use rcgen::{BasicConstraints, CertificateParams, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, SanType};

/// Longest time that a server may take to end, on a machine that does much else.
const PATIENCE: Duration = Duration::from_secs(30);

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
    write(here.path().join("nesam.toml"), "[grpc]\ndrain_s = 300.0\n").unwrap();
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
    let stat = read_to_string(format!("/proc/{}/stat", process.id())).unwrap();
    let fields: Vec<&str> = stat.rsplit_once(')').unwrap().1.split_whitespace().collect();
    [11, 12].map(|i| fields[i].parse::<f64>().unwrap()).iter().sum::<f64>() / 100.0
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_lack_of_file_descriptors_costs_no_processor() {
    let here = tempfile::tempdir().unwrap();
    write(here.path().join("nesam.toml"), "[tls]\nhandshake_s = 60.0\n").unwrap();
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

/// Mutual TLS, with files that are read again soon.
const CONFIG: &str = r#"
[grpc]
listen = "127.0.0.1:0"
[http]
enabled = false
[zenoh]
enabled = false
[tls]
certificate = "server.pem"
key = "server.key"
client_ca = "ca.pem"
fleet = "fleet.toml"
reload_s = 0.2
"#;

/// Goal: the log tells who changed what, and holds no secret, however much of it is asked for. Method: mutual TLS and every line of the log; a session that is opened and closed
/// by one client and refused to another, a key that is replaced by one that cannot be used.
#[tokio::test(flavor = "multi_thread")]
async fn service_the_log_tells_who_changes_what_and_no_secret() {
    let here = tempfile::tempdir().unwrap();
    let at = |name: &str| here.path().join(name);
    let authority_key = KeyPair::generate().unwrap();
    let mut params = CertificateParams::new(vec![]).unwrap();
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    let authority = params.self_signed(&authority_key).unwrap().pem();
    let issuer = Issuer::new(params, authority_key);
    let sign = |name: SanType| {
        let mut params = CertificateParams::new(vec![]).unwrap();
        params.subject_alt_names = vec![name];
        params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth, ExtendedKeyUsagePurpose::ClientAuth];
        let key = KeyPair::generate().unwrap();
        (params.signed_by(&key, &issuer).unwrap().pem(), key.serialize_pem())
    };
    let (server_pem, server_key) = sign(SanType::DnsName("localhost".try_into().unwrap()));
    write(at("server.pem"), &server_pem).unwrap();
    write(at("server.key"), &server_key).unwrap();
    write(at("ca.pem"), &authority).unwrap();
    write(at("fleet.toml"), "[vehicles.truck]\n[vehicles.other]\n").unwrap();
    write(at("nesam.toml"), CONFIG).unwrap();
    let mut server = Command::new(BINARY)
        .args(["serve", "--bundle", &bundle("hmmwv-nominal"), "--config", "nesam.toml"])
        .current_dir(here.path())
        .env("RUST_LOG", "trace")
        .stdout(Stdio::piped())
        .stderr(File::create(at("log")).unwrap())
        .spawn()
        .unwrap();
    let lines = BufReader::new(server.stdout.take().unwrap()).lines().map(Result::unwrap);
    let said: Vec<String> = lines.take_while(|line| !line.starts_with("ready")).collect();
    let address = told(&said, "grpc").unwrap_or_else(|| panic!("{said:?}")).split_whitespace().next().unwrap().to_owned();
    let address = format!("https://localhost:{}", address.rsplit(':').next().unwrap());

    let (truck, other) = (sign(uri("nesam:vehicle:truck")), sign(uri("nesam:vehicle:other")));
    let connect = async |(pem, key): &(String, String)| {
        let identity = Some((pem.clone().into_bytes(), key.clone().into_bytes()));
        let tls = Tls { authority: authority.clone().into_bytes(), identity, server_name: "localhost".into() };
        Client::connect_tls(&address, &tls).await.unwrap()
    };
    let open = || v1::OpenSessionRequest { vehicle_id: "truck".into(), ..Default::default() };
    let mut client = connect(&truck).await;
    client.open_session(open()).await.unwrap();
    connect(&other).await.open_session(open()).await.unwrap_err();
    client.close_session("truck").await.unwrap();
    // A name that would be a line of its own, of somebody else, and longer than any name.
    let forged = format!("x`\n2026-01-01T00:00:00Z  INFO nesam::audit: allowed: forged {}", "z".repeat(50_000));
    client.open_session(v1::OpenSessionRequest { session_id: forged, ..open() }).await.unwrap_err();
    let useless = sign(uri("nesam:vehicle:none")).1;
    write(at("server.key"), &useless).unwrap();

    let logged = |what: &str| {
        let begun = Instant::now();
        loop {
            let log = read_to_string(at("log")).unwrap();
            if let Some(line) = log.lines().find(|line| line.contains("nesam::audit") && line.contains(what)) {
                return line.to_owned();
            }
            assert!(
                begun.elapsed() < PATIENCE,
                "nothing is said of {what}: {}",
                log.lines().filter(|l| l.contains("audit")).collect::<String>()
            );
            std::thread::sleep(Duration::from_millis(50));
        }
    };
    for wish in ["open session `truck` of vehicle `truck`", "change session `truck`"] {
        let line = logged(&format!("allowed: {wish}"));
        assert!(line.contains("vehicle `truck`") && line.contains("127.0.0.1"), "{line}");
    }
    assert!(logged("refused: no right").contains("other"));
    let forged = logged("forged");
    assert!(forged.contains("allowed: open session `x\\u{60}\\n2026") && forged.len() < 500, "{forged}");
    logged("cannot be used");
    server.kill().unwrap();
    server.wait().unwrap();
    let log = read_to_string(at("log")).unwrap();
    assert!(log.lines().count() > 20, "much of it was asked for");
    for secret in [&server_key, &useless, &truck.1, &other.1] {
        for line in secret.lines().filter(|line| !line.starts_with("-----")) {
            assert!(!log.contains(line), "a line of a key is in the log");
        }
    }
}

fn uri(name: &str) -> SanType {
    SanType::URI(name.try_into().unwrap())
}
