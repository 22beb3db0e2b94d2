//! etcd: transactions, leases and watches with deadlines.

use std::time::Duration;

use nesam_proto::etcd as pb;
use pb::request_op::Request;
use tonic::transport::{Channel, Endpoint};
use tonic::{Status, Streaming};

use super::again;
use super::files::ClusterFiles;
use super::keys::behind;
use crate::config::ClusterConfig;
use crate::error::ServerError;

/// Longest wait for a connection.
const CONNECT: Duration = Duration::from_millis(500);
/// Longest wait for a transaction.
const TRANSACTION: Duration = Duration::from_secs(2);
/// Pause before something that etcd has not done is asked for again.
const RETRY_AFTER: Duration = Duration::from_millis(100);
/// Renewed connections to members that may wait to be taken.
const RENEWALS_WAITING: usize = 64;
/// Answers with all parts of a map may be this large, bytes.
const ANSWER_BYTES_MAX: usize = 256 << 20;

/// A client of the etcd members; clones share the connections.
#[derive(Clone, Debug)]
pub(crate) struct Etcd {
    kv: pb::kv_client::KvClient<Channel>,
    lease: pb::lease_client::LeaseClient<Channel>,
    watch: pb::watch_client::WatchClient<Channel>,
}

/// What a transaction did.
#[derive(Debug)]
pub(crate) struct Done {
    /// Whether all conditions held.
    pub held: bool,
    /// Revision of the store behind it.
    pub revision: i64,
    /// Keys that were read, in the order of the reads.
    pub read: Vec<Vec<pb::KeyValue>>,
}

impl Etcd {
    /// A client that connects when it is first used, and again when it has to or its certificates change; what reads those.
    ///
    /// # Errors
    /// `ServerError::Value` for an endpoint that is none, `ServerError::Tls` for files that cannot be used.
    pub fn new(config: &ClusterConfig) -> Result<(Self, ClusterFiles), ServerError> {
        let (channel, renewals) = Channel::balance_channel(RENEWALS_WAITING.max(config.etcd.len()));
        Ok((Self::over(channel), ClusterFiles::read(config, renewals)?))
    }

    /// A client over connections that somebody else makes.
    pub fn over(channel: Channel) -> Self {
        let kv = pb::kv_client::KvClient::new(channel.clone()).max_decoding_message_size(ANSWER_BYTES_MAX);
        let (lease, watch) = (pb::lease_client::LeaseClient::new(channel.clone()), pb::watch_client::WatchClient::new(channel));
        Self { kv, lease, watch }
    }

    /// Does all of `then` at one instant when every condition holds, and nothing when not.
    ///
    /// # Errors
    /// UNAVAILABLE with what etcd or the way to it says; whether the transaction was done is not known then.
    pub async fn transaction(&self, conditions: Vec<pb::Compare>, then: Vec<Request>) -> Result<Done, Status> {
        let success = then.into_iter().map(|request| pb::RequestOp { request: Some(request) }).collect();
        let request = pb::TxnRequest { compare: conditions, success };
        let reply = within(TRANSACTION, self.kv.clone().txn(request)).await?.into_inner();
        let read = reply.responses.into_iter().filter_map(|response| match response.response {
            Some(pb::response_op::Response::ResponseRange(range)) => Some(range.kvs),
            _ => None,
        });
        Ok(Done { held: reply.succeeded, revision: reply.header.unwrap_or_default().revision, read: read.collect() })
    }

    /// Does all of it, whatever there is.
    ///
    /// # Errors
    /// As [`Etcd::transaction`].
    pub async fn all(&self, then: Vec<Request>) -> Result<Done, Status> {
        self.transaction(Vec::new(), then).await
    }

    /// Forgets what keys were before a revision.
    ///
    /// # Errors
    /// As [`Etcd::transaction`]; also when it is forgotten already.
    pub async fn compact(&self, revision: i64) -> Result<(), Status> {
        within(TRANSACTION, self.kv.clone().compact(pb::CompactionRequest { revision })).await.map(drop)
    }

    /// A new lease of about so many seconds: its number and the seconds that etcd gives.
    ///
    /// # Errors
    /// As [`Etcd::transaction`].
    pub async fn grant(&self, seconds: i64) -> Result<(i64, i64), Status> {
        let reply = within(TRANSACTION, self.lease.clone().lease_grant(pb::LeaseGrantRequest { ttl: seconds })).await?.into_inner();
        if reply.error.is_empty() { Ok((reply.id, reply.ttl)) } else { Err(Status::failed_precondition(reply.error)) }
    }

    /// Extends a lease: the seconds that it has from some instant after the call on; 0 = it has ended.
    ///
    /// # Errors
    /// As [`Etcd::transaction`].
    pub async fn keep_alive(&self, id: i64, limit: Duration) -> Result<i64, Status> {
        let mut client = self.lease.clone();
        let once = tokio_stream::once(pb::LeaseKeepAliveRequest { id });
        let asked = async move { client.lease_keep_alive(once).await?.into_inner().message().await };
        let reply = within(limit, asked).await?;
        reply.map(|reply| reply.ttl).ok_or_else(|| Status::unavailable("etcd ended the stream without an answer"))
    }

    /// Ends a lease; its keys go with it.
    ///
    /// # Errors
    /// As [`Etcd::transaction`].
    pub async fn revoke(&self, id: i64) -> Result<(), Status> {
        within(TRANSACTION, self.lease.clone().lease_revoke(pb::LeaseRevokeRequest { id })).await.map(drop)
    }

    /// Everything that happens to keys with this prefix from a revision on. The stream takes as long as both sides live.
    ///
    /// # Errors
    /// As [`Etcd::transaction`].
    pub async fn watch(&self, prefix: &str, from: i64) -> Result<Streaming<pb::WatchResponse>, Status> {
        let create = pb::WatchCreateRequest { key: bytes(prefix), range_end: behind(prefix).into(), start_revision: from };
        let request = pb::WatchRequest { request_union: Some(pb::watch_request::RequestUnion::CreateRequest(create)) };
        // The request side stays open: etcd ends a watch whose asker has closed it.
        let requests = tokio_stream::StreamExt::chain(tokio_stream::once(request), tokio_stream::pending());
        within(TRANSACTION, self.watch.clone().watch(requests)).await.map(tonic::Response::into_inner)
    }
}

/// Waits at most so long. Whatever goes wrong is UNAVAILABLE: the codes of etcd are about its own leases and keys, and whoever asked this server for a session has
/// asked for nothing wrong.
async fn within<T>(limit: Duration, asked: impl Future<Output = Result<T, Status>>) -> Result<T, Status> {
    let reason = match tokio::time::timeout(limit, asked).await {
        Ok(Ok(answer)) => return Ok(answer),
        Ok(Err(status)) => std::error::Error::source(&status).map_or_else(|| status.message().into(), in_short),
        Err(_) => format!("no answer within {:.1} s", limit.as_secs_f64()),
    };
    Err(again(&format!("etcd: {reason}"), RETRY_AFTER))
}

/// How servers connect to a member of etcd, without certificates.
///
/// # Errors
/// `ServerError::Value` for an address that is none.
pub(super) fn plain_endpoint(address: &str) -> Result<Endpoint, ServerError> {
    let wrong = |error| ServerError::value("cluster.etcd", format!("`{address}`: {error}"));
    let endpoint = Endpoint::from_shared(address.to_string()).map_err(|error| wrong(error.to_string()))?;
    Ok(endpoint
        .connect_timeout(CONNECT)
        .tcp_nodelay(true)
        .http2_keep_alive_interval(Duration::from_secs(1))
        .keep_alive_timeout(Duration::from_secs(1))
        .keep_alive_while_idle(true))
}

/// An error with what it came from: the network says `transport error`, and below why.
pub(super) fn in_short(error: &(dyn std::error::Error + 'static)) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(error) = source {
        let reason = error.to_string();
        if !text.contains(&reason) {
            text = format!("{text}: {reason}");
        }
        source = error.source();
    }
    text
}

fn bytes(text: &str) -> bytes::Bytes {
    bytes::Bytes::copy_from_slice(text.as_bytes())
}

/// Condition: the key was created at this revision and not since; 0 = it is not there.
pub(crate) fn created(key: &str, revision: i64) -> pb::Compare {
    pb::Compare {
        result: pb::compare::CompareResult::Equal.into(),
        target: pb::compare::CompareTarget::Create.into(),
        key: bytes(key),
        target_union: Some(pb::compare::TargetUnion::CreateRevision(revision)),
    }
}

/// Condition: the key was last written at this revision; 0 = it is not there.
pub(crate) fn written(key: &str, revision: i64) -> pb::Compare {
    pb::Compare {
        result: pb::compare::CompareResult::Equal.into(),
        target: pb::compare::CompareTarget::Mod.into(),
        key: bytes(key),
        target_union: Some(pb::compare::TargetUnion::ModRevision(revision)),
    }
}

/// Reads one key.
pub(crate) fn get(key: &str) -> Request {
    Request::RequestRange(pb::RangeRequest { key: bytes(key), ..Default::default() })
}

/// Reads all keys with a prefix, in order.
pub(crate) fn get_all(prefix: &str) -> Request {
    Request::RequestRange(pb::RangeRequest { key: bytes(prefix), range_end: behind(prefix).into(), keys_only: false })
}

/// Reads all keys with a prefix, in order, without their values.
pub(crate) fn get_keys(prefix: &str) -> Request {
    Request::RequestRange(pb::RangeRequest { key: bytes(prefix), range_end: behind(prefix).into(), keys_only: true })
}

/// Writes a key; it goes with the lease, 0 = it stays.
pub(crate) fn put(key: &str, value: Vec<u8>, lease: i64) -> Request {
    Request::RequestPut(pb::PutRequest { key: bytes(key), value: value.into(), lease })
}

/// Removes a key.
pub(crate) fn delete(key: &str) -> Request {
    Request::RequestDeleteRange(pb::DeleteRangeRequest { key: bytes(key), range_end: bytes::Bytes::new() })
}

/// Removes all keys with a prefix.
pub(crate) fn delete_all(prefix: &str) -> Request {
    Request::RequestDeleteRange(pb::DeleteRangeRequest { key: bytes(prefix), range_end: behind(prefix).into() })
}

#[cfg(test)]
mod tests {
    use tonic::Code;
    use tonic_types::StatusExt as _;

    use super::*;

    #[tokio::test]
    async fn analytic_whatever_etcd_says_is_to_be_asked_again() {
        let asked_again = |status: Status| (status.code(), status.get_details_retry_info().and_then(|info| info.retry_delay));
        let expected = (Code::Unavailable, Some(RETRY_AFTER));
        for code in [Code::NotFound, Code::Unknown, Code::Cancelled, Code::DeadlineExceeded, Code::Internal] {
            let status = within(TRANSACTION, async { Err::<(), _>(Status::new(code, "requested lease not found")) }).await.unwrap_err();
            assert!(status.message().contains("requested lease not found"), "{status}");
            assert_eq!(asked_again(status), expected, "{code:?}");
        }
        let late = within(Duration::ZERO, std::future::pending::<Result<(), Status>>()).await.unwrap_err();
        assert_eq!(asked_again(late), expected);
    }
}
