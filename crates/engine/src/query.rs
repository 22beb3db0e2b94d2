//! Predictions: what is asked and what is answered.

use nesam_model::Rollout;
use nesam_physics::{Control, SOIL_DIM, Vehicle, VehicleState};

use crate::candidates::Candidates;
use crate::command::Reply;
use crate::error::EngineError;
use crate::extras::{ExtraOutputs, PredictExtras};
use crate::forward::StartInstant;
use crate::limits::{Limits, outside_card};
use crate::ranking::{PathCost, Ranking};
use crate::session::SoilEstimate;

/// Bit of `Rollout::flags` that the engine adds to those of the model: the drive has told nothing of the soil yet, the prior alone speaks.
pub const SOIL_NOT_LEARNED: u32 = 128;

/// The same: an alarm of the session is active, its measurements disagree with its predictions.
pub const ALARM_ACTIVE: u32 = 256;

/// A batch of candidate command sequences from one session.
#[derive(Clone, Debug, PartialEq)]
pub struct PredictQuery {
    /// Session to read.
    pub session: String,
    /// State to start from; `None` = the newest measured step.
    pub start: Option<VehicleState<f64>>,
    /// Instant to start from; `None` = that of the newest measured step. Not together with `start`.
    pub instant: Option<StartInstant>,
    /// Whether the measured history precedes the start. A given start then replaces the state of the newest step.
    pub use_history: bool,
    /// N.
    pub samples: usize,
    /// Fewest samples that are of use when time is short; 0 = all or nothing.
    pub samples_min: usize,
    /// K.
    pub horizon: usize,
    /// The candidates.
    pub controls: Candidates,
    /// What they are worth; then only the best are answered. Not together with extras.
    pub cost: Option<PathCost>,
    /// What to compute beyond the states.
    pub extras: PredictExtras,
}

/// What a prediction was computed from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Provenance {
    /// Changes of the history since the session was opened.
    pub history_epoch: u64,
    /// Updates of the soil correction.
    pub soil_epoch: u64,
    /// Map, its version and its hash.
    pub map: Option<(String, u64, String)>,
    /// Name of the bundle.
    pub bundle_name: String,
    /// Hash of the bundle.
    pub bundle_hash: String,
}

impl Provenance {
    /// Version of the map; 0 = no map.
    pub fn map_version(&self) -> u64 {
        self.map.as_ref().map_or(0, |(_, version, _)| *version)
    }
}

/// An answered prediction.
#[derive(Clone, Debug, PartialEq)]
pub struct Prediction {
    /// Predicted states, sinkages, flags and the soil under the start; one row for each sample of each group of what-if soils, or for each of the best of the
    /// ranking.
    pub rollout: Rollout,
    /// State that the rollout started from.
    pub start: VehicleState<f64>,
    /// Instant of that state, ns of the vehicle's clock; `None` when the state was given.
    pub start_stamp_ns: Option<i64>,
    /// Steps from the newest measured one to the start.
    pub rolled_forward_steps: usize,
    /// Measured steps before the start.
    pub history_steps: usize,
    /// Variance of the soil under the start in physical units squared; `None` while no filter runs.
    pub soil_variance: Option<[f64; SOIL_DIM]>,
    /// What the session knew of the soil.
    pub soil: SoilEstimate,
    /// Time since the newest measured step arrived, s.
    pub measurement_age_s: Option<f64>,
    /// What it was computed from.
    pub provenance: Provenance,
    /// What was asked for beyond the states.
    pub extras: ExtraOutputs,
    /// Commands of the rows of the rollout, (rows, horizon, 2); empty for candidates that were given.
    pub drawn_controls: Vec<f32>,
    /// What all candidates are worth, where it was asked.
    pub ranking: Option<Ranking>,
}

impl Prediction {
    /// Candidates that were computed.
    pub fn candidates(&self) -> usize {
        let rows = self.rollout.samples / self.extras.soil_groups.max(1);
        self.ranking.as_ref().map_or(rows, |ranking| ranking.costs.len())
    }
}

impl PredictQuery {
    /// Leaves of a query that was answered so the samples that were computed.
    pub(crate) fn keep_answered(&mut self, result: &Result<Reply, EngineError>) {
        if let Ok(Reply::Predicted(prediction)) = result
            && prediction.candidates() < self.samples
        {
            self.keep_first(prediction.candidates());
        }
    }

    /// Fewest samples that answer it.
    pub(crate) fn least(&self) -> usize {
        if self.samples_min == 0 { self.samples } else { self.samples_min.min(self.samples) }
    }

    /// Whether its first samples are an answer when they are done and it is due: nothing is asked for that is worked out after all of them.
    pub(crate) fn takes_fewer(&self) -> bool {
        let extras = PredictExtras { risk: false, exact_terrain: false, ..self.extras.clone() };
        self.least() < self.samples && extras == PredictExtras::default()
    }

    /// Leaves the first samples only, of a query that was checked.
    pub(crate) fn keep_first(&mut self, samples: usize) {
        self.samples = samples;
        if let Candidates::Given(controls) = &mut self.controls {
            controls.truncate(samples * self.horizon * 2);
        }
        if let Some(cost) = &mut self.cost {
            cost.best = cost.best.min(samples);
        }
    }

    /// Checks what needs no session: shape, finite numbers, range of the card, plausible start.
    ///
    /// # Errors
    /// `EngineError::Invalid` naming the field and the limit.
    pub fn check(&self, limits: &Limits, vehicle: &Vehicle) -> Result<(), EngineError> {
        limits.check_shape(self.samples, self.horizon)?;
        if self.samples_min > self.samples {
            let reason = format!("is {}, allowed are 0 to samples = {}", self.samples_min, self.samples);
            return Err(EngineError::invalid("samples_min", reason));
        }
        self.extras.check(limits, self.samples)?;
        if let Some(cost) = &self.cost {
            cost.check(self.samples)?;
            if self.extras != PredictExtras::default() {
                return Err(EngineError::invalid("cost", "is given together with `extras`, allowed is one of the two"));
            }
        }
        self.check_commands(vehicle)?;
        match (&self.start, &self.instant) {
            (Some(_), Some(_)) => Err(EngineError::invalid("start", "is given together with `start_stamp_ns`, allowed is one of the two")),
            (Some(start), None) => limits.check_state("start", start),
            (None, Some(instant)) => instant.check(vehicle),
            (None, None) => Ok(()),
        }
    }

    /// Checks number and range of the commands, those of the nominal sequence where candidates are drawn.
    fn check_commands(&self, vehicle: &Vehicle) -> Result<(), EngineError> {
        let rows = match &self.controls {
            Candidates::Given(_) => self.samples,
            Candidates::Drawn(drawing) => drawing.check().map(|()| 1)?,
        };
        let (field, controls) = self.controls.asked();
        let expected = rows * self.horizon * 2;
        if controls.len() != expected {
            let reason = format!("has {} numbers, {rows} x horizon x 2 = {expected} are needed", controls.len());
            return Err(EngineError::invalid(field, reason));
        }
        for (at, pair) in controls.chunks_exact(2).enumerate() {
            let place = || format!("{field}[{}, {}]", at / self.horizon, at % self.horizon);
            let control = Control { speed_m_s: f64::from(pair[0]), second: f64::from(pair[1]) };
            if !pair.iter().all(|v| v.is_finite()) {
                return Err(EngineError::invalid(place(), "holds a number that is not finite"));
            }
            if let Some((entry, reason)) = outside_card(vehicle, &control) {
                return Err(EngineError::invalid(format!("{}.{entry}", place()), reason));
            }
        }
        Ok(())
    }
}
