//! Goal: a client that abuses HTTP/2 harms nobody else. Method: frames by the `h2` crate, which does what a gRPC client never would.

use std::time::{Duration, Instant};

use h2::client::SendRequest;
use nesam_client::{Client, outcome_label};
use prost::bytes::Bytes;

use crate::stage::*;

/// A connection below gRPC, driven in the background.
async fn raw(address: std::net::SocketAddr) -> SendRequest<Bytes> {
    let socket = tokio::net::TcpStream::connect(address).await.unwrap();
    let (client, connection) = h2::client::handshake(socket).await.unwrap();
    tokio::spawn(async move { drop(connection.await) });
    client
}

fn request(method: &str, encoding: &str) -> http::Request<()> {
    let request = http::Request::post(format!("http://localhost/nesam.v1.Sessions/{method}"));
    request.header("content-type", "application/grpc").header("te", "trailers").header("grpc-encoding", encoding).body(()).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn service_rapid_resets_harm_nobody_else() {
    let recorded = recorded();
    let (server, mut client) = start().await;
    open(&mut client, "truck", "").await;
    let mut slowest = Duration::ZERO;
    let mut answered = 0;
    for _ in 0..10 {
        let mut attacker = raw(server.grpc_addr).await;
        for _ in 0..500 {
            let Ok(ready) = attacker.ready().await else { break };
            attacker = ready;
            let Ok((_, mut stream)) = attacker.send_request(request("List", "identity"), false) else { break };
            stream.send_reset(h2::Reason::CANCEL);
        }
        let start = Instant::now();
        client.feed(vec![sample("truck", &recorded.drive, answered)]).await.unwrap();
        (slowest, answered) = (slowest.max(start.elapsed()), answered + 1);
    }
    assert!(slowest < Duration::from_secs(5), "{slowest:?}");
    assert_eq!(client.session("truck").await.unwrap().history_steps, answered as u32);
    server.shutdown().await;
}

/// Goal: connections take no more than their places, and whoever waits for one is served when one ends. Method: two places, three clients.
#[tokio::test(flavor = "multi_thread")]
async fn service_a_connection_waits_for_a_place() {
    let (server, mut first) = start_with(|config| config.grpc.connections_max = 2).await;
    let address = format!("http://{}", server.grpc_addr);
    let connect = || Client::connect(&address);
    let mut second = connect().await.unwrap();
    for client in [&mut first, &mut second] {
        assert!(client.list_sessions().await.unwrap().is_empty());
    }
    let waiting = connect();
    tokio::pin!(waiting);
    let asked = async {
        let mut third = waiting.await.unwrap();
        third.list_sessions().await.unwrap()
    };
    tokio::pin!(asked);
    assert!(tokio::time::timeout(Duration::from_secs(1), &mut asked).await.is_err(), "three at two places");
    assert!(first.list_sessions().await.is_ok() && second.list_sessions().await.is_ok(), "those who have one are served");
    drop(first);
    assert!(tokio::time::timeout(Duration::from_secs(10), asked).await.expect("a place is free").is_empty());
    server.shutdown().await;
}

/// Requests whose head comes and whose message never does, or a byte at a time: they end, although their client answers pings, and a stream may be silent for longer.
#[tokio::test(flavor = "multi_thread")]
async fn service_a_request_that_never_ends_is_ended() {
    let (server, mut client) = start_with(|config| config.grpc.deadline_s = 0.5).await;
    open(&mut client, "truck", "").await;
    let mut silent = client.measure().await.unwrap();
    let mut waiting = Vec::new();
    for drips in [false, true] {
        for _ in 0..20 {
            let attacker = raw(server.grpc_addr).await;
            let (response, mut stream) = attacker.ready().await.unwrap().send_request(request("Get", "identity"), false).unwrap();
            waiting.push(tokio::spawn(async move {
                let begun = Instant::now();
                let dripping = tokio::spawn(async move {
                    for byte in [0, 0, 0, 0, 200].into_iter().chain([7; 200]) {
                        if drips {
                            let _ = stream.send_data(vec![byte].into(), false);
                        }
                        tokio::time::sleep(Duration::from_millis(50)).await;
                    }
                });
                let response = tokio::time::timeout(Duration::from_secs(5), response).await.expect("the server ends it").unwrap();
                dripping.abort();
                (response.headers()["grpc-status"].clone(), begun.elapsed())
            }));
        }
    }
    for waited in waiting {
        let (status, after) = waited.await.unwrap();
        assert_eq!(status, "4", "DEADLINE_EXCEEDED");
        assert!(after >= Duration::from_millis(450), "{after:?}");
    }
    tokio::time::sleep(Duration::from_millis(300)).await;
    let recorded = recorded();
    let answer = silent.exchange(sample("truck", &recorded.drive, 0)).await.unwrap();
    assert_eq!(outcome_label(&answer), "APPLIED");
    server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_compressed_messages_are_refused_unread() {
    let (server, mut client) = start().await;
    // With the headers, and after the refusal.
    for wait in [Duration::ZERO, Duration::from_millis(300)] {
        let attacker = raw(server.grpc_addr).await;
        let (response, mut stream) = attacker.ready().await.unwrap().send_request(request("Open", "gzip"), false).unwrap();
        tokio::time::sleep(wait).await;
        // gRPC's prefix: compressed, and a length that the rest does not have.
        let mut bomb = vec![1, 0, 0, 0, 40];
        bomb.extend([0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 3]);
        bomb.extend([0; 30]);
        // A stream that the server has refused takes nothing more.
        drop(stream.send_data(bomb.into(), true));
        let headers = tokio::time::timeout(Duration::from_secs(10), response).await.unwrap().unwrap();
        let status = headers.headers().get("grpc-status").expect("refused before anything is read");
        assert_eq!(status, "12", "UNIMPLEMENTED");
    }
    assert!(client.list_sessions().await.unwrap().is_empty());
    server.shutdown().await;
}
