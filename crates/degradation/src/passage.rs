//! One drive through the real engine, message by message.

use std::collections::BTreeMap;
use std::sync::Arc;

use nesam_engine::{Candidates, Command, Engine, EngineError, Limits, OpenSession, PredictExtras, PredictQuery, Prediction, Reply};
use nesam_evaluation::{POSE_DIM, Pose, PosePath, Truth, pose_of};
use nesam_model::Predictor;
use nesam_terrain::WorldMap;
use nesam_trajectories::Trajectory;

use crate::DegradationError;
use crate::link::{Arrival, Link, blend, place};

/// Name of the session and of its vehicle.
const VEHICLE: &str = "vehicle";
/// When the planner asks after the instant of a window, as a share of the step: it is not in step with the vehicle.
const ASKED_AFTER: f64 = 0.5;

/// What the engine is given.
#[derive(Clone, Debug)]
pub struct Setup {
    /// Loaded bundle.
    pub predictor: Arc<Predictor>,
    /// Steps K.
    pub horizon: usize,
    /// Channels that errors are measured against.
    pub truth: Truth,
}

/// A prediction that was asked for at the instant of a window, and the truth that belongs to it.
#[derive(Clone, Debug)]
pub struct Asked {
    /// Sample of the window.
    pub sample: usize,
    /// True pose at the start of the prediction.
    pub start: Pose,
    /// Predicted poses after steps 1…K.
    pub path: PosePath,
    /// True poses at the same times.
    pub truth: Vec<Pose>,
    /// How long before the question the state that the prediction starts from was true, s.
    pub age_s: f64,
    /// Measured steps before it.
    pub history_steps: usize,
    /// Whether the drive had told something of the soil.
    pub soil_learned: bool,
}

/// A full buffer of the soil filter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SoilBuffer {
    /// Normalised innovation squared.
    pub nis: f64,
    /// Its degrees of freedom.
    pub dof: usize,
    /// Whether the gate refused it.
    pub rejected: bool,
}

/// What became of a drive.
#[derive(Clone, Debug, Default)]
pub struct Passage {
    /// Messages sent.
    pub sent: usize,
    /// Answers to the messages that arrived, by kind; `rejected` for those that were refused as invalid.
    pub answers: BTreeMap<&'static str, usize>,
    /// Predictions, in the order of the windows.
    pub asked: Vec<Asked>,
    /// Windows for which the engine had no answer.
    pub unanswered: usize,
    /// Buffers of the soil filter.
    pub buffers: Vec<SoilBuffer>,
}

/// An engine that serves one drive.
struct Ride<'a> {
    engine: Engine,
    setup: &'a Setup,
    drive: &'a Trajectory,
    /// Stamps of what arrived and when it was true, s.
    true_s: BTreeMap<i64, f64>,
    /// Buffers that the session has judged so far.
    judged: u64,
    passage: Passage,
}

/// Sends what came over the link through an engine with one session, and asks at the instants of `windows` (samples of the drive).
///
/// # Errors
/// `DegradationError::Engine` when no session can be opened.
pub fn drive_through(
    setup: &Setup,
    drive: &Trajectory,
    map: Option<&Arc<WorldMap>>,
    link: &Link,
    windows: &[usize],
) -> Result<Passage, DegradationError> {
    let failed = |reason: String| DegradationError::Engine { drive: drive.id.clone(), reason };
    let engine = Engine::new(Arc::clone(&setup.predictor), Limits::default()).map_err(|e| failed(e.to_string()))?;
    let passage = Passage { sent: link.sent, ..Passage::default() };
    let mut ride = Ride { engine, setup, drive, true_s: BTreeMap::new(), judged: 0, passage };
    if let Some(map) = map {
        ride.engine.execute(0, &Command::PutMap { map: Arc::clone(map), base: None }).map_err(|e| failed(e.to_string()))?;
    }
    let open = OpenSession { vehicle: VEHICLE.into(), map: map.map(|map| map.id().into()).unwrap_or_default(), ..OpenSession::default() };
    ride.engine.execute(0, &Command::Open(open)).map_err(|e| failed(e.to_string()))?;
    let mut arrivals = link.arrivals.iter().peekable();
    for &sample in windows {
        let asked_s = (sample as f64 + ASKED_AFTER) * drive.dt_s;
        while let Some(arrival) = arrivals.next_if(|arrival| arrival.arrival_s <= asked_s) {
            ride.measure(arrival);
        }
        match ride.ask(sample, asked_s) {
            Some(asked) => ride.passage.asked.push(asked),
            None => ride.passage.unanswered += 1,
        }
    }
    arrivals.for_each(|arrival| ride.measure(arrival));
    Ok(ride.passage)
}

fn clock_ns(time_s: f64) -> u64 {
    (time_s.max(0.0) * 1e9) as u64
}

impl Ride<'_> {
    fn measure(&mut self, arrival: &Arrival) {
        let measurement = arrival.measurement;
        let command = Command::Measure { session: VEHICLE.into(), vehicle: None, measurement };
        let label = match self.engine.execute(clock_ns(arrival.arrival_s), &command) {
            Ok(Reply::Measured(answer)) => {
                if let Some(buffer) = answer.soil.state.last_buffer.filter(|buffer| buffer.judged != self.judged) {
                    self.judged = buffer.judged;
                    self.passage.buffers.push(SoilBuffer { nis: buffer.nis, dof: buffer.dof, rejected: buffer.rejected });
                }
                if answer.outcome.accepted() {
                    self.true_s.insert(measurement.stamp_ns, arrival.true_s);
                }
                answer.outcome.label()
            }
            _ => "rejected",
        };
        *self.passage.answers.entry(label).or_default() += 1;
    }

    fn predict(&mut self, asked_s: f64, controls: Vec<f32>) -> Result<Arc<Prediction>, EngineError> {
        let query = PredictQuery {
            session: VEHICLE.into(),
            start: None,
            instant: None,
            use_history: true,
            samples: 1,
            samples_min: 0,
            horizon: controls.len() / 2,
            extras: PredictExtras::default(),
            controls: Candidates::Given(controls),
            cost: None,
        };
        match self.engine.execute(clock_ns(asked_s), &Command::Predict(query))? {
            Reply::Predicted(prediction) => Ok(prediction),
            _ => Err(EngineError::Internal { reason: "a prediction was answered with another reply".into() }),
        }
    }

    /// Asks for the recorded commands from the newest step on. That step's stamp is what the vehicle's clock said; the planner of this test knows when
    /// it was true, and sends the commands from then on.
    fn ask(&mut self, sample: usize, asked_s: f64) -> Option<Asked> {
        let (steps, dt_s) = (self.setup.horizon, self.drive.dt_s);
        let probe = self.predict(asked_s, self.commands(sample as f64 * dt_s, 1)).ok()?;
        let start_s = self.true_time(probe.start_stamp_ns?)?;
        let end_s = (self.drive.states.len() - 1) as f64 * dt_s;
        if start_s + steps as f64 * dt_s > end_s + 1e-6 {
            return None;
        }
        let prediction = self.predict(asked_s, self.commands(start_s, steps)).ok()?;
        let poses = (0..steps).map(|k| pose_of(&prediction.rollout.state_f64(0, k))).collect();
        Some(Asked {
            sample,
            start: self.true_pose(start_s),
            path: PosePath { poses, predicts: [true; POSE_DIM] },
            truth: (1..=steps).map(|k| self.true_pose(start_s + k as f64 * dt_s)).collect(),
            age_s: asked_s - start_s,
            history_steps: prediction.history_steps,
            soil_learned: prediction.soil.state.epoch > 0,
        })
    }

    /// When the state of a stamp was true: that of the message with this stamp, else as far from the nearest one as the stamps are.
    fn true_time(&self, stamp_ns: i64) -> Option<f64> {
        let before = self.true_s.range(..=stamp_ns).next_back();
        let after = self.true_s.range(stamp_ns..).next();
        let (stamp, true_s) = [before, after].into_iter().flatten().min_by_key(|(stamp, _)| stamp.abs_diff(stamp_ns))?;
        Some(true_s + (stamp_ns.saturating_sub(*stamp)) as f64 * 1e-9)
    }

    /// The recorded commands at the middles of the steps from an instant on, row-major (steps, 2).
    fn commands(&self, from_s: f64, steps: usize) -> Vec<f32> {
        let at = |k: usize| self.drive.controls[place(self.drive, from_s + (k as f64 + 0.5) * self.drive.dt_s).0];
        (0..steps).map(at).flat_map(|control| control.packed()).collect()
    }

    fn true_pose(&self, time_s: f64) -> Pose {
        let (at, share) = place(self.drive, time_s);
        let states = match (self.setup.truth, &self.drive.truth) {
            (Truth::Gt, Some(truth)) => &truth.states,
            _ => &self.drive.states,
        };
        let next = (at + 1).min(states.len() - 1);
        pose_of(&blend(&states[at], &states[next], share))
    }
}
