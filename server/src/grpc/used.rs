//! Sessions that one stream uses: when one of them moves to another server the stream ends, so that its client comes after it.

use std::collections::BTreeMap;
use std::sync::Arc;

use tokio::sync::broadcast;
use tokio::sync::broadcast::error::RecvError;
use tonic::Status;

use super::Edge;
use crate::access::{Caller, Wish};
use crate::cluster::moved;

/// What a stream has used so far.
pub(super) struct Used {
    /// Each session with the epoch under which it was used first.
    sessions: BTreeMap<String, i64>,
    /// `None` for a server that is alone: nothing moves.
    leaving: Option<broadcast::Receiver<Arc<str>>>,
}

impl Used {
    /// Nothing yet.
    pub fn of(edge: &Edge) -> Self {
        Self { sessions: BTreeMap::new(), leaving: edge.cluster.as_ref().map(|cluster| cluster.leaving()) }
    }

    /// Lets a message of the stream use a session, which comes here if need be; gives its vehicle, where there are identities. A session that the stream has
    /// used and that has moved since is not fetched back, also when it is here again: somebody who came later asked for it, and what the stream has sent may be
    /// missing in it.
    ///
    /// # Errors
    /// UNAVAILABLE when the stream has to end: its session has moved, or does not come. Else as [`Edge::allow`]; the stream goes on.
    pub async fn enter(&mut self, edge: &Edge, caller: &Caller, wish: Wish<'_>) -> Result<Option<Arc<str>>, Status> {
        let (Some(cluster), Some(session)) = (&edge.cluster, wish.session()) else { return caller.may(wish) };
        let same = |used: &BTreeMap<String, i64>, epoch: Option<i64>| used.get(session).is_none_or(|before| Some(*before) == epoch);
        if !same(&self.sessions, cluster.epoch(session)) {
            return Err(moved(session));
        }
        let vehicle = edge.allow_caller(caller, wish, edge.stream_budget()).await?;
        // It may have gone and come back while this waited.
        let epoch = cluster.epoch(session);
        if !same(&self.sessions, epoch) {
            return Err(moved(session));
        }
        self.sessions.extend(epoch.map(|epoch| (session.into(), epoch)));
        Ok(vehicle)
    }

    /// Resolves with a session of the stream that has left.
    pub async fn gone(&mut self) -> Arc<str> {
        let Some(leaving) = &mut self.leaving else { return std::future::pending().await };
        loop {
            match leaving.recv().await {
                Ok(session) if self.sessions.contains_key(&*session) => return session,
                // A stream that missed some notices sees at its next message what is not here.
                Ok(_) | Err(RecvError::Lagged(_)) => {}
                Err(RecvError::Closed) => return std::future::pending().await,
            }
        }
    }
}
