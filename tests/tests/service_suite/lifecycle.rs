//! Goal: what operators rely on: health, reflection, metrics, status, clean shutdown, clear refusal to start.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use nesam_client::{Client, v1};
use nesam_server::{Config, serve};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio_stream::StreamExt as _;
use tonic_health::pb::health_check_response::ServingStatus;
use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};
use tonic_reflection::pb::v1::server_reflection_request::MessageRequest;
use tonic_reflection::pb::v1::server_reflection_response::MessageResponse;
use tonic_reflection::pb::v1::{ServerReflectionRequest, server_reflection_client::ServerReflectionClient};
use tonic_reflection::pb::v1alpha;

use crate::stage::*;

/// Status and body of what HTTP answers.
pub async fn http_get(address: SocketAddr, path: &str) -> (u16, String) {
    let mut socket = tokio::net::TcpStream::connect(address).await.unwrap();
    socket.write_all(format!("GET {path} HTTP/1.1\r\nhost: x\r\nconnection: close\r\n\r\n").as_bytes()).await.unwrap();
    let mut text = String::new();
    socket.read_to_string(&mut text).await.unwrap();
    let code = text.split(' ').nth(1).unwrap().parse().unwrap();
    (code, text.split_once("\r\n\r\n").unwrap().1.to_string())
}

async fn health(client: &Client, service: &str) -> ServingStatus {
    let request = HealthCheckRequest { service: service.into() };
    HealthClient::new(client.channel()).check(request).await.unwrap().into_inner().status()
}

/// The services that reflection lists for clients that know v1alpha alone.
async fn reflected_by_v1alpha(client: &Client) -> Vec<String> {
    use v1alpha::server_reflection_request::MessageRequest;
    use v1alpha::server_reflection_response::MessageResponse;
    let message_request = Some(MessageRequest::ListServices(String::new()));
    let list = v1alpha::ServerReflectionRequest { host: String::new(), message_request };
    let mut reflection = v1alpha::server_reflection_client::ServerReflectionClient::new(client.channel());
    let mut replies = reflection.server_reflection_info(tokio_stream::once(list)).await.unwrap().into_inner();
    match replies.next().await.unwrap().unwrap().message_response {
        Some(MessageResponse::ListServicesResponse(list)) => list.service.into_iter().map(|service| service.name).collect(),
        other => panic!("no list of services: {other:?}"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn service_health_reflection_metrics_and_status() {
    let recorded = recorded();
    let (server, mut client) = start().await;
    for name in ["", "nesam.v1.Prediction", "nesam.v1.Measurements", "nesam.v1.Diagnosis"] {
        assert_eq!(health(&client, name).await, ServingStatus::Serving, "{name}");
    }
    let list = ServerReflectionRequest { host: String::new(), message_request: Some(MessageRequest::ListServices(String::new())) };
    let mut replies =
        ServerReflectionClient::new(client.channel()).server_reflection_info(tokio_stream::once(list)).await.unwrap().into_inner();
    let Some(MessageResponse::ListServicesResponse(list)) = replies.next().await.unwrap().unwrap().message_response else {
        panic!("no list of services")
    };
    let older = reflected_by_v1alpha(&client).await;
    for name in ["Sessions", "Prediction", "Measurements", "Terrain", "Soil", "Diagnosis"] {
        let name = format!("nesam.v1.{name}");
        assert!(list.service.iter().any(|s| s.name == name), "{name}");
        assert!(older.contains(&name), "{name} by v1alpha");
    }

    open(&mut client, "s", "").await;
    client.feed(samples("s", &recorded.drive, 9)).await.unwrap();
    client.predict(candidates("s", &recorded.drive, 9, 2, 2)).await.unwrap();
    let _ = client.session("unknown").await;
    let http = server.http_addr.unwrap();
    let (code, metrics) = http_get(http, "/metrics").await;
    assert_eq!(code, 200);
    for line in [
        "nesam_measurements_total{transport=\"grpc\",outcome=\"applied\"} 10",
        "nesam_requests_total{transport=\"grpc\",method=\"stream_measurements\"} 1",
        "nesam_sessions 1",
        "nesam_maps 0",
        "nesam_cluster_sessions 1",
        "nesam_refusals_total{reason=\"handshake\"} 0",
        "nesam_commands_total{command=\"predict\",result=\"ok\"} 1",
        "nesam_commands_total{command=\"get\",result=\"not_found\"} 1",
        "nesam_prediction_compute_seconds_count 1",
        "nesam_waiting_predictions 0",
    ] {
        assert!(metrics.lines().any(|l| l == line), "{line} is not in\n{metrics}");
    }
    let (code, status) = http_get(http, "/status").await;
    let status: serde_json::Value = serde_json::from_str(&status).unwrap();
    assert_eq!((code, status["schema"].as_str()), (200, Some("nesam.status/1")));
    assert_eq!(status["sessions"][0]["history_steps"], 10);
    assert_eq!(status["bundle"]["hash"].as_str(), Some(predictor().bundle().hash.as_str()));
    assert_eq!(http_get(http, "/health").await.0, 200);
    assert_eq!(http_get(http, "/nothing").await.0, 404);
    server.shutdown().await;
}

/// A proxy asks for health where it must not read positions.
#[tokio::test(flavor = "multi_thread")]
async fn service_health_has_an_address_of_its_own() {
    let mut config = Config::ephemeral();
    config.http.health = "127.0.0.1:0".into();
    let server = serve(config, predictor()).await.unwrap();
    let address = server.health_addr.unwrap();
    assert_ne!(Some(address), server.http_addr);
    assert_eq!(http_get(address, "/health").await.0, 200);
    for closed in ["/", "/status", "/metrics", "/live"] {
        assert_eq!(http_get(address, closed).await.0, 404, "{closed}");
    }
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_shutdown_ends_streams_and_frees_the_ports() {
    let recorded = recorded();
    let (server, mut client) = start().await;
    let (grpc, http) = (server.grpc_addr, server.http_addr.unwrap());
    open(&mut client, "s", "").await;
    let mut stream = client.measure().await.unwrap();
    stream.exchange(sample("s", &recorded.drive, 0)).await.unwrap();
    let mut watch = client.watch_soil("s").await.unwrap();
    let first = watch.message().await.unwrap().unwrap();
    assert_eq!((first.soil_epoch, first.correction.unwrap().delta), (0, Some(v1::SoilVector::default())));
    // Streams of the standard services, which their clients leave open.
    let mut health = HealthClient::new(client.channel()).watch(HealthCheckRequest::default()).await.unwrap().into_inner();
    assert_eq!(health.message().await.unwrap().unwrap().status(), ServingStatus::Serving);
    let asked = tokio_stream::pending::<ServerReflectionRequest>();
    let mut reflection = ServerReflectionClient::new(client.channel()).server_reflection_info(asked).await.unwrap().into_inner();
    let started = Instant::now();
    server.shutdown().await;
    assert!(started.elapsed() < Duration::from_secs(4), "shutdown took {:?}", started.elapsed());
    assert_eq!(stream.answer().await.unwrap_err().code(), Some(tonic::Code::Unavailable));
    assert_eq!(watch.message().await.unwrap_err().code(), tonic::Code::Unavailable);
    assert_eq!(health.message().await.unwrap().unwrap().status(), ServingStatus::NotServing);
    assert_eq!(health.message().await.unwrap_err().code(), tonic::Code::Unavailable);
    assert_eq!(reflection.message().await.unwrap_err().code(), tonic::Code::Unavailable);
    // Both ports can be taken again at once.
    let mut config = Config::ephemeral();
    (config.grpc.listen, config.http.listen) = (grpc, http);
    serve(config, predictor()).await.unwrap().shutdown().await;
}

/// Goal: a stop waits for what is asked and not answered, and for the drain time once. Method: half a request of HTTP, first alone, which asks nothing yet, then with a request
/// of gRPC whose message never comes.
#[tokio::test(flavor = "multi_thread")]
async fn service_a_stop_waits_for_requests_as_long_as_its_drain_time() {
    let drain = Duration::from_secs(3);
    for with_grpc in [false, true] {
        let (server, _client) = start_with(|config| config.grpc.drain_s = drain.as_secs_f64()).await;
        let http = server.http_addr.unwrap();
        let mut page = tokio::net::TcpStream::connect(http).await.unwrap();
        page.write_all(b"GET /health HTTP/1.1\r\n").await.unwrap();
        let socket = tokio::net::TcpStream::connect(server.grpc_addr).await.unwrap();
        let (caller, connection) = h2::client::handshake(socket).await.unwrap();
        tokio::spawn(async move { drop(connection.await) });
        let request = http::Request::post("http://localhost/nesam.v1.Sessions/List");
        let request = request.header("content-type", "application/grpc").header("te", "trailers").body(()).unwrap();
        // Headers whose message never comes.
        let mut caller = caller.ready().await.unwrap();
        let _half = with_grpc.then(|| caller.send_request(request, false).unwrap());
        // Both are read.
        tokio::time::sleep(Duration::from_millis(500)).await;
        let started = Instant::now();
        server.shutdown().await;
        let took = started.elapsed();
        let expected = if with_grpc { drain..drain * 9 / 5 } else { Duration::ZERO..drain / 2 };
        assert!(expected.contains(&took), "with half a request of gRPC: {with_grpc}; {took:?}");
    }
}

/// Without TLS; `service_strangers_do_not_get_in` has it with TLS.
#[tokio::test(flavor = "multi_thread")]
async fn service_connections_that_say_nothing_are_closed() {
    let (server, _client) = start_with(|config| (config.tls.handshake_s, config.http.health) = (1.0, "127.0.0.1:0".into())).await;
    let http = [("http.listen", server.http_addr.unwrap()), ("http.health", server.health_addr.unwrap())];
    let mut open = Vec::new();
    for (what, address) in [("grpc", server.grpc_addr)].into_iter().chain(http) {
        let half: &[u8] = if what == "grpc" { b"PRI * HTTP/2.0\r\n" } else { b"GET /health HTTP/1.1\r\nhost: x\r\n" };
        for said in [&half[..0], half] {
            let mut socket = tokio::net::TcpStream::connect(address).await.unwrap();
            socket.write_all(said).await.unwrap();
            open.push((what, said.len(), socket));
        }
    }
    for (what, said, mut socket) in open {
        let mut rest = Vec::new();
        let closed = tokio::time::timeout(Duration::from_secs(20), socket.read_to_end(&mut rest)).await;
        assert!(closed.is_ok(), "{what}: still open after {said} bytes");
    }
    for (what, address) in http {
        assert_eq!(http_get(address, "/health").await.0, 200, "{what}");
    }
    server.shutdown().await;

    // They hold up no stop either.
    let change = |config: &mut Config| (config.tls.handshake_s, config.grpc.drain_s) = (300.0, 300.0);
    let (server, _client) = start_with(change).await;
    let _silent = tokio::net::TcpStream::connect(server.grpc_addr).await.unwrap();
    let mut half = tokio::net::TcpStream::connect(server.http_addr.unwrap()).await.unwrap();
    half.write_all(b"GET /status HTTP/1.1\r\n").await.unwrap();
    assert_eq!(http_get(server.http_addr.unwrap(), "/health").await.0, 200);
    // It is taken before the one after it, which answers.
    let mut later = Client::connect(&format!("http://{}", server.grpc_addr)).await.unwrap();
    later.list_sessions().await.unwrap();
    tokio::time::timeout(Duration::from_secs(60), server.shutdown()).await.expect("it waits for nobody who has said nothing");
}

#[tokio::test(flavor = "multi_thread")]
async fn service_closing_a_session_ends_its_soil_watch() {
    let (server, mut client) = start().await;
    open(&mut client, "s", "").await;
    let mut watch = client.watch_soil("s").await.unwrap();
    watch.message().await.unwrap().unwrap();
    client.close_session("s").await.unwrap();
    assert!(watch.message().await.unwrap().is_none());
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_taken_port_is_a_clear_error() {
    let (server, _client) = start().await;
    for (key, grpc, http) in [("grpc.listen", server.grpc_addr, None), ("http.listen", "127.0.0.1:0".parse().unwrap(), server.http_addr)] {
        let mut config = Config::ephemeral();
        config.grpc.listen = grpc;
        config.http.listen = http.unwrap_or(config.http.listen);
        let message = serve(config, predictor()).await.unwrap_err().to_string();
        assert!(message.contains(key) && message.contains("127.0.0.1"), "{message}");
    }
    let mut config = Config::ephemeral();
    (config.zenoh.enabled, config.zenoh.listen) = (true, vec!["nonsense".into()]);
    let message = serve(config, predictor()).await.unwrap_err().to_string();
    assert!(message.contains("zenoh.listen"), "{message}");
    server.shutdown().await;
}
