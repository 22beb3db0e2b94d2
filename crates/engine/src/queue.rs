//! The two lanes in front of the engine, and what is let in.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use crate::command::Command;
use crate::error::EngineError;
use crate::fair::FairQueue;
use crate::handle::Submission;
use crate::limits::Limits;
use crate::query::PredictQuery;
use crate::service_time::{ServiceTime, work};
use crate::sync::{Condvar, Mutex, MutexGuard};

/// What an answer still needs after the engine: its way back, ns.
const WAY_BACK_NS: u64 = 2_000_000;
/// Share by which waiting and computing may take longer than expected: measurements come in between, and times scatter. With less more predictions are let in that
/// are refused only when their turn comes.
const LONGER: f64 = 0.3;
/// Shortest pause that a refused asker is told, ns.
const RETRY_MIN_NS: u64 = 1_000_000;

/// Commands that wait. Predictions have a lane of their own, so that a flood of them neither delays nor displaces measurements.
#[derive(Debug, Default)]
pub(crate) struct Queue {
    lanes: Mutex<Lanes>,
    filled: Condvar,
}

#[derive(Debug, Default)]
struct Lanes {
    commands: VecDeque<Submission>,
    /// Of the waiting commands, those of each share.
    commands_of: BTreeMap<Arc<str>, usize>,
    predictions: FairQueue<Submission>,
    running: Option<Running>,
    service_time: ServiceTime,
    stopped: bool,
}

/// The prediction that the engine computes now.
#[derive(Clone, Copy, Debug)]
struct Running {
    since_ns: u64,
    expected_ns: u64,
}

/// What the engine does next.
pub(crate) enum Turn {
    /// All waiting commands, in order of arrival.
    Commands(VecDeque<Submission>),
    /// One prediction, since no command waits.
    Prediction(Box<Submission>),
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
        let admitted = match &submission.command {
            Command::Predict(query) => lanes.admit(&submission, query, limits),
            _ => lanes.take(&submission, limits).map(|()| 0),
        };
        match admitted {
            Err(error) => return Err(Box::new((error, submission))),
            Ok(expected_ns) if matches!(submission.command, Command::Predict(_)) => {
                let share = submission.share();
                lanes.predictions.push(&share, submission, expected_ns);
            }
            Ok(_) => lanes.commands.push_back(submission),
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
            if let Some((prediction, expected_ns)) = lanes.predictions.pop() {
                lanes.running = Some(Running { since_ns: now_ns(), expected_ns });
                return Turn::Prediction(Box::new(prediction));
            }
            lanes = self.filled.wait(lanes).expect("no holder of the queue panics; this is a bug");
        }
    }

    /// Leaves of the prediction whose turn it is what is expected to be done by its deadline, where fewer samples are of use.
    ///
    /// # Errors
    /// `EngineError::Overloaded` where it would be late all the same and others wait, who may not be.
    pub fn fit(&self, query: &mut PredictQuery, left_ns: u64) -> Result<(), EngineError> {
        let mut lanes = self.lock();
        if query.least() < query.samples {
            let affordable = lanes.service_time.affordable(query, left_ns);
            query.keep_first(affordable);
        }
        let expected_ns = lanes.service_time.expected_ns(work(query, query.samples));
        if let Some(running) = &mut lanes.running {
            running.expected_ns = expected_ns;
        }
        let waiting = lanes.predictions.len();
        if waiting > 0 && expected_ns > left_ns {
            return Err(EngineError::Overloaded { kind: "predictions", waiting, retry_after_ns: expected_ns.max(RETRY_MIN_NS) });
        }
        Ok(())
    }

    /// The prediction whose turn it was is done: learns how long it took if it was computed. Said before its answer leaves, so that whoever asks again at once
    /// finds the engine idle.
    pub fn done(&self, work: f64, took_ns: Option<u64>) {
        let mut lanes = self.lock();
        lanes.running = None;
        if let Some(took_ns) = took_ns {
            lanes.service_time.learn(work, took_ns);
        }
    }

    /// Refuses new commands and gives back the predictions that wait.
    pub fn stop(&self) -> Vec<Submission> {
        let mut lanes = self.lock();
        lanes.stopped = true;
        self.filled.notify_all();
        lanes.predictions.drain()
    }

    /// Whether [`Queue::next`] would give a command or a prediction at once.
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
    /// The time that a prediction is expected to take, if it is let in: all of it, or the least of it that is of use where all would be late.
    fn admit(&self, submission: &Submission, query: &PredictQuery, limits: &Limits) -> Result<u64, EngineError> {
        let (share, now_ns) = (submission.share(), submission.submitted_ns());
        let running_ns = self.running.map_or(0, |running| (running.since_ns + running.expected_ns).saturating_sub(now_ns));
        let of = |samples| {
            let expected_ns = self.service_time.expected_ns(work(query, samples));
            let wait_ns = running_ns + self.predictions.wait_ns(&share, expected_ns);
            let needed_ns = ((1.0 + LONGER) * (wait_ns + expected_ns) as f64) as u64 + WAY_BACK_NS;
            (expected_ns, wait_ns, now_ns.saturating_add(needed_ns))
        };
        let all = of(query.samples);
        let late = |done_ns| submission.deadline_ns.is_some_and(|deadline_ns| done_ns > deadline_ns);
        let (expected_ns, wait_ns, done_ns) = if late(all.2) { of(query.least()) } else { all };
        let refused = |kind, waiting, retry_after_ns: u64| EngineError::Overloaded {
            kind,
            waiting,
            retry_after_ns: retry_after_ns.max(RETRY_MIN_NS),
        };
        let (waiting, own) = (self.predictions.len(), self.predictions.len_of(&share));
        if waiting >= limits.waiting_predictions_max {
            return Err(refused("predictions", waiting, wait_ns));
        }
        if own >= limits.waiting_predictions_per_vehicle_max {
            return Err(refused("predictions of this vehicle", own, wait_ns));
        }
        // Whoever comes while nothing else is to be done is let in whatever is expected: so the estimate stays true.
        let idle = waiting == 0 && self.running.is_none();
        match submission.deadline_ns {
            Some(deadline_ns) if !idle && done_ns > deadline_ns => Err(refused("predictions", waiting, done_ns - deadline_ns)),
            _ => Ok(expected_ns),
        }
    }

    /// Lets another command in, unless too many wait.
    fn take(&mut self, submission: &Submission, limits: &Limits) -> Result<(), EngineError> {
        let refused = |kind, waiting| EngineError::Overloaded { kind, waiting, retry_after_ns: RETRY_MIN_NS };
        if self.commands.len() >= limits.waiting_commands_max {
            return Err(refused("commands", self.commands.len()));
        }
        if let Command::Measure { .. } = submission.command {
            let own = self.commands_of.entry(submission.share()).or_default();
            if *own >= limits.waiting_measurements_per_vehicle_max {
                return Err(refused("measurements of this vehicle", *own));
            }
            *own += 1;
        }
        Ok(())
    }
}
