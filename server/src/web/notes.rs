//! What the live page shows, put together from what passed: owned by the painter alone.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use nesam_engine::{
    AppliedEffects, BufferTest, EngineError, MeasureAnswer, Measurement, Prediction, SessionView, SoilEstimate, WheelMeasurement,
};

use super::alarms::Raised;
use super::feed::Note;

/// Points of the driven path that are kept, 60 s at 10 Hz.
const TRAIL_MAX: usize = 600;
/// Least time between two of them, s.
const TRAIL_EVERY_S: f64 = 0.09;
/// Tests of soil buffers that are kept.
const TESTS_MAX: usize = 200;
/// Timings of predictions that are kept.
const TIMINGS_MAX: usize = 600;
/// Refused commands that are kept.
const REFUSALS_MAX: usize = 100;
/// Sessions that the page shows; further ones are served and not shown.
const SESSIONS_MAX: usize = 64;
/// Raised alarms that are kept.
const RAISED_MAX: usize = 100;

/// The notes. Times are s of the server's clock.
#[derive(Clone, Debug, Default)]
pub(crate) struct Notes {
    /// By name.
    pub sessions: BTreeMap<String, SessionNotes>,
    /// Timings of predictions.
    pub timings: Ring<PredictionTiming>,
    /// Refused commands: when, which, why.
    pub refusals: Ring<(f64, &'static str, EngineError)>,
    /// Alarms that others have raised and not taken back.
    pub raised: Vec<Raised>,
}

/// The last elements of a sequence, and how many there were before.
#[derive(Clone, Debug)]
pub(crate) struct Ring<T> {
    items: VecDeque<T>,
    total: u64,
}

impl<T> Default for Ring<T> {
    fn default() -> Self {
        Self { items: VecDeque::new(), total: 0 }
    }
}

impl<T> Ring<T> {
    /// Appends an element; the oldest goes when there are `most`.
    pub fn push(&mut self, item: T, most: usize) {
        if self.items.len() >= most {
            self.items.pop_front();
        }
        self.items.push_back(item);
        self.total += 1;
    }

    /// Elements ever pushed.
    pub fn total(&self) -> u64 {
        self.total
    }

    /// Those that are kept, oldest first.
    pub fn iter(&self) -> impl DoubleEndedIterator<Item = &T> {
        self.items.iter()
    }

    /// Those that are kept and were pushed after the first `seen`.
    pub fn after(&self, seen: u64) -> impl Iterator<Item = &T> {
        let fresh = usize::try_from(self.total.saturating_sub(seen)).unwrap_or(usize::MAX);
        self.items.iter().skip(self.items.len().saturating_sub(fresh))
    }
}

/// How long a prediction took.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PredictionTiming {
    /// When it was noted, s.
    pub at_s: f64,
    /// In the queue, s.
    pub queue_s: f64,
    /// In the engine, s.
    pub compute_s: f64,
    /// Candidates.
    pub samples: usize,
}

/// Notes of one session.
#[derive(Clone, Debug, Default)]
pub(crate) struct SessionNotes {
    /// Vehicle that it belongs to.
    pub vehicle: String,
    /// World map, its version and its hash.
    pub map: Option<(String, u64, String)>,
    /// Newest accepted measurement, and when it came, s.
    pub newest: Option<(Measurement, f64)>,
    /// Driven path: stamp in s, x, y, speed over ground.
    pub trail: Ring<[f64; 4]>,
    /// Effects that were applied, over those of the bundle.
    pub effects: AppliedEffects,
    /// Steps in the history.
    pub history_steps: usize,
    /// Measurements by what became of them.
    pub outcomes: BTreeMap<&'static str, u64>,
    /// When a measurement of that kind came last, s.
    pub outcome_at: BTreeMap<&'static str, f64>,
    /// What was learned of the soil.
    pub soil: Option<SoilEstimate>,
    /// Tests of the full buffers of the soil filter.
    pub tests: Ring<BufferTest>,
    /// Newest prediction of several candidates, numbered, and when, s.
    pub fan: Option<Shown>,
    /// Newest prediction with a covariance.
    pub region: Option<Shown>,
}

/// A prediction that the page shows.
#[derive(Clone, Debug)]
pub(crate) struct Shown {
    /// Counts the predictions.
    pub number: u64,
    /// When it was noted, s.
    pub at_s: f64,
    /// The prediction, shared with the asker.
    pub prediction: Arc<Prediction>,
}

impl Notes {
    /// The sessions that were open when somebody began to watch.
    pub fn begin(sessions: &[SessionView], now_s: f64) -> Self {
        let mut notes = Self::default();
        sessions.iter().for_each(|view| notes.open(view, now_s));
        notes
    }

    /// Takes one note in.
    pub fn take(&mut self, note: Note, at_s: f64) {
        match note {
            Note::Measured(measured) => {
                let (session, measurement, answer) = *measured;
                self.measured(session, &measurement, &answer, at_s);
            }
            Note::Predicted { session, prediction, queue_s, compute_s } => {
                let timing = PredictionTiming { at_s, queue_s, compute_s, samples: prediction.candidates() };
                self.predicted(session, prediction, timing);
            }
            Note::Session(view) => self.open(&view, at_s),
            Note::Ended(sessions) => sessions.iter().for_each(|session| {
                self.sessions.remove(session);
                self.raised.retain(|raised| raised.session.as_ref() != Some(session));
            }),
            Note::Map(id, version, hash) => {
                let users = self.sessions.values_mut().filter_map(|session| session.map.as_mut()).filter(|(map, ..)| *map == id);
                users.for_each(|(_, held_version, held_hash)| {
                    *held_version = version;
                    held_hash.clone_from(&hash);
                });
            }
            Note::Refused(command, error) => self.refusals.push((at_s, command, error), REFUSALS_MAX),
            Note::Alarm(raised) => self.raise(raised),
        }
    }

    fn session(&mut self, name: String) -> Option<&mut SessionNotes> {
        if !self.sessions.contains_key(&name) && self.sessions.len() >= SESSIONS_MAX {
            return None;
        }
        Some(self.sessions.entry(name).or_default())
    }

    fn raise(&mut self, raised: Raised) {
        self.raised.retain(|held| held.session != raised.session || held.id != raised.id);
        if raised.active && self.raised.len() < RAISED_MAX {
            self.raised.push(raised);
        }
    }

    /// Notes a session as it is told; when its newest step arrived is not told.
    fn open(&mut self, view: &SessionView, now_s: f64) {
        view.alarm.iter().for_each(|alarm| self.raise(Raised::by_watch(&view.session, alarm)));
        let Some(session) = self.session(view.session.clone()) else { return };
        session.vehicle.clone_from(&view.vehicle);
        session.map.clone_from(&view.provenance.map);
        session.effects.clone_from(&view.effects);
        session.history_steps = view.history_steps;
        session.soil = Some(view.soil);
        if let (None, Some(step)) = (&session.newest, &view.newest) {
            let stamp_ns = view.last_stamp_ns.unwrap_or(0);
            let wheels = WheelMeasurement::default();
            let newest =
                Measurement { sequence: view.last_sequence, boot: view.boot, stamp_ns, state: step.state, command: step.control, wheels };
            session.newest = Some((newest, now_s));
        }
    }

    fn measured(&mut self, session: String, measurement: &Measurement, answer: &MeasureAnswer, at_s: f64) {
        let Some(notes) = self.session(session) else { return };
        let label = answer.outcome.label();
        *notes.outcomes.entry(label).or_default() += 1;
        notes.outcome_at.insert(label, at_s);
        if !answer.outcome.accepted() {
            return;
        }
        let judged = |soil: &Option<SoilEstimate>| soil.as_ref().and_then(|soil| soil.state.last_buffer).map_or(0, |test| test.judged);
        let before = judged(&notes.soil);
        if let Some(test) = answer.soil.state.last_buffer.filter(|test| test.judged != before) {
            notes.tests.push(test, TESTS_MAX);
        }
        notes.soil = Some(answer.soil);
        notes.history_steps = answer.history_steps;
        let newest = notes.newest.is_none_or(|(held, _)| held.stamp_ns < measurement.stamp_ns || held.boot != measurement.boot);
        if newest {
            notes.newest = Some((*measurement, at_s));
            notes.pass(measurement);
        }
    }

    fn predicted(&mut self, session: String, prediction: Arc<Prediction>, timing: PredictionTiming) {
        self.timings.push(timing, TIMINGS_MAX);
        let number = self.timings.total();
        let Some(notes) = self.session(session) else { return };
        let shown = Some(Shown { number, at_s: timing.at_s, prediction });
        if shown.as_ref().is_some_and(|shown| shown.prediction.extras.covariance.is_some()) {
            notes.region.clone_from(&shown);
        }
        if timing.samples > 1 {
            notes.fan = shown;
        }
    }
}

impl SessionNotes {
    fn pass(&mut self, measurement: &Measurement) {
        let (stamp_s, state) = (measurement.stamp_ns as f64 * 1e-9, &measurement.state);
        if self.trail.iter().next_back().is_none_or(|last| (stamp_s - last[0]).abs() >= TRAIL_EVERY_S) {
            let [vx, vy, _] = state.velocity_m_s;
            self.trail.push([stamp_s, state.position_m[0], state.position_m[1], vx.hypot(vy)], TRAIL_MAX);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_a_ring_gives_what_was_not_seen() {
        let mut ring = Ring::default();
        (0..7).for_each(|i| ring.push(i, 4));
        let after = |seen| ring.after(seen).copied().collect::<Vec<_>>();
        assert_eq!((after(0), after(5), after(7)), (vec![3, 4, 5, 6], vec![5, 6], vec![]));
    }

    #[test]
    fn property_another_map_of_the_same_version_is_told() {
        let on = |hash: &str| Some(("m".to_string(), 1, hash.to_string()));
        let mut notes = Notes::default();
        notes.sessions.insert("a".into(), SessionNotes { map: on("former"), ..Default::default() });
        notes.take(Note::Map("m".into(), 1, "present".into()), 0.0);
        assert_eq!(notes.sessions["a"].map, on("present"));
    }

    #[test]
    fn property_an_alarm_stays_until_it_is_taken_back_or_its_session_ends() {
        let raised = |id: &str, active| {
            let [what, advice] = ["", ""].map(String::from);
            Raised { session: Some("a".into()), id: id.into(), what, advice, active }
        };
        let mut notes = Notes::default();
        for alarm in [raised("i", true), raised("j", true), raised("i", true)] {
            notes.take(Note::Alarm(alarm), 0.0);
        }
        assert_eq!(notes.raised.len(), 2);
        notes.take(Note::Alarm(raised("i", false)), 1.0);
        assert_eq!(notes.raised.len(), 1);
        notes.take(Note::Ended(vec!["a".into()]), 2.0);
        assert!(notes.raised.is_empty());
    }
}
