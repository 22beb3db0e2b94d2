//! Sessions that no server has and nobody asks for: they leave etcd after the time for which a session may be idle.
//!
//! A session that is in use is closed by its owner; one whose owner died has none. Every server remembers since when it has seen such an image unchanged, by
//! its own clock, so a server that starts begins to count anew. The removal is conditional on both: a session that somebody has taken or written stays.

use std::collections::BTreeMap;
use std::time::Duration;

use tokio::time::Instant;

use super::{Cluster, created, delete, get_keys, written};

/// Looks per idle time, and bounds of the pause between two.
const LOOKS: u32 = 10;
const PAUSE: [Duration; 2] = [Duration::from_secs(2), Duration::from_secs(60)];

/// Images without an owner: the revision of their last write, and since when they have been seen so.
#[derive(Debug, Default)]
struct Abandoned(BTreeMap<String, (i64, Instant)>);

impl Abandoned {
    /// Takes in what has no owner now, with the revision of its last write, and gives what has been so for longer than `idle`.
    fn ripe(&mut self, found: BTreeMap<String, i64>, now: Instant, idle: Duration) -> Vec<(String, i64)> {
        let since = |session: &String, revision: i64| self.0.get(session).filter(|seen| seen.0 == revision).map_or(now, |seen| seen.1);
        self.0 = found.into_iter().map(|(session, revision)| (session.clone(), (revision, since(&session, revision)))).collect();
        let ripe = self.0.iter().filter(|(_, (_, since))| now.duration_since(*since) > idle);
        ripe.map(|(session, (revision, _))| (session.clone(), *revision)).collect()
    }
}

impl Cluster {
    /// Removes abandoned sessions for ever.
    pub(super) async fn reap(self, idle: Duration) {
        let mut abandoned = Abandoned::default();
        loop {
            tokio::time::sleep((idle / LOOKS).clamp(PAUSE[0], PAUSE[1])).await;
            let Some(found) = self.without_owner().await else { continue };
            for (session, revision) in abandoned.ripe(found, Instant::now(), idle) {
                let (owner, image) = (self.0.keys.owner(&session), self.0.keys.session(&session));
                let removed = self.0.etcd.transaction(vec![created(&owner, 0), written(&image, revision)], vec![delete(&image)]).await;
                if removed.is_ok_and(|done| done.held) {
                    tracing::info!(session, idle_s = idle.as_secs_f64(), "removed a session that no server has and nobody asked for");
                }
            }
        }
    }

    /// Images whose session has no owner as far as this server knows, with the revision of their last write; `None` without etcd.
    async fn without_owner(&self) -> Option<BTreeMap<String, i64>> {
        let keys = &self.0.keys;
        let read = self.0.etcd.all(vec![get_keys(&keys.sessions())]).await.ok()?.read;
        let state = self.lock();
        let found = read.iter().flatten().filter_map(|kv| Some((keys.session_name(&kv.key)?.to_owned(), kv.mod_revision)));
        Some(found.filter(|(session, _)| !state.held.contains_key(session) && !state.owners.contains_key(session)).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_only_what_stays_abandoned_and_unchanged_is_ripe() {
        let (start, idle) = (Instant::now(), Duration::from_secs(10));
        let at = |s: u64| start + Duration::from_secs(s);
        let found =
            |all: &[(&str, i64)]| -> BTreeMap<String, i64> { all.iter().map(|(name, revision)| ((*name).into(), *revision)).collect() };
        let mut abandoned = Abandoned::default();
        assert!(abandoned.ripe(found(&[("left", 3), ("written", 4), ("taken", 5)]), at(0), idle).is_empty());
        // One is written by somebody who came and went, one has an owner when it is looked for.
        assert!(abandoned.ripe(found(&[("left", 3), ("written", 9)]), at(6), idle).is_empty());
        assert_eq!(abandoned.ripe(found(&[("left", 3), ("written", 9), ("taken", 5)]), at(11), idle), [("left".to_owned(), 3)]);
        assert_eq!(abandoned.ripe(found(&[("written", 9), ("taken", 5)]), at(17), idle), [("written".to_owned(), 9)]);
        assert_eq!(abandoned.ripe(found(&[("taken", 5)]), at(22), idle), [("taken".to_owned(), 5)]);
    }
}
