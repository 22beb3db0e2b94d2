//! Bringing a session here.

use std::sync::Arc;
use std::time::Duration;

use nesam_engine::{EngineError, SessionImage, check_name};
use nesam_proto::etcd::KeyValue;
use tokio::runtime::Handle;
use tokio::sync::OwnedMutexGuard;
use tokio::time::Instant;
use tonic::Status;

use super::record::{Server, json, of_json, session_of};
use super::{Claim, Cluster, ENGINE_WAIT, Held, NO_TURN, Stage, again, created, delete, get, moved, put, written};
use crate::convert::to_status;
use crate::store::{StoredSession, resumed};

/// Sessions that are brought here at a time for a bus; each holds a message of it meanwhile.
const TURNS_MAX: usize = 1024;
/// Longest wait for an owner that is gone or slow, however long the client would wait.
const WAIT_MAX: Duration = Duration::from_secs(10);
/// Longest pause between two looks at etcd; the watch usually tells sooner.
const LOOK_AGAIN: Duration = Duration::from_millis(100);
/// Longest wait for a lease: as long as a proxy takes that looks at /health as those in `deploy` do, twice with 0.3 s between.
const LEASE_WAIT: Duration = Duration::from_millis(750);
/// Pause between two looks at the lease.
const LEASE_PAUSE: Duration = Duration::from_millis(20);
/// Shortest pause between two searches for one session on behalf of a bus.
const SEARCH_PAUSE: Duration = Duration::from_millis(200);

/// What came of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Brought {
    /// The session can be used here.
    Here,
    /// No server has a session of this name, and none is stored.
    Nowhere,
}

/// Where a session is, as far as this server knows without asking.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Standing {
    Here,
    /// With another server, or searched for a moment ago.
    Elsewhere,
    /// No server is known to have it: it is to be searched for now.
    Lost,
}

/// What may be done to have a session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Zeal {
    /// Take it when nobody has it.
    IfFree,
    /// Ask its owner for it.
    Ask,
    /// Have its name where there is no such session yet.
    Create,
}

/// What etcd says of a session.
struct Seen {
    /// Epoch, lease and name of the owner.
    owner: Option<(i64, i64, Server)>,
    stored: Option<StoredSession>,
}

/// A wish that an owner was told in etcd. Dropped, on whichever way out and when whoever asks gives up, it is taken back.
struct Asked {
    cluster: Cluster,
    session: String,
    /// Of the owner that was asked.
    epoch: i64,
    /// At which it was told; `None` = etcd does not hold it any more.
    revision: Option<i64>,
    runtime: Handle,
}

impl Asked {
    /// Tells the owner of this epoch. To its end, also when whoever asks gives up: else nobody would know what to take back.
    async fn tell(cluster: &Cluster, session: &str, epoch: i64) -> Result<Self, Status> {
        let lease = cluster.0.lease.id().ok_or_else(|| moved(session))?;
        let (cluster, session, runtime) = (cluster.clone(), session.to_owned(), Handle::current());
        let telling = tokio::spawn(async move {
            let told = cluster.0.etcd.all(vec![put(&cluster.0.keys.want(&session), json(&cluster.0.me.server), lease)]).await?;
            Ok(Self { cluster, session, epoch, revision: Some(told.revision), runtime })
        });
        telling.await.map_err(|error| Status::internal(format!("asking for a session: {error}")))?
    }
}

impl Drop for Asked {
    fn drop(&mut self) {
        let Some(revision) = self.revision else { return };
        let want = self.cluster.0.keys.want(&self.session);
        // Unless another one has asked since then.
        self.runtime.spawn(self.cluster.clone().insist(vec![written(&want, revision)], vec![delete(&want)]));
    }
}

/// Whether no session can have this name: nothing is remembered of it and etcd is not asked.
fn is_nowhere(session: &str) -> bool {
    check_name("session_id", session).is_err()
}

impl Cluster {
    /// Brings a session here, wherever it is. `permit` hears the vehicle that it belongs to before anything is done.
    ///
    /// # Errors
    /// What `permit` says; UNAVAILABLE when the owner does not let go within `budget` or etcd does not answer; FAILED_PRECONDITION when the session
    /// cannot go on here, for example for another bundle.
    pub async fn bring(&self, session: &str, budget: Duration, permit: impl Fn(&str) -> Result<(), Status>) -> Result<Brought, Status> {
        self.have(session, Zeal::Ask, budget, permit).await
    }

    /// Makes this server the owner of a name under which a session is to begin. A session that has the name already stays where it is: who may only open
    /// sessions must not move those of others.
    ///
    /// # Errors
    /// ALREADY_EXISTS for `field` when a session of this name is stored; else as [`Cluster::bring`].
    pub async fn claim(&self, session: &str, field: &'static str, budget: Duration) -> Result<Claim, Status> {
        // Before anything is taken: whoever asks may give up at any time.
        let claim = Claim::new(self, session);
        let taken = |_: &str| Err(to_status(EngineError::SessionExists { session: session.into(), field }));
        self.have(session, Zeal::Create, budget, taken).await.map(|_| claim)
    }

    /// Where a session is, for a bus that tells every server of it.
    pub fn standing(&self, session: &str) -> Standing {
        if self.is_here(session).unwrap_or(false) {
            return Standing::Here;
        }
        if self.is_elsewhere(session) {
            return Standing::Elsewhere;
        }
        if is_nowhere(session) {
            return Standing::Lost;
        }
        let now = Instant::now();
        let mut state = self.lock();
        state.looked.retain(|_, at| now.duration_since(*at) < SEARCH_PAUSE);
        if state.looked.contains_key(session) {
            return Standing::Elsewhere;
        }
        state.looked.insert(session.into(), now);
        Standing::Lost
    }

    /// Brings a session of this vehicle here if no server has it; `None` = another one was quicker, it is another vehicle's, etcd does not answer, or too many
    /// are being brought: whoever measures or asks does so again.
    pub async fn search(&self, session: &str, vehicle: &str, budget: Duration) -> Option<Brought> {
        if self.lock().turns.len() >= TURNS_MAX {
            return None;
        }
        let own = |of: &str| if of == vehicle { Ok(()) } else { Err(Status::permission_denied("of another vehicle")) };
        self.have(session, Zeal::IfFree, budget, own).await.ok()
    }

    async fn have(
        &self,
        session: &str,
        zeal: Zeal,
        budget: Duration,
        permit: impl Fn(&str) -> Result<(), Status>,
    ) -> Result<Brought, Status> {
        if is_nowhere(session) {
            return Ok(Brought::Nowhere);
        }
        let now = Instant::now();
        let until = now + budget.min(WAIT_MAX);
        // Without a lease nothing can be said. It may come back; a refusal at once would only bring the client back to this server. Once a proxy that watches
        // /health knows, another server answers who asks again; not every proxy cuts off who waits here.
        while self.0.lease.id().is_none() && Instant::now() < until.min(now + LEASE_WAIT) {
            tokio::time::sleep(LEASE_PAUSE).await;
        }
        if self.is_here(session)? {
            return Ok(Brought::Here);
        }
        let turn = self.turn(session).await;
        let result = self.have_in_turn(session, zeal, until, permit, turn).await;
        self.tidy_turns();
        result
    }

    /// Waits for the turn of a session: who takes it, or lets go what was begun for nobody, does so one after the other.
    pub(super) async fn turn(&self, session: &str) -> OwnedMutexGuard<()> {
        let turn = self.lock().turns.entry(session.into()).or_default().clone();
        turn.lock_owned().await
    }

    pub(super) fn end_turn(&self, turn: OwnedMutexGuard<()>) {
        drop(turn);
        self.tidy_turns();
    }

    fn tidy_turns(&self) {
        self.lock().turns.retain(|_, turn| Arc::strong_count(turn) > 1);
    }

    async fn have_in_turn(
        &self,
        session: &str,
        zeal: Zeal,
        until: Instant,
        permit: impl Fn(&str) -> Result<(), Status>,
        mut turn: OwnedMutexGuard<()>,
    ) -> Result<Brought, Status> {
        let mut changes = self.0.changes.subscribe();
        // One that took the session since then has not heard.
        let mut asked: Option<Asked> = None;
        loop {
            if self.is_here(session)? {
                return Ok(Brought::Here);
            }
            changes.borrow_and_update();
            let seen = self.look(session).await?;
            let image = seen.stored.as_ref().map(resumed).transpose().map_err(to_status)?;
            match &image {
                Some(image) => permit(&image.vehicle)?,
                // Somebody may be about to begin it; it is not there yet.
                None if zeal != Zeal::Create => return Ok(Brought::Nowhere),
                None => {}
            }
            let Some((epoch, lease, owner)) = seen.owner else {
                // To its end, and nobody else's turn before, also when the client does not wait any longer: a session half taken would be nobody's.
                let (cluster, name) = (self.clone(), session.to_owned());
                let taking = tokio::spawn(async move { (cluster.take(&name).await, turn) });
                let (taken, back) = taking.await.map_err(|error| Status::internal(format!("taking session `{session}`: {error}")))?;
                turn = back;
                if taken? {
                    // With the wish.
                    asked.iter_mut().for_each(|asked| asked.revision = None);
                    return Ok(Brought::Here);
                }
                continue;
            };
            if Some(lease) == self.0.lease.id() {
                // Taken by this server and never begun.
                self.release_key(session, epoch).await?;
                continue;
            }
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() || zeal == Zeal::IfFree {
                let reason = format!("session `{session}` is with server `{}` ({}), which has not let go of it", owner.name, owner.address);
                return Err(again(&reason, self.0.lease.length() / 4));
            }
            if asked.as_ref().is_none_or(|asked| asked.epoch != epoch) {
                asked = Some(Asked::tell(self, session, epoch).await?);
            }
            let _ = tokio::time::timeout(left.min(LOOK_AGAIN), changes.changed()).await;
        }
    }

    async fn look(&self, session: &str) -> Result<Seen, Status> {
        let keys = &self.0.keys;
        let read = self.0.etcd.all(vec![get(&keys.owner(session)), get(&keys.session(session))]).await?.read;
        let mut found = read.into_iter().map(first);
        let owner = found.next().flatten().map(|owner| {
            let server = of_json(&owner.value).unwrap_or_else(|| Server { name: "?".into(), address: "?".into() });
            (owner.create_revision, owner.lease, server)
        });
        let stored = found.next().flatten().map(|found| stored_session(session, &found)).transpose()?;
        Ok(Seen { owner, stored })
    }

    /// Takes a session that nobody has, and goes on with what is stored of it; false = somebody else was quicker.
    async fn take(&self, session: &str) -> Result<bool, Status> {
        let (keys, begun) = (&self.0.keys, Instant::now());
        let Some(lease) = self.0.lease.id() else { return Err(moved(session)) };
        let owner = keys.owner(session);
        // Read in the same transaction: nobody writes after it without the new epoch.
        let then = vec![put(&owner, json(&self.0.me.server), lease), delete(&keys.want(session)), get(&keys.session(session))];
        let done = self.0.etcd.transaction(vec![created(&owner, 0)], then).await?;
        if !done.held {
            return Ok(false);
        }
        let epoch = done.revision;
        self.lock().held.insert(session.into(), Held { epoch, since: Instant::now(), stage: Stage::Arriving });
        let stored = done.read.into_iter().flat_map(first).next();
        let begun_here = match stored.map(|found| stored_session(session, &found)).transpose() {
            Ok(None) => Ok(false),
            Ok(Some(stored)) => self.go_on(session, &stored).await.map(|()| true),
            Err(status) => Err(status),
        };
        match begun_here {
            Ok(went_on) => {
                if !self.arrived(session, epoch) {
                    // The lease has ended meanwhile, perhaps before the engine had the session, so that nothing was closed then.
                    self.forget(session).await;
                    return Err(moved(session));
                }
                self.lock().counts.taken += u64::from(went_on);
                self.heed(session);
                if went_on {
                    tracing::info!(session, epoch, took_s = begun.elapsed().as_secs_f64(), "session taken");
                }
                Ok(true)
            }
            Err(status) => {
                self.let_go(session, epoch).await;
                Err(status)
            }
        }
    }

    /// Notes that a session can be used from now on; false when it is not held any more.
    fn arrived(&self, session: &str, epoch: i64) -> bool {
        let mut state = self.lock();
        let Some(held) = state.held.get_mut(session).filter(|held| held.epoch == epoch) else { return false };
        held.stage = Stage::Here;
        true
    }

    /// Puts a stored session and its map into the engine.
    async fn go_on(&self, session: &str, stored: &StoredSession) -> Result<(), Status> {
        let mut image: SessionImage = resumed(stored).map_err(to_status)?;
        if let Some((map, hash)) = &mut image.map {
            *hash = self.have_map(map).await?;
        }
        let refused = |error: EngineError| match error {
            EngineError::Expired | EngineError::Overloaded { .. } | EngineError::Stopped => {
                again(&format!("session `{session}` has not gone on on this server yet: {error}"), NO_TURN)
            }
            error => Status::failed_precondition(format!(
                "session `{session}` cannot go on on this server: {error}; its servers must have the same bundle and limits"
            )),
        };
        self.0.engine.import(image, session, ENGINE_WAIT).await.map(drop).map_err(refused)
    }
}

fn first(found: Vec<KeyValue>) -> Option<KeyValue> {
    found.into_iter().next()
}

fn stored_session(session: &str, found: &KeyValue) -> Result<StoredSession, Status> {
    session_of(session, &found.value).ok_or_else(|| Status::data_loss(format!("what etcd holds of session `{session}` is no session")))
}
