//! Goal: a proxy in front of several servers can keep the calls of a vehicle together. Method: a listener in the place of the proxy, which looks at headers.

use nesam_client::{Client, v1};
use tonic::Code;

use crate::stage::*;

/// Answers every call with UNIMPLEMENTED and tells path and `x-vehicle-id` of each.
async fn listener() -> (std::net::SocketAddr, tokio::sync::mpsc::UnboundedReceiver<(String, Option<String>)>) {
    let socket = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = socket.local_addr().unwrap();
    let (tell, told) = tokio::sync::mpsc::unbounded_channel();
    tokio::spawn(async move {
        while let Ok((stream, _)) = socket.accept().await {
            let tell = tell.clone();
            tokio::spawn(async move {
                let mut connection = h2::server::handshake(stream).await.unwrap();
                while let Some(Ok((request, mut respond))) = connection.accept().await {
                    let vehicle = request.headers().get("x-vehicle-id").map(|value| value.to_str().unwrap().to_string());
                    tell.send((request.uri().path().to_string(), vehicle)).unwrap();
                    let response = http::Response::builder().header("content-type", "application/grpc").header("grpc-status", "12");
                    respond.send_response(response.body(()).unwrap(), true).unwrap();
                }
            });
        }
    });
    (address, told)
}

#[tokio::test]
async fn service_every_call_names_its_vehicle() {
    let (address, mut told) = listener().await;
    let plain = Client::connect(&format!("http://{address}")).await.unwrap();
    let mut client = plain.clone().for_vehicle("truck-7").unwrap();
    let mut calls = Vec::new();
    macro_rules! call {
        ($call:expr) => {{
            let error = $call.await.err().expect("nobody answers here");
            assert!(matches!(error, nesam_client::ClientError::Refused { code: Code::Unimplemented, .. }), "{error}");
            let (path, vehicle) = told.recv().await.unwrap();
            assert_eq!(vehicle.as_deref(), Some("truck-7"), "{path}");
            calls.push(path);
        }};
    }
    call!(client.open_session(v1::OpenSessionRequest::default()));
    call!(client.predict(nesam_client::Candidates::new("s", 1, 1, vec![0.0, 0.0])));
    call!(client.list_maps());
    call!(client.feed(vec![]));
    call!(client.watch_alarms("s"));
    call!(client.diagnose(v1::StartDiagnosisRequest::default()));
    assert_eq!(calls.len(), 6);
    assert!(plain.clone().list_sessions().await.is_err());
    assert_eq!(told.recv().await.unwrap(), ("/nesam.v1.Sessions/List".to_string(), None));
    assert_refused("a line break", plain.for_vehicle("a\nb").map(drop), Code::InvalidArgument, "vehicle_id");
}
