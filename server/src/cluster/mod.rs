//! Servers that share sessions: each session has one owner at a time, and moves to where it is asked for.
//!
//! A session lives in the memory of its owner and, up to its durable place, in etcd. The owner holds a key under its lease; the revision at which that key
//! was made is the epoch, and every write of the session is conditional on it: an owner that was stopped, cut off or slow can write nothing once somebody
//! else has the session. Whoever is asked for a session that it does not have takes it: from an owner that is gone as soon as its lease has ended, from
//! one that lives by asking for it; that one writes what it has, lets go, and ends the streams that feed it, so that their clients come after it and send
//! again what was not durable. A load balancer that sends a vehicle always to the same server makes moves rare; nothing depends on it.
//!
//! ```text
//! request ── bring ──► owner's key free? take it (epoch), read image and map, import ──► answer
//!                        └─ held by another: put `want` ── watch ──► that one: write, let go
//! ```

mod bring;
mod claim;
mod etcd;
mod files;
mod keys;
mod lease;
mod leave;
mod maps;
mod members;
mod reap;
mod record;
mod watch;

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use nesam_model::ModelBundle;
use tokio::sync::{broadcast, watch as latest};
use tokio::task::JoinHandle;
use tokio::time::Instant;
use tonic::Status;
use tonic_types::{ErrorDetails, StatusExt as _};

pub(crate) use self::bring::{Brought, Standing};
pub(crate) use self::claim::Claim;
pub(crate) use self::etcd::{Etcd, created, delete, delete_all, get, get_all, get_keys, put, written};
pub(crate) use self::files::ClusterFiles;
pub use self::files::etcd_endpoint;
pub(crate) use self::keys::Keys;
use self::lease::Lease;
use self::members::Members;
pub use self::record::knows_record;
pub(crate) use self::record::session_bytes;
use self::record::{Member, Server};
use crate::call::EngineClient;
use crate::config::ClusterConfig;
use crate::error::ServerError;
use crate::store::Keeper;

/// Streams that may lag behind the sessions that left.
const LEFT_KEPT: usize = 1024;
/// Longest wait for the first lease.
const FIRST_LEASE: Duration = Duration::from_secs(10);
/// Longest wait for the engine.
const ENGINE_WAIT: Duration = Duration::from_secs(10);
/// Pause before the engine is asked again that had no turn.
const NO_TURN: Duration = Duration::from_millis(100);

/// How far a session has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    Arriving,
    Here,
    Leaving,
}

/// A session whose owner this server is.
#[derive(Clone, Copy, Debug)]
struct Held {
    epoch: i64,
    since: Instant,
    stage: Stage,
}

/// Who has a session, as the watch tells.
#[derive(Clone, Copy, Debug)]
struct Owner {
    epoch: i64,
    lease: i64,
}

/// Counters of a server among others.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ClusterCounts {
    /// Sessions whose owner this server is.
    pub held: usize,
    /// Sessions that were taken, handed over on request, and lost to others.
    pub taken: u64,
    pub handed_over: u64,
    pub lost: u64,
    /// Whether the lease lasts.
    pub leased: bool,
    /// Servers beside this one, and how many of them answer with another bundle.
    pub others: usize,
    pub other_bundles: usize,
}

#[derive(Debug, Default)]
struct State {
    held: BTreeMap<String, Held>,
    /// Owner of each session of the fleet, as the watch tells.
    owners: BTreeMap<String, Owner>,
    /// Revision at which another server asked for a session, as the watch tells.
    wants: BTreeMap<String, i64>,
    /// Sessions that are being brought here: one at a time each.
    turns: BTreeMap<String, Arc<tokio::sync::Mutex<()>>>,
    /// How many requests are about to begin a session under a name.
    claims: BTreeMap<String, usize>,
    /// When a session was last looked for on behalf of a bus that sends to everybody.
    looked: BTreeMap<String, Instant>,
    /// SHA-256 of each map that is in etcd, as it was last read or written.
    maps: BTreeMap<String, String>,
    members: Members,
    counts: ClusterCounts,
}

impl State {
    /// A session that is here and that another server has asked for since this one took it: an older wish was for an earlier owner.
    fn wanted(&self, session: &str) -> Option<Held> {
        let held = self.held.get(session).filter(|held| held.stage == Stage::Here)?;
        self.wants.get(session).is_some_and(|asked| *asked > held.epoch).then_some(*held)
    }

    /// Epoch of a session that another server has asked for and whose key stands under this lease, ours, although it is not here: etcd did not say that it was
    /// taken, or nobody could let it go. It may be on its way, unless whoever asks has its turn.
    fn stray(&self, session: &str, lease: Option<i64>) -> Option<i64> {
        let owner = self.owners.get(session).filter(|owner| Some(owner.lease) == lease && !self.held.contains_key(session))?;
        self.wants.get(session).is_some_and(|asked| *asked > owner.epoch).then_some(owner.epoch)
    }

    /// Notes that a session is not here any more; false when that was noted before, or when it has come back since then under another epoch.
    fn leave(&mut self, session: &str, epoch: i64) -> bool {
        let here = self.held.get(session).is_some_and(|held| held.epoch == epoch);
        if here {
            self.held.remove(session);
        }
        here
    }

    /// Notes that one of the requests that claimed a name is done with it; whether it was the last one.
    fn unclaim(&mut self, session: &str) -> bool {
        let Some(claims) = self.claims.get_mut(session) else { return true };
        *claims -= 1;
        let last = *claims == 0;
        if last {
            self.claims.remove(session);
        }
        last
    }
}

/// This server among the others; clones share it.
#[derive(Clone, Debug)]
pub(crate) struct Cluster(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    etcd: Etcd,
    keys: Keys,
    me: Member,
    lease: Lease,
    state: Mutex<State>,
    /// Counts the changes of owners, for those who wait for one.
    changes: latest::Sender<u64>,
    /// Sessions that left.
    left: broadcast::Sender<Arc<str>>,
    engine: EngineClient,
    keeper: Arc<Keeper>,
    tasks: Mutex<Vec<JoinHandle<()>>>,
}

impl Cluster {
    /// Joins the servers at this etcd as the one at `address` with this bundle, and returns when the first lease is there.
    ///
    /// # Errors
    /// `ServerError` when etcd does not answer.
    pub async fn start(
        etcd: Etcd,
        config: &ClusterConfig,
        (address, bundle): (String, &ModelBundle),
        engine: EngineClient,
        keeper: Arc<Keeper>,
    ) -> Result<Self, ServerError> {
        let name = if config.name.is_empty() { own_name(&address) } else { config.name.clone() };
        let (changes, _) = latest::channel(0);
        let (left, _) = broadcast::channel(LEFT_KEPT);
        let cluster = Self(Arc::new(Inner {
            etcd: etcd.clone(),
            keys: Keys::new(&config.prefix),
            me: Member { server: Server { name, address }, bundle: bundle.name.clone(), bundle_hash: bundle.hash.clone() },
            lease: Lease::new(f64::from(config.lease_s)),
            state: Mutex::default(),
            changes,
            left,
            engine,
            keeper,
            tasks: Mutex::default(),
        }));
        let lost = {
            let cluster = cluster.clone();
            move || cluster.clone().lose_all()
        };
        let keeping = tokio::spawn(cluster.0.lease.clone().keep(etcd, lost));
        let watching = tokio::spawn(cluster.clone().watch());
        if let Ok(mut tasks) = cluster.0.tasks.lock() {
            tasks.extend([keeping, watching, tokio::spawn(cluster.clone().compact()), tokio::spawn(cluster.clone().announce())]);
            // A time that no clock can hold is never.
            if let Ok(idle) = Duration::try_from_secs_f64(cluster.0.engine.handle().limits().session_idle_s) {
                tasks.push(tokio::spawn(cluster.clone().reap(idle)));
            }
        }
        let begun = Instant::now();
        while cluster.0.lease.id().is_none() {
            if begun.elapsed() > FIRST_LEASE {
                cluster.stop().await;
                let trouble = cluster.0.lease.trouble().unwrap_or_else(|| "no answer".into());
                return Err(ServerError::value(
                    "cluster.etcd",
                    format!("{}: no lease within {} s ({trouble}); is etcd there?", config.etcd.join(", "), FIRST_LEASE.as_secs()),
                ));
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
        tracing::info!(server = cluster.0.me.server.name, etcd = config.etcd.join(","), lease_s = config.lease_s, "sharing sessions");
        Ok(cluster)
    }

    /// Gives everything back. What is to be durable must be committed before.
    pub async fn stop(&self) {
        for task in self.0.tasks.lock().map(|mut tasks| std::mem::take(&mut *tasks)).unwrap_or_default() {
            task.abort();
        }
        self.0.lease.give_back(&self.0.etcd).await;
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.state.lock().expect("no holder of the cluster's state panics; this is a bug")
    }

    /// The connection.
    pub fn etcd(&self) -> &Etcd {
        &self.0.etcd
    }

    /// The keys.
    pub fn keys(&self) -> &Keys {
        &self.0.keys
    }

    /// Whether a session can be used here now.
    ///
    /// # Errors
    /// UNAVAILABLE without a lease, and for a session that is on its way to another server.
    pub fn is_here(&self, session: &str) -> Result<bool, Status> {
        if self.0.lease.id().is_none() {
            let reason = "this server has lost touch with etcd and may not answer for its sessions; ask again, another one will";
            return Err(again(reason, self.0.lease.length() / 4));
        }
        match self.lock().held.get(session).map(|held| held.stage) {
            Some(Stage::Here) => Ok(true),
            Some(Stage::Leaving) => Err(moved(session)),
            Some(Stage::Arriving) | None => Ok(false),
        }
    }

    /// Whether another server has the session, as far as this one knows.
    fn is_elsewhere(&self, session: &str) -> bool {
        let state = self.lock();
        !state.held.contains_key(session) && state.owners.get(session).is_some_and(|owner| Some(owner.lease) != self.0.lease.id())
    }

    /// Epoch of a session whose owner this server is.
    pub fn epoch(&self, session: &str) -> Option<i64> {
        self.lock().held.get(session).map(|held| held.epoch)
    }

    /// Tells which sessions leave, from now on.
    pub fn leaving(&self) -> broadcast::Receiver<Arc<str>> {
        self.0.left.subscribe()
    }

    /// Whether this server may answer for sessions now.
    pub fn is_leased(&self) -> bool {
        self.0.lease.id().is_some()
    }

    /// Counters.
    pub fn counts(&self) -> ClusterCounts {
        let state = self.lock();
        let [others, other_bundles] = state.members.others(&self.0.me);
        ClusterCounts { held: state.held.len(), leased: self.is_leased(), others, other_bundles, ..state.counts }
    }
}

/// What a client hears of a session that has moved or is about to.
pub(crate) fn moved(session: &str) -> Status {
    again(
        &format!("session `{session}` moves to another server; ask again, and send again what was not durable"),
        Duration::from_millis(20),
    )
}

/// UNAVAILABLE with the time to wait.
fn again(reason: &str, after: Duration) -> Status {
    Status::with_error_details(tonic::Code::Unavailable, reason, ErrorDetails::with_retry_info(Some(after)))
}

fn own_name(address: &str) -> String {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let port = address.rsplit(':').next().unwrap_or_default();
    format!("{}:{port}", host.trim())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: a wish is heard whenever it comes. Method: the orders in which a watch may tell of it, around a session that arrives.
    #[test]
    fn analytic_a_wish_is_heeded_as_soon_as_the_session_is_here() {
        let mut state = State::default();
        let arrives = |stage| Held { epoch: 7, since: Instant::now(), stage };
        state.wants.insert("s".into(), 8);
        assert!(state.wanted("s").is_none(), "told before etcd's answer to the taking is here");
        state.held.insert("s".into(), arrives(Stage::Arriving));
        assert!(state.wanted("s").is_none(), "cannot be handed over yet");
        state.held.insert("s".into(), arrives(Stage::Here));
        assert_eq!(state.wanted("s").map(|held| held.epoch), Some(7));
        state.held.insert("s".into(), arrives(Stage::Leaving));
        assert!(state.wanted("s").is_none(), "once");

        state.held.insert("s".into(), arrives(Stage::Here));
        state.wants.insert("s".into(), 6);
        assert!(state.wanted("s").is_none(), "a wish that the taking has fulfilled, of which the watch has not told yet");
        state.wants.clear();
        assert!(state.wanted("s").is_none());
    }

    /// Goal: what ends an earlier stay of a session ends no later one. Method: a session that went and came back under another epoch.
    #[test]
    fn analytic_an_earlier_epoch_ends_no_later_one() {
        let mut state = State::default();
        state.held.insert("s".into(), Held { epoch: 9, since: Instant::now(), stage: Stage::Here });
        assert!(!state.leave("s", 7) && state.held.contains_key("s"), "of an earlier stay");
        assert!(!state.leave("t", 9), "never here");
        assert!(state.leave("s", 9) && state.held.is_empty());
        assert!(!state.leave("s", 9), "once");
    }

    /// Goal: a key of this server under which it has no session is found when somebody wants the session, and no other one is.
    #[test]
    fn analytic_a_key_without_a_session_is_stray_when_it_is_wanted() {
        let (mut state, ours) = (State::default(), Some(3));
        assert_eq!(state.stray("s", ours), None, "nobody's");
        state.owners.insert("s".into(), Owner { epoch: 7, lease: 3 });
        assert_eq!(state.stray("s", ours), None, "nobody asks");
        state.wants.insert("s".into(), 6);
        assert_eq!(state.stray("s", ours), None, "somebody asked an earlier owner");
        state.wants.insert("s".into(), 8);
        assert_eq!(state.stray("s", ours), Some(7));
        assert_eq!((state.stray("s", Some(4)), state.stray("s", None)), (None, None), "another server's, or of an earlier lease");
        state.held.insert("s".into(), Held { epoch: 7, since: Instant::now(), stage: Stage::Arriving });
        assert_eq!(state.stray("s", ours), None, "it is here");
    }

    /// Goal: the last of those who claimed a name sees to it.
    #[test]
    fn analytic_the_last_claim_is_told() {
        let mut state = State::default();
        state.claims.insert("s".into(), 2);
        assert!(!state.unclaim("s") && state.unclaim("s"));
        assert!(state.claims.is_empty());
    }
}
