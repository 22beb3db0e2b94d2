//! Names under which sessions are about to begin.

use nesam_engine::EngineError;
use tokio::runtime::Handle;

use super::{Cluster, ENGINE_WAIT, NO_TURN, Stage};

/// A name that a request has claimed, or is about to. The request may be given up at any time, also while the name is on its way: dropping this lets the name
/// go, unless a session has begun under it.
#[derive(Debug)]
pub(crate) struct Claim {
    cluster: Cluster,
    session: String,
    runtime: Handle,
    /// Somebody has seen to it.
    done: bool,
}

impl Claim {
    /// To be made before the name is claimed.
    pub(super) fn new(cluster: &Cluster, session: &str) -> Self {
        *cluster.lock().claims.entry(session.into()).or_default() += 1;
        Self { cluster: cluster.clone(), session: session.into(), runtime: Handle::current(), done: false }
    }

    /// A session has begun under the name.
    pub fn begun(mut self) {
        self.done = true;
        self.cluster.lock().unclaim(&self.session);
    }

    /// None has: resolves when the name was let go.
    pub async fn give_back(mut self) {
        self.done = true;
        // To its end, also when the client does not wait any longer.
        let _ = self.runtime.spawn(self.cluster.clone().unclaim(self.session.clone())).await;
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        if !self.done {
            self.runtime.spawn(self.cluster.clone().unclaim(std::mem::take(&mut self.session)));
        }
    }
}

impl Cluster {
    /// Lets a claimed name go if no session has begun under it and nobody else is about to begin one.
    async fn unclaim(self, session: String) {
        // Behind a taking that whoever asked for it does not wait for any more.
        let turn = self.turn(&session).await;
        let last = self.lock().unclaim(&session);
        if last && self.is_without_session(&session).await {
            let left = {
                let mut state = self.lock();
                // Whoever has claimed it since then sees to it.
                let epoch = state.held.get(&session).filter(|held| held.stage == Stage::Here).map(|held| held.epoch);
                epoch.filter(|epoch| !state.claims.contains_key(&session) && state.leave(&session, *epoch))
            };
            if let Some(epoch) = left {
                self.gone(&session, epoch).await;
            }
        }
        self.end_turn(turn);
    }

    /// Whether the name is held here and the engine has no session of it.
    async fn is_without_session(&self, session: &str) -> bool {
        loop {
            if self.epoch(session).is_none() {
                return false;
            }
            // What was asked of the engine before is done before, also for a client that does not wait any longer.
            match self.0.engine.get(session, ENGINE_WAIT).await {
                Ok(_) | Err(EngineError::Stopped) => return false,
                Err(EngineError::UnknownSession { .. }) => return true,
                // It does not say: a session that runs must not go.
                Err(_) => tokio::time::sleep(NO_TURN).await,
            }
        }
    }
}
