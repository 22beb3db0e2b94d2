//! The engine behind a thread.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use nesam_model::{Interruption, is_raised};
use nesam_physics::Vehicle;
use nesam_terrain::{PatchScale, WorldMap};

use crate::clock::Clock;
use crate::command::{Command, Reply, Until};
use crate::engine::{Engine, Prepared};
use crate::error::EngineError;
use crate::heard::{Heard, HeardPlace};
use crate::limits::Limits;
use crate::query::PredictQuery;
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
    /// Called once with the answer, on one of the engine's threads or on the submitter's; it must not wait.
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
        (self.reply)(Answer::refused(error));
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
    /// Whether a longer prediction paused for this one.
    pub is_urgent: bool,
    /// Time of `busy_ns` in which this prediction paused for others, ns.
    pub paused_ns: u64,
}

impl Answer {
    /// To what never had its turn.
    pub fn refused(error: EngineError) -> Self {
        Self { result: Err(error), queued_ns: 0, busy_ns: 0, is_urgent: false, paused_ns: 0 }
    }
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

/// Hears of every command but snapshots after its answer was sent, in the order of execution: what was executed while a prediction was computed comes after that
/// prediction. Called on the engine's threads, so it must not wait.
pub type Tap = Box<dyn FnMut(Executed) + Send>;

/// The way to an engine. Clones share the engine.
#[derive(Clone)]
pub struct EngineHandle {
    queue: Arc<Queue>,
    clock: Arc<dyn Clock>,
    limits: Arc<Limits>,
    vehicle: Arc<Vehicle>,
    /// How predictions see a map.
    patches: PatchScale,
    worker: Arc<Worker>,
}

/// Who executes. `None` once the engine was given back.
enum Worker {
    /// A thread of its own.
    Thread(Mutex<Option<JoinHandle<Engine>>>),
    /// Whoever submits.
    Submitter(Box<Mutex<Option<(Engine, Heard)>>>),
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
        let (limits, vehicle, patches) = (Arc::new(engine.limits().clone()), Arc::new(engine.vehicle().clone()), engine.patch_scale());
        let heard = Arc::new(Heard::new(tap));
        let computing = Computing::start(&queue, &clock, &heard);
        let thread = thread::Builder::new()
            .name("nesam-engine".into())
            .spawn({
                let (queue, clock) = (queue.clone(), clock.clone());
                move || run(engine, &queue, clock.as_ref(), computing, &heard)
            })
            .expect("the system starts a thread");
        Self { queue, clock, limits, vehicle, patches, worker: Arc::new(Worker::Thread(Mutex::new(Some(thread)))) }
    }

    /// An engine without a thread: whoever submits executes all that waits before it goes on, unless somebody else is at it. So a simulation runs on one
    /// thread.
    pub fn unthreaded(engine: Engine, clock: Arc<dyn Clock>, tap: Option<Tap>) -> Self {
        let (limits, vehicle, patches) = (Arc::new(engine.limits().clone()), Arc::new(engine.vehicle().clone()), engine.patch_scale());
        Self {
            queue: Arc::default(),
            clock,
            limits,
            vehicle,
            patches,
            worker: Arc::new(Worker::Submitter(Box::new(Mutex::new(Some((engine, Heard::new(tap))))))),
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
            let Some((engine, heard)) = held.as_mut() else { return };
            while self.queue.has_turn() {
                take_turn(self.queue.next(|| self.clock.now_ns()), engine, &self.queue, self.clock.as_ref(), heard);
            }
        }
    }

    /// Makes a map ready to be put, which takes up to a second for a large one. Of one that is not, all sessions wait for that at the first pose on it.
    pub fn make_ready(&self, map: &WorldMap) {
        map.make_ready(&self.patches);
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
                let (mut engine, heard) = held.lock().ok()?.take()?;
                while take_turn(self.queue.next(|| self.clock.now_ns()), &mut engine, &self.queue, self.clock.as_ref(), &heard) {}
                Some(engine)
            }
        }
    }
}

/// The threads that compute predictions, those that run and urgent ones, each in the order in which they were begun.
struct Computing {
    running: Computer,
    urgent: Computer,
}

impl Computing {
    /// # Panics
    /// When the system refuses to start a thread.
    fn start(queue: &Arc<Queue>, clock: &Arc<dyn Clock>, heard: &Arc<Heard>) -> Self {
        let start = |name: &str, within: Workers| {
            let (queue, clock, heard) = (queue.clone(), clock.clone(), heard.clone());
            Computer::start(name, move |prediction| within.run(|| prediction.finish(&queue, clock.as_ref(), &heard)))
        };
        Self { running: start("nesam-predict", Workers::shared()), urgent: start("nesam-urgent", Workers::own("nesam-urgent")) }
    }

    fn compute(&self, prediction: Begun) {
        let computer = if prediction.is_urgent { &self.urgent } else { &self.running };
        computer.begun.send(prediction).expect("the thread ends after this; this is a bug");
    }

    /// Ends the threads after all that was begun.
    fn end(self) {
        for Computer { begun, thread } in [self.urgent, self.running] {
            drop(begun);
            thread.join().expect("panics of a prediction are caught; this is a bug");
        }
    }
}

/// A thread that does something with each prediction.
struct Computer {
    begun: mpsc::Sender<Begun>,
    thread: JoinHandle<()>,
}

impl Computer {
    fn start(name: &str, compute: impl Fn(Begun) + Send + 'static) -> Self {
        let (begun, waiting) = mpsc::channel::<Begun>();
        let each = move || {
            while let Ok(prediction) = waiting.recv() {
                compute(prediction);
            }
        };
        let thread = thread::Builder::new().name(name.into()).spawn(each).expect("the system starts a thread");
        Self { begun, thread }
    }
}

/// Does all that is asked for until the end. Predictions are computed beside the engine, one at a time, so that measurements do not wait for them.
fn run(mut engine: Engine, queue: &Queue, clock: &dyn Clock, computing: Computing, heard: &Heard) -> Engine {
    // Shared out among the threads of predictions, the work of a measurement would wait for theirs.
    let _alone = Workers::alone();
    loop {
        match queue.next(|| clock.now_ns()) {
            Turn::Commands(commands) => answer_all(&mut engine, commands, clock, heard),
            Turn::Prediction { submission, is_urgent } => {
                computing.compute(Begun::new(&mut engine, *submission, is_urgent, queue, clock, heard));
            }
            Turn::End => break,
        }
    }
    computing.end();
    engine
}

/// Whether schedules of threads are tried: these share one thread of the system, which must not wait.
const SCHEDULED: bool = cfg!(feature = "shuttle");

/// Who does the parallel work of a thread.
struct Workers(Option<rayon::ThreadPool>);

impl Workers {
    /// Those of the process.
    fn shared() -> Self {
        Self(None)
    }

    /// As many as the process has, which are there when those wait.
    ///
    /// # Panics
    /// When the system refuses to start a thread.
    fn own(name: &'static str) -> Self {
        if SCHEDULED {
            return Self(None);
        }
        let threads = rayon::ThreadPoolBuilder::new().num_threads(rayon::current_num_threads());
        let pool = threads.thread_name(move |number| format!("{name}-{number}")).build().expect("the system starts threads");
        Self(Some(pool))
    }

    /// The current thread alone, for as long as what is given lives; where it is one of others already these.
    fn alone() -> Self {
        if SCHEDULED {
            return Self(None);
        }
        Self(rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build().ok())
    }

    fn run(&self, work: impl FnOnce() + Send) {
        match &self.0 {
            Some(pool) => pool.install(work),
            None => work(),
        }
    }
}

/// Does what a turn asks for, on this thread; false at the end.
fn take_turn(turn: Turn, engine: &mut Engine, queue: &Queue, clock: &dyn Clock, heard: &Heard) -> bool {
    match turn {
        Turn::Commands(commands) => answer_all(engine, commands, clock, heard),
        Turn::Prediction { submission, is_urgent } => {
            Begun::new(engine, *submission, is_urgent, queue, clock, heard).finish(queue, clock, heard)
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
    guarded(command.label(), || engine.execute(now_ns, command))
}

fn guarded<T>(label: &str, work: impl FnOnce() -> Result<T, EngineError>) -> Result<T, EngineError> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|_| Err(EngineError::Internal { reason: format!("command `{label}` panicked") }))
}

/// Executes commands other than predictions, answers them, and lets a recording hear of them.
fn answer_all(engine: &mut Engine, commands: impl IntoIterator<Item = Submission>, clock: &dyn Clock, heard: &Heard) {
    for Submission { command, reply, submitted_ns, .. } in commands {
        let place = heard.reserve();
        let now_ns = clock.now_ns();
        let result = execute_guarded(engine, now_ns, &command);
        let (queued_ns, busy_ns) = (now_ns.saturating_sub(submitted_ns), clock.now_ns().saturating_sub(now_ns));
        let is_told = heard.listens() && !matches!(command, Command::Snapshot { .. } | Command::TellFleetSoil);
        let executed = is_told.then(|| Executed { now_ns, command, result: result.clone(), queued_ns, busy_ns });
        reply(Answer { result, queued_ns, busy_ns, is_urgent: false, paused_ns: 0 });
        heard.tell(place, executed);
    }
}

/// A prediction whose turn it was: all that it is computed from was read.
struct Begun {
    query: PredictQuery,
    prepared: Result<Prepared, EngineError>,
    deadline_ns: Option<u64>,
    abandoned: Option<Arc<AtomicBool>>,
    due: Option<Arc<AtomicBool>>,
    reply: Box<dyn FnOnce(Answer) + Send>,
    now_ns: u64,
    queued_ns: u64,
    is_urgent: bool,
    place: HeardPlace,
}

impl Begun {
    /// Begins a prediction, unless nobody waits for it any more, it is too late, or it does not fit.
    fn new(engine: &mut Engine, submission: Submission, is_urgent: bool, queue: &Queue, clock: &dyn Clock, heard: &Heard) -> Self {
        let Submission { command, deadline_ns, abandoned, due, reply, submitted_ns, share: _ } = submission;
        let Command::Predict(mut query) = command else { unreachable!("the lane of predictions holds nothing else; this is a bug") };
        // Of one that is asked wrongly fewer samples may be within the limits: it stays whole, to be refused for what is wrong with it.
        let right = query.samples_min == 0 || query.check(engine.limits(), engine.vehicle()).is_ok();
        let fits = if right { queue.fit(&mut query, is_urgent, deadline_ns, clock.now_ns()) } else { Ok(()) };
        let place = heard.reserve();
        let now_ns = clock.now_ns();
        let begun = if is_raised(abandoned.as_deref()) {
            Err(EngineError::Abandoned)
        } else if deadline_ns.is_some_and(|deadline_ns| now_ns > deadline_ns) {
            Err(EngineError::Expired)
        } else {
            fits
        };
        engine.touch(now_ns, Some(&query.session));
        let prepared = begun.and_then(|()| guarded("predict", || engine.prepare(now_ns, &query)));
        let queued_ns = now_ns.saturating_sub(submitted_ns);
        Self { query, prepared, deadline_ns, abandoned, due, reply, now_ns, queued_ns, is_urgent, place }
    }

    /// Computes and answers it. The queue is told what of it was answered and how long that took, if it was begun, before the answer leaves.
    fn finish(self, queue: &Queue, clock: &dyn Clock, heard: &Heard) {
        let Self { mut query, prepared, deadline_ns, abandoned, due, reply, now_ns, queued_ns, is_urgent, place } = self;
        let is_begun = prepared.is_ok();
        let gate = Some(queue.gate()).filter(|_| !is_urgent && !SCHEDULED);
        let until = Until { interruption: Interruption { abandoned: abandoned.as_deref(), gate }, due: due.as_deref() };
        let (result, encoded) = match prepared {
            Err(error) => (Err(error), 0),
            Ok(prepared) => {
                let before = prepared.encoded_nodes();
                let result = guarded("predict", || prepared.compute(&query, until));
                (result, prepared.encoded_nodes().saturating_sub(before))
            }
        };
        let result = match result {
            // Nobody waits any more since it is too late.
            Err(EngineError::Abandoned) if deadline_ns.is_some_and(|deadline_ns| clock.now_ns() > deadline_ns) => Err(EngineError::Expired),
            result => result.map(|prediction| Reply::Predicted(Arc::new(prediction))),
        };
        let busy_ns = clock.now_ns().saturating_sub(now_ns);
        let took = match &result {
            Ok(_) => Some(Took::All(busy_ns)),
            Err(EngineError::Abandoned | EngineError::Expired) if is_begun => Some(Took::AtLeast(busy_ns)),
            Err(_) => None,
        };
        query.keep_answered(&result);
        let paused_ns = queue.done(work(&query, query.samples) + encoding_work(encoded), is_urgent, took, clock.now_ns());
        let told = heard.listens().then(|| result.clone());
        reply(Answer { result, queued_ns, busy_ns, is_urgent, paused_ns });
        heard.tell(place, told.map(|result| Executed { now_ns, command: Command::Predict(query), result, queued_ns, busy_ns }));
    }
}
