//! The engine behind a thread.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use nesam_model::is_raised;
use nesam_physics::Vehicle;

use crate::clock::Clock;
use crate::command::{Command, Reply, Until};
use crate::engine::Engine;
use crate::error::EngineError;
use crate::limits::Limits;
use crate::queue::{Queue, Took, Turn};
use crate::service_time::{encoding_work, work};
use crate::sync::thread::{self, JoinHandle};
use crate::sync::{Mutex, mpsc};

/// A command on its way to the engine.
pub struct Submission {
    /// What is asked.
    pub command: Command,
    /// Instant of the engine's clock after which a prediction is of no use, ns: it is not started any more. Whoever submits raises `abandoned` then.
    pub deadline_ns: Option<u64>,
    /// Raised when nobody waits for the answer any more; a prediction is then skipped or given up.
    pub abandoned: Option<Arc<AtomicBool>>,
    /// Raised when the answer is due: a prediction of which fewer samples are of use then ends with those that are done.
    pub due: Option<Arc<AtomicBool>>,
    /// Called once with the answer, on the engine's thread or on the submitter's; it must not wait.
    pub reply: Box<dyn FnOnce(Answer) + Send>,
    /// Vehicle that the command counts for when vehicles compete; `None` = its session stands for it.
    pub share: Option<Arc<str>>,
    submitted_ns: u64,
}

impl core::fmt::Debug for Submission {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Submission").field("command", &self.command.label()).field("deadline_ns", &self.deadline_ns).finish_non_exhaustive()
    }
}

impl Submission {
    /// A command without a deadline.
    pub fn new(command: Command, reply: impl FnOnce(Answer) + Send + 'static) -> Self {
        Self { command, deadline_ns: None, abandoned: None, due: None, reply: Box::new(reply), share: None, submitted_ns: 0 }
    }

    /// Whom the command counts for.
    pub(crate) fn share(&self) -> Arc<str> {
        let session = || match &self.command {
            Command::Predict(query) => query.session.as_str(),
            Command::Measure { session, .. } => session,
            _ => "",
        };
        self.share.clone().unwrap_or_else(|| session().into())
    }

    /// When it was submitted, ns of the engine's clock.
    pub(crate) fn submitted_ns(&self) -> u64 {
        self.submitted_ns
    }

    /// The same, submitted then.
    pub(crate) fn at(self, submitted_ns: u64) -> Self {
        Self { submitted_ns, ..self }
    }

    /// Whether a prediction is asked for as it must be; of other commands only the engine knows.
    fn check(&self, limits: &Limits, vehicle: &Vehicle) -> Result<(), EngineError> {
        match &self.command {
            Command::Predict(query) => query.check(limits, vehicle),
            _ => Ok(()),
        }
    }

    fn refuse(self, error: EngineError) {
        (self.reply)(Answer { result: Err(error), queued_ns: 0, busy_ns: 0 });
    }
}

/// The answer to a submission.
#[derive(Debug)]
pub struct Answer {
    /// Reply or refusal.
    pub result: Result<Reply, EngineError>,
    /// Time in the queue, ns.
    pub queued_ns: u64,
    /// Time in the engine, ns.
    pub busy_ns: u64,
}

/// A command that the engine's thread has answered, for a recording.
#[derive(Clone, Debug)]
pub struct Executed {
    /// Instant at which it was executed, ns of the engine's clock.
    pub now_ns: u64,
    /// The command.
    pub command: Command,
    /// Reply or refusal. `Abandoned` and `Expired` say that the prediction was not computed, or not to the end; it has left no trace.
    pub result: Result<Reply, EngineError>,
    /// Time in the queue, ns.
    pub queued_ns: u64,
    /// Time in the engine, ns.
    pub busy_ns: u64,
}

/// Hears of every command but snapshots after its answer was sent, in the order of execution; called on the engine's thread, so it must not wait.
pub type Tap = Box<dyn FnMut(Executed) + Send>;

/// The way to an engine. Clones share the engine.
#[derive(Clone)]
pub struct EngineHandle {
    queue: Arc<Queue>,
    clock: Arc<dyn Clock>,
    limits: Arc<Limits>,
    vehicle: Arc<Vehicle>,
    worker: Arc<Worker>,
}

/// Who executes. `None` once the engine was given back.
enum Worker {
    /// A thread of its own.
    Thread(Mutex<Option<JoinHandle<Engine>>>),
    /// Whoever submits.
    Submitter(Box<Mutex<Option<(Engine, Option<Tap>)>>>),
}

impl core::fmt::Debug for EngineHandle {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("EngineHandle").field("queue", &self.queue).finish_non_exhaustive()
    }
}

impl EngineHandle {
    /// Starts the thread.
    ///
    /// # Panics
    /// When the system refuses to start a thread.
    pub fn spawn(engine: Engine, clock: Arc<dyn Clock>) -> Self {
        Self::spawn_tapped(engine, clock, None)
    }

    /// The same with somebody who hears every executed command. Executing these commands again at their instants, on an engine with the same
    /// predictor and limits, gives the same answers.
    ///
    /// # Panics
    /// When the system refuses to start a thread.
    pub fn spawn_tapped(engine: Engine, clock: Arc<dyn Clock>, tap: Option<Tap>) -> Self {
        let queue = Arc::new(Queue::default());
        let (limits, vehicle) = (Arc::new(engine.limits().clone()), Arc::new(engine.vehicle().clone()));
        let thread = thread::Builder::new()
            .name("nesam-engine".into())
            .spawn({
                let (queue, clock) = (queue.clone(), clock.clone());
                move || run(engine, &queue, clock.as_ref(), tap)
            })
            .expect("the system starts a thread");
        Self { queue, clock, limits, vehicle, worker: Arc::new(Worker::Thread(Mutex::new(Some(thread)))) }
    }

    /// An engine without a thread: whoever submits executes all that waits before it goes on, unless somebody else is at it. So a simulation runs on one
    /// thread.
    pub fn unthreaded(engine: Engine, clock: Arc<dyn Clock>, tap: Option<Tap>) -> Self {
        let (limits, vehicle) = (Arc::new(engine.limits().clone()), Arc::new(engine.vehicle().clone()));
        Self {
            queue: Arc::default(),
            clock,
            limits,
            vehicle,
            worker: Arc::new(Worker::Submitter(Box::new(Mutex::new(Some((engine, tap)))))),
        }
    }

    /// Puts a command in the queue. The answer always comes, and only through `reply`; a full queue is answered at once, and so is a prediction that would not
    /// be done in time, with what is wrong with it where that will not change.
    pub fn submit(&self, submission: Submission) {
        if let Err(refused) = self.queue.push(submission.at(self.clock.now_ns()), &self.limits) {
            let (error, submission) = *refused;
            // Asked wrongly it is in vain however often it is asked again.
            let wrong = submission.check(&self.limits, &self.vehicle).err();
            submission.refuse(wrong.unwrap_or(error));
        }
        self.work_off();
    }

    /// The same, waiting for the answer on this thread.
    ///
    /// # Errors
    /// Any [`EngineError`].
    pub fn call(&self, command: Command) -> Result<Reply, EngineError> {
        let (sender, receiver) = mpsc::channel();
        self.submit(Submission::new(command, move |answer| {
            let _ = sender.send(answer.result);
        }));
        receiver.recv().unwrap_or(Err(EngineError::Stopped))
    }

    /// Executes what waits where nobody else does. What comes while another executes is found by that one: it looks again after it has let the engine go.
    fn work_off(&self) {
        let Worker::Submitter(held) = self.worker.as_ref() else { return };
        while self.queue.has_turn() {
            let Ok(mut held) = held.try_lock() else { return };
            let Some((engine, tap)) = held.as_mut() else { return };
            while self.queue.has_turn() {
                take_turn(self.queue.next(|| self.clock.now_ns()), engine, &self.queue, self.clock.as_ref(), tap);
            }
        }
    }

    /// Limits in force.
    pub fn limits(&self) -> &Limits {
        &self.limits
    }

    /// The engine's clock.
    pub fn now_ns(&self) -> u64 {
        self.clock.now_ns()
    }

    /// Waiting commands and waiting predictions.
    pub fn waiting(&self) -> (usize, usize) {
        self.queue.waiting()
    }

    /// Stops the engine: waiting commands are executed, waiting predictions are refused, later submissions too. Gives the engine back to the first
    /// caller, `None` to the others and after a crash of the thread.
    pub fn stop(&self) -> Option<Engine> {
        for submission in self.queue.stop() {
            submission.refuse(EngineError::Stopped);
        }
        match self.worker.as_ref() {
            Worker::Thread(thread) => thread.lock().ok()?.take()?.join().ok(),
            Worker::Submitter(held) => {
                let (engine, tap) = held.lock().ok()?.take()?;
                Some(run(engine, &self.queue, self.clock.as_ref(), tap))
            }
        }
    }
}

/// Does all that is asked for until the end.
fn run(mut engine: Engine, queue: &Queue, clock: &dyn Clock, mut tap: Option<Tap>) -> Engine {
    while take_turn(queue.next(|| clock.now_ns()), &mut engine, queue, clock, &mut tap) {}
    engine
}

/// Does what a turn asks for; false at the end.
fn take_turn(turn: Turn, engine: &mut Engine, queue: &Queue, clock: &dyn Clock, tap: &mut Option<Tap>) -> bool {
    match turn {
        Turn::Commands(commands) => commands.into_iter().for_each(|submission| {
            answer(engine, submission, Ok(()), clock, tap, |_, _, _| ());
        }),
        Turn::Prediction(mut submission) => {
            if let Command::Predict(query) = &mut submission.command {
                // Of one that is asked wrongly fewer samples may be within the limits: it stays whole, to be refused for what is wrong with it.
                let right = query.samples_min == 0 || query.check(engine.limits(), engine.vehicle()).is_ok();
                let fits = if right { queue.fit(query, submission.deadline_ns, clock.now_ns()) } else { Ok(()) };
                let before = engine.encoded_nodes(&query.session);
                answer(engine, *submission, fits, clock, tap, |engine, command, took| {
                    let Command::Predict(query) = command else { return };
                    let encoded = engine.encoded_nodes(&query.session).saturating_sub(before);
                    queue.done(work(query, query.samples) + encoding_work(encoded), took, clock.now_ns());
                });
            }
        }
        Turn::End => return false,
    }
    true
}

/// Executes a command. A panic inside is a bug of ours; it costs that command, not the service.
///
/// # Errors
/// Any [`EngineError`]; `Internal` after a panic.
pub fn execute_guarded(engine: &mut Engine, now_ns: u64, command: &Command) -> Result<Reply, EngineError> {
    guarded(engine, now_ns, command, Until::default())
}

fn guarded(engine: &mut Engine, now_ns: u64, command: &Command, until: Until<'_>) -> Result<Reply, EngineError> {
    catch_unwind(AssertUnwindSafe(|| engine.execute_until(now_ns, command, until)))
        .unwrap_or_else(|_| Err(EngineError::Internal { reason: format!("command `{}` panicked", command.label()) }))
}

/// Executes one submission and answers it, or refuses it where it does not fit; a recording hears of it last. `done` is told what of it was
/// answered and the time that it took, if it was not refused, before the answer leaves.
fn answer(
    engine: &mut Engine,
    submission: Submission,
    fits: Result<(), EngineError>,
    clock: &dyn Clock,
    tap: &mut Option<Tap>,
    done: impl FnOnce(&Engine, &Command, Option<Took>),
) {
    let Submission { command, deadline_ns, abandoned, due, reply, submitted_ns, share: _ } = submission;
    let now_ns = clock.now_ns();
    let is_prediction = matches!(command, Command::Predict(_));
    let abandoned = abandoned.as_deref().filter(|_| is_prediction);
    let is_past = |now_ns: u64| is_prediction && deadline_ns.is_some_and(|deadline_ns| now_ns > deadline_ns);
    let begun = if is_raised(abandoned) {
        Err(EngineError::Abandoned)
    } else if is_past(now_ns) {
        Err(EngineError::Expired)
    } else {
        fits
    };
    let is_begun = begun.is_ok();
    let result = begun.and_then(|()| match guarded(engine, now_ns, &command, Until { abandoned, due: due.as_deref() }) {
        // Nobody waits any more since it is too late.
        Err(EngineError::Abandoned) if is_past(clock.now_ns()) => Err(EngineError::Expired),
        result => result,
    });
    let (queued_ns, busy_ns) = (now_ns.saturating_sub(submitted_ns), clock.now_ns().saturating_sub(now_ns));
    let took = match &result {
        Ok(_) => Some(Took::All(busy_ns)),
        Err(EngineError::Abandoned | EngineError::Expired) if is_begun => Some(Took::AtLeast(busy_ns)),
        Err(_) => None,
    };
    let heard = tap.as_ref().filter(|_| !matches!(command, Command::Snapshot { .. } | Command::TellFleetSoil)).map(|_| result.clone());
    let command = command.answered(&result);
    done(engine, &command, took);
    reply(Answer { result, queued_ns, busy_ns });
    if let (Some(tap), Some(result)) = (tap, heard) {
        tap(Executed { now_ns, command, result, queued_ns, busy_ns });
    }
}
