//! The way from passing answers to the live page: bounded and lossy, so that no answer ever waits for the page.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use nesam_engine::{Answer, Command, EngineError, MeasureAnswer, Measurement, Prediction, Reply, SessionView};
use tokio::sync::mpsc::{Receiver, Sender, channel};

use super::alarms::Raised;

/// Notes that may wait for the painter, 1 kB each at most: half a second of 8000 answers a second. What comes on top is dropped and counted.
const WAITING_MAX: usize = 4096;

/// Where answers are noted as they pass. Clones share it.
#[derive(Clone, Debug)]
pub(crate) struct Feed {
    watched: Arc<AtomicBool>,
    missed: Arc<AtomicU64>,
    notes: Sender<Note>,
}

/// What the page hears of.
#[derive(Debug)]
pub(crate) enum Note {
    /// A measurement and what became of it.
    Measured(Box<(String, Measurement, MeasureAnswer)>),
    /// A prediction of a session, and what it cost.
    Predicted {
        /// Session.
        session: String,
        /// The prediction, shared with the asker.
        prediction: Arc<Prediction>,
        /// In the queue, s.
        queue_s: f64,
        /// In the engine, s.
        compute_s: f64,
    },
    /// A session that was opened, copied or read.
    Session(Box<SessionView>),
    /// Sessions that are no more.
    Ended(Vec<String>),
    /// A map has this version and this hash now.
    Map(String, u64, String),
    /// A command that was refused.
    Refused(&'static str, EngineError),
    /// An alarm that somebody else has found begins or ends.
    Alarm(Raised),
}

/// A command on its way, as far as the page needs it when its answer comes.
#[derive(Debug)]
pub(crate) struct Passing {
    feed: Feed,
    label: &'static str,
    what: What,
}

#[derive(Debug)]
enum What {
    Measured(Box<(String, Measurement)>),
    Asked(String),
    Closed(String),
    Other,
}

impl Feed {
    /// A feed that nobody watches yet, and its only reader.
    pub fn new() -> (Self, Receiver<Note>) {
        let (notes, reader) = channel(WAITING_MAX);
        (Self { watched: Arc::default(), missed: Arc::default(), notes }, reader)
    }

    /// What of a command is needed when its answer comes; `None` while nobody watches.
    pub fn look(&self, command: &Command) -> Option<Passing> {
        if !self.watched.load(Ordering::Relaxed) {
            return None;
        }
        let what = match command {
            Command::Measure { session, measurement, .. } => What::Measured(Box::new((session.clone(), *measurement))),
            Command::Predict(query) => What::Asked(query.session.clone()),
            Command::Close { session } => What::Closed(session.clone()),
            _ => What::Other,
        };
        Some(Passing { feed: self.clone(), label: command.label(), what })
    }

    /// Shows an alarm on the page, or takes it away; this never waits.
    pub fn alarm(&self, raised: Raised) {
        if self.watched.load(Ordering::Relaxed) {
            self.note(Note::Alarm(raised));
        }
    }

    /// Begins or ends the taking of notes.
    pub fn watch(&self, watched: bool) {
        self.watched.store(watched, Ordering::Relaxed);
    }

    /// Notes that were dropped because too many waited.
    pub fn missed(&self) -> u64 {
        self.missed.load(Ordering::Relaxed)
    }

    fn note(&self, note: Note) {
        if self.notes.try_send(note).is_err() {
            self.missed.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl Passing {
    /// Notes the answer. This runs on the engine's thread: it copies and returns.
    pub fn answered(self, answer: &Answer) {
        let note = match (self.what, &answer.result) {
            (_, Err(error)) => Note::Refused(self.label, error.refusal().clone()),
            (What::Measured(asked), Ok(Reply::Measured(answer))) => {
                let (session, measurement) = *asked;
                Note::Measured(Box::new((session, measurement, (**answer).clone())))
            }
            (What::Asked(session), Ok(Reply::Predicted(prediction))) => Note::Predicted {
                session,
                prediction: Arc::clone(prediction),
                queue_s: answer.queued_ns as f64 * 1e-9,
                compute_s: answer.busy_ns as f64 * 1e-9,
            },
            (What::Closed(session), Ok(_)) => Note::Ended(vec![session]),
            (_, Ok(Reply::Session(view))) => Note::Session(view.clone()),
            (_, Ok(Reply::Expired(sessions))) if !sessions.is_empty() => Note::Ended(sessions.clone()),
            (_, Ok(Reply::Map(map))) => Note::Map(map.id().into(), map.version(), map.hash().into()),
            _ => return,
        };
        self.feed.note(note);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused() -> Answer {
        Answer::refused(EngineError::Expired)
    }

    #[test]
    fn property_nothing_is_noted_while_nobody_watches() {
        let (feed, mut reader) = Feed::new();
        assert!(feed.look(&Command::List).is_none());
        feed.watch(true);
        feed.look(&Command::List).expect("watched").answered(&refused());
        assert!(matches!(reader.try_recv(), Ok(Note::Refused("list", EngineError::Expired))));
        let silent = Raised { session: None, id: "i".into(), what: "w".into(), advice: String::new(), active: true };
        feed.alarm(silent.clone());
        assert!(matches!(reader.try_recv(), Ok(Note::Alarm(raised)) if raised == silent));
        feed.watch(false);
        feed.alarm(silent);
        assert!(feed.look(&Command::List).is_none() && reader.try_recv().is_err());
    }

    #[test]
    fn property_a_reader_that_never_reads_costs_notes_and_no_time() {
        let (feed, mut reader) = Feed::new();
        feed.watch(true);
        let more = 1000;
        for _ in 0..WAITING_MAX + more {
            feed.look(&Command::List).expect("watched").answered(&refused());
        }
        assert_eq!(feed.missed(), more as u64);
        let mut kept = 0;
        while reader.try_recv().is_ok() {
            kept += 1;
        }
        assert_eq!(kept, WAITING_MAX);
        drop(reader);
        feed.look(&Command::List).expect("watched").answered(&refused());
        assert_eq!(feed.missed(), more as u64 + 1);
    }
}
