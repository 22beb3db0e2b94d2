//! What is not on stable storage yet, and the thread that brings it there.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use nesam_engine::sync::thread::{self, JoinHandle};
use nesam_engine::sync::{Condvar, Mutex, MutexGuard};
use nesam_engine::{CellKey, Command, EngineHandle, Event, FleetCell, Reply, Snapshot};
use prost::Message as _;
use tokio::sync::watch;
use tokio::time::Instant;

use super::map_bytes::map_bytes;
use super::restore::{Restored, StoredMap};
use super::{Change, SessionStore, StoreError, StoredSession, StoredSoil};
use crate::clock::unix_ns;
use crate::convert::{SoilTeller, image_bytes};

/// Pause before a commit that failed is tried again.
const RETRY_AFTER: Duration = Duration::from_secs(1);
/// Pause between two looks of a keeper without a thread.
const LOOK_EVERY: Duration = Duration::from_millis(10);
/// Time for which it is remembered that a session left, for those who still wait for the store or learn of it late.
const LEFT_KEPT: Duration = Duration::from_secs(60);

/// Accepted measurements of each session in a commit; `None` = the session was closed. One that belongs to another server is not among them.
type Places = BTreeMap<String, Option<u64>>;

/// What can change.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Key {
    Session(String),
    Map(String),
    /// What was brought to a cell of the soil map of the fleet.
    Soil(CellKey),
}

/// A change that is not on stable storage yet. Changes are numbered in the order in which the engine made them.
#[derive(Clone, Copy, Debug)]
struct Dirty {
    /// First and last change that no commit holds.
    first: u64,
    latest: u64,
    /// When the first of them was made, at the latest.
    since: Instant,
    due: Instant,
}

/// Counters of a store.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct StoreCounts {
    pub commits: u64,
    pub failures: u64,
    pub bytes: u64,
    /// Time of all commits together, s.
    pub commit_s: f64,
    /// Sessions and maps that wait for a commit.
    pub waiting: usize,
    /// Time for which the oldest of them has waited, s.
    pub oldest_s: f64,
    /// Sessions that the server could not read at its start.
    pub set_aside: usize,
}

#[derive(Debug, Default)]
struct State {
    changes: u64,
    dirty: BTreeMap<Key, Dirty>,
    /// Accepted measurements of each session that are on stable storage.
    durable: BTreeMap<String, u64>,
    /// Last opening or closing of sessions since their last commit: what was read before says nothing of the session of that name now.
    renamed: BTreeMap<String, u64>,
    /// What was brought to the cells that wait for a commit: edge of a cell in m, evidence, and when that was, ns since 1970.
    soil: BTreeMap<CellKey, (f64, FleetCell, i64)>,
    /// Sessions that are taken out of the engine without being closed: other servers have them.
    gone: BTreeSet<String>,
    /// Last change of sessions that left, up to which nobody knows what was written, and when they did; until this server writes one of that name again.
    left: BTreeMap<String, (u64, Instant)>,
    /// Maps that were taken out of the store by somebody else.
    lost_maps: BTreeSet<String>,
    counts: StoreCounts,
    stopping: bool,
}

impl State {
    /// Notes a change that is to be written at this instant; gives its number.
    fn change(&mut self, key: Key, due: Instant) -> u64 {
        self.changes += 1;
        let latest = self.changes;
        let entry = self.dirty.entry(key).or_insert(Dirty { first: latest, latest, since: Instant::now(), due });
        *entry = Dirty { latest, due: due.min(entry.due), ..*entry };
        latest
    }

    /// Notes that a session is another server's, whose changes up to this one may not be written.
    fn leave(&mut self, session: &str, change: u64) {
        let before = self.left.get(session).map_or(0, |(before, _)| *before);
        self.left.insert(session.into(), (change.max(before), Instant::now()));
    }

    /// Time for which the oldest change that is not on stable storage has waited; `None` = nothing waits.
    fn oldest(&self) -> Option<Duration> {
        self.dirty.values().map(|dirty| dirty.since).min().map(|since| since.elapsed())
    }

    /// Whether the changes of a session or map up to this one are on stable storage; `None` = not yet.
    fn settled(&self, key: &Key, latest: u64) -> Option<bool> {
        if let Key::Session(session) = key
            && self.left.get(session).is_some_and(|(left, _)| latest <= *left)
        {
            return Some(false);
        }
        self.dirty.get(key).is_none_or(|dirty| dirty.first > latest).then_some(true)
    }
}

/// Knows what is durable and sees to it that everything becomes so.
#[derive(Debug)]
pub struct Keeper {
    state: Mutex<State>,
    changed: Condvar,
    /// Counts the commits and the sessions that left, for those who wait for one.
    committed: watch::Sender<u64>,
    interval: Duration,
    /// Whose soil map is kept; `None` = nobody's.
    soil_of: Option<SoilTeller>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

impl Keeper {
    /// A keeper that only notes until [`Keeper::start`].
    pub fn new(interval: Duration) -> Self {
        let (committed, _) = watch::channel(0);
        Self { state: Mutex::default(), changed: Condvar::new(), committed, interval, soil_of: None, thread: Mutex::new(None) }
    }

    /// Whose evidence of the soil is kept.
    pub(crate) fn soil_of(&self) -> Option<&SoilTeller> {
        self.soil_of.as_ref()
    }

    /// Keeps what is brought to the soil map of the fleet too.
    pub(crate) fn with_soil(self, of: SoilTeller) -> Self {
        Self { soil_of: Some(of), ..self }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("no holder of the keeper's state panics; this is a bug")
    }

    /// Hears the engine; called on its thread.
    pub fn note(&self, event: &Event) {
        let (key, wait) = match event {
            Event::SessionOpened { session, .. } | Event::SessionClosed { session, .. } | Event::EffectsChanged { session, .. } => {
                (Key::Session(session.clone()), Duration::ZERO)
            }
            Event::MeasurementAccepted { session, buffer_ended } => {
                (Key::Session(session.clone()), if *buffer_ended { Duration::ZERO } else { self.interval })
            }
            Event::MapChanged { map, .. } => (Key::Map(map.clone()), Duration::ZERO),
            Event::FleetSoilChanged { own, .. } if self.soil_of.is_some() => (Key::Soil(own.key.clone()), self.interval),
            Event::SoilChanged { .. } | Event::FleetSoilChanged { .. } | Event::AlarmChanged { .. } | Event::SoilFilterFailed { .. } => {
                return;
            }
        };
        let mut state = self.lock();
        if let Event::FleetSoilChanged { cell_m, own, .. } = event {
            state.soil.insert(own.key.clone(), (*cell_m, (**own).clone(), unix_ns()));
        }
        if let Key::Session(session) = &key
            && state.gone.contains(session)
        {
            if !matches!(event, Event::SessionOpened { .. }) {
                return;
            }
            state.gone.remove(session);
        }
        let latest = state.change(key, Instant::now() + wait);
        if let Event::SessionOpened { session, .. } | Event::SessionClosed { session, .. } = event {
            state.durable.remove(session);
            state.renamed.insert(session.clone(), latest);
        }
        if wait.is_zero() {
            self.changed.notify_one();
        }
    }

    /// Accepted measurements of a session that are on stable storage.
    pub fn durable(&self, session: &str) -> u64 {
        self.lock().durable.get(session).copied().unwrap_or(0)
    }

    /// Counters.
    pub(crate) fn counts(&self) -> StoreCounts {
        let state = self.lock();
        StoreCounts { waiting: state.dirty.len(), oldest_s: state.oldest().unwrap_or_default().as_secs_f64(), ..state.counts }
    }

    /// Time for which the oldest change that is not on stable storage has waited; `None` = nothing waits.
    pub(crate) fn oldest(&self) -> Option<Duration> {
        self.lock().oldest()
    }

    /// Resolves when every change that is noted now of a session or map is on stable storage; says whether that was within `budget`. A session that left for
    /// another server before is not: nobody knows what was written of it.
    pub(crate) async fn settled(&self, key: &Key, budget: Duration) -> bool {
        let mut committed = self.committed.subscribe();
        // 0 = nothing waits.
        let latest = self.lock().dirty.get(key).map_or(0, |dirty| dirty.latest);
        let wait = async {
            loop {
                let settled = self.lock().settled(key, latest);
                if let Some(settled) = settled {
                    return settled;
                }
                if committed.changed().await.is_err() {
                    return false;
                }
            }
        };
        tokio::time::timeout(budget, wait).await.unwrap_or(false)
    }

    /// Whether a session has left for another server a moment ago, and was not written here since then.
    pub(crate) fn has_left(&self, session: &str) -> bool {
        self.lock().left.contains_key(session)
    }

    /// Makes what waits for a commit due now.
    pub(crate) fn hurry(&self, key: &Key) {
        if let Some(dirty) = self.lock().dirty.get_mut(key) {
            dirty.due = Instant::now();
            self.changed.notify_one();
        }
    }

    /// Forgets a session that goes to another server: that the engine will lose it is no closing.
    pub fn forget(&self, session: &str) {
        let mut state = self.lock();
        state.changes += 1;
        let latest = state.changes;
        state.dirty.remove(&Key::Session(session.into()));
        state.leave(session, latest);
        state.durable.remove(session);
        // A commit that runs now says nothing of a session of that name that comes later.
        state.renamed.insert(session.into(), latest);
        state.gone.insert(session.into());
        drop(state);
        self.committed.send_modify(|commits| *commits += 1);
    }

    /// The engine did not have a forgotten session, or has lost it: from now on its name is like any other.
    pub fn forgotten(&self, session: &str) {
        self.lock().gone.remove(session);
    }

    /// The store does not hold a map any more: it is written again if the engine holds it.
    pub(crate) fn lost_map(&self, map: &str) {
        let mut state = self.lock();
        state.lost_maps.insert(map.into());
        state.change(Key::Map(map.into()), Instant::now());
        drop(state);
        self.changed.notify_one();
    }

    /// What was restored is durable already.
    fn begin(self: &Arc<Self>, store: Box<dyn SessionStore>, engine: EngineHandle, restored: Restored) -> Work {
        let mut state = self.lock();
        state.dirty.clear();
        state.renamed.clear();
        state.soil.clear();
        state.durable = restored.accepted;
        state.counts.set_aside = restored.set_aside.len();
        drop(state);
        Work { keeper: Arc::clone(self), store, engine, maps: restored.maps, set_aside: restored.set_aside }
    }

    /// Does in the calling task what the thread does, without an end, for a server on one thread.
    pub async fn keep(self: Arc<Self>, store: Box<dyn SessionStore>, engine: EngineHandle, restored: Restored) {
        let mut work = self.begin(store, engine, restored);
        loop {
            tokio::time::sleep(LOOK_EVERY).await;
            let due = self.due(&mut self.lock());
            if !due.is_empty() {
                work.commit_in_task(&due).await;
            }
        }
    }

    /// Starts the thread.
    ///
    /// # Errors
    /// `StoreError::File` when the system refuses to start a thread.
    pub fn start(self: &Arc<Self>, store: Box<dyn SessionStore>, engine: EngineHandle, restored: Restored) -> Result<(), StoreError> {
        let work = self.begin(store, engine, restored);
        let thread = thread::Builder::new().name("nesam-store".into()).spawn(move || work.run());
        let thread = thread.map_err(|source| StoreError::File { path: "thread nesam-store".into(), source })?;
        if let Ok(mut held) = self.thread.lock() {
            *held = Some(thread);
        }
        Ok(())
    }

    /// Commits what is left and ends the thread. The engine must still run. Gives how many sessions, maps and cells of the soil map have changes that the store
    /// did not take.
    pub fn finish(&self) -> usize {
        self.lock().stopping = true;
        self.changed.notify_all();
        let thread = self.thread.lock().ok().and_then(|mut thread| thread.take());
        if thread.is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the store's thread panicked; what was not durable is lost; this is a bug");
        }
        self.lock().dirty.len()
    }

    /// What is due now, everything once the server stops: each with its latest change.
    fn due(&self, state: &mut State) -> BTreeMap<Key, u64> {
        let (now, stopping) = (Instant::now(), state.stopping);
        let due = state.dirty.iter_mut().filter(|(_, dirty)| stopping || dirty.due <= now);
        due.map(|(key, dirty)| {
            // What changes while this is committed is due by itself.
            dirty.due = now + self.interval;
            (key.clone(), dirty.latest)
        })
        .collect()
    }

    /// Changes that make these cells durable.
    fn soil(&self, due: &BTreeMap<Key, u64>) -> Vec<Change> {
        let Some(of) = &self.soil_of else { return Vec::new() };
        let state = self.lock();
        let cells = due.keys().filter_map(|key| if let Key::Soil(cell) = key { state.soil.get(cell) } else { None });
        let change = |(cell_m, cell, saved_unix_ns): &(f64, FleetCell, i64)| {
            let CellKey { map, colour: [red, green, blue], cell: [column, row] } = &cell.key;
            Change::PutSoil(StoredSoil {
                key: format!("{}/{map}/{red:02x}{green:02x}{blue:02x}/{column}/{row}", of.service()),
                saved_unix_ns: *saved_unix_ns,
                share: of.tell_cell(*cell_m, cell).encode_to_vec(),
            })
        };
        cells.map(change).collect()
    }

    /// Waits until something is due; nothing when the server stops and there is nothing left to do.
    fn next_due(&self) -> BTreeMap<Key, u64> {
        let mut state = self.lock();
        loop {
            let due = self.due(&mut state);
            if !due.is_empty() || state.stopping {
                return due;
            }
            let next = state.dirty.values().map(|dirty| dirty.due).min();
            // Woken by a change that is due at once; what is due later is looked at after an interval at the latest.
            let pause = next.map_or(self.interval, |next| next.saturating_duration_since(Instant::now()));
            (state, _) = self.changed.wait_timeout(state, pause).expect("no holder of the keeper's state panics; this is a bug");
        }
    }

    /// Notes a commit of changes up to these.
    fn committed(&self, due: &BTreeMap<Key, u64>, places: &Places, bytes: u64, took: Duration) {
        let mut state = self.lock();
        let now = Instant::now();
        let begun = now.checked_sub(took).unwrap_or(now);
        for (key, written) in due {
            if let Some(dirty) = state.dirty.get_mut(key) {
                // What is left came while this was committed.
                (dirty.first, dirty.since) = (written + 1, begun);
                if dirty.latest == *written {
                    state.dirty.remove(key);
                }
            }
            let session = match key {
                Key::Session(session) => session,
                Key::Soil(cell) if !state.dirty.contains_key(key) => {
                    state.soil.remove(cell);
                    continue;
                }
                Key::Soil(_) | Key::Map(_) => continue,
            };
            let place = places.get(session).copied();
            if place.is_none() {
                state.leave(session, *written);
            }
            if state.renamed.get(session).is_some_and(|renamed| renamed > written) {
                continue;
            }
            state.renamed.remove(session);
            match place.flatten() {
                Some(accepted) => state.durable.insert(session.clone(), accepted),
                None => state.durable.remove(session),
            };
            if place.is_some() {
                state.left.remove(session);
            }
        }
        state.left.retain(|_, (_, since)| since.elapsed() < LEFT_KEPT);
        state.counts.commits += 1;
        state.counts.bytes += bytes;
        state.counts.commit_s += took.as_secs_f64();
        drop(state);
        self.committed.send_modify(|commits| *commits += 1);
    }

    /// Notes that a commit failed; it is tried again. Says whether the server waits for the end.
    fn failed(&self, due: &BTreeMap<Key, u64>) -> bool {
        let mut state = self.lock();
        let again = Instant::now() + RETRY_AFTER;
        for key in due.keys() {
            if let Some(dirty) = state.dirty.get_mut(key) {
                dirty.due = again;
            }
        }
        state.counts.failures += 1;
        state.stopping
    }
}

/// What one commit is to hold.
struct Batch {
    changes: Vec<Change>,
    places: Places,
    /// Each map in the store after it.
    maps: BTreeMap<String, StoredMap>,
    bytes: u64,
}

/// What commits.
struct Work {
    keeper: Arc<Keeper>,
    store: Box<dyn SessionStore>,
    engine: EngineHandle,
    /// Each map in the store.
    maps: BTreeMap<String, StoredMap>,
    /// Sessions in the store that nobody could read, and whose names nobody has taken yet.
    set_aside: BTreeSet<String>,
}

impl Work {
    /// The thread: commits what is due until everything is written and the server stops.
    fn run(mut self) {
        loop {
            let due = self.keeper.next_due();
            if due.is_empty() || !self.commit(&due) {
                return;
            }
        }
    }

    /// Commits these, or sees to it that they are tried again; false when the server stops and will not wait for that.
    fn commit(&mut self, due: &BTreeMap<Key, u64>) -> bool {
        let begun = Instant::now();
        match self.read(due) {
            Ok(batch) => {
                let committed = self.store.commit(&batch.changes);
                self.note(due, begun, batch, committed)
            }
            Err(reason) => self.failed(due, &reason),
        }
    }

    /// The same in a task.
    async fn commit_in_task(&mut self, due: &BTreeMap<Key, u64>) -> bool {
        let begun = Instant::now();
        match self.read(due) {
            Ok(batch) => {
                let committed = self.store.commit_in_task(&batch.changes).await;
                self.note(due, begun, batch, committed)
            }
            Err(reason) => self.failed(due, &reason),
        }
    }

    /// Notes that a batch was written but for sessions that belong to another server, or that it was not.
    fn note(&mut self, due: &BTreeMap<Key, u64>, begun: Instant, batch: Batch, committed: Result<Vec<String>, StoreError>) -> bool {
        match committed {
            Ok(foreign) => {
                let Batch { mut places, maps, bytes, .. } = batch;
                places.retain(|session, _| !foreign.contains(session));
                self.set_aside.retain(|session| !places.contains_key(session));
                self.maps = maps;
                self.keeper.committed(due, &places, bytes, begun.elapsed());
                true
            }
            Err(error) => self.failed(due, &error.to_string()),
        }
    }

    fn failed(&self, due: &BTreeMap<Key, u64>, reason: &str) -> bool {
        tracing::error!(reason, changes = due.len(), "sessions are not durable: the store did not take them; tried again");
        !self.keeper.failed(due)
    }

    /// Reads the present state of these sessions and maps.
    fn read(&mut self, due: &BTreeMap<Key, u64>) -> Result<Batch, String> {
        let lost_maps = std::mem::take(&mut self.keeper.lock().lost_maps);
        self.maps.retain(|map, _| !lost_maps.contains(map));
        let snapshot = self.snapshot(due)?;
        let (mut changes, mut places, mut maps) = (Vec::new(), Places::new(), self.maps.clone());
        for (id, map) in &snapshot.maps {
            match map {
                Some(map) => {
                    let stored = StoredMap::of(map);
                    if maps.get(id) != Some(&stored) {
                        maps.insert(id.clone(), stored);
                        changes.push(Change::PutMap(id.clone(), map_bytes(map)));
                    }
                }
                None => {
                    maps.remove(id);
                    changes.push(Change::RemoveMap(id.clone()));
                }
            }
        }
        let saved_unix_ns = unix_ns();
        for (name, image) in snapshot.sessions {
            places.insert(name.clone(), image.as_ref().map(|image| image.accepted));
            if self.set_aside.contains(&name) {
                changes.push(Change::SetAside(name.clone()));
            }
            changes.push(match image {
                Some(image) => Change::PutSession(StoredSession { name, saved_unix_ns, image: image_bytes(&image) }),
                None => Change::RemoveSession(name),
            });
        }
        changes.extend(self.keeper.soil(due));
        let bytes = changes.iter().map(weight).sum();
        Ok(Batch { changes, places, maps, bytes })
    }

    fn snapshot(&mut self, due: &BTreeMap<Key, u64>) -> Result<Snapshot, String> {
        let (mut sessions, mut maps) = (Vec::new(), Vec::new());
        for key in due.keys() {
            match key {
                Key::Session(name) => sessions.push(name.clone()),
                Key::Map(id) => maps.push(id.clone()),
                Key::Soil(_) => {}
            }
        }
        self.store.begin(&sessions);
        match self.engine.call(Command::Snapshot { sessions, maps }) {
            Ok(Reply::Snapshot(snapshot)) => Ok(*snapshot),
            Ok(_) => Err("the engine answered with another reply; this is a bug".into()),
            Err(error) => Err(error.to_string()),
        }
    }
}

fn weight(change: &Change) -> u64 {
    match change {
        Change::PutSession(session) => session.image.len() as u64,
        Change::PutMap(_, bytes) => bytes.len() as u64,
        Change::PutSoil(soil) => soil.share.len() as u64,
        Change::SetAside(_) | Change::RemoveSession(_) | Change::RemoveMap(_) | Change::RemoveSoil(_) => 0,
    }
}

#[cfg(test)]
mod tests;
