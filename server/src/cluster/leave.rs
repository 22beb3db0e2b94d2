//! Letting sessions go: to another server that asks, or because they are lost.

use std::sync::Arc;
use std::time::Duration;

use tonic::Status;

use super::{Cluster, Held, Stage, created, delete};
use crate::store::Key;

/// Time for which a session stays at least, so that two askers do not tear at it.
const STAY: Duration = Duration::from_millis(500);
/// Longest wait for what is not durable yet; what is left then is sent again by the clients.
const LAST_COMMIT: Duration = Duration::from_secs(2);
/// Longest wait for the engine.
const CLOSE: Duration = Duration::from_secs(10);

impl Cluster {
    /// Hands a session over if it is here and another server wants it: to be looked at when either begins.
    pub(super) fn heed(&self, session: &str) {
        let wanted = self.lock().wanted(session);
        if let Some(held) = wanted {
            tokio::spawn(self.clone().hand_over(session.into(), held));
        }
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
        self.let_go(&session).await;
        tracing::info!(session, epoch = held.epoch, "session handed over");
    }

    /// Lets one session go: from the engine, then from etcd.
    pub(super) async fn let_go(&self, session: &str) {
        let Some(held) = self.lock().held.remove(session) else { return };
        self.forget(session).await;
        if let Err(status) = self.release_key(session, held.epoch).await {
            tracing::warn!(session, reason = status.message(), "owner's key not removed; it goes with the lease");
        }
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

    /// Forgets a session that belongs to another server now.
    pub(crate) async fn lose(&self, session: &str) {
        let Some(held) = self.lock().held.remove(session) else { return };
        tracing::warn!(session, epoch = held.epoch, "session lost: another server has it");
        self.forget(session).await;
        self.lock().counts.lost += 1;
    }

    /// A session was closed, and etcd knows it.
    pub(crate) fn closed(&self, session: &str, epoch: i64) {
        let mut state = self.lock();
        if state.held.get(session).is_some_and(|held| held.epoch == epoch) {
            state.held.remove(session);
        }
    }

    /// Takes a session out of the engine. It is not held any more, so nothing that the store does from now on changes what is stored of it.
    pub(super) async fn forget(&self, session: &str) {
        self.0.keeper.forget(session);
        // A name that was only claimed is not in the engine.
        let _ = self.0.engine.close(session, CLOSE).await;
        self.0.keeper.forgotten(session);
        let _ = self.0.left.send(Arc::from(session));
    }

    pub(super) async fn release_key(&self, session: &str, epoch: i64) -> Result<(), Status> {
        let owner = self.0.keys.owner(session);
        self.0.etcd.transaction(vec![created(&owner, epoch)], vec![delete(&owner)]).await.map(drop)
    }
}
