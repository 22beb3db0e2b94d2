//! The two lanes in front of the engine, and what is let in.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use nesam_model::Gate;

use crate::command::Command;
use crate::demand::Demand;
use crate::error::EngineError;
use crate::handle::Submission;
use crate::limits::Limits;
use crate::plan::{Place, Plan, Underway, left_ns, surely_done_ns};
use crate::query::PredictQuery;
use crate::service_time::{ServiceTime, work};
use crate::sync::{Condvar, Mutex, MutexGuard};

/// What an answer still needs after the engine: its way back, ns.
const WAY_BACK_NS: u64 = 2_000_000;
/// Share of the time before its deadline after which an answer of fewer samples is due (chosen: the rest is for its way back).
pub const DUE_AFTER: f64 = 0.9;
/// A prediction that is expected to take this many times as long as there is time would be computed in vain (chosen).
const HOPELESS: u64 = 2;
/// Times as long as it took that a prediction would have taken which was given up later than it was expected to end (chosen): how much was left is not known.
const WHOLE_OF_GIVEN_UP: u64 = 2;
/// Time for which an estimate is relied on that the last prediction bore out, ns (chosen).
const RELIED_ON_NS: u64 = 1_000_000_000;
/// Shortest and longest pause that a refused asker is told, ns. What is expected may be far from the truth, and is soon corrected where others ask.
const RETRY_MIN_NS: u64 = 1_000_000;
const RETRY_MAX_NS: u64 = 5_000_000_000;

/// Commands that wait. Predictions have a lane of their own, so that a flood of them neither delays nor displaces measurements.
#[derive(Debug, Default)]
pub(crate) struct Queue {
    lanes: Mutex<Lanes>,
    filled: Condvar,
    /// Closed while the prediction that runs waits for an urgent one.
    gate: Gate,
}

#[derive(Debug, Default)]
struct Lanes {
    commands: VecDeque<Submission>,
    /// Of the waiting commands, those of each share.
    commands_of: BTreeMap<Arc<str>, usize>,
    predictions: Plan<Submission>,
    demand: Demand,
    running: Option<Running>,
    /// A short one for which that waits.
    urgent: Option<Running>,
    service_time: ServiceTime,
    /// Instant until which the expected times are relied on, ns.
    relied_on_until_ns: u64,
    stopped: bool,
}

/// A prediction that the engine computes now.
#[derive(Clone, Debug)]
struct Running {
    share: Arc<str>,
    since_ns: u64,
    expected_ns: u64,
    /// The same of the fewest samples that are of use.
    least_ns: u64,
    /// Time for which it waited for urgent ones that are done, ns.
    paused_ns: u64,
    deadline_ns: Option<u64>,
}

impl Running {
    /// Where it stands. `pause_ns` = time for which it has waited for the urgent one that is computed now, which needs `urgent_left_ns`.
    fn underway(&self, now_ns: u64, pause_ns: u64, urgent_left_ns: u64) -> Underway {
        let paused_ns = self.paused_ns + pause_ns;
        let ran_ns = now_ns.saturating_sub(self.since_ns + paused_ns);
        let given_up_after_ns = self.deadline_ns.map_or(u64::MAX, |deadline_ns| deadline_ns.saturating_sub(now_ns));
        // All of it may last twice as long, and where fewer samples are of use half of them are left.
        let pause_max_ns = if self.least_ns < self.expected_ns { self.expected_ns / 2 } else { self.expected_ns };
        Underway {
            cost_ns: self.expected_ns,
            left_ns: left_ns(self.expected_ns, ran_ns).min(given_up_after_ns),
            least_left_ns: left_ns(self.least_ns, ran_ns),
            given_up_after_ns,
            urgent_left_ns,
            spare_ns: pause_max_ns.saturating_sub(paused_ns),
            due_ns: self.deadline_ns.map_or(u64::MAX, |deadline_ns| deadline_ns.saturating_sub(WAY_BACK_NS)),
        }
    }
}

/// Time that a prediction took, ns.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Took {
    /// It was computed.
    All(u64),
    /// It was given up.
    AtLeast(u64),
}

impl Took {
    /// The same without the time for which it waited.
    fn less(self, paused_ns: u64) -> Self {
        match self {
            Self::All(ns) => Self::All(ns.saturating_sub(paused_ns)),
            Self::AtLeast(ns) => Self::AtLeast(ns.saturating_sub(paused_ns)),
        }
    }
}

/// How a prediction is let in.
struct Admitted {
    place: Place,
    /// Time that it is expected to take: all of it, or the least of it that is of use where all would be late.
    expected_ns: u64,
    due_ns: u64,
}

/// What the engine does next.
pub(crate) enum Turn {
    /// All waiting commands, in order of arrival.
    Commands(VecDeque<Submission>),
    /// One prediction, since no command waits and none is computed; or an urgent one, for which the one at work waits at its next step.
    Prediction { submission: Box<Submission>, is_urgent: bool },
    /// Nothing more will come.
    End,
}

impl Queue {
    fn lock(&self) -> MutexGuard<'_, Lanes> {
        self.lanes.lock().expect("no holder of the queue panics; this is a bug")
    }

    /// Adds a command, or gives it back with the reason. A prediction is refused at once when it would not be done in time.
    pub fn push(&self, submission: Submission, limits: &Limits) -> Result<(), Box<(EngineError, Submission)>> {
        let mut lanes = self.lock();
        if lanes.stopped {
            return Err(Box::new((EngineError::Stopped, submission)));
        }
        if let Command::Predict(query) = &submission.command {
            let share = submission.share();
            match lanes.admit(&share, &submission, query, limits) {
                Err(error) => return Err(Box::new((error, submission))),
                Ok(Admitted { place, expected_ns, due_ns }) => lanes.predictions.insert(place, share, submission, expected_ns, due_ns),
            }
        } else {
            match lanes.take(&submission, limits) {
                Err(error) => return Err(Box::new((error, submission))),
                Ok(()) => lanes.commands.push_back(submission),
            }
        }
        self.filled.notify_one();
        Ok(())
    }

    /// Waits for the next turn. After `stop`, waiting commands still have their turn and waiting predictions do not.
    pub fn next(&self, now_ns: impl Fn() -> u64) -> Turn {
        let mut lanes = self.lock();
        loop {
            if !lanes.commands.is_empty() {
                lanes.commands_of.clear();
                return Turn::Commands(std::mem::take(&mut lanes.commands));
            }
            if lanes.stopped {
                return Turn::End;
            }
            // One at a time: they share the processors.
            let is_urgent = lanes.running.is_some() && lanes.predictions.is_next_urgent();
            if lanes.urgent.is_none()
                && (is_urgent || lanes.running.is_none())
                && let Some(next) = lanes.predictions.pop()
            {
                let deadline_ns = next.item.deadline_ns;
                let (share, expected_ns) = (next.share, next.cost_ns);
                let running = Running { share, since_ns: now_ns(), expected_ns, least_ns: expected_ns, paused_ns: 0, deadline_ns };
                *lanes.at_work(is_urgent) = Some(running);
                if is_urgent {
                    self.gate.close();
                }
                return Turn::Prediction { submission: Box::new(next.item), is_urgent };
            }
            lanes = self.filled.wait(lanes).expect("no holder of the queue panics; this is a bug");
        }
    }

    /// Leaves of the prediction whose turn it is what is expected to be done by its deadline without making one that waits late, where fewer samples are of use.
    ///
    /// # Errors
    /// `EngineError::Expired` where it would be late all the same and others wait, who may not be: it was let in, and others took longer than was expected of them.
    pub fn fit(&self, query: &mut PredictQuery, is_urgent: bool, deadline_ns: Option<u64>, now_ns: u64) -> Result<(), EngineError> {
        let mut lanes = self.lock();
        if query.least() < query.samples {
            let own_ns = deadline_ns.map_or(u64::MAX, |deadline_ns| (DUE_AFTER * deadline_ns.saturating_sub(now_ns) as f64) as u64);
            // Others wait for an urgent one: it takes what it was let in for.
            let let_in_ns = lanes.urgent.as_ref().filter(|_| is_urgent).map_or(u64::MAX, |urgent| urgent.expected_ns);
            let affordable = lanes.service_time.affordable(query, own_ns.min(let_in_ns).min(lanes.predictions.spare_ns(now_ns)));
            query.keep_first(affordable);
        }
        let expected_ns = lanes.service_time.expected_ns(work(query, query.samples));
        lanes.correct(is_urgent, expected_ns, now_ns);
        let least = if query.takes_fewer() { query.least() } else { query.samples };
        let least_ns = lanes.service_time.expected_ns(work(query, least));
        lanes.at_work(is_urgent).iter_mut().for_each(|running| running.least_ns = least_ns);
        let waiting = lanes.predictions.len();
        if waiting > 0 && deadline_ns.is_some_and(|deadline_ns| now_ns + expected_ns > deadline_ns) {
            return Err(EngineError::Expired);
        }
        Ok(())
    }

    /// Where the prediction that runs waits for urgent ones.
    pub fn gate(&self) -> &Gate {
        &self.gate
    }

    /// The prediction whose turn it was is done: learns how long it took if it was computed, or that it takes longer if it was given up later than expected.
    /// Said before its answer leaves, so that whoever asks again at once finds the engine idle. Tells for how long it waited for urgent ones, ns.
    pub fn done(&self, work: f64, is_urgent: bool, took: Option<Took>, now_ns: u64) -> u64 {
        let mut lanes = self.lock();
        let expected_ns = lanes.service_time.expected_ns(work);
        let paused_ns = lanes.at_work(is_urgent).as_ref().map_or(0, |running| running.paused_ns);
        match took.map(|took| took.less(paused_ns)) {
            Some(Took::All(took_ns)) => {
                let bears_out = took_ns / HOPELESS <= expected_ns && expected_ns / HOPELESS <= took_ns;
                lanes.relied_on_until_ns = if bears_out { now_ns + RELIED_ON_NS } else { 0 };
                lanes.service_time.learn(work, took_ns);
            }
            Some(Took::AtLeast(took_ns)) => {
                if (1..took_ns).contains(&expected_ns) {
                    lanes.service_time.learn(work, WHOLE_OF_GIVEN_UP * took_ns);
                }
                lanes.correct(is_urgent, took_ns, now_ns);
            }
            None => lanes.correct(is_urgent, 0, now_ns),
        }
        let done = lanes.at_work(is_urgent).take();
        if is_urgent {
            self.gate.open();
        }
        if let (true, Some(urgent), Some(running)) = (is_urgent, done, &mut lanes.running) {
            running.paused_ns += now_ns.saturating_sub(urgent.since_ns);
        }
        self.filled.notify_one();
        paused_ns
    }

    /// Refuses new commands and gives back the predictions that wait.
    pub fn stop(&self) -> Vec<Submission> {
        let mut lanes = self.lock();
        lanes.stopped = true;
        self.filled.notify_all();
        lanes.predictions.drain()
    }

    /// Whether [`Queue::next`] would give a command or a prediction at once, where none is computed.
    pub fn has_turn(&self) -> bool {
        let lanes = self.lock();
        !lanes.commands.is_empty() || (!lanes.stopped && lanes.predictions.len() > 0)
    }

    /// Waiting commands and predictions.
    pub fn waiting(&self) -> (usize, usize) {
        let lanes = self.lock();
        (lanes.commands.len(), lanes.predictions.len())
    }
}

impl Lanes {
    /// How a prediction is let in: where everybody who waits is still in time, and it is too.
    fn admit(&mut self, share: &Arc<str>, submission: &Submission, query: &PredictQuery, limits: &Limits) -> Result<Admitted, EngineError> {
        let now_ns = submission.submitted_ns();
        self.demand.ask(share, self.service_time.expected_ns(work(query, query.samples)), now_ns);
        let urgent_left_ns = self.urgent.as_ref().map_or(0, |urgent| urgent.underway(now_ns, 0, 0).left_ns);
        let pause_ns = self.urgent.as_ref().map_or(0, |urgent| now_ns.saturating_sub(urgent.since_ns));
        let underway = self.running.as_ref().map(|running| running.underway(now_ns, pause_ns, urgent_left_ns));
        let before_ns = urgent_left_ns + underway.map_or(0, |underway| underway.left_ns);
        let due_ns = submission.deadline_ns.map_or(u64::MAX, |deadline_ns| deadline_ns.saturating_sub(WAY_BACK_NS));
        let room_ns = (self.demand.room(share) * due_ns.saturating_sub(now_ns) as f64) as u64;
        let of = |samples| {
            let expected_ns = self.service_time.expected_ns(work(query, samples));
            let urgent = underway.and_then(|underway| self.predictions.urgent_place(share, expected_ns, now_ns, underway));
            let place = urgent.unwrap_or_else(|| self.predictions.place(share, expected_ns, now_ns, before_ns));
            let late_ns = surely_done_ns(now_ns, place.wait_ns + expected_ns).saturating_sub(now_ns.saturating_add(room_ns));
            (Admitted { place, expected_ns, due_ns }, late_ns)
        };
        let (admitted, late_ns) = Some(of(query.samples)).filter(|(_, late_ns)| *late_ns == 0).unwrap_or_else(|| of(query.least()));
        let (waiting, own) = (self.predictions.len(), self.predictions.len_of(share));
        // Whoever comes while nothing else is to be done is let in though it may be late, so that the estimate stays true; not in vain while the estimate is.
        let first = waiting + self.running.iter().chain(&self.urgent).count();
        let is_hopeless = now_ns < self.relied_on_until_ns && admitted.expected_ns / HOPELESS > due_ns.saturating_sub(now_ns);
        if waiting >= limits.waiting_predictions_max {
            Err(overloaded("predictions", first, admitted.place.wait_ns))
        } else if own >= limits.waiting_predictions_per_vehicle_max {
            Err(overloaded("predictions of this vehicle", own, admitted.place.wait_ns))
        } else if late_ns > 0 && first > 0 {
            Err(overloaded("predictions", first, late_ns.max(self.demand.recovers_ns(share))))
        } else if is_hopeless {
            Err(EngineError::Expired)
        } else {
            self.demand.give(share, admitted.expected_ns as f64, now_ns);
            Ok(admitted)
        }
    }

    /// The prediction that is computed, or the urgent one.
    fn at_work(&mut self, is_urgent: bool) -> &mut Option<Running> {
        if is_urgent { &mut self.urgent } else { &mut self.running }
    }

    /// A prediction at work is expected to take this long.
    fn correct(&mut self, is_urgent: bool, expected_ns: u64, now_ns: u64) {
        let Some(running) = self.at_work(is_urgent) else { return };
        let more_ns = expected_ns as f64 - running.expected_ns as f64;
        running.expected_ns = expected_ns;
        let share = Arc::clone(&running.share);
        self.demand.give(&share, more_ns, now_ns);
    }

    /// Lets another command in, unless too many wait.
    fn take(&mut self, submission: &Submission, limits: &Limits) -> Result<(), EngineError> {
        if self.commands.len() >= limits.waiting_commands_max {
            return Err(overloaded("commands", self.commands.len(), 0));
        }
        if let Command::Measure { .. } = submission.command {
            let own = self.commands_of.entry(submission.share()).or_default();
            if *own >= limits.waiting_measurements_per_vehicle_max {
                return Err(overloaded("measurements of this vehicle", *own, 0));
            }
            *own += 1;
        }
        Ok(())
    }
}

/// A refusal with a pause within the bounds.
fn overloaded(kind: &'static str, waiting: usize, retry_after_ns: u64) -> EngineError {
    EngineError::Overloaded { kind, waiting, retry_after_ns: retry_after_ns.clamp(RETRY_MIN_NS, RETRY_MAX_NS) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::candidates::Candidates;

    const MS: u64 = 1_000_000;
    /// With this many samples of a step each a question takes 16 ms where a unit of work takes 10 µs.
    const SAMPLES: usize = 1344;
    const TAKES_NS: f64 = 16e6;
    const NS_PER_WORK: f64 = 1e4;
    const DEADLINE_NS: u64 = 200 * MS;
    /// Time that is simulated, and of that the time after which answers count.
    const ENDS_NS: u64 = 12_000 * MS;
    const COUNTS_NS: u64 = 4_000 * MS;
    /// Times as long where few ask.
    const LONGER: u64 = 20;

    /// What became of the questions of one vehicle.
    #[derive(Clone, Copy, Debug, Default, PartialEq)]
    struct Tally {
        asked: usize,
        in_time: usize,
        late: usize,
        refused_at_turn: usize,
        samples: usize,
    }

    /// A vehicle that asks at random instants: how often, in multiples of what the engine can do, for how many samples, and by when.
    #[derive(Clone, Copy, Debug)]
    struct Asker {
        rate: f64,
        samples: usize,
        deadline_ns: u64,
    }

    impl Asker {
        fn usual(rate: f64) -> Self {
            Self { rate, samples: SAMPLES, deadline_ns: DEADLINE_NS }
        }

        /// Until it asks again.
        fn pause_ns(&self, random: f64) -> f64 {
            -random.ln() * NS_PER_WORK * (TAKES_NS / NS_PER_WORK - SAMPLES as f64 + self.samples as f64) / self.rate
        }
    }

    fn question(vehicle: usize, samples_min: usize, now_ns: u64) -> Submission {
        of_asker(vehicle, Asker::usual(1.0), samples_min, now_ns)
    }

    fn of_asker(vehicle: usize, asker: Asker, samples_min: usize, now_ns: u64) -> Submission {
        let query = PredictQuery {
            session: vehicle.to_string(),
            start: None,
            instant: None,
            use_history: true,
            samples: asker.samples,
            samples_min,
            horizon: 1,
            controls: Candidates::Given(vec![0.0; 2 * asker.samples]),
            cost: None,
            extras: Default::default(),
        };
        let mut submission = Submission::new(Command::Predict(query), |_| ()).at(now_ns);
        submission.deadline_ns = Some(now_ns + asker.deadline_ns);
        submission
    }

    /// Numbers from 0 to 1, the same ones each time.
    fn random(seed: u64) -> impl FnMut() -> f64 {
        let mut state = seed;
        move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            ((state >> 33) as f64 + 0.5) / (1_u64 << 31) as f64
        }
    }

    /// Vehicles that ask at these rates for what takes 16 ms.
    fn simulate(rates: &[f64], samples_min: usize) -> Vec<Tally> {
        simulate_askers(&rates.iter().map(|rate| Asker::usual(*rate)).collect::<Vec<_>>(), samples_min, ENDS_NS)
    }

    /// A prediction at work.
    #[derive(Clone, Copy)]
    struct AtWork {
        vehicle: usize,
        work: f64,
        begin_ns: u64,
        end_ns: u64,
        deadline_ns: u64,
    }

    /// An engine that takes 0.85 to 1.15 of what is expected, and in which a prediction waits for urgent ones.
    fn simulate_askers(askers: &[Asker], samples_min: usize, ends_ns: u64) -> Vec<Tally> {
        let (queue, limits, mut random) = (Queue::default(), Limits::default(), random(11));
        queue.done(1.0, false, Some(Took::All(NS_PER_WORK as u64)), 0);
        let mut tallies = vec![Tally::default(); askers.len()];
        let mut asks_ns: Vec<f64> = askers.iter().map(|asker| asker.pause_ns(random())).collect();
        let mut at_work: [Option<AtWork>; 2] = [None; 2];
        loop {
            let (vehicle, ask_ns) = asks_ns.iter().copied().enumerate().min_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
            let mut now_ns = ask_ns as u64;
            let is_urgent = at_work[1].is_some();
            if let Some(done) = at_work[usize::from(is_urgent)].filter(|at_work| at_work.end_ns <= now_ns) {
                queue.done(done.work, is_urgent, Some(Took::All(done.end_ns - done.begin_ns)), done.end_ns);
                if let (true, Some(running)) = (is_urgent, &mut at_work[0]) {
                    running.end_ns += done.end_ns - done.begin_ns;
                }
                at_work[usize::from(is_urgent)] = None;
                if done.begin_ns > COUNTS_NS {
                    let tally = &mut tallies[done.vehicle];
                    tally.in_time += usize::from(done.end_ns <= done.deadline_ns);
                    tally.late += usize::from(done.end_ns > done.deadline_ns);
                }
                now_ns = done.end_ns;
            } else if now_ns > ends_ns {
                return tallies;
            } else {
                tallies[vehicle].asked += usize::from(now_ns > COUNTS_NS);
                let _ = queue.push(of_asker(vehicle, askers[vehicle], samples_min, now_ns), &limits);
                asks_ns[vehicle] += askers[vehicle].pause_ns(random());
            }
            while at_work[1].is_none() && (at_work[0].is_none() || queue.lock().predictions.is_next_urgent()) && queue.has_turn() {
                let Turn::Prediction { mut submission, is_urgent } = queue.next(|| now_ns) else {
                    panic!("only predictions were asked for")
                };
                let deadline_ns = submission.deadline_ns;
                let Command::Predict(query) = &mut submission.command else { panic!("only predictions were asked for") };
                let fits = queue.fit(query, is_urgent, deadline_ns, now_ns).is_ok();
                let work = work(query, query.samples);
                let end_ns = now_ns + (NS_PER_WORK * work * (0.85 + 0.3 * random())) as u64;
                let vehicle = query.session.parse::<usize>().unwrap();
                if now_ns > COUNTS_NS {
                    tallies[vehicle].refused_at_turn += usize::from(!fits);
                    tallies[vehicle].samples += if fits { query.samples } else { 0 };
                }
                if fits {
                    let begun = AtWork { vehicle, work, begin_ns: now_ns, end_ns, deadline_ns: deadline_ns.unwrap() };
                    at_work[usize::from(is_urgent)] = Some(begun);
                } else {
                    queue.done(work, is_urgent, None, now_ns);
                }
            }
        }
    }

    /// Answers that the engine can give while they count.
    const ANSWERS: f64 = (ENDS_NS - COUNTS_NS) as f64 / TAKES_NS;

    fn sum(tallies: &[Tally], of: impl Fn(&Tally) -> usize) -> f64 {
        tallies.iter().map(of).sum::<usize>() as f64
    }

    #[test]
    fn property_who_is_let_in_is_answered_in_time_and_no_time_is_lost() {
        for load in [0.5, 1.0, 3.0, 10.0] {
            let tallies = simulate(&[load / 4.0; 4], 0);
            assert_eq!(sum(&tallies, |one| one.late + one.refused_at_turn), 0.0, "load {load}: {tallies:?}");
            let answered = sum(&tallies, |one| one.in_time) / ANSWERS.min(sum(&tallies, |one| one.asked));
            assert!(answered > if load == 1.0 { 0.9 } else { 0.97 }, "load {load}: {answered} of what can be, {tallies:?}");
        }
    }

    #[test]
    fn property_who_asks_most_gets_what_the_others_leave() {
        // Three ask for a fifth of the time each, one for all of it twice.
        let tallies = simulate(&[2.0, 0.2, 0.2, 0.2], 0);
        let got = |tally: &Tally| tally.in_time as f64 / tally.asked as f64;
        assert!(tallies[1..].iter().all(|one| got(one) > 0.9), "{tallies:?}");
        assert!(sum(&tallies, |one| one.in_time) > 0.97 * ANSWERS, "{tallies:?}");
        // Twenty ask for more than a twentieth each, one of them ten times as often.
        let tallies = simulate(&[vec![1.0], vec![0.1; 19]].concat(), 0);
        let (first, others) = (tallies[0].in_time as f64, sum(&tallies[1..], |one| one.in_time) / 19.0);
        assert!(first < 1.5 * others && 20.0 * others > 0.9 * ANSWERS, "{first} and {others}: {tallies:?}");
    }

    /// Goal: who asks for little and soon does not wait for who asks for much, and nobody who was let in is late. Method: two ask for 0.2 s within 1 s, together for half of
    /// the time, two for 16 ms within 60 ms; then with so many short ones that long ones have to wait for their turn.
    #[test]
    fn property_short_questions_do_not_wait_for_long_ones() {
        let long = |rate: f64| Asker { rate, samples: 20_000, deadline_ns: 1_000 * MS };
        let short = |rate: f64| Asker { rate, samples: SAMPLES, deadline_ns: 60 * MS };
        let part = |tallies: &[Tally]| sum(tallies, |one| one.in_time) / sum(tallies, |one| one.asked);
        for (of_short, all_short, all_long) in [(0.05, 0.95, 0.9), (0.2, 0.9, 0.6)] {
            let tallies = simulate_askers(&[long(0.25), long(0.25), short(of_short), short(of_short)], 0, LONGER * ENDS_NS);
            assert_eq!(sum(&tallies, |one| one.late + one.refused_at_turn), 0.0, "{tallies:?}");
            assert!(part(&tallies[2..]) > all_short && part(&tallies[..2]) > all_long, "{tallies:?}");
        }
    }

    /// Where fewer samples are of use a long one takes all the time that it has; a short one is computed in the midst of it all the same, and no second one when that would leave
    /// less than half.
    #[test]
    fn analytic_a_short_question_does_not_wait_for_one_that_takes_what_time_it_has() {
        let (queue, limits) = (Queue::default(), Limits::default());
        queue.done(1.0, false, Some(Took::All(NS_PER_WORK as u64)), 0);
        let long = Asker { rate: 1.0, samples: 20_000, deadline_ns: 100 * MS };
        assert!(queue.push(of_asker(0, long, 64, 0), &limits).is_ok());
        let Turn::Prediction { submission: mut begun, is_urgent: false } = queue.next(|| 0) else { panic!("nothing else was asked for") };
        let Command::Predict(query) = &mut begun.command else { panic!("a prediction was asked for") };
        queue.fit(query, false, Some(100 * MS), 0).unwrap();
        assert!((8000..9000).contains(&query.samples), "nine tenths of the time, {}", query.samples);
        let short = |vehicle: usize, now_ns: u64| of_asker(vehicle, Asker { rate: 1.0, samples: SAMPLES, deadline_ns: 60 * MS }, 0, now_ns);
        for at_ns in [5 * MS, 30 * MS] {
            assert!(queue.push(short(1, at_ns), &limits).is_ok());
            assert!(matches!(queue.next(|| at_ns), Turn::Prediction { is_urgent: true, .. }));
            assert_eq!(queue.done(work(query, SAMPLES), true, Some(Took::All(16 * MS)), at_ns + 16 * MS), 0, "nobody pauses it");
        }
        assert!(queue.push(short(1, 47 * MS), &limits).is_err(), "it paused for 32 ms of 44");
        assert_eq!(queue.done(work(query, SAMPLES), false, Some(Took::All(90 * MS)), 90 * MS), 32 * MS);
    }

    #[test]
    fn property_fewer_samples_mean_more_answers() {
        let [all, fewer] = [0, 16].map(|samples_min| simulate(&[0.75; 4], samples_min));
        assert_eq!(sum(&fewer, |one| one.late + one.refused_at_turn), 0.0, "{fewer:?}");
        let [answers, samples] = [|one: &Tally| one.in_time, |one: &Tally| one.samples].map(|of| sum(&fewer, of) / sum(&all, of));
        assert!(answers > 1.8, "{answers} times as many answers, {fewer:?}");
        assert!(samples > 0.5, "with {samples} times the samples in all, {fewer:?}");
    }

    #[test]
    fn analytic_who_is_refused_hears_of_the_one_that_is_computed_and_may_come_back_soon() {
        let (queue, limits) = (Queue::default(), Limits::default());
        // A quarter of an hour for a unit of work, which nobody would wait for.
        queue.done(1.0, false, Some(Took::All(900_000 * MS)), 0);
        assert!(queue.push(question(0, 0, 0), &limits).is_ok(), "nothing else is to be done");
        assert!(matches!(queue.next(|| 0), Turn::Prediction { is_urgent: false, .. }));
        let (refused, _) = *queue.push(question(1, 0, 0), &limits).unwrap_err();
        assert!(matches!(refused, EngineError::Overloaded { waiting: 1, retry_after_ns: RETRY_MAX_NS, .. }), "{refused}");
    }

    /// A question of 16 ms on an idle engine with 4 ms, of which an answer needs two for its way back: let in until a prediction has borne the estimate out.
    #[test]
    fn analytic_what_cannot_be_in_time_is_not_begun_while_the_estimate_is_relied_on() {
        let (queue, limits) = (Queue::default(), Limits::default());
        let (of_one, takes_ns) = (TAKES_NS / NS_PER_WORK, TAKES_NS as u64);
        let ask = |vehicle, now_ns: u64, within_ns: u64| {
            let mut asked = question(vehicle, 0, now_ns);
            asked.deadline_ns = Some(now_ns + within_ns);
            queue.push(asked, &limits).map_err(|refused| {
                let (error, _) = *refused;
                error
            })
        };
        let begin = |now_ns: u64| assert!(matches!(queue.next(|| now_ns), Turn::Prediction { is_urgent: false, .. }));
        queue.done(of_one, false, Some(Took::All(takes_ns)), 0);
        assert_eq!(ask(0, 0, 4 * MS), Ok(()));
        begin(0);
        // It will be given up after 4 ms: another one is in time behind it.
        assert_eq!(ask(1, 0, 30 * MS), Ok(()));
        queue.done(of_one, false, Some(Took::AtLeast(4 * MS)), 4 * MS);
        assert_eq!(queue.lock().service_time.expected_ns(of_one), takes_ns, "it says nothing of how long it would have taken");
        begin(4 * MS);
        queue.done(of_one, false, Some(Took::All(takes_ns)), 20 * MS);
        assert_eq!(ask(0, 20 * MS, 4 * MS), Err(EngineError::Expired));
        assert_eq!(ask(0, 20 * MS, 12 * MS), Ok(()), "it may be in time");
        begin(20 * MS);
        // Given up later than it was expected to end: such a question takes longer.
        queue.done(of_one, false, Some(Took::AtLeast(40 * MS)), 60 * MS);
        assert!(queue.lock().service_time.expected_ns(of_one) > takes_ns);
        assert_eq!(ask(0, 20 * MS + RELIED_ON_NS, 4 * MS), Ok(()), "the machine may have become faster since");
    }
}
