//! The two lanes in front of the engine.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, MutexGuard};

use crate::command::Command;
use crate::error::EngineError;
use crate::handle::Submission;
use crate::limits::Limits;

/// Commands that wait. Predictions have a lane of their own, so that a flood of them neither delays nor displaces measurements.
#[derive(Debug, Default)]
pub(crate) struct Queue {
    lanes: Mutex<Lanes>,
    filled: Condvar,
}

#[derive(Debug, Default)]
struct Lanes {
    commands: VecDeque<Submission>,
    predictions: VecDeque<Submission>,
    stopped: bool,
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

    /// Adds a command, or gives it back with the reason.
    pub fn push(&self, submission: Submission, limits: &Limits) -> Result<(), Box<(EngineError, Submission)>> {
        let mut lanes = self.lock();
        if lanes.stopped {
            return Err(Box::new((EngineError::Stopped, submission)));
        }
        let (lane, limit, kind) = match submission.command {
            Command::Predict(_) => (&mut lanes.predictions, limits.waiting_predictions_max, "predictions"),
            _ => (&mut lanes.commands, limits.waiting_commands_max, "commands"),
        };
        if lane.len() >= limit {
            return Err(Box::new((EngineError::Overloaded { kind, waiting: lane.len() }, submission)));
        }
        lane.push_back(submission);
        self.filled.notify_one();
        Ok(())
    }

    /// Waits for the next turn. After `stop`, waiting commands still have their turn and waiting predictions do not.
    pub fn next(&self) -> Turn {
        let mut lanes = self.lock();
        loop {
            if !lanes.commands.is_empty() {
                return Turn::Commands(std::mem::take(&mut lanes.commands));
            }
            if lanes.stopped {
                return Turn::End;
            }
            if let Some(prediction) = lanes.predictions.pop_front() {
                return Turn::Prediction(Box::new(prediction));
            }
            lanes = self.filled.wait(lanes).expect("no holder of the queue panics; this is a bug");
        }
    }

    /// Refuses new commands and gives back the predictions that wait.
    pub fn stop(&self) -> VecDeque<Submission> {
        let mut lanes = self.lock();
        lanes.stopped = true;
        self.filled.notify_all();
        std::mem::take(&mut lanes.predictions)
    }

    /// Waiting commands and predictions.
    pub fn waiting(&self) -> (usize, usize) {
        let lanes = self.lock();
        (lanes.commands.len(), lanes.predictions.len())
    }
}
