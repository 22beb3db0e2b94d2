//! Measurements that a vehicle keeps until the service has them on stable storage.

use std::collections::VecDeque;

use nesam_proto::v1;

/// Where a measurement stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Progress {
    /// Not sent, or sent over a connection that broke.
    Unsent,
    /// Sent, not answered; counted in the order of sending, which is that of the answers.
    Sent(u64),
    /// Answered: its place among those that the session has accepted.
    Received(u64),
}

/// Keeps the measurements of one session until they are durable, so that a crash of the server loses none.
///
/// Send what [`Outbox::next_unsent`] gives over one stream at a time, hand every answer to [`Outbox::answered`] in order, and call [`Outbox::reconnected`]
/// when a new stream is opened: it sends again what is not known to be durable, and the service drops what it has.
#[derive(Clone, Debug, Default)]
pub struct Outbox {
    kept: VecDeque<(v1::Measurement, Progress)>,
    /// How often a measurement was sent.
    sent: u64,
    /// Who counts the places.
    run: u64,
}

impl Outbox {
    /// Takes a new measurement.
    pub fn push(&mut self, measurement: v1::Measurement) {
        self.kept.push_back((measurement, Progress::Unsent));
    }

    /// The next measurement to send; it counts as sent from now on.
    pub fn next_unsent(&mut self) -> Option<v1::Measurement> {
        let (measurement, progress) = self.kept.iter_mut().find(|(_, progress)| *progress == Progress::Unsent)?;
        self.sent += 1;
        *progress = Progress::Sent(self.sent);
        Some(measurement.clone())
    }

    /// Takes the answer to the measurement that was sent first of those not answered. A refused measurement is not kept, but for one that the service had no
    /// room for: that is sent again.
    pub fn answered(&mut self, answer: &v1::MeasurementAnswer) {
        // A refusal need not tell who counts.
        if answer.place != 0 {
            self.counted_by(answer.run);
        }
        let sent = self.kept.iter().enumerate().filter_map(|(at, (_, progress))| match progress {
            Progress::Sent(number) => Some((*number, at)),
            _ => None,
        });
        if let Some((_, at)) = sent.min() {
            match &answer.outcome {
                Some(v1::measurement_answer::Outcome::Rejected(rejected))
                    if [tonic::Code::ResourceExhausted, tonic::Code::Unavailable].contains(&rejected.code.into()) =>
                {
                    self.kept[at].1 = Progress::Unsent;
                }
                _ if answer.place == 0 => drop(self.kept.remove(at)),
                _ => self.kept[at].1 = Progress::Received(answer.place),
            }
        }
        if answer.run == self.run {
            self.durable(answer.run, answer.durable_place);
        }
    }

    /// Takes a `durable_place` and the `run` that told it, for example by `Sessions.Get`. Another run than the one that answered says nothing of its places:
    /// what it answered is sent again.
    pub fn durable(&mut self, run: u64, place: u64) {
        self.counted_by(run);
        self.kept.retain(|(_, progress)| !matches!(progress, Progress::Received(received) if *received <= place));
    }

    fn counted_by(&mut self, run: u64) {
        if run != self.run {
            self.run = run;
            let received = self.kept.iter_mut().filter(|(_, progress)| matches!(progress, Progress::Received(_)));
            received.for_each(|(_, progress)| *progress = Progress::Unsent);
        }
    }

    /// A new stream begins, to the same run of the server or another one: everything kept is sent again.
    pub fn reconnected(&mut self) {
        self.kept.iter_mut().for_each(|(_, progress)| *progress = Progress::Unsent);
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
        (1..=measurements).for_each(|sequence| outbox.push(v1::Measurement { sequence, ..Default::default() }));
        outbox
    }

    fn no_room() -> v1::MeasurementAnswer {
        let rejected = v1::Rejected { code: tonic::Code::ResourceExhausted.into(), ..Default::default() };
        v1::MeasurementAnswer { outcome: Some(v1::measurement_answer::Outcome::Rejected(rejected)), ..Default::default() }
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
        assert_eq!(sequences(&mut outbox), [2, 4]);
        // A number of another run of the server says nothing before the measurement is answered again.
        outbox.durable(0, 7);
        assert_eq!(outbox.len(), 2);
        outbox.answered(&answer(7, 7));
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
}
