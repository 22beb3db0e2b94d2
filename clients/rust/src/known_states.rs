//! Where vehicles were last.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use nesam_proto::v1;

use crate::message::{outcome_label, state_array};
use crate::prediction::{Candidates, Prediction};

/// A state of a session and its instant, ns of the vehicle's clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct KnownState {
    pub state: [f64; 12],
    pub stamp_ns: i64,
}

/// The newest state that a client and its clones know of each session; a fallback without a given start begins there.
#[derive(Clone, Debug, Default)]
pub(crate) struct KnownStates(Arc<Mutex<HashMap<String, KnownState>>>);

/// What is kept of a measurement until its answer comes.
#[derive(Clone, Debug)]
pub(crate) struct Reported {
    session: String,
    known: Option<KnownState>,
}

impl Reported {
    pub(crate) fn new(measurement: &v1::Measurement) -> Self {
        let state = measurement.state.as_ref().and_then(state_array);
        let known = state.map(|state| KnownState { state, stamp_ns: measurement.stamp_ns });
        Self { session: measurement.session_id.clone(), known }
    }
}

impl KnownStates {
    /// Notes a measured state that is now the newest of its session.
    pub(crate) fn measured(&self, reported: &Reported, answer: &v1::MeasurementAnswer) {
        let newest = ["APPLIED", "GAP", "GATED", "CLOCK_JUMP", "RESTARTED"].contains(&outcome_label(answer)) && !answer.reordered;
        if let (true, Some(known)) = (newest, reported.known) {
            self.note(&reported.session, known);
        }
    }

    /// Notes where a prediction of the session began that was not given its start.
    pub(crate) fn predicted(&self, candidates: &Candidates, prediction: &Prediction) {
        if let (None, Some(stamp_ns)) = (candidates.start, prediction.start_stamp_ns) {
            self.note(&candidates.session, KnownState { state: prediction.start, stamp_ns });
        }
    }

    /// The newest known state of a session.
    pub(crate) fn of(&self, session: &str) -> Option<KnownState> {
        self.states().get(session).copied()
    }

    /// Forgets a closed session.
    pub(crate) fn forget(&self, session: &str) {
        self.states().remove(session);
    }

    fn note(&self, session: &str, newest: KnownState) {
        let mut states = self.states();
        match states.get_mut(session) {
            Some(known) => *known = newest,
            None => {
                states.insert(session.into(), newest);
            }
        }
    }

    fn states(&self) -> MutexGuard<'_, HashMap<String, KnownState>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::message::measurement;

    /// Goal: a fallback begins at the newest state of its own session. Method: answers of several kinds, late ones among them.
    #[test]
    fn analytic_the_newest_accepted_state_is_known() {
        use v1::measurement_answer::Outcome;
        let known = KnownStates::default();
        let applied = || Outcome::Applied(v1::Applied::default());
        let hear = |state: f64, outcome: Outcome, reordered: bool| {
            let answer = v1::MeasurementAnswer { outcome: Some(outcome), reordered, ..Default::default() };
            known.measured(&Reported::new(&measurement("s", 0, [state; 12], [0.0; 2])), &answer);
            known.of("s").map(|known| known.state[0])
        };
        assert_eq!(hear(1.0, Outcome::Rejected(v1::Rejected::default()), false), None);
        assert_eq!(hear(2.0, applied(), false), Some(2.0));
        assert_eq!(hear(3.0, applied(), true), Some(2.0), "it came after a later one");
        assert_eq!(hear(4.0, Outcome::Buffered(v1::Buffered::default()), false), Some(2.0), "it is no step yet");
        assert_eq!(hear(5.0, Outcome::Gap(v1::Gap::default()), false), Some(5.0));
        assert_eq!(known.clone().of("s"), Some(KnownState { state: [5.0; 12], stamp_ns: 0 }), "clones know the same");
        assert_eq!(known.of("another"), None);
        known.forget("s");
        assert_eq!(known.of("s"), None);
    }
}
