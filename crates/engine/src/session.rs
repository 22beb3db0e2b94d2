//! What the service remembers of one vehicle.

use std::collections::VecDeque;
use std::sync::Arc;

use nesam_adaptation::SoilFilter;
use nesam_model::{HISTORY, HistoryStep, Predictor};
use nesam_physics::{SOIL_DIM, Vehicle};
use nesam_terrain::WorldMap;

mod soil;

use self::soil::SoilLearner;
pub use self::soil::{BufferTest, SoilState};
use crate::error::EngineError;
use crate::forward::Newest;
use crate::grid::{Place, StepGrid};
use crate::limits::{Limits, outside_card};
use crate::measurement::{Measurement, Outcome};

/// Accepted stamps that are remembered to tell a resent measurement from a late one.
const RECENT_STAMPS: usize = 256;

/// What is known of the soil: the estimate and its whole covariance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SoilEstimate {
    /// Correction of the prior, its variance, and what of it is learned.
    pub state: SoilState,
    /// P⁺, in the coordinates of the correction.
    pub covariance: [[f64; SOIL_DIM]; SOIL_DIM],
}

/// A session: identity, recent measured motion, soil.
#[derive(Clone, Debug)]
pub struct Session {
    id: String,
    vehicle: String,
    map: Option<String>,
    /// Oldest first; the newest is the start of the next prediction.
    history: VecDeque<HistoryStep>,
    grid: Option<StepGrid>,
    recent_stamps: VecDeque<i64>,
    last_sequence: Option<u64>,
    /// Engine clock when the newest step of the history arrived, ns.
    arrived_ns: u64,
    /// Engine clock when the session was fed or asked last, ns.
    used_ns: u64,
    history_epoch: u64,
    learner: SoilLearner,
    soil: SoilEstimate,
}

/// What a session needs to judge a measurement.
#[derive(Clone, Copy, Debug)]
pub struct Rules<'a> {
    /// Step of the model, ns.
    pub step_ns: i64,
    /// Card of the vehicle.
    pub vehicle: &'a Vehicle,
    /// Limits.
    pub limits: &'a Limits,
}

impl Session {
    /// A session without history, whose soil filter knows the prior only.
    pub fn new(id: &str, vehicle: &str, map: Option<&str>, filter: SoilFilter, now_ns: u64) -> Self {
        let covariance = filter.posterior().covariance;
        let learner = SoilLearner::new(filter);
        Self {
            id: id.into(),
            vehicle: vehicle.into(),
            map: map.map(Into::into),
            history: VecDeque::with_capacity(HISTORY),
            grid: None,
            recent_stamps: VecDeque::with_capacity(RECENT_STAMPS),
            last_sequence: None,
            arrived_ns: 0,
            used_ns: now_ns,
            history_epoch: 0,
            soil: SoilEstimate { state: learner.state(0, None), covariance },
            learner,
        }
    }

    /// Takes one measurement. Only an outcome that is `accepted` changes the session.
    ///
    /// # Errors
    /// `EngineError::Invalid` naming the entry that is implausible or outside the card; the session is unchanged.
    pub fn observe(&mut self, measurement: &Measurement, now_ns: u64, rules: Rules<'_>) -> Result<Outcome, EngineError> {
        if let Some(field) = measurement.not_finite() {
            return Ok(Outcome::NotFinite { field });
        }
        rules.limits.check_state("state", &measurement.state)?;
        if let Some((entry, reason)) = outside_card(rules.vehicle, &measurement.command) {
            return Err(EngineError::invalid(format!("command.{entry}"), reason));
        }
        if let Some(refused) = self.judge_order(measurement, rules)? {
            return Ok(refused);
        }
        Ok(self.accept(measurement, now_ns, rules.step_ns))
    }

    /// Duplicates and late measurements.
    fn judge_order(&self, measurement: &Measurement, rules: Rules<'_>) -> Result<Option<Outcome>, EngineError> {
        let stamp = measurement.stamp_ns;
        let repeated = measurement.sequence.is_some() && measurement.sequence == self.last_sequence;
        if repeated || self.recent_stamps.contains(&stamp) {
            return Ok(Some(Outcome::Duplicate));
        }
        let Some(last) = self.last_stamp_ns() else { return Ok(None) };
        if stamp < last {
            return Ok(Some(Outcome::TooOld { behind_s: seconds(last.saturating_sub(stamp)) }));
        }
        if let (Some(sequence), Some(last_sequence)) = (measurement.sequence, self.last_sequence)
            && sequence < last_sequence
        {
            return Ok(Some(Outcome::TooOld { behind_s: 0.0 }));
        }
        let ahead_s = seconds(stamp.saturating_sub(last));
        if ahead_s > rules.limits.pause_max_s {
            let limit = rules.limits.pause_max_s;
            let reason = format!("lies {ahead_s} s after the last one, allowed are {limit} s; open a new session after a longer pause");
            return Err(EngineError::invalid("stamp_ns", reason));
        }
        Ok(None)
    }

    fn accept(&mut self, measurement: &Measurement, now_ns: u64, step_ns: i64) -> Outcome {
        if self.recent_stamps.len() == RECENT_STAMPS {
            self.recent_stamps.pop_front();
        }
        self.recent_stamps.push_back(measurement.stamp_ns);
        self.last_sequence = measurement.sequence.or(self.last_sequence);
        let stamp_ns = measurement.stamp_ns;
        let outcome = match self.grid.as_mut().map(|grid| grid.take(stamp_ns)) {
            Some(Place::Between { remaining_ns }) => return Outcome::Buffered { next_step_in_s: seconds(remaining_ns) },
            Some(Place::Step) => Outcome::Applied,
            Some(Place::Gap { gap_ns }) => {
                self.grid = Some(StepGrid::start(stamp_ns, step_ns));
                self.history.clear();
                Outcome::Gap { gap_s: seconds(gap_ns) }
            }
            None => {
                self.grid = Some(StepGrid::start(stamp_ns, step_ns));
                Outcome::Applied
            }
        };
        if self.history.len() == HISTORY {
            self.history.pop_front();
        }
        self.history.push_back(HistoryStep { state: measurement.state, control: measurement.command });
        self.history_epoch += 1;
        self.arrived_ns = now_ns;
        outcome
    }

    /// Lets the soil filter learn from the step that an observation has just made; every B-th step makes an update (paper Alg. 1). The
    /// step stays in the history when the filter refuses its buffer: then the outcome says so.
    pub fn learn(&mut self, predictor: &Predictor, map: Option<&Arc<WorldMap>>, outcome: Outcome) -> Outcome {
        match outcome {
            Outcome::Applied => {}
            Outcome::Gap { .. } => self.learner.forget_open(),
            _ => return outcome,
        }
        let stamp_ns = self.last_stamp_ns();
        let Some((newest, before)) = self.history.make_contiguous().split_last() else { return outcome };
        let Some(update) = self.learner.step(predictor, before, newest, map) else { return outcome };
        let judged = self.soil.state.last_buffer.map_or(0, |last| last.judged) + 1;
        let last_buffer = Some(BufferTest { judged, nis: update.nis, dof: update.dof, rejected: update.rejected });
        if update.rejected {
            self.soil.state.last_buffer = last_buffer;
            return Outcome::Gated { nis: update.nis };
        }
        let state = SoilState { last_buffer, ..self.learner.state(self.soil.state.epoch + 1, stamp_ns) };
        self.soil = SoilEstimate { state, covariance: update.posterior.covariance };
        outcome
    }

    /// A copy of everything under another name.
    pub fn fork(&self, id: &str, now_ns: u64) -> Self {
        Self { id: id.into(), used_ns: now_ns, ..self.clone() }
    }

    /// Notes that the session is fed or asked.
    pub fn touch(&mut self, now_ns: u64) {
        self.used_ns = now_ns;
    }

    /// Time since the session was fed or asked last, s.
    pub fn idle_s(&self, now_ns: u64) -> f64 {
        now_ns.saturating_sub(self.used_ns) as f64 * 1e-9
    }

    /// Name of the session.
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Vehicle that it belongs to.
    pub fn vehicle(&self) -> &str {
        &self.vehicle
    }

    /// Map that the vehicle drives on.
    pub fn map(&self) -> Option<&str> {
        self.map.as_deref()
    }

    /// Measured steps, oldest first, the newest included; at most 32.
    pub fn history(&self) -> &VecDeque<HistoryStep> {
        &self.history
    }

    /// Newest step of the history.
    pub fn newest(&self) -> Option<&HistoryStep> {
        self.history.back()
    }

    /// Stamp and command of the newest step of the history.
    pub(crate) fn newest_at(&self) -> Option<Newest> {
        let (grid, step) = (self.grid.as_ref()?, self.newest()?);
        Some(Newest { stamp_ns: grid.last_ns(), command: step.control })
    }

    /// Counts the changes of the history.
    pub fn history_epoch(&self) -> u64 {
        self.history_epoch
    }

    /// Stamp of the newest accepted measurement, ns of the vehicle's clock.
    pub fn last_stamp_ns(&self) -> Option<i64> {
        self.recent_stamps.back().copied()
    }

    /// Sequence number of the newest accepted measurement that had one.
    pub fn last_sequence(&self) -> Option<u64> {
        self.last_sequence
    }

    /// What was learned of the soil.
    pub fn soil(&self) -> &SoilEstimate {
        &self.soil
    }

    /// Time since the newest step of the history arrived, s; `None` before the first.
    pub fn age_s(&self, now_ns: u64) -> Option<f64> {
        self.newest().map(|_| now_ns.saturating_sub(self.arrived_ns) as f64 * 1e-9)
    }
}

fn seconds(ns: i64) -> f64 {
    ns as f64 * 1e-9
}

#[cfg(test)]
mod tests;
