//! Makes the updates of the live page: one thread of its own, one rendering for all pages, and nothing at all while nobody watches.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use nesam_engine::{Command, Reply, Submission};
use nesam_model::{CacheCounts, Predictor};
use nesam_physics::Vehicle;
use serde_json::{Value, json};
use tokio::sync::broadcast;
use tokio::sync::mpsc::Receiver;

use super::alarms::{ServiceFacts, alarms};
use super::feed::{Feed, Note};
use super::frame::{Cursor, Scenery};
use super::notes::Notes;
use super::reports::Reports;
use crate::call::EngineClient;
use crate::clock::MonotonicClock;
use crate::recording::Recorder;
use crate::zenoh::Presence;

/// Time between two updates.
const UPDATE_EVERY: Duration = Duration::from_millis(125);
/// Time for which a page that was closed or reloaded finds its past again.
const KEPT_FOR: Duration = Duration::from_secs(30);
/// Updates that a page may lag behind; then it begins anew.
const UPDATES_KEPT: usize = 8;
/// Longest wait for the engine, which has more important things to do.
const ENGINE_WAIT: Duration = Duration::from_secs(1);
/// Updates over which the recent hit rate of the terrain cache is taken, 10 s.
const CACHE_UPDATES: usize = 80;

/// One update, the same for all pages.
#[derive(Debug)]
pub(crate) struct Update {
    /// What is new since the update before it, as JSON.
    pub fresh: String,
    /// Everything, as JSON, when a page asked for it.
    pub whole: Option<String>,
}

/// The desk that pages and painter share.
#[derive(Debug)]
pub(crate) struct Desk {
    updates: broadcast::Sender<Arc<Update>>,
    whole_wanted: AtomicBool,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    watchers: usize,
    stopped: bool,
}

impl Desk {
    pub fn new() -> Self {
        let (updates, _) = broadcast::channel(UPDATES_KEPT);
        Self { updates, whole_wanted: AtomicBool::new(false), state: Mutex::default(), changed: Condvar::new() }
    }

    /// Takes a place among at most `most` watchers; false when there is none left.
    pub fn enter(&self, most: usize) -> bool {
        let mut state = self.state();
        if state.stopped || state.watchers >= most {
            return false;
        }
        state.watchers += 1;
        self.changed.notify_all();
        true
    }

    /// Gives the place back.
    pub fn leave(&self) {
        self.state().watchers -= 1;
    }

    /// The updates from now on.
    pub fn subscribe(&self) -> broadcast::Receiver<Arc<Update>> {
        self.updates.subscribe()
    }

    /// Asks for an update that holds everything.
    pub fn ask_whole(&self) {
        self.whole_wanted.store(true, Ordering::Relaxed);
    }

    /// Whether a page has asked for it since the last look.
    pub fn take_whole_wanted(&self) -> bool {
        self.whole_wanted.swap(false, Ordering::Relaxed)
    }

    /// Hands an update to all pages; one that nobody listens to is lost.
    pub fn publish(&self, update: Update) {
        let _ = self.updates.send(Arc::new(update));
    }

    /// Ends the painter.
    pub fn stop(&self) {
        self.state().stopped = true;
        self.changed.notify_all();
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sleeps until somebody watches; false when the service stops.
    fn wait_for_watcher(&self) -> bool {
        let mut state = self.state();
        while state.watchers == 0 && !state.stopped {
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        !state.stopped
    }

    /// Sleeps for the time between two updates; whether somebody watches, `None` when the service stops.
    fn wait_for_turn(&self) -> Option<bool> {
        let until = Instant::now() + UPDATE_EVERY;
        let mut state = self.state();
        loop {
            let left = until.saturating_duration_since(Instant::now());
            if state.stopped || left.is_zero() {
                return (!state.stopped).then_some(state.watchers > 0);
            }
            state = self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

/// What the painter knows of the service.
pub(crate) struct Painter {
    pub engine: EngineClient,
    pub predictor: Arc<Predictor>,
    pub presence: Option<Presence>,
    pub clock: MonotonicClock,
    pub recorder: Option<Arc<Recorder>>,
    pub reports: Reports,
    pub desk: Arc<Desk>,
    pub feed: Feed,
    pub passed: Receiver<Note>,
}

/// What is on the canvas while somebody watches.
struct Canvas {
    notes: Notes,
    cursor: Cursor,
    scenery: Scenery,
    /// Counts of the terrain caches at the last updates.
    caches: Vec<CacheCounts>,
    reports_seen: Option<u64>,
}

impl Painter {
    /// Starts the thread. It ends with [`Desk::stop`].
    ///
    /// # Errors
    /// When the system refuses to start a thread.
    pub fn start(self) -> std::io::Result<()> {
        std::thread::Builder::new().name("nesam-page".into()).spawn(move || self.run()).map(|_| ())
    }

    fn run(mut self) {
        while self.desk.wait_for_watcher() {
            self.feed.watch(true);
            self.paint_while_watched();
            self.feed.watch(false);
            while self.passed.try_recv().is_ok() {}
        }
    }

    /// Paints until nobody has watched for a while or the service stops.
    fn paint_while_watched(&mut self) {
        let mut canvas: Option<Canvas> = None;
        let mut unwatched_since: Option<Instant> = None;
        while let Some(watched) = self.desk.wait_for_turn() {
            match unwatched_since {
                _ if watched => unwatched_since = None,
                Some(since) if since.elapsed() > KEPT_FOR => return,
                Some(_) => {}
                None => unwatched_since = Some(Instant::now()),
            }
            // What passes while the engine lists its sessions waits in the feed.
            if canvas.is_none() {
                canvas = self.begin();
            }
            let Some(canvas) = &mut canvas else { continue };
            self.take_notes(&mut canvas.notes);
            if watched {
                self.fetch_maps(canvas);
                canvas.scenery.look_at_soil(&canvas.notes);
                self.desk.publish(self.paint(canvas));
            }
        }
    }

    /// The sessions as they are now; `None` when the engine does not say in time.
    fn begin(&self) -> Option<Canvas> {
        let Some(Reply::Sessions(sessions)) = self.ask(Command::List) else { return None };
        let notes = Notes::begin(&sessions, self.now_s());
        let scenery = Scenery::new(Arc::clone(&self.predictor));
        Some(Canvas { notes, cursor: Cursor::default(), scenery, caches: Vec::new(), reports_seen: None })
    }

    fn now_s(&self) -> f64 {
        self.clock.elapsed().as_secs_f64()
    }

    /// Asks the engine; `None` when it refuses or does not answer in time.
    fn ask(&self, command: Command) -> Option<Reply> {
        let (sender, receiver) = std::sync::mpsc::sync_channel(1);
        self.engine.handle().submit(Submission::new(command, move |answer| {
            let _ = sender.try_send(answer.result);
        }));
        receiver.recv_timeout(ENGINE_WAIT).ok()?.ok()
    }

    fn take_notes(&mut self, notes: &mut Notes) {
        let at_s = self.now_s();
        // No more than wait now: what comes meanwhile is for the next update.
        for _ in 0..self.passed.len() {
            let Ok(note) = self.passed.try_recv() else { return };
            notes.take(note, at_s);
        }
    }

    /// Brings the maps up to date that sessions drive on; one question for each change.
    fn fetch_maps(&self, canvas: &mut Canvas) {
        let wanted: BTreeSet<(String, u64, String)> = canvas.notes.sessions.values().filter_map(|session| session.map.clone()).collect();
        let Canvas { notes, scenery, .. } = canvas;
        scenery.maps.retain(|id, _| wanted.iter().any(|(held, ..)| held == id));
        for (id, _, hash) in wanted {
            let is_current = scenery.maps.get(&id).is_some_and(|map| map.hash() == hash);
            if !is_current && let Some(Reply::Map(map)) = self.ask(Command::GetMap { map: id.clone() }) {
                // The engine may have gone on since the note.
                notes.take(Note::Map(id.clone(), map.version(), map.hash().into()), self.now_s());
                scenery.maps.insert(id, map);
            }
        }
    }

    /// Renders what is new, and everything where a page asked for it.
    fn paint(&self, canvas: &mut Canvas) -> Update {
        let cache = canvas.terrain_cache();
        let whole = self.desk.take_whole_wanted().then(|| self.render(canvas, &mut Cursor::default(), &cache, Some(self.reports.read())));
        let version = self.reports.version();
        let reports = (canvas.reports_seen != Some(version)).then(|| self.reports.read());
        canvas.reports_seen = Some(version);
        let mut cursor = std::mem::take(&mut canvas.cursor);
        let fresh = self.render(canvas, &mut cursor, &cache, reports);
        canvas.cursor = cursor;
        Update { fresh, whole }
    }

    /// What is new to this cursor, as JSON.
    fn render(&self, canvas: &Canvas, cursor: &mut Cursor, cache: &Value, reports: Option<Value>) -> String {
        let (notes, now_s) = (&canvas.notes, self.now_s());
        let counts = self.recorder.as_ref().map(|recorder| recorder.counts());
        let facts = ServiceFacts {
            dropped_commands: counts.as_ref().map(|counts| counts.dropped),
            recording_ended: counts.as_ref().is_some_and(|counts| counts.ended),
        };
        let bundle = self.predictor.bundle();
        let waiting = self.engine.handle().waiting();
        json!({
            "schema": "nesam.live/1",
            "now_s": now_s,
            "service": {
                "version": env!("CARGO_PKG_VERSION"),
                "bundle": bundle.name,
                "bundle_hash": bundle.hash,
                "vehicle_card": bundle.vehicle.name,
                "vehicle_length_m": extent(&bundle.vehicle, 0),
                "vehicle_width_m": extent(&bundle.vehicle, 1),
                "waiting": {"commands": waiting.0, "predictions": waiting.1},
                "predictions": self.engine.metrics().predictions(),
                "recording": counts.map(|counts| json!({"commands": counts.recorded, "dropped_commands": counts.dropped, "bytes": counts.bytes})),
                "vehicles_alive": self.presence.as_ref().map(|presence| presence.vehicles()),
                "terrain_cache": cache,
                "notes_missed": self.feed.missed(),
            },
            "timings": cursor.timings(notes),
            "sessions": cursor.sessions(notes, &canvas.scenery, now_s),
            "alarms": alarms(notes, facts, now_s).iter().map(|alarm| alarm.to_json()).collect::<Vec<_>>(),
            "reports": reports,
        })
        .to_string()
    }
}

impl Canvas {
    /// Share of the terrain lookups that found what they need, of all time and of the last ten seconds.
    fn terrain_cache(&mut self) -> Value {
        let mut now = CacheCounts::default();
        for map in self.scenery.maps.values() {
            let counts = self.scenery.predictor.terrain_cache(map);
            now.looked_up += counts.looked_up;
            now.encoded += counts.encoded;
        }
        if self.caches.len() == CACHE_UPDATES {
            self.caches.remove(0);
        }
        self.caches.push(now);
        // Counts go back when a map is changed or forgotten.
        let before = self.caches.iter().find(|c| c.looked_up <= now.looked_up && c.encoded <= now.encoded).copied().unwrap_or(now);
        let recent = now.since(before);
        let rate = |counts: CacheCounts| (counts.looked_up > 0).then(|| counts.hit_rate());
        json!({"hit_rate": rate(now), "recent_hit_rate": rate(recent), "looked_up": now.looked_up, "encoded": now.encoded})
    }
}

/// Length (axis 0) or width (axis 1) over the wheels, m.
fn extent(vehicle: &Vehicle, axis: usize) -> f64 {
    let (low, high) = vehicle
        .wheel_centre_m
        .iter()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), wheel| (low.min(wheel[axis]), high.max(wheel[axis])));
    high - low + if axis == 0 { 2.0 * vehicle.wheel_radius_m } else { vehicle.wheel_width_m }
}
