//! Goal: no payload stops the service or changes a session. Method: every method of every service in the committed descriptor set, so that a new
//! method cannot be forgotten, is sent random bytes, truncated messages and an oversized one, by a codec that knows no messages.

use std::time::Duration;

use nesam_client::{Client, v1};
use prost::Message as _;
use prost::bytes::{Buf as _, BufMut as _, Bytes};
use tonic::codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder};
use tonic::codegen::http::uri::PathAndQuery;
use tonic::{Code, Status};

use crate::stage::*;

/// Passes bytes through.
#[derive(Clone, Copy, Default)]
struct Raw;

impl Codec for Raw {
    type Encode = Bytes;
    type Decode = Bytes;
    type Encoder = Self;
    type Decoder = Self;

    fn encoder(&mut self) -> Self {
        Self
    }

    fn decoder(&mut self) -> Self {
        Self
    }
}

impl Encoder for Raw {
    type Item = Bytes;
    type Error = Status;

    fn encode(&mut self, item: Bytes, to: &mut EncodeBuf<'_>) -> Result<(), Status> {
        to.put(item);
        Ok(())
    }
}

impl Decoder for Raw {
    type Item = Bytes;
    type Error = Status;

    fn decode(&mut self, from: &mut DecodeBuf<'_>) -> Result<Option<Bytes>, Status> {
        let length = from.remaining();
        Ok(Some(from.copy_to_bytes(length)))
    }
}

/// Sends one payload and reads the first reply; streaming on the wire is the same for all kinds of methods.
async fn send(client: &Client, path: &str, payload: Bytes) -> Result<Option<Bytes>, Status> {
    let mut grpc = tonic::client::Grpc::new(client.channel());
    grpc.ready().await.map_err(|error| Status::unknown(error.to_string()))?;
    let path = PathAndQuery::try_from(path).unwrap();
    let exchange = async {
        let mut replies = grpc.streaming(tonic::Request::new(tokio_stream::once(payload)), path, Raw).await?.into_inner();
        replies.message().await
    };
    tokio::time::timeout(Duration::from_secs(20), exchange).await.expect("an answer")
}

/// `/nesam.v1.Service/Method` of everything that the descriptor set names.
fn methods() -> Vec<String> {
    let set = prost_types::FileDescriptorSet::decode(v1::FILE_DESCRIPTOR_SET).unwrap();
    let services = set.file.iter().flat_map(|file| file.service.iter().map(|service| (file.package(), service)));
    services.flat_map(|(package, s)| s.method.iter().map(move |m| format!("/{package}.{}/{}", s.name(), m.name()))).collect()
}

/// A message that the method would take, and every beginning of which is refused or only reads.
fn valid_message(path: &str, recorded: &Recorded, map: &str) -> Vec<u8> {
    let session_id = || "s".to_string();
    let tile = v1::MapTile { rows: 1, columns: 1, elevation_m: vec![0; 4].into(), ..Default::default() };
    match path.rsplit('/').next().unwrap() {
        // The vehicle has the name of an open session, so that the beginning without `session_id` is refused too.
        "Open" => v1::OpenSessionRequest { vehicle_id: session_id(), session_id: "new".into(), ..Default::default() }.encode_to_vec(),
        "Fork" => v1::ForkSessionRequest { session_id: session_id(), new_session_id: "new".into() }.encode_to_vec(),
        "Export" => v1::ExportSessionRequest { session_id: session_id() }.encode_to_vec(),
        // Complete but empty: exports with content are changed one by one in `moving`.
        "Import" => {
            let checksum = <sha2::Sha256 as sha2::Digest>::digest(b"").to_vec();
            let image = v1::SessionImage { version: 3, checksum: checksum.into(), content: Bytes::new() }.encode_to_vec();
            v1::ImportSessionRequest { image: image.into(), session_id: "new".into() }.encode_to_vec()
        }
        "ApplyEffects" => {
            let parameters = vec![v1::EffectParameter { name: "second".into(), value: 0.01, sd: 0.0 }];
            let effects = vec![v1::Effect { id: "steering_offset".into(), parameters }];
            v1::ApplyEffectsRequest { session_id: session_id(), source: "test".into(), effects }.encode_to_vec()
        }
        "RevertEffects" => v1::RevertEffectsRequest { session_id: session_id() }.encode_to_vec(),
        "WatchAlarms" => v1::WatchAlarmsRequest { session_id: session_id() }.encode_to_vec(),
        // Nothing is recorded here, so that the whole of it is refused too.
        "Start" => v1::StartDiagnosisRequest { session_id: session_id(), from_stamp_ns: Some(-1), ..Default::default() }.encode_to_vec(),
        "Close" => v1::CloseSessionRequest { session_id: session_id() }.encode_to_vec(),
        "Predict" | "PredictStream" => candidates("s", &recorded.drive, 39, 2, 3)
            .starting_at(39 * STEP_NS, vec![(40 * STEP_NS, [1.0, 0.0])])
            .to_message()
            .encode_to_vec(),
        "Stream" => sample("s", &recorded.drive, 40).encode_to_vec(),
        "Map" => v1::FleetSoilRequest { map_id: session_id() }.encode_to_vec(),
        "Watch" => v1::WatchSoilRequest { session_id: session_id() }.encode_to_vec(),
        "UploadMap" => {
            let header = v1::MapHeader { map_id: "m".into(), version: 1, resolution_m: 1.0, width: 2, height: 2, ..Default::default() };
            v1::UploadMapRequest { part: Some(v1::upload_map_request::Part::Header(header)) }.encode_to_vec()
        }
        "PatchTile" => v1::PatchTileRequest { map_id: map.into(), base_version: 1, tile: Some(tile) }.encode_to_vec(),
        "Delete" => v1::DeleteMapRequest { map_id: map.into() }.encode_to_vec(),
        "Get" | "List" => v1::GetSessionRequest { session_id: session_id() }.encode_to_vec(),
        other => panic!("method {other} has no message here; add one"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn service_no_bytes_on_any_method_change_or_stop_anything() {
    let (server, mut client, recorded) = driven("s", 39).await;
    let query = candidates("s", &recorded.drive, 39, 2, 8);
    let before = (client.list_sessions().await.unwrap(), client.list_maps().await.unwrap(), client.predict(query.clone()).await.unwrap());
    let methods = methods();
    assert!(methods.len() >= 14, "{methods:?}");
    let mut refused = 0;
    for path in &methods {
        let valid = valid_message(path, &recorded, recorded.world.id());
        let truncated = (0..valid.len()).map(|length| Bytes::copy_from_slice(&valid[..length]));
        for payload in truncated.chain(garbage(7, 60)) {
            let Err(status) = send(&client, path, payload.clone()).await else { continue };
            let known = [
                Code::Internal, // what tonic says of bytes that are no message
                Code::InvalidArgument,
                Code::NotFound,
                Code::AlreadyExists,
                Code::Aborted,
                Code::FailedPrecondition,
            ];
            assert!(known.contains(&status.code()) && status.message().len() > 10, "{path} {payload:?}: {status:?}");
            assert!(!status.message().contains("bug"), "{path} {payload:?}: {status:?}");
            refused += 1;
        }
        let oversized = send(&client, path, vec![0; 5 << 20].into()).await.unwrap_err();
        assert!(matches!(oversized.code(), Code::OutOfRange | Code::ResourceExhausted), "{path}: {oversized:?}");
        assert!(oversized.message().contains("limit"), "{path}: {oversized:?}");
        assert_eq!(client.list_sessions().await.unwrap(), before.0, "{path}");
        assert_eq!(client.list_maps().await.unwrap(), before.1, "{path}");
    }
    assert!(refused > 20 * methods.len(), "{refused} payloads were refused");
    let after = client.predict(query).await.unwrap();
    assert!(bits(&after.states) == bits(&before.2.states));
    // A method that does not exist is said to be so.
    let unknown = send(&client, "/nesam.v1.Sessions/Explode", Bytes::new()).await.unwrap_err();
    assert_eq!(unknown.code(), Code::Unimplemented);
    server.shutdown().await;
}
