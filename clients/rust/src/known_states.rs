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
///
/// What is sent is numbered, as answers may overtake each other: a state that was asked for later replaces another, one that was asked for earlier only
/// where its stamp is larger and the vehicle's clock has not begun anew since.
#[derive(Clone, Debug, Default)]
pub(crate) struct KnownStates(Arc<Mutex<Numbered>>);

#[derive(Debug, Default)]
struct Numbered {
    asked: u64,
    states: HashMap<String, Newest>,
}

#[derive(Clone, Copy, Debug)]
struct Newest {
    known: KnownState,
    /// Number of what it answered, or of what was answered before.
    asked: u64,
    /// Number of the measurement with which the vehicle's clock began anew.
    clock: u64,
}

/// What is kept of a measurement until its answer comes.
#[derive(Clone, Debug)]
pub(crate) struct Reported {
    session: String,
    known: Option<KnownState>,
    asked: u64,
}

impl KnownStates {
    /// Number of a question that is sent now.
    pub(crate) fn ask(&self) -> u64 {
        let mut numbered = self.numbered();
        numbered.asked += 1;
        numbered.asked
    }

    /// A measurement that is sent now.
    pub(crate) fn report(&self, measurement: &v1::Measurement) -> Reported {
        let state = measurement.state.as_ref().and_then(state_array);
        let known = state.map(|state| KnownState { state, stamp_ns: measurement.stamp_ns });
        Reported { session: measurement.session_id.clone(), known, asked: self.ask() }
    }

    /// Notes a measured state that is now the newest of its session.
    pub(crate) fn measured(&self, reported: &Reported, answer: &v1::MeasurementAnswer) {
        let outcome = outcome_label(answer);
        let begins_anew = ["CLOCK_JUMP", "RESTARTED"].contains(&outcome);
        let newest = (begins_anew || ["APPLIED", "GAP", "GATED"].contains(&outcome)) && !answer.reordered;
        if let (true, Some(known)) = (newest, reported.known) {
            self.note(&reported.session, known, reported.asked, begins_anew);
        }
    }

    /// Notes where a prediction of the session began that was not given its start; `asked` is the number of its question.
    pub(crate) fn predicted(&self, asked: u64, candidates: &Candidates, prediction: &Prediction) {
        if let (None, Some(stamp_ns)) = (candidates.start, prediction.start_stamp_ns) {
            self.note(&candidates.session, KnownState { state: prediction.start, stamp_ns }, asked, false);
        }
    }

    /// The newest known state of a session.
    pub(crate) fn of(&self, session: &str) -> Option<KnownState> {
        self.numbered().states.get(session).map(|newest| newest.known)
    }

    /// Forgets a closed session.
    pub(crate) fn forget(&self, session: &str) {
        self.numbered().states.remove(session);
    }

    fn note(&self, session: &str, known: KnownState, asked: u64, begins_anew: bool) {
        let mut numbered = self.numbered();
        let Some(newest) = numbered.states.get_mut(session) else {
            let clock = if begins_anew { asked } else { 0 };
            numbered.states.insert(session.into(), Newest { known, asked, clock });
            return;
        };
        if begins_anew {
            *newest = Newest { known, asked, clock: asked };
        } else if asked > newest.asked || (asked > newest.clock && known.stamp_ns > newest.known.stamp_ns) {
            *newest = Newest { known, asked: asked.max(newest.asked), ..*newest };
        }
    }

    fn numbered(&self) -> MutexGuard<'_, Numbered> {
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
            known.measured(&known.report(&measurement("s", 0, [state; 12], [0.0; 2])), &answer);
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

    /// Goal: an answer that comes late is not taken for newer than what is known. Method: questions and measurements, numbered as they are sent and heard in
    /// another order.
    #[test]
    fn analytic_what_was_asked_for_earlier_replaces_only_what_is_older() {
        use v1::measurement_answer::Outcome;
        let known = KnownStates::default();
        let report = |stamp_ns: i64| known.report(&measurement("s", stamp_ns, [stamp_ns as f64; 12], [0.0; 2]));
        let measured = |reported: &Reported, outcome: Outcome| {
            known.measured(reported, &v1::MeasurementAnswer { outcome: Some(outcome), ..Default::default() });
            known.of("s").map(|known| known.stamp_ns)
        };
        let predicted = |asked: u64, stamp_ns: i64| {
            known.note("s", KnownState { state: [0.0; 12], stamp_ns }, asked, false);
            known.of("s").map(|known| known.stamp_ns)
        };
        let applied = || Outcome::Applied(v1::Applied::default());
        let [late, ahead] = [known.ask(), known.ask()];
        assert_eq!(measured(&report(200), applied()), Some(200));
        assert_eq!(predicted(late, 100), Some(200), "it was asked for before the measurement and is older");
        assert_eq!(predicted(ahead, 300), Some(300), "somebody else had measured more");
        assert_eq!(measured(&report(250), applied()), Some(250), "what was sent later tells what the session has now");
        let of_the_old_clock = known.ask();
        let jump = report(10);
        let after = known.ask();
        assert_eq!(predicted(after, 260), Some(260));
        assert_eq!(measured(&jump, Outcome::ClockJump(v1::ClockJump::default())), Some(10), "stamps of before say nothing");
        assert_eq!(predicted(of_the_old_clock, 400), Some(10), "the clock has begun anew since");
        assert_eq!(measured(&report(20), applied()), Some(20));
        assert_eq!(measured(&report(5), Outcome::Restarted(v1::Restarted {})), Some(5));
        assert_eq!(predicted(after, 500), Some(5), "the vehicle has been restarted since");
        assert_eq!(predicted(known.ask(), 7), Some(7));
    }
}
