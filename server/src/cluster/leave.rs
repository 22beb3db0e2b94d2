//! Letting sessions go: to another server that asks, or because they are lost.

use std::sync::Arc;
use std::time::Duration;

use nesam_engine::EngineError;
use nesam_proto::etcd as pb;
use pb::request_op::Request;
use tonic::Status;

use super::{Cluster, Held, Stage, created, delete};
use crate::store::Key;

/// Time for which a session stays at least, so that two askers do not tear at it.
const STAY: Duration = Duration::from_millis(500);
/// Longest wait for what is not durable yet; what is left then is sent again by the clients.
const LAST_COMMIT: Duration = Duration::from_secs(2);
/// Pause before an engine that had no room is told again to close a session.
const CLOSE_AGAIN: Duration = Duration::from_millis(100);
/// Pause before etcd is asked again to take something back.
const INSIST_AGAIN: Duration = Duration::from_millis(100);

impl Cluster {
    /// Hands a session over if it is here and another server wants it: to be looked at when either begins. A wanted one that is not here although its key is
    /// ours is let go as well.
    pub(super) fn heed(&self, session: &str) {
        let lease = self.0.lease.number();
        let (wanted, stray) = {
            let state = self.lock();
            (state.wanted(session), state.stray(session, lease))
        };
        if let Some(held) = wanted {
            tokio::spawn(self.clone().hand_over(session.into(), held));
        }
        if stray.is_some() {
            tokio::spawn(self.clone().free_stray(session.into()));
        }
    }

    /// Gives the key of a session back under which there is none here.
    async fn free_stray(self, session: String) {
        // One that is being taken is here in a moment.
        let turn = self.turn(&session).await;
        let lease = self.0.lease.number();
        let stray = self.lock().stray(&session, lease);
        if let Some(epoch) = stray {
            tracing::warn!(session, epoch, "owner's key without a session given back");
            self.release(&session, epoch).await;
        }
        self.end_turn(turn);
    }

    /// Writes what there is of a session and lets it go.
    async fn hand_over(self, session: String, held: Held) {
        tokio::time::sleep(STAY.saturating_sub(held.since.elapsed())).await;
        {
            let mut state = self.lock();
            if state.wanted(&session).is_none_or(|now| now.epoch != held.epoch) {
                return;
            }
            state.held.insert(session.clone(), Held { stage: Stage::Leaving, ..held });
            state.counts.handed_over += 1;
        }
        self.0.keeper.hurry(&Key::Session(session.clone()));
        if !self.0.keeper.settled(&Key::Session(session.clone()), LAST_COMMIT).await {
            tracing::warn!(session, "the store is slow; the session moves with what is durable of it");
        }
        self.let_go(&session, held.epoch).await;
        tracing::info!(session, epoch = held.epoch, "session handed over");
    }

    /// Lets one session go: from the engine, then from etcd. In tasks that nobody gives up: a session half left would be nobody's.
    pub(super) async fn let_go(&self, session: &str, epoch: i64) {
        let left = self.lock().leave(session, epoch);
        if left {
            self.gone(session, epoch).await;
        }
    }

    /// Takes a session that is not held any more out of the engine, then gives its key back.
    pub(super) async fn gone(&self, session: &str, epoch: i64) {
        self.forget(session).await;
        self.release(session, epoch).await;
    }

    /// Forgets all sessions: the lease has ended.
    pub(super) async fn lose_all(self) {
        let lost = std::mem::take(&mut self.lock().held);
        for (session, held) in &lost {
            tracing::warn!(session, epoch = held.epoch, "session lost with the lease");
            self.forget(session).await;
        }
        self.lock().counts.lost += lost.len() as u64;
    }

    /// Forgets a session that belongs to another server now, unless it has come back since this epoch.
    pub(crate) async fn lose(&self, session: &str, epoch: i64) {
        let left = self.lock().leave(session, epoch);
        if left {
            tracing::warn!(session, epoch, "session lost: another server has it");
            self.forget(session).await;
            self.lock().counts.lost += 1;
        }
    }

    /// A session was closed, and etcd knows it.
    pub(crate) fn closed(&self, session: &str, epoch: i64) {
        self.lock().leave(session, epoch);
    }

    /// Takes a session out of the engine. It is not held any more, so nothing that the store does from now on changes what is stored of it.
    pub(super) async fn forget(&self, session: &str) {
        self.0.keeper.forget(session);
        // A name that was only claimed is not in the engine. One that has no room for a command has the session still, which another server has too. What it has taken
        // it executes: asked twice, it would close one that has come back.
        while let Err(EngineError::Overloaded { .. }) = self.0.engine.close(session, Duration::MAX).await {
            tokio::time::sleep(CLOSE_AGAIN).await;
        }
        self.0.keeper.forgotten(session);
        let _ = self.0.left.send(Arc::from(session));
    }

    /// Gives the key of one epoch back, at the latest when etcd answers again: while this server lives nobody else would.
    async fn release(&self, session: &str, epoch: i64) {
        let Err(status) = self.release_key(session, epoch).await else { return };
        tracing::warn!(session, epoch, reason = status.message(), "owner's key not removed yet; etcd is asked again while the lease lasts");
        let (conditions, then) = self.key_given_back(session, epoch);
        tokio::spawn(self.clone().insist(conditions, then));
    }

    /// The same once.
    pub(super) async fn release_key(&self, session: &str, epoch: i64) -> Result<(), Status> {
        let (conditions, then) = self.key_given_back(session, epoch);
        self.0.etcd.transaction(conditions, then).await.map(drop)
    }

    /// The transaction that gives the key of one epoch back; a repetition does nothing.
    fn key_given_back(&self, session: &str, epoch: i64) -> (Vec<pb::Compare>, Vec<Request>) {
        let owner = self.0.keys.owner(session);
        (vec![created(&owner, epoch)], vec![delete(&owner)])
    }

    /// Takes something of ours back that goes with the lease at the latest: asks until etcd has done it or the lease has ended. The conditions must see to it
    /// that a repetition does nothing.
    pub(super) async fn insist(self, conditions: Vec<pb::Compare>, then: Vec<Request>) {
        let lease = self.0.lease.number();
        while lease.is_some() && self.0.lease.number() == lease {
            if self.0.etcd.transaction(conditions.clone(), then.clone()).await.is_ok() {
                return;
            }
            tokio::time::sleep(INSIST_AGAIN).await;
        }
    }
}
