//! Goal: who may do nothing gets nothing, is told so by a typed status, and leaves no trace; the service goes on. Method: a server with mutual TLS, an
//! authority and certificates made here, one client for each kind of stranger.

use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

use nesam_client::{Client, ClientError, Tls, outcome_label, v1};
use nesam_server::{Config, access, serve};
use prost::Message as _;
use prost::bytes::Bytes;
use rcgen::SanType;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tonic::Code;

use crate::authority::{Authority, dns, secured, uri, written};
use crate::lifecycle::http_get;
use crate::stage::*;

fn open_request(vehicle: &str, session: &str) -> v1::OpenSessionRequest {
    v1::OpenSessionRequest { vehicle_id: vehicle.into(), session_id: session.into(), ..Default::default() }
}

fn offset() -> Vec<v1::Effect> {
    let parameters = vec![v1::EffectParameter { name: "second".into(), value: 0.02, sd: 0.0 }];
    vec![v1::Effect { id: "steering_offset".into(), parameters }]
}

fn diagnosis(session: &str) -> v1::StartDiagnosisRequest {
    v1::StartDiagnosisRequest { session_id: session.into(), ..Default::default() }
}

/// Asserts PERMISSION_DENIED with the name of whoever asked.
fn denied<T: core::fmt::Debug>(what: &str, result: Result<T, ClientError>, who: &str) {
    let error = result.expect_err(what);
    assert_eq!(error.code(), Some(Code::PermissionDenied), "{what}: {error}");
    assert!(error.to_string().contains(who), "{what}: {error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn service_each_client_reaches_its_own_vehicles_only() {
    let recorded = recorded();
    let stage = secured().await;
    let (mut truck, mut other) = (stage.client("nesam:vehicle:truck").await, stage.client("nesam:vehicle:other").await);
    let (mut planner, mut operator) = (stage.client("nesam:planner:mission").await, stage.client("nesam:operator:control").await);

    // Everybody does what it is there for.
    operator.upload_map(&layers(&recorded.world)).await.unwrap();
    let with_map = v1::OpenSessionRequest { map_id: recorded.world.id().into(), ..open_request("truck", "") };
    truck.open_session(with_map).await.unwrap();
    let fed = truck.feed(samples("truck", &recorded.drive, 40)).await.unwrap();
    assert!(fed.iter().all(|answer| outcome_label(answer) == "APPLIED"));
    other.open_session(open_request("other", "")).await.unwrap();
    other.feed(samples("other", &recorded.drive, 9)).await.unwrap();
    let query = candidates("truck", &recorded.drive, 40, 2, 8);
    let predicted = planner.predict(query.clone()).await.unwrap();
    assert!(bits(&predicted.states) == bits(&truck.predict(query.clone()).await.unwrap().states));
    assert_eq!(operator.list_sessions().await.unwrap().len(), 2);
    let before = operator.list_sessions().await.unwrap();

    // A vehicle that says it is another one, or asks for what is another one's.
    for client in [&mut other, &mut planner] {
        let who = if client.session("other").await.is_ok() { "vehicle `other`" } else { "planner `mission`" };
        denied("open", client.open_session(open_request("truck", "spare")).await, who);
        denied("close", client.close_session("truck").await, who);
        denied("fork", client.fork_session("truck", "copy").await, who);
        denied("import", client.import_session(operator.export_session("truck").await.unwrap(), "copy").await, who);
        denied("effects", client.apply_effects("truck", "", offset()).await, who);
        denied("revert", client.revert_effects("truck").await, who);
        denied("diagnose", client.diagnose(diagnosis("truck")).await, who);
        denied("map", client.upload_map(&layers(&recorded.world)).await, who);
        denied("delete", client.delete_map(recorded.world.id()).await, who);
        let answers = client.feed(samples("truck", &recorded.drive, 3)).await.unwrap();
        for answer in answers {
            let Some(v1::measurement_answer::Outcome::Rejected(rejected)) = answer.outcome else { panic!("{answer:?}") };
            assert_eq!((rejected.code, rejected.field.as_str()), (Code::PermissionDenied.into(), "session_id"));
        }
    }
    denied("its own effects", truck.apply_effects("truck", "", offset()).await, "vehicle `truck`");
    denied("its own diagnosis", truck.diagnose(diagnosis("truck")).await, "vehicle `truck`");
    denied("a diagnosis of nobody", other.diagnose(diagnosis("nobody")).await, "vehicle `other`");
    denied("alarms", other.watch_alarms("truck").await, "vehicle `other`");
    denied("get", other.session("truck").await, "vehicle `other`");
    denied("export", other.export_session("truck").await, "vehicle `other`");
    denied("predict", other.predict(query.clone()).await, "vehicle `other`");
    denied("watch", other.watch_soil("truck").await, "vehicle `other`");
    denied("a planner without this vehicle", planner.session("other").await, "planner `mission`");
    denied("another's name", truck.open_session(open_request("truck", "other")).await, "vehicle `truck`");
    let replies = other.predict_stream(vec![query.to_message(), candidates("other", &recorded.drive, 9, 1, 2).to_message()]).await.unwrap();
    let codes: Vec<i32> = replies.iter().map(|r| matches!(&r.outcome, Some(v1::predict_stream_reply::Outcome::Reply(_))).into()).collect();
    assert_eq!(codes, [0, 1], "one request is refused, the stream goes on");
    assert_refused("not there", other.session("nobody").await, Code::NotFound, "session_id");
    let seen = |sessions: Vec<v1::Session>| sessions.into_iter().map(|s| s.session_id).collect::<Vec<_>>();
    assert_eq!(seen(other.list_sessions().await.unwrap()), ["other"]);
    assert_eq!(seen(planner.list_sessions().await.unwrap()), ["truck"]);
    assert_eq!(operator.list_sessions().await.unwrap(), before, "nothing of that has left a trace");

    // A replayed measurement changes nothing either.
    assert_eq!(outcome_label(&truck.feed(vec![sample("truck", &recorded.drive, 40)]).await.unwrap()[0]), "DUPLICATE");

    // An operator may diagnose, if only something were recorded.
    assert_refused("no recording", operator.diagnose(diagnosis("truck")).await, Code::FailedPrecondition, "recording");

    // What a vehicle is taken to be is for operators.
    assert_eq!(operator.apply_effects("truck", "", offset()).await.unwrap().effects, offset());
    stage.server.shutdown().await;
}

/// An image with other effects and another word on where they come from, and a checksum that fits: what whoever has an image can write.
fn rewritten(image: &[u8], effects: Vec<v1::Effect>, source: &str) -> Vec<u8> {
    let outer = v1::SessionImage::decode(image).unwrap();
    let content = v1::SessionContent::decode(outer.content.clone()).unwrap();
    let content = v1::SessionContent { effects, effects_source: source.into(), ..content }.encode_to_vec();
    let checksum = <sha2::Sha256 as sha2::Digest>::digest(&content).to_vec();
    v1::SessionImage { checksum: checksum.into(), content: content.into(), ..outer }.encode_to_vec()
}

/// Goal: whoever may not put effects on a session does not bring them in with an image. Method: images with effects of an operator, with effects and with a
/// source that were written into them; what a vehicle may do all the same is written down in docs/security.md.
#[tokio::test(flavor = "multi_thread")]
async fn service_an_image_brings_effects_for_operators_alone() {
    let recorded = recorded();
    let stage = secured().await;
    let (mut truck, mut operator) = (stage.client("nesam:vehicle:truck").await, stage.client("nesam:operator:control").await);
    truck.open_session(open_request("truck", "")).await.unwrap();
    truck.feed(samples("truck", &recorded.drive, 40)).await.unwrap();
    let bare = truck.export_session("truck").await.unwrap();
    operator.apply_effects("truck", "a report", offset()).await.unwrap();
    let applied = truck.export_session("truck").await.unwrap();
    let before = operator.list_sessions().await.unwrap();
    for (what, image) in [
        ("an operator's effects", applied.clone()),
        ("an operator's effects under another source", rewritten(&applied, offset(), "a better report")),
        ("effects of its own", rewritten(&bare, offset(), "")),
        ("a source alone", rewritten(&bare, Vec::new(), "a report")),
    ] {
        let refused = truck.import_session(image, "copy").await;
        assert!(refused.as_ref().is_err_and(|error| error.to_string().contains("effects")), "{what}: {refused:?}");
        denied(what, refused, "vehicle `truck`");
    }
    assert_eq!(operator.list_sessions().await.unwrap(), before, "nothing of that has left a trace");

    // An image without effects is its own business, also one that they were taken out of.
    for (name, image) in [("bare", bare.clone()), ("stripped", rewritten(&applied, Vec::new(), ""))] {
        let session = truck.import_session(image, name).await.unwrap();
        assert_eq!((session.effects, session.effects_source.as_str()), (Vec::new(), ""), "{name}");
    }
    let copy = operator.import_session(applied, "copy").await.unwrap();
    assert_eq!((copy.effects, copy.effects_source.as_str()), (offset(), "a report"));
    stage.server.shutdown().await;
}

/// Lists the sessions over a client's connection as a proxy would, with these words in place of the client's certificate.
async fn list_for(client: &Client, words: &[&str]) -> Result<Vec<String>, tonic::Status> {
    let mut request = tonic::Request::new(v1::ListSessionsRequest {});
    for word in words {
        request.metadata_mut().append("x-nesam-identity", word.parse().unwrap());
    }
    let listed = v1::sessions_client::SessionsClient::new(client.channel()).list(request).await?;
    Ok(listed.into_inner().sessions.into_iter().map(|session| session.session_id).collect())
}

#[tokio::test(flavor = "multi_thread")]
async fn service_a_proxy_is_believed_for_whom_it_calls_and_nobody_else_is() {
    let stage = secured().await;
    let (mut truck, mut other) = (stage.client("nesam:vehicle:truck").await, stage.client("nesam:vehicle:other").await);
    truck.open_session(open_request("truck", "")).await.unwrap();
    other.open_session(open_request("other", "")).await.unwrap();
    let proxy = stage.client("nesam:proxy:front").await;
    assert_eq!(list_for(&proxy, &["nesam:vehicle:truck"]).await.unwrap(), ["truck"]);
    assert_eq!(list_for(&proxy, &["nesam:operator:control"]).await.unwrap(), ["other", "truck"]);
    for (words, code) in [
        (&[][..], Code::Unauthenticated),
        (&["nesam:vehicle:truck", "nesam:operator:control"], Code::Unauthenticated),
        (&["truck"], Code::Unauthenticated),
        (&["nesam:proxy:front"], Code::Unauthenticated),
        (&["nesam:vehicle:sold"], Code::PermissionDenied),
    ] {
        assert_eq!(list_for(&proxy, words).await.unwrap_err().code(), code, "{words:?}");
    }
    // Of anybody else the words mean nothing, and a proxy that is not in the fleet file is nobody.
    assert_eq!(list_for(&other, &["nesam:operator:control"]).await.unwrap(), ["other"]);
    let unknown = stage.client("nesam:proxy:back").await;
    assert_eq!(list_for(&unknown, &["nesam:operator:control"]).await.unwrap_err().code(), Code::PermissionDenied);
    stage.server.shutdown().await;
}

/// How many refusals of a reason `/metrics` tells.
async fn refusals(http: SocketAddr, reason: &str) -> u64 {
    let (_, metrics) = http_get(http, "/metrics").await;
    let line = format!("nesam_refusals_total{{reason=\"{reason}\"}} ");
    metrics.lines().find_map(|told| told.strip_prefix(&line)).unwrap().parse().unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn service_strangers_do_not_get_in() {
    let recorded = recorded();
    let stage = secured().await;
    let mut truck = stage.client("nesam:vehicle:truck").await;
    truck.open_session(open_request("truck", "")).await.unwrap();

    // With a certificate of the right authority that says nothing, too much or somebody who is not in the fleet file.
    let names: [(&str, Vec<SanType>, Code); 4] = [
        ("nobody", vec![dns("truck")], Code::Unauthenticated),
        ("two", vec![uri("nesam:vehicle:truck"), uri("nesam:operator:control")], Code::Unauthenticated),
        ("a king", vec![uri("nesam:king:control")], Code::Unauthenticated),
        ("revoked", vec![uri("nesam:vehicle:sold")], Code::PermissionDenied),
    ];
    for (what, names, code) in names {
        let mut client = stage.connect(Some(stage.authority.sign(&names, false))).await.unwrap();
        let error = client.list_sessions().await.expect_err(what);
        assert_eq!(error.code(), Some(code), "{what}: {error}");
    }
    // With none, an expired one, one of another authority, and without TLS: the handshake fails.
    let stranger = Authority::new();
    let operator = [uri("nesam:operator:control")];
    for (what, identity) in
        [("none", None), ("expired", Some(stage.authority.sign(&operator, true))), ("foreign", Some(stranger.sign(&operator, false)))]
    {
        let refused = match stage.connect(identity).await {
            Ok(mut client) => client.list_sessions().await.map(|_| ()),
            Err(error) => Err(error),
        };
        assert!(refused.is_err(), "{what}");
    }
    let refused = match Client::connect(&format!("http://{}", stage.server.grpc_addr)).await {
        Ok(mut client) => client.list_sessions().await.map(|_| ()),
        Err(error) => Err(error),
    };
    assert!(refused.is_err(), "without TLS");
    // A client that trusts another authority does not talk to this server.
    let tls = Tls { authority: stranger.pem.into_bytes(), identity: None, server_name: "localhost".into() };
    assert!(Client::connect_tls(&format!("https://{}", stage.server.grpc_addr), &tls).await.is_err());

    // Connections that say nothing, or nonsense, are closed; many of them keep nobody out.
    let mut silent = Vec::new();
    for i in 0..64 {
        let mut socket = tokio::net::TcpStream::connect(stage.server.grpc_addr).await.unwrap();
        if i % 2 == 1 {
            socket.write_all(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n").await.unwrap();
        }
        silent.push(socket);
    }
    assert_eq!(truck.feed(samples("truck", &recorded.drive, 9)).await.unwrap().len(), 10);
    for mut socket in silent {
        let mut rest = Vec::new();
        let closed = tokio::time::timeout(Duration::from_secs(5), socket.read_to_end(&mut rest)).await;
        assert!(closed.is_ok(), "a silent connection is closed after tls.handshake_s");
    }
    // Three with the wrong certificate, one without TLS, one that trusts another authority, 64 that were silent or talked nonsense; and four that are nobody.
    let http = stage.server.http_addr.unwrap();
    eventually(Duration::from_secs(5), "handshakes that failed are counted", async || refusals(http, "handshake").await >= 69).await;
    assert_eq!((refusals(http, "identity").await, refusals(http, "right").await), (4, 0));
    // Oversize and malformed messages of somebody who may ask.
    let huge = v1::OpenSessionRequest { vehicle_id: "x".repeat(1 << 20), ..Default::default() };
    let error = truck.open_session(huge).await.unwrap_err();
    assert_eq!(error.code(), Some(Code::OutOfRange), "{error}");
    let image: Bytes = garbage(5, 1).remove(0);
    assert_refused("an image of garbage", truck.import_session(image.to_vec(), "x").await, Code::InvalidArgument, "image");
    assert_eq!(truck.session("truck").await.unwrap().history_steps, 10);
    stage.server.shutdown().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn service_bad_security_files_are_told_at_the_start() {
    let files = tempfile::tempdir().unwrap();
    let authority = Authority::new();
    let (certificate, key) = authority.sign(&[dns("localhost")], false);
    let write = |name: &str, bytes: &[u8]| drop(written(files.path(), name, bytes));
    write("server.pem", &certificate);
    write("server.key", &key);
    write("other.key", &authority.sign(&[dns("localhost")], false).1);
    for (name, names, expired) in [("expired", [dns("localhost")], true), ("vehicle", [uri("nesam:vehicle:truck")], false)] {
        let (certificate, key) = authority.sign(&names, expired);
        write(&format!("{name}.pem"), &certificate);
        write(&format!("{name}.key"), &key);
    }
    write("ca.pem", authority.pem.as_bytes());
    write("foreign.pem", Authority::new().pem.as_bytes());
    write("fleet.toml", crate::authority::FLEET.as_bytes());
    write("text", b"not PEM");
    write("king.toml", b"kings = [\"ghost\"]");
    let at = |name: &str| if name.is_empty() { Default::default() } else { files.path().join(name) };
    let started = |certificate: &str, key: &str, client_ca: &str, fleet: &str| {
        let mut config = Config::ephemeral();
        (config.tls.certificate, config.tls.key) = (at(certificate), at(key));
        (config.tls.client_ca, config.tls.fleet) = (at(client_ca), at(fleet));
        serve(config, predictor())
    };
    for (files, part) in [
        (["absent", "server.key", "", ""], "tls.certificate"),
        (["server.pem", "absent", "", ""], "tls.key"),
        (["server.pem", "", "", ""], "tls.key"),
        (["text", "server.key", "", ""], "tls"),
        (["server.pem", "text", "", ""], "tls"),
        (["server.pem", "other.key", "", ""], "does not belong"),
        (["expired.pem", "expired.key", "", ""], "days ago"),
        (["vehicle.pem", "vehicle.key", "", ""], "vehicle `truck`, not of a server"),
        (["server.pem", "server.key", "ca.pem", ""], "tls.fleet"),
        (["server.pem", "server.key", "ca.pem", "king.toml"], "kings"),
        (["server.pem", "server.key", "ca.pem", "absent"], "tls.fleet"),
        (["server.pem", "server.key", "text", "fleet.toml"], "tls"),
    ] {
        let [certificate, key, client_ca, fleet] = files;
        let message = started(certificate, key, client_ca, fleet).await.expect_err(part).to_string();
        assert!(message.contains(part), "{files:?}: {message}");
        assert!(!message.contains("BEGIN") && !message.contains("not PEM"), "no content of a file: {message}");
    }
    // A certificate of another authority than the clients' may be meant so.
    for (client_ca, doubts) in [("ca.pem", 0), ("foreign.pem", 1)] {
        let mut config = Config::ephemeral();
        (config.tls.certificate, config.tls.key) = (at("server.pem"), at("server.key"));
        (config.tls.client_ca, config.tls.fleet) = (at(client_ca), at("fleet.toml"));
        let (credentials, _) = access::load(&config.tls).unwrap();
        assert_eq!(credentials.unwrap().doubts().len(), doubts, "{client_ca}");
    }
    // TLS without client certificates: the way is private, everybody may do everything.
    let server = started("server.pem", "server.key", "", "").await.unwrap();
    let tls = Tls { authority: authority.pem.into_bytes(), identity: None, server_name: "localhost".into() };
    let mut client = Client::connect_tls(&format!("https://{}", server.grpc_addr), &tls).await.unwrap();
    client.open_session(open_request("truck", "")).await.unwrap();
    server.shutdown().await;
    let unreadable = Tls::from_files(Path::new("/nowhere/ca.pem"), None).unwrap_err().to_string();
    assert!(unreadable.contains("/nowhere/ca.pem"), "{unreadable}");
}
