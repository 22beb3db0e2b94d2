//! One machine: what it was told last, and what became of what it measured.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use nesam_engine::{Command, EngineError, MeasureAnswer, Measurement, OpenSession, Outcome, WheelMeasurement};
use nesam_physics::{Control, VehicleState};
use nesam_ros2::messages::{CommandType, Level, Odometry};

use super::reading;
use crate::config::{Ros2Config, Ros2Vehicle};
use crate::convert::unsigned_zero;
use crate::grpc::Edge;
use crate::telemetry::Transport;
use crate::zenoh::arrival::Arrival;

/// A machine is silent when nothing was measured for this long (chosen: ten steps of the model).
const SILENT_AFTER: Duration = Duration::from_secs(1);

/// A machine of ROS 2.
pub struct Machine {
    /// What the configuration says of it.
    pub config: Ros2Vehicle,
    /// Type of its commands.
    pub kind: CommandType,
    hold: Duration,
    edge: Edge,
    heard: Mutex<Heard>,
}

/// What was heard of a machine since the server joined the network.
#[derive(Clone, Debug, Default)]
pub struct Heard {
    /// The command that holds, and since when.
    command: Option<(nesam_ros2::messages::Command, Instant)>,
    moved: Option<Instant>,
    /// Whether the last measurement came with a command that held.
    commanded: bool,
    /// Why the session cannot be opened; `None` where it is open, or nobody has tried.
    unopened: Option<String>,
    /// Why the last measurement was refused; `None` where it was not.
    refused: Option<String>,
    /// Why the last command was refused; `None` where it was not.
    command_refused: Option<String>,
    /// Time that was missing before the last measurement, s; `None` where it continued the history.
    gap_s: Option<f64>,
    /// Messages by what became of them.
    counts: BTreeMap<&'static str, u64>,
}

impl Heard {
    fn count(&mut self, what: &'static str) {
        *self.counts.entry(what).or_default() += 1;
    }

    /// How well the machine is heard, in one sentence.
    pub fn level(&self) -> (Level, String) {
        let refused = self.unopened.as_ref().or(self.refused.as_ref()).or(self.command_refused.as_ref());
        let Some(moved) = self.moved else {
            return refused.map_or((Level::Stale, "no odometry yet".into()), |reason| (Level::Error, format!("refused: {reason}")));
        };
        if moved.elapsed() > SILENT_AFTER {
            let before = refused.map_or(String::new(), |reason| format!("; before that refused: {reason}"));
            return (Level::Stale, format!("no odometry for {:.1} s{before}", moved.elapsed().as_secs_f64()));
        }
        match (refused, self.gap_s) {
            (Some(reason), _) => (Level::Error, format!("refused: {reason}")),
            (None, Some(gap_s)) => {
                let reason = "the history begins anew after each pause, and predictions and soil with it";
                (Level::Warn, format!("odometry comes too seldom: {gap_s:.2} s passed before the last one; {reason}"))
            }
            _ if !self.commanded => (Level::Warn, "no command holds: taken as told to stand".into()),
            _ => (Level::Ok, "measurements are taken".into()),
        }
    }

    /// Messages by what became of them.
    pub fn counts(&self) -> impl Iterator<Item = (&'static str, u64)> {
        self.counts.iter().map(|(what, count)| (*what, *count))
    }
}

impl Machine {
    /// A machine of which nothing was heard yet. Its type of commands has been checked with the configuration.
    pub fn new(vehicle: Ros2Vehicle, config: &Ros2Config, edge: &Edge) -> Self {
        Self {
            kind: vehicle.kind().expect("the configuration was checked; this is a bug"),
            config: vehicle,
            hold: Duration::from_secs_f64(config.command_hold_s),
            edge: edge.clone(),
            heard: Mutex::default(),
        }
    }

    /// What was heard of it so far.
    pub fn heard(&self) -> Heard {
        self.state().clone()
    }

    fn state(&self) -> MutexGuard<'_, Heard> {
        self.heard.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    /// Hears a command.
    pub fn told(self: &Arc<Self>, message: Result<&[u8], EngineError>) {
        let read = message.and_then(|bytes| self.kind.read(bytes).ok_or_else(|| unreadable(self.kind.message().name)));
        let finite = read.and_then(|command| {
            let finite = command.speed_m_s.is_finite() && command.turn.is_finite();
            finite.then_some(command).ok_or_else(|| EngineError::invalid("command", "is NaN or infinite"))
        });
        let mut heard = self.state();
        match finite {
            Ok(command) => {
                heard.command = Some((command, Instant::now()));
                heard.command_refused = None;
                heard.count("command");
            }
            Err(error) => {
                heard.count("command_refused");
                heard.command_refused = Some(error.to_string());
            }
        }
    }

    /// Hears how it moves: a measurement.
    pub fn moved(self: &Arc<Self>, message: Result<&[u8], EngineError>) {
        self.edge.engine.metrics().request(Transport::Zenoh, "measurement");
        let read = message.and_then(|bytes| Odometry::read(bytes).ok_or_else(|| unreadable("nav_msgs/msg/Odometry")));
        let measurement = read.and_then(|odometry| {
            let state = reading::state(&odometry, self.config.reference_m)?;
            Ok(Measurement {
                // Numbers of rmw_zenoh count what was sent; stamps tell what is new as well, and go on where a publisher begins anew.
                sequence: None,
                boot: None,
                stamp_ns: odometry.stamp_ns,
                // As messages of ours give them.
                state: VehicleState::from_array(state.to_array().map(unsigned_zero)),
                command: self.control(),
                wheels: WheelMeasurement::default(),
            })
        });
        if measurement.is_ok() {
            self.open();
        }
        let machine = self.clone();
        let vehicle = self.config.vehicle.clone();
        let answer = Box::new(move |result| machine.answered(&result));
        Arrival { edge: self.edge.clone(), session: vehicle.clone(), vehicle, run: 0, answer }.take(measurement);
    }

    /// The command that the vehicle follows now.
    fn control(&self) -> Control<f64> {
        let card = &self.edge.predictor.bundle().vehicle;
        let mut heard = self.state();
        let holding = heard.command.filter(|(_, since)| since.elapsed() <= self.hold).map(|(command, _)| command);
        heard.commanded = holding.is_some();
        let (control, limited) =
            holding.map_or_else(|| (Control { speed_m_s: 0.0, second: 0.0 }, false), |command| reading::control(self.kind, card, &command));
        if limited {
            heard.count("command_beyond_card");
        }
        Control { speed_m_s: unsigned_zero(control.speed_m_s), second: unsigned_zero(control.second) }
    }

    fn answered(&self, result: &Result<MeasureAnswer, EngineError>) {
        let label = result.as_ref().map_or("rejected", |measured| measured.outcome.label());
        self.edge.engine.metrics().measurement(Transport::Zenoh, label);
        let mut heard = self.state();
        heard.moved = Some(Instant::now());
        heard.count(label);
        match result {
            // It was taken before; nothing is amiss.
            Ok(MeasureAnswer { outcome: Outcome::Duplicate, .. }) => {}
            Ok(measured) => {
                heard.unopened = None;
                heard.refused = why_refused(&measured.outcome).map(|why| format!("{why}; {} were taken", measured.accepted));
                heard.gap_s = if let Outcome::Gap { gap_s } = measured.outcome { Some(gap_s) } else { None };
            }
            Err(error) => heard.refused = Some(error.to_string()),
        }
    }

    /// Opens the session where none is open. What follows waits behind it.
    fn open(self: &Arc<Self>) {
        let Ros2Vehicle { vehicle, map, open, .. } = &self.config;
        if !open || self.edge.access.directory.vehicle(vehicle).is_some() {
            return;
        }
        let wish = OpenSession {
            session: vehicle.clone(),
            vehicle: vehicle.clone(),
            vehicle_card: String::new(),
            map: map.clone(),
            initial: None,
        };
        if self.edge.cluster.is_none() {
            let machine = self.clone();
            let submission = self.edge.engine.submission(Command::Open(wish), move |answer| {
                machine.opened(answer.result.err().map(|error| error.to_string()));
            });
            return self.edge.engine.handle().submit(submission);
        }
        // Only the server that gets the name may open it; the others hear that it exists.
        let machine = self.clone();
        self.edge.runtime.spawn(async move {
            let budget = machine.edge.stream_budget();
            let name = machine.config.vehicle.clone();
            let refused = match machine.edge.bring_map(&machine.config.map, budget).await {
                Ok(()) => machine.edge.begin("session_id", &name, budget, machine.edge.engine.open(wish, budget)).await.err(),
                Err(status) => Some(status),
            };
            machine.opened(refused.filter(|status| status.code() != tonic::Code::AlreadyExists).map(|status| status.message().into()));
        });
    }

    fn opened(&self, refused: Option<String>) {
        let session = &self.config.vehicle;
        let unopened = refused.map(|reason| format!("the session cannot be opened: {reason}"));
        let before = core::mem::replace(&mut self.state().unopened, unopened.clone());
        match unopened {
            None => tracing::info!(session, "session opened for a machine of ROS 2"),
            // Each odometry tries again.
            Some(reason) if before.as_ref() != Some(&reason) => tracing::warn!(session, reason, "a machine of ROS 2 is not heard"),
            Some(_) => {}
        }
    }
}

/// Why a measurement was refused; `None` where it was taken.
fn why_refused(outcome: &Outcome) -> Option<String> {
    match outcome {
        Outcome::TooOld { behind_s } => Some(format!("the odometry is {behind_s:.3} s too old")),
        Outcome::NotFinite { field } => Some(format!("`{field}` of the odometry is NaN or infinite")),
        Outcome::Future { ahead_s } => Some(format!("the stamp of the odometry lies {ahead_s:.3} s ahead of where time can be")),
        _ => None,
    }
}

fn unreadable(kind: &str) -> EngineError {
    EngineError::invalid("", format!("the message is no {kind} in little-endian CDR"))
}
