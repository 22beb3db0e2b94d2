//! Goal: the stand-in for etcd is like etcd. Method: the same transactions, leases and watches, drawn from a seed, at both; every answer compared.
//! Needs `etcd` on the path (Debian: etcd-server) and says so where it is not.

use std::process::{Child, Command, Stdio};
use std::time::Duration;

use nesam_proto::etcd as pb;
use pb::kv_client::KvClient;
use pb::lease_client::LeaseClient;
use pb::watch_client::WatchClient;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use tokio_stream::StreamExt as _;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::transport::{Channel, Endpoint};

use super::etcd::Etcd;

const TRANSACTIONS: usize = 400;
const KEYS: [&str; 6] = ["a/1", "a/2", "a/3", "b/1", "b/2", "c"];
/// Long enough that none ends by itself.
const LEASE_S: i64 = 600;

/// Ends with the test.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

async fn free_port() -> u16 {
    tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap().local_addr().unwrap().port()
}

/// etcd itself, if it is installed.
async fn real(folder: &std::path::Path) -> Option<(Running, Channel)> {
    let (clients, peers) = (format!("http://127.0.0.1:{}", free_port().await), format!("http://127.0.0.1:{}", free_port().await));
    let started = Command::new("etcd")
        .args(["--name", "one", "--log-level", "error", "--data-dir"])
        .arg(folder)
        .args(["--listen-client-urls", &clients, "--advertise-client-urls", &clients, "--listen-peer-urls", &peers])
        .args(["--initial-advertise-peer-urls", &peers, "--initial-cluster", &format!("one={peers}")])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn();
    let running = Running(started.ok()?);
    let endpoint = Endpoint::from_shared(clients).unwrap();
    for _ in 0..200 {
        if let Ok(channel) = endpoint.connect().await
            && KvClient::new(channel.clone()).txn(pb::TxnRequest::default()).await.is_ok()
        {
            return Some((running, channel));
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    panic!("etcd is installed and does not answer within 10 s");
}

async fn stand_in() -> Channel {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = format!("http://{}", listener.local_addr().unwrap());
    tokio::spawn(Etcd::default().router().serve_with_incoming(TcpListenerStream::new(listener)));
    Endpoint::from_shared(address).unwrap().connect().await.unwrap()
}

/// A key, or a range of them.
fn drawn(rng: &mut ChaCha8Rng) -> (prost::bytes::Bytes, prost::bytes::Bytes) {
    match rng.random_range(0..4) {
        0 => ("a/".into(), "a0".into()),
        1 => ("b/1".into(), "c".into()),
        _ => (KEYS[rng.random_range(0..KEYS.len())].into(), "".into()),
    }
}

fn operation(rng: &mut ChaCha8Rng, leases: &[i64]) -> pb::RequestOp {
    use pb::request_op::Request;
    let (key, range_end) = drawn(rng);
    let request = match rng.random_range(0..4) {
        0 => Request::RequestRange(pb::RangeRequest { key, range_end, keys_only: rng.random() }),
        1 => Request::RequestDeleteRange(pb::DeleteRangeRequest { key, range_end }),
        _ => {
            let lease = if rng.random() { 0 } else { leases[rng.random_range(0..leases.len())] };
            let value = format!("{}", rng.random_range(0..100)).into();
            Request::RequestPut(pb::PutRequest { key: KEYS[rng.random_range(0..KEYS.len())].into(), value, lease })
        }
    };
    pb::RequestOp { request: Some(request) }
}

fn condition(rng: &mut ChaCha8Rng, revision: i64) -> pb::Compare {
    use pb::compare::{CompareResult, CompareTarget, TargetUnion};
    // Often one that may hold.
    let asked = if rng.random() { 0 } else { (revision - rng.random_range(0..6)).max(1) };
    let (target, union) = match rng.random() {
        true => (CompareTarget::Create, TargetUnion::CreateRevision(asked)),
        false => (CompareTarget::Mod, TargetUnion::ModRevision(asked)),
    };
    let key = KEYS[rng.random_range(0..KEYS.len())].into();
    pb::Compare { result: CompareResult::Equal.into(), target: target.into(), key, target_union: Some(union) }
}

/// A key without what its writer could not know, its lease as a number of its own.
fn told(kv: &mut pb::KeyValue, leases: &[i64]) {
    kv.lease = leases.iter().position(|lease| *lease == kv.lease).map_or(0, |at| at as i64 + 1);
}

/// Everything that is answered to the script of a seed.
async fn answers(channel: Channel, seed: u64) -> Vec<String> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let (mut kv, mut lease) = (KvClient::new(channel.clone()), LeaseClient::new(channel.clone()));
    let (mut leases, mut said, mut revision) = (Vec::new(), Vec::new(), 1);
    for i in 0..TRANSACTIONS {
        if i % 50 == 0 {
            let granted = lease.lease_grant(pb::LeaseGrantRequest { ttl: LEASE_S }).await.unwrap().into_inner();
            leases.push(granted.id);
            let once = tokio_stream::once(pb::LeaseKeepAliveRequest { id: granted.id });
            let kept = lease.lease_keep_alive(once).await.unwrap().into_inner().message().await.unwrap().unwrap();
            said.push(format!("granted {}, extended {} {}", granted.ttl, kept.id == granted.id, kept.ttl));
        }
        if i % 70 == 69 {
            let id = leases[rng.random_range(0..leases.len())];
            let ended = lease.lease_revoke(pb::LeaseRevokeRequest { id }).await;
            let kept =
                lease.lease_keep_alive(tokio_stream::once(pb::LeaseKeepAliveRequest { id })).await.unwrap().into_inner().message().await;
            said.push(format!("revoked {:?}, extended {}", ended.map(drop).map_err(|s| s.code()), kept.unwrap().unwrap().ttl));
        }
        let compare = (0..rng.random_range(0..3)).map(|_| condition(&mut rng, revision)).collect();
        let mut success: Vec<pb::RequestOp> = Vec::new();
        for _ in 0..rng.random_range(0..4) {
            success.push(operation(&mut rng, &leases));
        }
        // etcd refuses to write a key twice in one transaction, and servers do not.
        let writes = |op: &pb::RequestOp| !matches!(op.request, Some(pb::request_op::Request::RequestRange(_)));
        if success.iter().filter(|op| writes(op)).count() > 1 {
            success.retain(|op| !writes(op) || rng.random_range(0..2) == 0);
            let mut first = true;
            success.retain(|op| !writes(op) || std::mem::take(&mut first));
        }
        match kv.txn(pb::TxnRequest { compare, success }).await {
            Ok(reply) => {
                let mut reply = reply.into_inner();
                revision = reply.header.as_ref().unwrap().revision;
                for response in &mut reply.responses {
                    if let Some(pb::response_op::Response::ResponseRange(range)) = &mut response.response {
                        range.kvs.iter_mut().for_each(|kv| told(kv, &leases));
                    }
                }
                said.push(format!("{reply:?}"));
            }
            Err(status) => said.push(format!("{:?}", status.code())),
        }
    }
    let compacted = kv.compact(pb::CompactionRequest { revision: revision / 2 }).await.map(drop).map_err(|s| s.code());
    let again = kv.compact(pb::CompactionRequest { revision: revision / 2 }).await.map(drop).map_err(|s| s.code());
    said.push(format!("{compacted:?} {again:?}"));
    for start_revision in [revision / 4, revision / 2 + 1] {
        let create = pb::WatchCreateRequest { key: "a/".into(), range_end: "c".into(), start_revision };
        let request = pb::WatchRequest { request_union: Some(pb::watch_request::RequestUnion::CreateRequest(create)) };
        let requests = tokio_stream::once(request).chain(tokio_stream::pending());
        let mut watched = WatchClient::new(channel.clone()).watch(requests).await.unwrap().into_inner();
        let mut events = Vec::new();
        while let Ok(Ok(Some(reply))) = tokio::time::timeout(Duration::from_millis(500), watched.message()).await {
            said.extend(reply.canceled.then(|| format!("canceled, compacted up to {}", reply.compact_revision)));
            events.extend(reply.events);
        }
        for mut event in events {
            event.kv.iter_mut().for_each(|kv| told(kv, &leases));
            said.push(format!("{event:?}"));
        }
    }
    said
}

#[test]
fn published_the_stand_in_answers_as_etcd_does() {
    let folder = tempfile::tempdir().unwrap();
    tokio::runtime::Runtime::new().unwrap().block_on(async {
        let Some((_running, etcd)) = real(folder.path()).await else {
            eprintln!("etcd is not installed: the stand-in is not held against it");
            return;
        };
        let (expected, got) = (answers(etcd, 1).await, answers(stand_in().await, 1).await);
        assert!(expected.len() > TRANSACTIONS + 30, "{} answers", expected.len());
        for (i, (expected, got)) in expected.iter().zip(&got).enumerate() {
            assert_eq!(expected, got, "answer {i}");
        }
        assert_eq!(expected.len(), got.len());
    });
}
