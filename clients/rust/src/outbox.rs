//! Measurements that a vehicle keeps until the service has them on stable storage.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::hash::{BuildHasher, RandomState};
use std::sync::{LazyLock, Mutex, PoisonError};

use nesam_proto::v1;
use v1::measurement_answer::Outcome;

use crate::error::ClientError;

/// Measurements that an outbox keeps at most, unless it is told otherwise; as in the other clients.
const PENDING_MAX: usize = 65_536;

/// This start of the program, and by session the numbers of its measurements that have none of their own: by them the service knows what it has had, however long ago.
static BOOT_ID: LazyLock<u64> = LazyLock::new(|| RandomState::new().hash_one(std::process::id()) | 1);
static NUMBERS: Mutex<BTreeMap<String, u64>> = Mutex::new(BTreeMap::new());

/// Keeps the measurements of one session until they are durable, so that a crash of the server loses none.
///
/// Send what [`Outbox::next_unsent`] gives over one stream at a time, hand every answer to [`Outbox::answered`] in order, and call [`Outbox::reconnected`]
/// when a new stream is opened: it sends again what is not known to be durable, and the service drops what it has.
///
/// Several measurements may be on their way at once. Where the service has no room for one of them (RESOURCE_EXHAUSTED, UNAVAILABLE), those that were sent
/// after it may have been accepted before it is sent again, and further than the reorder window (`limits.reorder_window_s`) behind them it is not taken any
/// more. So that no more overtake it, it is sent again first, and nothing after it before it is answered; pause before it is. One that comes too late all the
/// same is given back by [`Outbox::answered`]. Who must lose none sends one measurement at a time: the next one after the answer to the one before.
#[derive(Clone, Debug)]
pub struct Outbox {
    pending_max: usize,
    /// What is not known to be durable, by the order of [`Outbox::push`].
    kept: BTreeMap<u64, v1::Measurement>,
    /// Those of `kept` that were not sent, or sent over a connection that broke.
    unsent: BTreeSet<u64>,
    /// Those of `kept` that were sent and not answered, in the order of sending, which is that of the answers.
    on_the_way: VecDeque<u64>,
    /// Those of `kept` that were accepted: place in the session, number in `kept`.
    received: BTreeSet<(u64, u64)>,
    /// Places of those of `kept` that this run has accepted, now or before they were sent again, by number in `kept`.
    places: BTreeMap<u64, u64>,
    /// Those of `kept` that the service had no room for and has not answered otherwise since.
    no_room: BTreeSet<u64>,
    /// How many were pushed.
    pushed: u64,
    /// Who counts the places.
    run: u64,
    /// Whether measurements come with numbers of their own; `None` before the first.
    numbered: Option<bool>,
}

impl Default for Outbox {
    /// Keeps 65 536 measurements at most. A store commits at least every second (`store.interval_s`), so this many are more than ten minutes at 100 Hz; without
    /// a store nothing becomes durable, and they are all that can be sent.
    fn default() -> Self {
        Self::with_pending_max(PENDING_MAX)
    }
}

impl Outbox {
    /// Keeps `pending_max` measurements at most; [`Outbox::push`] refuses more.
    pub fn with_pending_max(pending_max: usize) -> Self {
        Self {
            pending_max,
            kept: BTreeMap::new(),
            unsent: BTreeSet::new(),
            on_the_way: VecDeque::new(),
            received: BTreeSet::new(),
            places: BTreeMap::new(),
            no_room: BTreeSet::new(),
            pushed: 0,
            run: 0,
            numbered: None,
        }
    }

    /// Takes a new measurement. One without a number or a boot gets one of this program, so that nothing is taken for new that is sent again.
    ///
    /// # Errors
    /// `ClientError::Refused` with RESOURCE_EXHAUSTED of `pending_max` when as many are not known to be durable; this one is not kept. Hand over answers, or a
    /// `durable_place` ([`Outbox::durable`]), first. INVALID_ARGUMENT of `sequence` where some have a number of their own and some have none: one may be that which another got here.
    pub fn push(&mut self, mut measurement: v1::Measurement) -> Result<(), ClientError> {
        if self.kept.len() >= self.pending_max {
            return Err(ClientError::Refused {
                code: tonic::Code::ResourceExhausted,
                field: "pending_max".into(),
                message: format!("{} measurements are not known to be durable; wait until some are", self.kept.len()),
                retry_after: None,
            });
        }
        let numbered = measurement.sequence != 0;
        if self.numbered.is_some_and(|before| before != numbered) {
            return Err(ClientError::Refused {
                code: tonic::Code::InvalidArgument,
                field: "sequence".into(),
                message: "some measurements have a number and some have none; 0 is none, numbers begin at 1".into(),
                retry_after: None,
            });
        }
        self.numbered = Some(numbered);
        if measurement.boot_id == 0 {
            measurement.boot_id = *BOOT_ID;
        }
        if measurement.sequence == 0 {
            let mut numbers = NUMBERS.lock().unwrap_or_else(PoisonError::into_inner);
            let number = numbers.entry(measurement.session_id.clone()).or_default();
            *number += 1;
            measurement.sequence = *number;
        }
        self.pushed += 1;
        self.kept.insert(self.pushed, measurement);
        self.unsent.insert(self.pushed);
        Ok(())
    }

    /// The next measurement to send, oldest first; it counts as sent from now on. `None` when everything is sent, and, while one is kept that the service had no
    /// room for, until that one and those before it are answered.
    pub fn next_unsent(&mut self) -> Option<v1::Measurement> {
        let number = *self.unsent.first()?;
        let awaited = |sent: &u64| *sent < number || self.no_room.contains(sent);
        if !self.no_room.is_empty() && self.on_the_way.iter().any(awaited) {
            return None;
        }
        self.unsent.remove(&number);
        self.on_the_way.push_back(number);
        self.kept.get(&number).cloned()
    }

    /// Takes the answer to the measurement that was sent first of those not answered. A refused measurement is not kept, but for one that the service had no
    /// room for: that is sent again.
    ///
    /// Gives back a measurement that is lost: the service had no room for it, has accepted later ones since, and answers TOO_OLD now. `None` otherwise, also
    /// for other refusals, which the answer tells.
    pub fn answered(&mut self, answer: &v1::MeasurementAnswer) -> Option<v1::Measurement> {
        // A refusal need not tell who counts.
        if answer.place != 0 {
            self.counted_by(answer.run);
        }
        let lost = match self.on_the_way.pop_front() {
            Some(number) => self.settle(number, answer),
            None => None,
        };
        // Without a place it does not tell whether the session is the same.
        if answer.run == self.run && answer.place != 0 {
            self.durable(answer.run, answer.durable_place);
        }
        lost
    }

    /// Notes what a measurement was answered; gives it back where it is lost.
    fn settle(&mut self, number: u64, answer: &v1::MeasurementAnswer) -> Option<v1::Measurement> {
        match &answer.outcome {
            Some(Outcome::Rejected(rejected))
                if [tonic::Code::ResourceExhausted, tonic::Code::Unavailable].contains(&rejected.code.into()) =>
            {
                self.no_room.insert(number);
                self.unsent.insert(number);
                None
            }
            outcome if answer.place == 0 => {
                let place = self.places.get(&number).filter(|_| answer.run == self.run && !matches!(outcome, Some(Outcome::Rejected(_))));
                if let Some(place) = place {
                    // The session has it, and does not know it again: it is of a boot that has ended. It keeps its place until that is durable.
                    self.received.insert((*place, number));
                    return None;
                }
                self.places.remove(&number);
                let overtaken = self.no_room.remove(&number) && matches!(outcome, Some(Outcome::TooOld(_)));
                self.kept.remove(&number).filter(|_| overtaken)
            }
            _ => {
                self.no_room.remove(&number);
                self.places.insert(number, answer.place);
                self.received.insert((answer.place, number));
                None
            }
        }
    }

    /// Takes a `durable_place` and the `run` that told it, for example by `Sessions.Get`. Another run than the one that answered says nothing of its places:
    /// what it answered is sent again.
    pub fn durable(&mut self, run: u64, place: u64) {
        self.counted_by(run);
        while let Some((received, number)) = self.received.first().copied()
            && received <= place
        {
            self.received.pop_first();
            self.places.remove(&number);
            self.kept.remove(&number);
        }
    }

    fn counted_by(&mut self, run: u64) {
        if run != self.run {
            self.run = run;
            self.places.clear();
            let received = std::mem::take(&mut self.received);
            self.unsent.extend(received.into_iter().map(|(_, number)| number));
        }
    }

    /// A new stream begins, to the same run of the server or another one: everything kept is sent again.
    pub fn reconnected(&mut self) {
        self.on_the_way.clear();
        self.received.clear();
        self.unsent = self.kept.keys().copied().collect();
    }

    /// Measurements that are not known to be durable.
    pub fn len(&self) -> usize {
        self.kept.len()
    }

    /// Whether all are.
    pub fn is_empty(&self) -> bool {
        self.kept.is_empty()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    fn answer(place: u64, durable_place: u64) -> v1::MeasurementAnswer {
        v1::MeasurementAnswer { place, durable_place, ..Default::default() }
    }

    fn holding(measurements: u64) -> Outbox {
        let mut outbox = Outbox::default();
        (1..=measurements).for_each(|sequence| outbox.push(v1::Measurement { sequence, ..Default::default() }).unwrap());
        outbox
    }

    fn no_room() -> v1::MeasurementAnswer {
        let rejected = v1::Rejected { code: tonic::Code::ResourceExhausted.into(), ..Default::default() };
        v1::MeasurementAnswer { outcome: Some(Outcome::Rejected(rejected)), ..Default::default() }
    }

    fn too_old() -> v1::MeasurementAnswer {
        v1::MeasurementAnswer { outcome: Some(Outcome::TooOld(v1::TooOld::default())), ..Default::default() }
    }

    fn sequences(outbox: &mut Outbox) -> Vec<u64> {
        std::iter::from_fn(|| outbox.next_unsent()).map(|m| m.sequence).collect()
    }

    #[test]
    fn analytic_only_what_is_durable_is_forgotten() {
        let mut outbox = holding(4);
        assert_eq!(sequences(&mut outbox), [1, 2, 3, 4]);
        outbox.answered(&answer(1, 0));
        outbox.answered(&answer(2, 1));
        assert_eq!(outbox.len(), 3);
        // Refused for good: not kept. No room: sent again.
        outbox.answered(&answer(0, 1));
        outbox.answered(&no_room());
        assert_eq!(sequences(&mut outbox), [4]);
        outbox.reconnected();
        assert_eq!(sequences(&mut outbox), [2], "4 had no room and waits for the answer to 2");
        // A number of another run of the server says nothing before the measurement is answered again.
        outbox.durable(0, 7);
        assert_eq!(outbox.len(), 2);
        outbox.answered(&answer(7, 7));
        assert_eq!(sequences(&mut outbox), [4]);
        outbox.answered(&answer(8, 7));
        outbox.durable(0, 8);
        assert!(outbox.is_empty());
    }

    #[test]
    fn analytic_places_of_another_run_say_nothing() {
        let mut outbox = holding(2);
        assert_eq!(sequences(&mut outbox), [1, 2]);
        outbox.answered(&v1::MeasurementAnswer { run: 5, ..answer(1, 0) });
        outbox.answered(&v1::MeasurementAnswer { run: 5, ..answer(2, 1) });
        assert_eq!(outbox.len(), 1);
        // Taken up by another server, which has more of somebody else.
        outbox.durable(6, 9);
        assert_eq!(sequences(&mut outbox), [2]);
        outbox.answered(&v1::MeasurementAnswer { run: 6, ..answer(10, 9) });
        outbox.durable(6, 10);
        assert!(outbox.is_empty());
    }

    #[test]
    fn analytic_a_measurement_that_is_sent_again_is_answered_last() {
        let mut outbox = holding(3);
        assert_eq!(sequences(&mut outbox), [1, 2, 3]);
        outbox.answered(&no_room());
        assert_eq!(sequences(&mut outbox), [1]);
        // The answers to 2 and 3 come before that to 1.
        outbox.answered(&answer(1, 1));
        outbox.answered(&answer(2, 2));
        outbox.reconnected();
        assert_eq!(sequences(&mut outbox), [1]);
    }

    #[test]
    fn analytic_a_refusal_without_a_run_takes_no_place_away() {
        let mut outbox = holding(2);
        assert_eq!(sequences(&mut outbox), [1, 2]);
        outbox.answered(&v1::MeasurementAnswer { run: 5, ..answer(1, 0) });
        outbox.answered(&answer(0, 0));
        assert!(sequences(&mut outbox).is_empty() && outbox.len() == 1, "1 has its place, 2 was refused for good");
        outbox.durable(5, 1);
        assert!(outbox.is_empty());
    }

    /// Goal: nothing overtakes a measurement that there was no room for, but what was on its way. Method: the service has no room for the first two of three,
    /// new ones come meanwhile; what is sent is written down after every answer.
    #[test]
    fn analytic_what_had_no_room_goes_first_and_alone() {
        let mut outbox = holding(3);
        assert_eq!(sequences(&mut outbox), [1, 2, 3]);
        outbox.answered(&no_room());
        outbox.push(v1::Measurement { sequence: 4, ..Default::default() }).unwrap();
        assert_eq!(sequences(&mut outbox), [1], "4 waits");
        outbox.answered(&no_room());
        assert!(sequences(&mut outbox).is_empty(), "2 waits for the answer to 1");
        assert!(outbox.answered(&answer(1, 0)).is_none(), "3 is accepted");
        assert!(sequences(&mut outbox).is_empty());
        // Still no room for 1: once more, alone.
        assert!(outbox.answered(&no_room()).is_none());
        assert_eq!(sequences(&mut outbox), [1]);
        assert!(outbox.answered(&answer(2, 0)).is_none(), "put in its place within the reorder window");
        assert_eq!(sequences(&mut outbox), [2]);
        assert!(outbox.answered(&answer(3, 0)).is_none());
        outbox.push(v1::Measurement { sequence: 5, ..Default::default() }).unwrap();
        assert_eq!(sequences(&mut outbox), [4, 5], "there is room again");
        outbox.answered(&answer(4, 0));
        outbox.answered(&answer(5, 5));
        assert!(outbox.is_empty());
    }

    /// Goal: no measurement is lost without a word. Method: one that had no room is TOO_OLD after later ones were accepted, also over a new connection; one that
    /// was never refused for room is TOO_OLD because the service has it.
    #[test]
    fn regress_a_measurement_that_was_overtaken_is_given_back() {
        for reconnects in [false, true] {
            let mut outbox = holding(2);
            assert_eq!(sequences(&mut outbox), [1, 2]);
            outbox.answered(&no_room());
            assert!(outbox.answered(&answer(1, 1)).is_none());
            if reconnects {
                outbox.reconnected();
            }
            assert_eq!(sequences(&mut outbox), [1]);
            assert_eq!(outbox.answered(&too_old()).map(|lost| lost.sequence), Some(1), "reconnects: {reconnects}");
            assert!(outbox.is_empty());
        }
        let mut outbox = holding(1);
        assert_eq!(sequences(&mut outbox), [1]);
        assert!(outbox.answered(&too_old()).is_none() && outbox.is_empty());
    }

    /// Goal: what the session has is kept until that is durable, though the session does not know it again. Method: of two starts of a vehicle the first is over when a new stream
    /// begins, and its measurements are TOO_OLD; the same where another run counts, which may not have them.
    #[test]
    fn regress_a_measurement_of_an_ended_boot_keeps_its_place() {
        let of = |run: u64, answer: v1::MeasurementAnswer| v1::MeasurementAnswer { run, ..answer };
        let mut outbox = holding(3);
        assert_eq!(sequences(&mut outbox), [1, 2, 3]);
        (1..=3).for_each(|place| drop(outbox.answered(&of(5, answer(place, 0)))));
        outbox.reconnected();
        assert_eq!(sequences(&mut outbox), [1, 2, 3]);
        for _ in 0..2 {
            assert!(outbox.answered(&v1::MeasurementAnswer { durable_place: 3, ..of(5, too_old()) }).is_none());
        }
        assert_eq!(outbox.len(), 3, "an answer without a place may be of a session that began anew");
        outbox.answered(&of(5, answer(3, 1)));
        assert_eq!(outbox.len(), 2, "the first is durable");
        outbox.durable(5, 3);
        assert!(outbox.is_empty());

        let mut outbox = holding(1);
        assert_eq!(sequences(&mut outbox), [1]);
        outbox.answered(&of(5, answer(1, 0)));
        outbox.reconnected();
        assert_eq!(sequences(&mut outbox), [1]);
        outbox.answered(&of(6, too_old()));
        assert!(outbox.is_empty(), "another run has refused it");
    }

    /// Goal: a server that keeps no store does not fill the memory of the vehicle. Method: one more than is kept; one becomes durable.
    #[test]
    fn analytic_no_more_are_kept_than_the_limit() {
        let mut outbox = Outbox::with_pending_max(2);
        let push = |outbox: &mut Outbox, sequence: u64| outbox.push(v1::Measurement { sequence, ..Default::default() });
        push(&mut outbox, 1).unwrap();
        push(&mut outbox, 2).unwrap();
        let refused = push(&mut outbox, 3).unwrap_err();
        assert_eq!((refused.code(), refused.field()), (Some(tonic::Code::ResourceExhausted), "pending_max"));
        assert_eq!(sequences(&mut outbox), [1, 2], "the refused one is not kept");
        outbox.answered(&answer(1, 1));
        push(&mut outbox, 3).unwrap();
        assert_eq!((sequences(&mut outbox), outbox.len()), (vec![3], 2));
    }
}
