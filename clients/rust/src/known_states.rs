//! Where vehicles were last.

use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use nesam_proto::v1;
use v1::measurement_answer::Outcome;

use crate::error::ClientError;
use crate::message::state_array;
use crate::prediction::{Candidates, Prediction};

/// Oldest state that a fallback begins at, by the client's clock: as far as it rolls one forward.
const AGE_MAX: Duration = Duration::from_millis(3200);

/// A state of a session, its instant, ns of the vehicle's clock, and the steps from the newest measurement to it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct KnownState {
    pub state: [f64; 12],
    pub stamp_ns: i64,
    pub rolled_forward_steps: usize,
}

/// What is known of where a vehicle was: its newest measured state, and the state that the service last rolled forward from a measurement.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Known {
    pub measured: Option<KnownState>,
    pub ahead: Option<KnownState>,
}

/// When something was sent: its number among all that is, and the client's clock.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Moment {
    number: u64,
    at: Instant,
}

/// The newest state that a client and its clones know of each session; a fallback without a given start begins there, unless it is too old. Where a prediction
/// began that was rolled forward is kept apart: it is later than what was measured, and no measurement.
///
/// What is sent is numbered, as answers may overtake each other: a state that was asked for later replaces another, one that was asked for earlier only
/// where its stamp is larger and neither session nor vehicle's clock has begun anew since. A measurement that is no step of the session yet stays until a
/// state with a larger stamp comes, or it is too old to begin at.
#[derive(Clone, Debug, Default)]
pub(crate) struct KnownStates(Arc<Mutex<Numbered>>);

#[derive(Debug, Default)]
struct Numbered {
    asked: u64,
    states: HashMap<String, Newest>,
    ahead: HashMap<String, Ahead>,
}

/// A state that the service rolled forward, and when it was asked for.
#[derive(Clone, Copy, Debug)]
struct Ahead {
    known: KnownState,
    asked: Moment,
}

#[derive(Clone, Copy, Debug)]
struct Newest {
    /// `None` where the session was opened and nothing is known of it yet.
    known: Option<KnownState>,
    /// Number of what it answered, or of what was answered before.
    asked: u64,
    /// Number of that with which the session or the vehicle's clock began anew.
    clock: u64,
    /// When it was so.
    at: Instant,
    /// Whether it is no step of the session yet, as far as the client knows: it waits for the grid, or got no answer.
    ahead: bool,
}

impl Newest {
    fn is_before(&self, known: &KnownState) -> bool {
        self.known.is_none_or(|held| known.stamp_ns > held.stamp_ns)
    }

    /// Whether a state of the same clock is newer. One that measurements may have overtaken is so where it is later.
    fn is_replaced_by(&self, known: &KnownState, sent: Moment, overtaken: bool) -> bool {
        let stays = (self.ahead || overtaken) && sent.at.saturating_duration_since(self.at) <= AGE_MAX;
        self.is_before(known) || (!stays && sent.number > self.asked)
    }
}

/// How a state becomes known.
#[derive(Clone, Copy, Debug, Default)]
struct Noted {
    /// The session or the vehicle's clock begins anew with it.
    begins_anew: bool,
    /// It is no step of the session yet.
    ahead: bool,
    /// Measurements may have overtaken it.
    overtaken: bool,
}

/// What is kept of a measurement until its answer comes; no state where it holds a number that is not finite.
#[derive(Clone, Debug)]
pub(crate) struct Reported {
    session: String,
    known: Option<KnownState>,
    sent: Moment,
}

impl KnownStates {
    /// Number and time of a question that is sent now.
    pub(crate) fn ask(&self) -> Moment {
        let mut numbered = self.numbered();
        numbered.asked += 1;
        Moment { number: numbered.asked, at: Instant::now() }
    }

    /// A measurement that is sent now.
    pub(crate) fn report(&self, measurement: &v1::Measurement) -> Reported {
        let state = measurement.state.as_ref().and_then(state_array).filter(|state| state.iter().all(|value| value.is_finite()));
        let known = state.map(|state| KnownState { state, stamp_ns: measurement.stamp_ns, rolled_forward_steps: 0 });
        Reported { session: measurement.session_id.clone(), known, sent: self.ask() }
    }

    /// Notes a measured state that is now the newest of its session.
    pub(crate) fn measured(&self, reported: &Reported, answer: &v1::MeasurementAnswer) {
        match &answer.outcome {
            Some(Outcome::Rejected(rejected)) => match tonic::Code::from(rejected.code) {
                tonic::Code::ResourceExhausted | tonic::Code::Unavailable => self.unheard(reported),
                tonic::Code::NotFound if rejected.field == "session_id" => self.forget(&reported.session),
                _ => {}
            },
            _ if answer.reordered => {}
            Some(Outcome::ClockJump(_) | Outcome::Restarted(_)) => self.note(reported, Noted { begins_anew: true, ..Noted::default() }),
            Some(Outcome::Buffered(_)) => self.note(reported, Noted { ahead: true, ..Noted::default() }),
            Some(Outcome::Applied(_) | Outcome::Gap(_) | Outcome::Gated(_)) => self.note(reported, Noted::default()),
            _ => {}
        }
    }

    /// Notes a measured state that got no answer: the vehicle was there all the same. The same one sent again, or what was kept meanwhile, is not where it
    /// is now.
    pub(crate) fn unheard(&self, reported: &Reported) {
        let newest = self.numbered().states.get(&reported.session).copied();
        if reported.known.is_some_and(|known| newest.is_none_or(|newest| newest.is_before(&known))) {
            self.note(reported, Noted { ahead: true, ..Noted::default() });
        }
    }

    /// Notes where a prediction of the session began that was not given its start; `asked` is the moment of its question.
    pub(crate) fn predicted(&self, asked: Moment, candidates: &Candidates, prediction: &Prediction) {
        // Who asks from an instant asks from now.
        let age_s = if candidates.start_stamp_ns.is_some() { 0.0 } else { prediction.measurement_age_s.unwrap_or(0.0) };
        let at = Duration::try_from_secs_f64(age_s).ok().and_then(|age| asked.at.checked_sub(age));
        let (None, Some(stamp_ns), Some(at)) = (candidates.start, prediction.start_stamp_ns, at) else {
            return;
        };
        let (begun, sent) = (prediction.rolled_forward_steps, Moment { at, ..asked });
        let known = KnownState { state: prediction.start, stamp_ns, rolled_forward_steps: begun };
        if begun > 0 {
            return self.note_ahead(&candidates.session, Ahead { known, asked: sent });
        }
        let overtaken = candidates.start_stamp_ns.is_some();
        let reported = Reported { session: candidates.session.clone(), known: Some(known), sent };
        self.note(&reported, Noted { overtaken, ..Noted::default() });
    }

    /// What is known of a session and not too old to begin at.
    pub(crate) fn of(&self, session: &str) -> Known {
        self.of_at(session, Instant::now())
    }

    fn of_at(&self, session: &str, now: Instant) -> Known {
        let numbered = self.numbered();
        let young = |at: Instant| now.saturating_duration_since(at) <= AGE_MAX;
        let measured = numbered.states.get(session).filter(|newest| young(newest.at)).and_then(|newest| newest.known);
        Known { measured, ahead: numbered.ahead.get(session).filter(|ahead| young(ahead.asked.at)).map(|ahead| ahead.known) }
    }

    /// Forgets what was known under the name of a session that was opened now, also what comes late.
    pub(crate) fn opened(&self, session: &str) {
        let now = self.ask();
        let newest = Newest { known: None, asked: now.number, clock: now.number, at: now.at, ahead: false };
        let mut numbered = self.numbered();
        numbered.states.insert(session.into(), newest);
        numbered.ahead.remove(session);
    }

    /// Forgets a closed session.
    pub(crate) fn forget(&self, session: &str) {
        let mut numbered = self.numbered();
        numbered.states.remove(session);
        numbered.ahead.remove(session);
    }

    /// Forgets a session where the service says that it is not open.
    pub(crate) fn refused(&self, session: &str, error: &ClientError) {
        if error.code() == Some(tonic::Code::NotFound) && error.field() == "session_id" {
            self.forget(session);
        }
    }

    fn note(&self, reported: &Reported, Noted { begins_anew, ahead, overtaken }: Noted) {
        let (Some(known), sent) = (reported.known, reported.sent) else {
            return;
        };
        let mut numbered = self.numbered();
        let newest = numbered.states.get(&reported.session).copied();
        let replaced = |newest: Newest| sent.number > newest.clock && (begins_anew || newest.is_replaced_by(&known, sent, overtaken));
        if newest.is_none_or(replaced) {
            let (asked, clock) = newest.map_or((0, 0), |newest| (newest.asked, newest.clock));
            let clock = if begins_anew { sent.number } else { clock };
            let noted = Newest { known: Some(known), asked: asked.max(sent.number), clock, at: sent.at, ahead };
            numbered.states.insert(reported.session.clone(), noted);
        }
        if begins_anew && numbered.ahead.get(&reported.session).is_some_and(|ahead| ahead.asked.number < sent.number) {
            numbered.ahead.remove(&reported.session);
        }
    }

    /// Notes a state that the service rolled forward, unless a later question has told of another one or the clock has begun anew since.
    fn note_ahead(&self, session: &str, ahead: Ahead) {
        let mut numbered = self.numbered();
        let clock = numbered.states.get(session).map_or(0, |newest| newest.clock);
        let before = numbered.ahead.get(session).map_or(0, |before| before.asked.number);
        if ahead.asked.number > clock.max(before) {
            numbered.ahead.insert(session.into(), ahead);
        }
    }

    fn numbered(&self) -> MutexGuard<'_, Numbered> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Measurements without an answer, oldest first. Those that it leaves with are unheard.
#[derive(Debug)]
pub(crate) struct Waiting {
    known: KnownStates,
    reported: VecDeque<Reported>,
}

impl Waiting {
    pub(crate) fn new(known: KnownStates) -> Self {
        Self { known, reported: VecDeque::new() }
    }

    /// A measurement that is sent now.
    pub(crate) fn push(&mut self, measurement: &v1::Measurement) {
        self.reported.push_back(self.known.report(measurement));
    }

    /// Takes the answer to the oldest.
    pub(crate) fn answered(&mut self, answer: &v1::MeasurementAnswer) {
        if let Some(reported) = self.reported.pop_front() {
            self.known.measured(&reported, answer);
        }
    }

    /// They get no answer any more.
    pub(crate) fn unheard(&mut self) {
        self.reported.drain(..).for_each(|reported| self.known.unheard(&reported));
    }
}

impl Drop for Waiting {
    fn drop(&mut self) {
        self.unheard();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::message::measurement;

    fn report(known: &KnownStates, stamp_ns: i64) -> Reported {
        known.report(&measurement("s", stamp_ns, [stamp_ns as f64; 12], [0.0; 2]))
    }

    fn applied() -> Outcome {
        Outcome::Applied(v1::Applied::default())
    }

    fn newest(known: &KnownStates) -> Option<i64> {
        begun(known.of("s"))
    }

    /// Where a fallback begins that is asked plainly.
    fn begun(known: Known) -> Option<i64> {
        known.measured.or(known.ahead).map(|known| known.stamp_ns)
    }

    fn hear(known: &KnownStates, reported: &Reported, outcome: Outcome) -> Option<i64> {
        known.measured(reported, &v1::MeasurementAnswer { outcome: Some(outcome), ..Default::default() });
        newest(known)
    }

    /// A prediction that began there.
    fn begins(known: &KnownStates, asked: Moment, stamp_ns: i64) -> Option<i64> {
        begins_aged(known, asked, stamp_ns, None);
        newest(known)
    }

    fn begins_aged(known: &KnownStates, asked: Moment, stamp_ns: i64, measurement_age_s: Option<f64>) {
        predicted(known, asked, stamp_ns, measurement_age_s, None);
    }

    /// The answer to a question from an instant, which began so many steps after a measurement.
    fn rolled(known: &KnownStates, asked: Moment, stamp_ns: i64, steps: u32) -> Known {
        predicted(known, asked, stamp_ns, None, Some(steps));
        known.of("s")
    }

    fn predicted(known: &KnownStates, asked: Moment, stamp_ns: i64, measurement_age_s: Option<f64>, from_now_steps: Option<u32>) {
        let reply = v1::PredictReply {
            start: Some(v1::VehicleState {
                position_m: Some(v1::Vector3::default()),
                attitude_rad: Some(v1::Vector3::default()),
                velocity_m_s: Some(v1::Vector3::default()),
                angular_velocity_rad_s: Some(v1::Vector3::default()),
            }),
            start_stamp_ns: Some(stamp_ns),
            rolled_forward_steps: from_now_steps.unwrap_or(0),
            measurement_age_s,
            soil: Some(v1::SoilVector::default()),
            soil_correction: Some(v1::SoilCorrection::default()),
            provenance: Some(v1::Provenance::default()),
            ..Default::default()
        };
        let prediction = Prediction::from_message(&reply).expect("a whole reply");
        let asked_plainly = Candidates::new("s", 1, 1, vec![0.0; 2]);
        known.predicted(asked, &Candidates { start_stamp_ns: from_now_steps.map(|_| stamp_ns), ..asked_plainly }, &prediction);
    }

    /// Goal: a state that was rolled forward is no measurement. Method: beside one, in answers that overtake each other, with a clock that begins anew, and of a
    /// planner that only asks.
    #[test]
    fn regress_a_state_that_was_rolled_forward_is_kept_apart() {
        let known = KnownStates::default();
        let stamps = |known: Known| [known.measured, known.ahead].map(|known| known.map(|known| known.stamp_ns));
        hear(&known, &report(&known, 100), applied());
        let late = known.ask();
        assert_eq!(stamps(rolled(&known, known.ask(), 900, 8)), [Some(100), Some(900)]);
        assert_eq!(stamps(rolled(&known, known.ask(), 300, 2)), [Some(100), Some(300)], "the last one");
        assert_eq!(stamps(rolled(&known, late, 600, 5)), [Some(100), Some(300)], "it was asked for before");
        assert_eq!(known.of("s").ahead.map(|ahead| ahead.rolled_forward_steps), Some(2));
        hear(&known, &report(&known, 200), applied());
        assert_eq!(stamps(rolled(&known, known.ask(), 100, 0)), [Some(200), Some(300)], "measurements overtook the question");
        assert_eq!(stamps(rolled(&known, known.ask(), 250, 0)), [Some(250), Some(300)], "somebody else has measured more");
        let of_the_old_clock = known.ask();
        hear(&known, &report(&known, 5), Outcome::ClockJump(v1::ClockJump::default()));
        assert_eq!(stamps(known.of("s")), [Some(5), None]);
        assert_eq!(stamps(rolled(&known, of_the_old_clock, 400, 3)), [Some(5), None]);
        known.opened("s");
        assert_eq!(stamps(rolled(&known, known.ask(), 400, 3)), [None, Some(400)]);
        known.forget("s");
        assert_eq!(known.of("s"), Known::default());
    }

    /// Goal: a fallback begins at the newest state of its own session. Method: answers of several kinds, late ones among them.
    #[test]
    fn analytic_the_newest_accepted_state_is_known() {
        let known = KnownStates::default();
        let hear = |state: f64, outcome: Outcome, reordered: bool| {
            let answer = v1::MeasurementAnswer { outcome: Some(outcome), reordered, ..Default::default() };
            known.measured(&known.report(&measurement("s", 0, [state; 12], [0.0; 2])), &answer);
            known.of("s").measured.map(|known| known.state[0])
        };
        assert_eq!(hear(1.0, Outcome::Rejected(v1::Rejected::default()), false), None);
        assert_eq!(hear(2.0, applied(), false), Some(2.0));
        assert_eq!(hear(3.0, applied(), true), Some(2.0), "it came after a later one");
        assert_eq!(hear(5.0, Outcome::Gap(v1::Gap::default()), false), Some(5.0));
        let five = KnownState { state: [5.0; 12], stamp_ns: 0, rolled_forward_steps: 0 };
        assert_eq!(known.clone().of("s"), Known { measured: Some(five), ahead: None }, "clones know the same");
        assert_eq!(known.of("another"), Known::default());
        known.forget("s");
        assert_eq!(known.of("s"), Known::default());
    }

    /// Goal: an answer that comes late is not taken for newer than what is known. Method: questions and measurements, numbered as they are sent and heard in
    /// another order.
    #[test]
    fn analytic_what_was_asked_for_earlier_replaces_only_what_is_older() {
        let known = KnownStates::default();
        let [late, ahead] = [known.ask(), known.ask()];
        assert_eq!(hear(&known, &report(&known, 200), applied()), Some(200));
        assert_eq!(begins(&known, late, 100), Some(200), "it was asked for before the measurement and is older");
        assert_eq!(begins(&known, ahead, 300), Some(300), "somebody else had measured more");
        assert_eq!(hear(&known, &report(&known, 250), applied()), Some(250), "what was sent later tells what the session has now");
        let of_the_old_clock = known.ask();
        let jump = report(&known, 10);
        let after = known.ask();
        assert_eq!(begins(&known, after, 260), Some(260));
        assert_eq!(hear(&known, &jump, Outcome::ClockJump(v1::ClockJump::default())), Some(10), "stamps of before say nothing");
        assert_eq!(begins(&known, of_the_old_clock, 400), Some(10), "the clock has begun anew since");
        assert_eq!(hear(&known, &report(&known, 20), applied()), Some(20));
        assert_eq!(hear(&known, &report(&known, 5), Outcome::Restarted(v1::Restarted {})), Some(5));
        assert_eq!(begins(&known, after, 500), Some(5), "the vehicle has been restarted since");
        assert_eq!(begins(&known, known.ask(), 7), Some(7));
    }

    /// Goal: a fallback follows a vehicle that gets no answers. Method: what becomes of measurements, refusals among them.
    #[test]
    fn analytic_a_measurement_counts_whatever_became_of_it_unless_it_is_refused() {
        let known = KnownStates::default();
        let rejected = |code: tonic::Code, field: &str| {
            Outcome::Rejected(v1::Rejected { code: code.into(), field: field.into(), ..Default::default() })
        };
        assert_eq!(hear(&known, &report(&known, 10), applied()), Some(10));
        assert_eq!(hear(&known, &report(&known, 11), Outcome::Buffered(v1::Buffered::default())), Some(11), "it waits for the grid");
        assert_eq!(begins(&known, known.ask(), 10), Some(11), "the step before it is older");
        assert_eq!(begins(&known, known.ask(), 20), Some(20));
        let mut waiting = Waiting::new(known.clone());
        [30, 31].into_iter().for_each(|stamp_ns| waiting.push(&measurement("s", stamp_ns, [0.0; 12], [0.0; 2])));
        assert_eq!(newest(&known), Some(20));
        waiting.answered(&v1::MeasurementAnswer { outcome: Some(applied()), ..Default::default() });
        assert_eq!(newest(&known), Some(30));
        drop(waiting);
        assert_eq!(newest(&known), Some(31), "it got no answer");
        assert_eq!(hear(&known, &report(&known, 40), rejected(tonic::Code::ResourceExhausted, "")), Some(40), "there was no room");
        for refused in
            [Outcome::TooOld(v1::TooOld::default()), Outcome::Duplicate(v1::Duplicate {}), rejected(tonic::Code::InvalidArgument, "")]
        {
            assert_eq!(hear(&known, &report(&known, 50), refused), Some(40));
        }
        known.unheard(&known.report(&measurement("s", 60, [f64::NAN; 12], [0.0; 2])));
        assert_eq!(newest(&known), Some(40), "it is nowhere");
        known.unheard(&report(&known, 35));
        assert_eq!(newest(&known), Some(40), "kept since before, sent again");
    }

    /// Goal: nothing begins where the vehicle was long ago. Method: moments before and after the limit.
    #[test]
    fn analytic_a_state_grows_too_old() {
        let known = KnownStates::default();
        let now = Instant::now();
        let sent = |stamp_ns: i64, after_ms: u64| {
            let mut reported = report(&known, stamp_ns);
            reported.sent.at = now + Duration::from_millis(after_ms);
            reported
        };
        let after = |ms: u64| begun(known.of_at("s", now + Duration::from_millis(ms)));
        hear(&known, &sent(10, 0), applied());
        assert_eq!((after(3200), after(3201)), (Some(10), None));
        known.unheard(&sent(10, 4000));
        assert_eq!(after(4000), None, "the same one sent again");
        // What a prediction began at is as old as it says.
        let mut asked = known.ask();
        asked.at = now + Duration::from_millis(6000);
        begins_aged(&known, asked, 20, Some(3.0));
        assert_eq!((after(6200), after(6201)), (Some(20), None));
        for age_s in [f64::NAN, -1.0, 1e300] {
            begins_aged(&known, asked, 30, Some(age_s));
        }
        assert_eq!(begun(known.of_at("s", now)), Some(20), "an age that is none");
        // One that is no step yet holds nothing up for longer.
        known.unheard(&sent(90, 7000));
        hear(&known, &sent(60, 10_200), applied());
        assert_eq!(after(7000), Some(90));
        hear(&known, &sent(60, 10_201), applied());
        assert_eq!(after(10_201), Some(60));
    }

    /// Goal: another session of the same name begins nowhere. Method: what was sent before it was opened is heard after, then the service has lost it.
    #[test]
    fn analytic_a_session_of_the_same_name_is_another_one() {
        let known = KnownStates::default();
        assert_eq!(hear(&known, &report(&known, 10), applied()), Some(10));
        let (sent, asked) = (report(&known, 20), known.ask());
        known.opened("s");
        assert_eq!(newest(&known), None);
        assert_eq!((hear(&known, &sent, applied()), begins(&known, asked, 30)), (None, None), "they are of the session before");
        known.unheard(&sent);
        assert_eq!(newest(&known), None);
        assert_eq!(hear(&known, &report(&known, 1), applied()), Some(1));
        let refusal =
            |code: tonic::Code| ClientError::Refused { code, field: "session_id".into(), message: String::new(), retry_after: None };
        known.refused("s", &refusal(tonic::Code::PermissionDenied));
        assert_eq!(newest(&known), Some(1));
        known.refused("s", &refusal(tonic::Code::NotFound));
        assert_eq!(newest(&known), None);
    }
}
