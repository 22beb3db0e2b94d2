//! What the others do: who has which session, who wants ours, which maps are new.

use std::time::Duration;

use nesam_proto::etcd as pb;
use tonic::Status;

use super::keys::Topic;
use super::record::{MapHead, of_json};
use super::{Cluster, Owner, get_all};

/// Time for which etcd remembers old contents, at least.
const COMPACT_EVERY: Duration = Duration::from_secs(30);
/// Pause before a broken watch is begun again.
const RETRY: Duration = Duration::from_millis(50);

impl Cluster {
    /// Follows everything below `live` for ever.
    pub(super) async fn watch(self) {
        loop {
            if let Err(status) = self.follow().await {
                tracing::debug!(reason = status.message(), "watch of etcd broke; begun again");
            }
            tokio::time::sleep(RETRY).await;
        }
    }

    /// Lets etcd forget old contents of the keys, for ever: sessions are written every second, and etcd keeps every version until it is told otherwise. Every
    /// server does so; what one has done the others find done.
    pub(super) async fn compact(self) {
        let mut before = None;
        loop {
            if let Ok(now) = self.0.etcd.all(Vec::new()).await
                && let Some(revision) = before.replace(now.revision)
            {
                let _ = self.0.etcd.compact(revision).await;
            }
            tokio::time::sleep(COMPACT_EVERY).await;
        }
    }

    /// Reads all, then follows the changes until the stream breaks.
    async fn follow(&self) -> Result<(), Status> {
        let live = self.0.keys.live();
        let all = self.0.etcd.all(vec![get_all(&live)]).await?;
        let gone: Vec<String> = {
            let mut state = self.lock();
            state.owners.clear();
            state.wants.clear();
            let is_there = |lease| all.read.iter().flatten().any(|found| self.0.keys.topic(&found.key) == Some(Topic::Member(lease)));
            state.members.keep(is_there);
            let there = |map: &str| all.read.iter().flatten().any(|found| self.0.keys.topic(&found.key) == Some(Topic::Map(map)));
            state.maps.keys().filter(|map| !there(map)).cloned().collect()
        };
        for map in gone {
            tokio::spawn(self.clone().lose_map(map));
        }
        for found in all.read.iter().flatten() {
            self.apply(found, true).await;
        }
        self.tell();
        let mut changes = self.0.etcd.watch(&live, all.revision + 1).await?;
        while let Some(change) = changes.message().await? {
            if change.canceled || change.compact_revision > 0 {
                return Err(Status::aborted(change.cancel_reason));
            }
            for event in &change.events {
                if let Some(found) = &event.kv {
                    self.apply(found, event.r#type() == pb::event::EventType::Put).await;
                }
            }
            self.tell();
        }
        Ok(())
    }

    /// Takes note of a key that is there, or not any more.
    async fn apply(&self, found: &pb::KeyValue, there: bool) {
        match (self.0.keys.topic(&found.key), there) {
            (Some(Topic::Owner(session)), true) => {
                let before = {
                    let mut state = self.lock();
                    state.owners.insert(session.into(), Owner { epoch: found.create_revision, lease: found.lease });
                    state.held.get(session).map(|held| held.epoch).filter(|epoch| *epoch < found.create_revision)
                };
                if let Some(epoch) = before
                    && Some(found.lease) != self.0.lease.id()
                {
                    self.lose(session, epoch).await;
                }
            }
            (Some(Topic::Owner(session)), false) => {
                self.lock().owners.remove(session);
            }
            (Some(Topic::Want(session)), true) => {
                // By the lease: two servers may have been given the same name.
                if self.0.lease.number() != Some(found.lease) {
                    self.lock().wants.insert(session.into(), found.mod_revision);
                    self.heed(session);
                } else {
                    self.lock().wants.remove(session);
                }
            }
            (Some(Topic::Want(session)), false) => {
                self.lock().wants.remove(session);
            }
            (Some(Topic::Map(map)), true) => {
                if let Some(MapHead { sha256, .. }) = of_json(&found.value) {
                    tokio::spawn(self.clone().renew_map(map.into(), sha256));
                }
            }
            (Some(Topic::Map(map)), false) => {
                tokio::spawn(self.clone().lose_map(map.into()));
            }
            (Some(Topic::Member(lease)), true) => {
                if let Some(member) = of_json(&found.value) {
                    self.lock().members.note(lease, member);
                }
            }
            (Some(Topic::Member(lease)), false) => self.lock().members.forget(lease),
            (None, _) => {}
        }
    }

    fn tell(&self) {
        self.0.changes.send_modify(|changes| *changes += 1);
    }
}
