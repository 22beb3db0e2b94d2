//! A stand-in for etcd with the part of its interface that servers use: keys with revisions, transactions, leases, watches.
//!
//! `published_the_stand_in_answers_as_etcd_does` holds it against etcd itself where that is installed; `tests/fleet/run` has the servers with etcd itself.

use std::collections::BTreeMap;
use std::ops::Bound;
use std::pin::Pin;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use nesam_proto::etcd as pb;
use pb::event::EventType;
use pb::request_op::Request as Asked;
use pb::response_op::Response as Told;
use prost::bytes::Bytes;
use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::ReceiverStream;
use tokio_stream::{Stream, StreamExt as _};
use tonic::{Code, Request, Response, Status, Streaming};

/// Between two looks for leases that have ended.
const LOOK_EVERY: Duration = Duration::from_millis(100);

type Answers<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

#[derive(Debug)]
struct Lease {
    length: Duration,
    /// On the clock of whoever calls [`Etcd::expire`].
    until: Duration,
}

#[derive(Debug)]
struct Held {
    revision: i64,
    keys: BTreeMap<Vec<u8>, pb::KeyValue>,
    leases: BTreeMap<i64, Lease>,
    granted: i64,
    now: Duration,
    compacted: i64,
    /// Everything that ever happened, with its revision.
    history: Vec<(i64, pb::Event)>,
}

/// What goes wrong with transactions.
#[derive(Clone, Copy, Debug, Default)]
pub struct Trouble {
    /// Each waits this long before it is done.
    pub delay: Duration,
    /// None is done, and all are answered with this code.
    pub refusal: Option<Code>,
    /// None that removes a single key which begins so is done; they are answered with UNAVAILABLE.
    pub keeps: Option<&'static str>,
}

/// What etcd holds; clones share it, and it outlives the host that serves it as a disk does.
#[derive(Clone, Debug)]
pub struct Etcd {
    held: Arc<Mutex<Held>>,
    trouble: Arc<Mutex<Trouble>>,
    /// Transactions that were refused for what they would remove.
    kept: Arc<AtomicUsize>,
    /// The newest revision.
    changed: watch::Sender<i64>,
}

impl Default for Etcd {
    /// Empty, as etcd begins.
    fn default() -> Self {
        let (keys, leases, history) = (BTreeMap::new(), BTreeMap::new(), Vec::new());
        let held = Held { revision: 1, keys, leases, granted: 0, now: Duration::ZERO, compacted: 0, history };
        Self { held: Arc::new(Mutex::new(held)), trouble: Arc::default(), kept: Arc::default(), changed: watch::channel(1).0 }
    }
}

fn within<'a>(keys: &'a BTreeMap<Vec<u8>, pb::KeyValue>, key: &[u8], end: &[u8]) -> Vec<&'a pb::KeyValue> {
    if end.is_empty() {
        return keys.get(key).into_iter().collect();
    }
    let range: (Bound<&[u8]>, Bound<&[u8]>) = (Bound::Included(key), Bound::Excluded(end));
    keys.range::<[u8], _>(range).map(|(_, kv)| kv).collect()
}

impl Held {
    fn header(&self) -> Option<pb::ResponseHeader> {
        Some(pb::ResponseHeader { revision: self.revision })
    }

    fn holds(&self, condition: &pb::Compare) -> bool {
        use pb::compare::TargetUnion::{CreateRevision, ModRevision};
        let kv = self.keys.get(&condition.key[..]);
        match condition.target_union {
            Some(CreateRevision(asked)) => kv.map_or(0, |kv| kv.create_revision) == asked,
            Some(ModRevision(asked)) => kv.map_or(0, |kv| kv.mod_revision) == asked,
            None => false,
        }
    }

    fn happens(&mut self, revision: i64, kind: EventType, kv: pb::KeyValue) {
        self.history.push((revision, pb::Event { r#type: kind.into(), kv: Some(kv) }));
    }

    /// Removes keys; how many there were.
    fn remove(&mut self, revision: i64, key: &[u8], end: &[u8]) -> i64 {
        let gone: Vec<Vec<u8>> = within(&self.keys, key, end).into_iter().map(|kv| kv.key.to_vec()).collect();
        for key in &gone {
            self.keys.remove(key);
            self.happens(
                revision,
                EventType::Delete,
                pb::KeyValue { key: key.clone().into(), mod_revision: revision, ..Default::default() },
            );
        }
        gone.len() as i64
    }

    fn transaction(&mut self, asked: pb::TxnRequest) -> Result<pb::TxnResponse, Status> {
        let lost = |op: &pb::RequestOp| matches!(&op.request, Some(Asked::RequestPut(put)) if put.lease != 0 && !self.leases.contains_key(&put.lease));
        let succeeded = asked.compare.iter().all(|condition| self.holds(condition));
        if succeeded && asked.success.iter().any(lost) {
            return Err(Status::not_found("etcdserver: requested lease not found"));
        }
        let (revision, mut responses, mut wrote) = (self.revision + 1, Vec::new(), false);
        for op in asked.success.into_iter().filter(|_| succeeded) {
            let told = match op.request {
                Some(Asked::RequestRange(range)) => {
                    let mut kvs: Vec<_> = within(&self.keys, &range.key, &range.range_end).into_iter().cloned().collect();
                    if range.keys_only {
                        kvs.iter_mut().for_each(|kv| kv.value.clear());
                    }
                    Told::ResponseRange(pb::RangeResponse { kvs })
                }
                Some(Asked::RequestPut(pb::PutRequest { key, value, lease })) => {
                    let create_revision = self.keys.get(&key[..]).map_or(revision, |before| before.create_revision);
                    let kv = pb::KeyValue { key: key.clone(), create_revision, mod_revision: revision, value, lease };
                    self.keys.insert(key.to_vec(), kv.clone());
                    self.happens(revision, EventType::Put, kv);
                    wrote = true;
                    Told::ResponsePut(pb::PutResponse {})
                }
                Some(Asked::RequestDeleteRange(range)) => {
                    let deleted = self.remove(revision, &range.key, &range.range_end);
                    wrote |= deleted > 0;
                    Told::ResponseDeleteRange(pb::DeleteRangeResponse { deleted })
                }
                None => return Err(Status::invalid_argument("an empty operation")),
            };
            responses.push(pb::ResponseOp { response: Some(told) });
        }
        self.revision += i64::from(wrote);
        Ok(pb::TxnResponse { header: self.header(), succeeded, responses })
    }

    /// Ends a lease; its keys go at one revision.
    fn end(&mut self, id: i64) {
        if self.leases.remove(&id).is_none() {
            return;
        }
        let revision = self.revision + 1;
        let keys: Vec<_> = self.keys.values().filter(|kv| kv.lease == id).map(|kv| kv.key.clone()).collect();
        let gone: i64 = keys.iter().map(|key| self.remove(revision, key, &[])).sum();
        self.revision += i64::from(gone > 0);
    }
}

impl Etcd {
    fn lock(&self) -> MutexGuard<'_, Held> {
        self.held.lock().unwrap()
    }

    /// Does something, and tells those who watch.
    fn with<T>(&self, act: impl FnOnce(&mut Held) -> T) -> T {
        let mut held = self.lock();
        let done = act(&mut held);
        self.changed.send_replace(held.revision);
        done
    }

    /// Goes wrong in this way from now on.
    pub fn trouble(&self, trouble: Trouble) {
        *self.trouble.lock().unwrap() = trouble;
    }

    /// How many transactions were refused for what they would remove.
    pub fn kept(&self) -> usize {
        self.kept.load(Ordering::Relaxed)
    }

    /// Writes a key under a lease that lasts, as the server with that lease would.
    pub fn put(&self, key: &str, value: Bytes, lease: i64) {
        let put = pb::PutRequest { key: Bytes::copy_from_slice(key.as_bytes()), value, lease };
        let success = vec![pb::RequestOp { request: Some(Asked::RequestPut(put)) }];
        self.with(|held| held.transaction(pb::TxnRequest { compare: Vec::new(), success })).unwrap();
    }

    /// A key as it is now.
    pub fn get(&self, key: &str) -> Option<pb::KeyValue> {
        self.lock().keys.get(key.as_bytes()).cloned()
    }

    /// Removes all keys with a prefix, as another server would.
    pub fn delete_all(&self, prefix: &str) {
        // Behind `/` comes `0`.
        let end = format!("{}0", prefix.strip_suffix('/').unwrap());
        self.with(|held| {
            let revision = held.revision + 1;
            let gone = held.remove(revision, prefix.as_bytes(), end.as_bytes());
            held.revision += i64::from(gone > 0);
        });
    }

    /// Everything that happened so far, with its revision.
    pub fn history(&self) -> Vec<(i64, pb::Event)> {
        self.lock().history.clone()
    }

    /// Serves this host's clock: leases are as long again as they were when it begins, and end when nobody extends them.
    pub async fn expire(self, clock: impl Fn() -> Duration) {
        self.with(|held| {
            held.now = clock();
            let now = held.now;
            held.leases.values_mut().for_each(|lease| lease.until = now + lease.length);
        });
        loop {
            tokio::time::sleep(LOOK_EVERY).await;
            self.with(|held| {
                held.now = clock();
                let over: Vec<_> = held.leases.iter().filter(|(_, lease)| lease.until <= held.now).map(|(id, _)| *id).collect();
                over.into_iter().for_each(|id| held.end(id));
            });
        }
    }

    /// Its services.
    pub fn router(&self) -> tonic::transport::server::Router {
        tonic::transport::Server::builder()
            .add_service(pb::kv_server::KvServer::new(self.clone()))
            .add_service(pb::lease_server::LeaseServer::new(self.clone()))
            .add_service(pb::watch_server::WatchServer::new(self.clone()))
    }

    async fn follow(self, asked: pb::WatchCreateRequest, sender: mpsc::Sender<Result<pb::WatchResponse, Status>>) {
        let (mut changed, mut next) = (self.changed.subscribe(), asked.start_revision);
        let (header, compacted) = {
            let held = self.lock();
            (held.header(), held.compacted)
        };
        if next > 0 && next <= compacted {
            let cancelled = pb::WatchResponse { header, canceled: true, compact_revision: compacted, ..Default::default() };
            drop(sender.send(Ok(cancelled)).await);
            return;
        }
        let created = pb::WatchResponse { header, ..Default::default() };
        if sender.send(Ok(created)).await.is_err() {
            return;
        }
        loop {
            changed.borrow_and_update();
            let told = {
                let held = self.lock();
                let concerns = |kv: &pb::KeyValue| match &asked.range_end[..] {
                    [] => kv.key == asked.key,
                    end => kv.key >= asked.key && &kv.key[..] < end,
                };
                let new = held.history.iter().filter(|(revision, event)| *revision >= next && event.kv.as_ref().is_some_and(concerns));
                let events: Vec<_> = new.map(|(_, event)| event.clone()).collect();
                next = held.revision + 1;
                pb::WatchResponse { header: held.header(), events, ..Default::default() }
            };
            if !told.events.is_empty() && sender.send(Ok(told)).await.is_err() {
                return;
            }
            tokio::select! {
                _ = changed.changed() => {}
                () = sender.closed() => return,
            }
        }
    }
}

#[tonic::async_trait]
impl pb::kv_server::Kv for Etcd {
    async fn txn(&self, request: Request<pb::TxnRequest>) -> Result<Response<pb::TxnResponse>, Status> {
        let Trouble { delay, refusal, keeps } = *self.trouble.lock().unwrap();
        if !delay.is_zero() {
            tokio::time::sleep(delay).await;
        }
        if let Some(code) = refusal {
            return Err(Status::new(code, "simulated"));
        }
        let asked = request.into_inner();
        let removes = |prefix: &str| {
            let mut requests = asked.success.iter().filter_map(|op| op.request.as_ref());
            requests.any(|request| matches!(request, Asked::RequestDeleteRange(range) if range.key.starts_with(prefix.as_bytes())))
        };
        if keeps.is_some_and(removes) {
            self.kept.fetch_add(1, Ordering::Relaxed);
            return Err(Status::unavailable("simulated"));
        }
        self.with(|held| held.transaction(asked)).map(Response::new)
    }

    async fn compact(&self, request: Request<pb::CompactionRequest>) -> Result<Response<pb::CompactionResponse>, Status> {
        let asked = request.into_inner().revision;
        let mut held = self.lock();
        if asked <= held.compacted {
            return Err(Status::out_of_range("etcdserver: mvcc: required revision has been compacted"));
        }
        if asked > held.revision {
            return Err(Status::out_of_range("etcdserver: mvcc: required revision is a future revision"));
        }
        held.compacted = asked;
        Ok(Response::new(pb::CompactionResponse {}))
    }
}

#[tonic::async_trait]
impl pb::lease_server::Lease for Etcd {
    async fn lease_grant(&self, request: Request<pb::LeaseGrantRequest>) -> Result<Response<pb::LeaseGrantResponse>, Status> {
        let seconds = request.into_inner().ttl.max(1);
        let mut held = self.lock();
        held.granted += 1;
        let (id, length) = (held.granted, Duration::from_secs(seconds.unsigned_abs()));
        let until = held.now + length;
        held.leases.insert(id, Lease { length, until });
        Ok(Response::new(pb::LeaseGrantResponse { id, ttl: seconds, error: String::new() }))
    }

    async fn lease_revoke(&self, request: Request<pb::LeaseRevokeRequest>) -> Result<Response<pb::LeaseRevokeResponse>, Status> {
        let id = request.into_inner().id;
        self.with(|held| match held.leases.contains_key(&id) {
            true => {
                held.end(id);
                Ok(Response::new(pb::LeaseRevokeResponse {}))
            }
            false => Err(Status::not_found("etcdserver: requested lease not found")),
        })
    }

    type LeaseKeepAliveStream = Answers<pb::LeaseKeepAliveResponse>;

    async fn lease_keep_alive(
        &self,
        request: Request<Streaming<pb::LeaseKeepAliveRequest>>,
    ) -> Result<Response<Self::LeaseKeepAliveStream>, Status> {
        let etcd = self.clone();
        let extended = move |asked: Result<pb::LeaseKeepAliveRequest, Status>| {
            let id = asked?.id;
            let mut held = etcd.lock();
            let now = held.now;
            let ttl = held.leases.get_mut(&id).map_or(0, |lease| {
                lease.until = now + lease.length;
                lease.length.as_secs() as i64
            });
            Ok(pb::LeaseKeepAliveResponse { id, ttl })
        };
        Ok(Response::new(Box::pin(request.into_inner().map(extended))))
    }
}

#[tonic::async_trait]
impl pb::watch_server::Watch for Etcd {
    type WatchStream = Answers<pb::WatchResponse>;

    async fn watch(&self, request: Request<Streaming<pb::WatchRequest>>) -> Result<Response<Self::WatchStream>, Status> {
        let mut asked = request.into_inner();
        let Some(pb::watch_request::RequestUnion::CreateRequest(create)) = asked.message().await?.and_then(|asked| asked.request_union)
        else {
            return Err(Status::invalid_argument("a watch begins with what to watch"));
        };
        let (sender, answers) = mpsc::channel(16);
        tokio::spawn(self.clone().follow(create, sender));
        // What asks stays open as long as the watch.
        let answers = ReceiverStream::new(answers).map(move |answer| {
            let _ = &asked;
            answer
        });
        Ok(Response::new(Box::pin(answers)))
    }
}
