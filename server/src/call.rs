//! The asynchronous way into the engine.

use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};
use std::time::Duration;

use nesam_engine::{
    Answer, AppliedEffects, Command, DUE_AFTER, EngineError, EngineHandle, FleetCell, FleetShare, MeasureAnswer, OpenSession, PredictQuery,
    Prediction, Reply, SessionImage, SessionView, Submission,
};
use nesam_terrain::WorldMap;
use tokio::sync::oneshot;
use tokio::time::Sleep;

use crate::access::Directory;
use crate::telemetry::Metrics;
use crate::web::Feed;

/// Awaits the engine; one for all handlers, clones share it.
#[derive(Clone, Debug)]
pub struct EngineClient {
    handle: EngineHandle,
    metrics: Arc<Metrics>,
    directory: Directory,
    page: Option<Feed>,
}

/// How long a prediction waited and computed.
#[derive(Clone, Copy, Debug, Default)]
pub struct Timing {
    /// In the queue, s.
    pub queue_s: f64,
    /// In the engine, s.
    pub compute_s: f64,
}

/// An answer that is on its way. Awaiting it tells the engine when it is due, dropping it that nobody waits any more.
#[derive(Debug)]
pub struct Pending {
    answer: oneshot::Receiver<Answer>,
    abandoned: Arc<AtomicBool>,
    due: Option<Due>,
}

/// When an answer of fewer samples is due, and the flag that is raised then.
#[derive(Debug)]
struct Due {
    at: Pin<Box<Sleep>>,
    flag: Arc<AtomicBool>,
}

impl Future for Pending {
    type Output = Answer;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Answer> {
        if self.due.as_mut().is_some_and(|due| due.at.as_mut().poll(context).is_ready()) {
            self.due.take().into_iter().for_each(|due| due.flag.store(true, Ordering::Relaxed));
        }
        let stopped = |_| Answer::refused(EngineError::Stopped);
        Pin::new(&mut self.answer).poll(context).map(|answer| answer.unwrap_or_else(stopped))
    }
}

impl Drop for Pending {
    fn drop(&mut self) {
        self.abandoned.store(true, Ordering::Relaxed);
    }
}

impl EngineClient {
    /// A client of an engine whose sessions stand in this directory: vehicles compete, not their sessions.
    pub fn new(handle: EngineHandle, metrics: Arc<Metrics>, directory: Directory) -> Self {
        Self { handle, metrics, directory, page: None }
    }

    /// Shows what passes to the live page.
    pub(crate) fn shown_on(mut self, page: Option<Feed>) -> Self {
        self.page = page;
        self
    }

    /// The engine's handle.
    pub fn handle(&self) -> &EngineHandle {
        &self.handle
    }

    /// Counters of the server.
    pub fn metrics(&self) -> &Arc<Metrics> {
        &self.metrics
    }

    /// A command whose answer is counted and shown on the live page before `reply` gets it, on the engine's thread or on the submitter's.
    pub(crate) fn submission(&self, command: Command, reply: impl FnOnce(Answer) + Send + 'static) -> Submission {
        let (label, metrics) = (command.label(), self.metrics.clone());
        let passing = self.page.as_ref().and_then(|page| page.look(&command));
        Submission::new(command, move |answer: Answer| {
            metrics.engine_answer(label, &answer);
            if let Some(passing) = passing {
                passing.answered(&answer);
            }
            reply(answer);
        })
    }

    /// Whether what nobody counts may wait too: the look at the session of a measurement that never reaches the engine. Where as much waits as one vehicle may
    /// have there the answer goes without: what is sent wrongly must not take the place of what is not.
    pub(crate) fn has_room(&self) -> bool {
        self.handle.waiting().0 < self.handle.limits().waiting_measurements_per_vehicle_max
    }

    /// Puts a command in the queue now; commands submitted by one task are executed in that order.
    pub fn submit(&self, command: Command, budget: Duration) -> Pending {
        let (sender, answer) = oneshot::channel();
        let abandoned = Arc::new(AtomicBool::new(false));
        let mut submission = self.submission(command, move |answer| {
            let _ = sender.send(answer);
        });
        submission.abandoned = Some(abandoned.clone());
        submission.share = match &submission.command {
            Command::Predict(query) => self.directory.vehicle(&query.session),
            Command::Measure { session, .. } => self.directory.vehicle(session),
            _ => None,
        };
        let due = matches!(&submission.command, Command::Predict(query) if query.samples_min > 0).then(|| {
            let flag = Arc::new(AtomicBool::new(false));
            submission.due = Some(flag.clone());
            Due { at: Box::pin(tokio::time::sleep(budget.mul_f64(DUE_AFTER))), flag }
        });
        submission.deadline_ns = Some(self.handle.now_ns().saturating_add(u64::try_from(budget.as_nanos()).unwrap_or(u64::MAX)));
        self.handle.submit(submission);
        Pending { answer, abandoned, due }
    }

    /// Submits and awaits, at most as long as `budget`.
    async fn call(&self, command: Command, budget: Duration) -> Result<(Reply, Timing), EngineError> {
        let answer = tokio::time::timeout(budget, self.submit(command, budget)).await.map_err(|_| EngineError::Expired)?;
        let timing = Timing { queue_s: answer.queued_ns as f64 * 1e-9, compute_s: answer.busy_ns as f64 * 1e-9 };
        answer.result.map(|reply| (reply, timing))
    }

    /// Opens a session.
    ///
    /// # Errors
    /// Any `EngineError`, as all functions below.
    pub async fn open(&self, open: OpenSession, budget: Duration) -> Result<SessionView, EngineError> {
        match self.call(Command::Open(open), budget).await?.0 {
            Reply::Session(view) => Ok(*view),
            _ => Err(mismatch("open")),
        }
    }

    /// Reads a session.
    pub async fn get(&self, session: &str, budget: Duration) -> Result<SessionView, EngineError> {
        match self.call(Command::Get { session: session.into() }, budget).await?.0 {
            Reply::Session(view) => Ok(*view),
            _ => Err(mismatch("get")),
        }
    }

    /// Lists the sessions.
    pub async fn list(&self, budget: Duration) -> Result<Vec<SessionView>, EngineError> {
        match self.call(Command::List, budget).await?.0 {
            Reply::Sessions(views) => Ok(views),
            _ => Err(mismatch("list")),
        }
    }

    /// Copies a session.
    pub async fn fork(&self, session: &str, copy: &str, budget: Duration) -> Result<SessionView, EngineError> {
        match self.call(Command::Fork { session: session.into(), copy: copy.into() }, budget).await?.0 {
            Reply::Session(view) => Ok(*view),
            _ => Err(mismatch("fork")),
        }
    }

    /// Reads the soil map of the fleet: edge of a cell in m, and the cells.
    pub async fn fleet_soil(&self, map: &str, budget: Duration) -> Result<(f64, Vec<FleetCell>), EngineError> {
        match self.call(Command::FleetSoil { map: map.into() }, budget).await?.0 {
            Reply::FleetSoil(cell_m, cells) => Ok((cell_m, cells)),
            _ => Err(mismatch("fleet_soil")),
        }
    }

    /// What was brought to the soil map of the fleet here and elsewhere: edge of a cell in m, and the shares of the servers.
    pub async fn fleet_shares(&self, budget: Duration) -> Result<(f64, Vec<FleetShare>), EngineError> {
        match self.call(Command::TellFleetSoil, budget).await?.0 {
            Reply::FleetShares(cell_m, shares) => Ok((cell_m, shares)),
            _ => Err(mismatch("tell_fleet_soil")),
        }
    }

    /// Copies everything that a session remembers.
    pub async fn export(&self, session: &str, budget: Duration) -> Result<SessionImage, EngineError> {
        match self.call(Command::Export { session: session.into() }, budget).await?.0 {
            Reply::Image(image) => Ok(*image),
            _ => Err(mismatch("export")),
        }
    }

    /// Opens a session from such a copy.
    pub async fn import(&self, image: SessionImage, session: &str, budget: Duration) -> Result<SessionView, EngineError> {
        match self.call(Command::Import { image: Box::new(image), session: session.into() }, budget).await?.0 {
            Reply::Session(view) => Ok(*view),
            _ => Err(mismatch("import")),
        }
    }

    /// Puts effects on a session, in place of those that were applied before.
    pub async fn set_effects(&self, session: &str, effects: AppliedEffects, budget: Duration) -> Result<SessionView, EngineError> {
        match self.call(Command::SetEffects { session: session.into(), effects }, budget).await?.0 {
            Reply::Session(view) => Ok(*view),
            _ => Err(mismatch("set_effects")),
        }
    }

    /// Closes the idle sessions and gives their names.
    pub async fn expire(&self, budget: Duration) -> Result<Vec<String>, EngineError> {
        match self.call(Command::Expire, budget).await?.0 {
            Reply::Expired(sessions) => Ok(sessions),
            _ => Err(mismatch("expire")),
        }
    }

    /// Closes a session.
    pub async fn close(&self, session: &str, budget: Duration) -> Result<(), EngineError> {
        self.call(Command::Close { session: session.into() }, budget).await.map(|_| ())
    }

    /// Predicts.
    pub async fn predict(&self, query: PredictQuery, budget: Duration) -> Result<(Arc<Prediction>, Timing), EngineError> {
        match self.call(Command::Predict(query), budget).await? {
            (Reply::Predicted(prediction), timing) => Ok((prediction, timing)),
            _ => Err(mismatch("predict")),
        }
    }

    /// Takes a map, once it is ready.
    pub async fn put_map(&self, map: Arc<WorldMap>, base: Option<u64>, budget: Duration) -> Result<Arc<WorldMap>, EngineError> {
        let (handle, unready) = (self.handle.clone(), map.clone());
        // A map that could not be made ready is made so by the engine, which answers for it.
        let _ = tokio::task::spawn_blocking(move || handle.make_ready(&unready)).await;
        match self.call(Command::PutMap { map, base }, budget).await?.0 {
            Reply::Map(map) => Ok(map),
            _ => Err(mismatch("put_map")),
        }
    }

    /// Reads a map.
    pub async fn get_map(&self, map: &str, budget: Duration) -> Result<Arc<WorldMap>, EngineError> {
        match self.call(Command::GetMap { map: map.into() }, budget).await?.0 {
            Reply::Map(map) => Ok(map),
            _ => Err(mismatch("get_map")),
        }
    }

    /// Lists the maps.
    pub async fn list_maps(&self, budget: Duration) -> Result<Vec<Arc<WorldMap>>, EngineError> {
        match self.call(Command::ListMaps, budget).await?.0 {
            Reply::Maps(maps) => Ok(maps),
            _ => Err(mismatch("list_maps")),
        }
    }

    /// Forgets a map.
    pub async fn delete_map(&self, map: &str, budget: Duration) -> Result<(), EngineError> {
        self.call(Command::DeleteMap { map: map.into() }, budget).await.map(|_| ())
    }
}

/// The outcome of a measurement in an engine answer.
pub fn measured(answer: Answer) -> Result<MeasureAnswer, EngineError> {
    match answer.result? {
        Reply::Measured(answer) => Ok(*answer),
        _ => Err(mismatch("measure")),
    }
}

/// Why a measurement never reached the engine, with where its session stands if the answer to `Command::Get` tells of a session of its vehicle (`None` = of any).
pub fn unmeasured(cause: EngineError, vehicle: Option<&str>, session: Answer) -> EngineError {
    match session.result {
        Ok(Reply::Session(view)) if vehicle.is_none_or(|vehicle| vehicle == view.vehicle) => {
            EngineError::RefusedMeasurement { cause: Box::new(cause), standing: Box::new(view.provenance) }
        }
        _ => cause,
    }
}

fn mismatch(command: &str) -> EngineError {
    EngineError::Internal { reason: format!("command `{command}` was answered with another reply") }
}
