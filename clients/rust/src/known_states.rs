//! Where vehicles were last.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use nesam_proto::v1;

use crate::message::{outcome_label, state_array};
use crate::prediction::{Candidates, Prediction};

/// The newest state that a client and its clones know of each session; a fallback without a given start begins there.
#[derive(Clone, Debug, Default)]
pub(crate) struct KnownStates(Arc<Mutex<HashMap<String, [f64; 12]>>>);

/// What is kept of a measurement until its answer comes.
#[derive(Clone, Debug)]
pub(crate) struct Reported {
    session: String,
    state: Option<[f64; 12]>,
}

impl Reported {
    pub(crate) fn new(measurement: &v1::Measurement) -> Self {
        Self { session: measurement.session_id.clone(), state: measurement.state.as_ref().and_then(state_array) }
    }
}

impl KnownStates {
    /// Notes a measured state that is now the newest of its session.
    pub(crate) fn measured(&self, reported: &Reported, answer: &v1::MeasurementAnswer) {
        let newest = ["APPLIED", "GAP", "GATED", "CLOCK_JUMP", "RESTARTED"].contains(&outcome_label(answer)) && !answer.reordered;
        if let (true, Some(state)) = (newest, reported.state) {
            self.note(&reported.session, state);
        }
    }

    /// Notes where a prediction from the newest measured state began.
    pub(crate) fn predicted(&self, candidates: &Candidates, prediction: &Prediction) {
        if candidates.start.is_none() && candidates.start_stamp_ns.is_none() {
            self.note(&candidates.session, prediction.start);
        }
    }

    /// The newest known state of a session.
    pub(crate) fn of(&self, session: &str) -> Option<[f64; 12]> {
        self.states().get(session).copied()
    }

    /// Forgets a closed session.
    pub(crate) fn forget(&self, session: &str) {
        self.states().remove(session);
    }

    fn note(&self, session: &str, state: [f64; 12]) {
        let mut states = self.states();
        match states.get_mut(session) {
            Some(known) => *known = state,
            None => {
                states.insert(session.into(), state);
            }
        }
    }

    fn states(&self) -> MutexGuard<'_, HashMap<String, [f64; 12]>> {
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
            known.of("s").map(|state| state[0])
        };
        assert_eq!(hear(1.0, Outcome::Rejected(v1::Rejected::default()), false), None);
        assert_eq!(hear(2.0, applied(), false), Some(2.0));
        assert_eq!(hear(3.0, applied(), true), Some(2.0), "it came after a later one");
        assert_eq!(hear(4.0, Outcome::Buffered(v1::Buffered::default()), false), Some(2.0), "it is no step yet");
        assert_eq!(hear(5.0, Outcome::Gap(v1::Gap::default()), false), Some(5.0));
        assert_eq!(known.clone().of("s"), Some([5.0; 12]), "clones know the same");
        assert_eq!(known.of("another"), None);
        known.forget("s");
        assert_eq!(known.of("s"), None);
    }
}
