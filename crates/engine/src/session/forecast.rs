//! Predictions of a session that came true, compared with what was measured: one begins where the last one ended.

use std::sync::Arc;

use nesam_adaptation::{FORECAST_AHEAD, FORECAST_STEPS, ForecastCheck};
use nesam_model::{HISTORY, HistoryStep, Predictor, RolloutNoise, SoilByClass};
use nesam_physics::SoilCorrection;
use nesam_terrain::WorldMap;

/// Steps that an open prediction holds at most: history, start, and what was measured since.
const FORECAST_HELD: usize = HISTORY + FORECAST_AHEAD;

/// What a prediction would have been made from, and what was measured since.
#[derive(Clone, Debug, PartialEq)]
pub struct OpenForecast {
    /// Measured steps, oldest first: a whole history, whose newest is the start, and those after it.
    pub steps: Vec<HistoryStep>,
    /// Corrections of all classes of ground at the start.
    pub corrections: Vec<SoilCorrection>,
    /// How many times the model's noise counted then, before forecasts had their say.
    pub noise_scale: f64,
}

impl OpenForecast {
    /// One from the newest step of `history`; `None` while the history is not whole.
    pub(super) fn begin(history: &[HistoryStep], corrections: impl FnOnce() -> Vec<SoilCorrection>, noise_scale: f64) -> Option<Self> {
        let first = history.len().checked_sub(HISTORY)?;
        Some(Self { steps: history[first..].to_vec(), corrections: corrections(), noise_scale })
    }

    /// Takes the step that follows; says whether the prediction can be compared now.
    pub(super) fn follow(&mut self, step: &HistoryStep) -> bool {
        self.steps.push(*step);
        self.steps.len() == FORECAST_HELD
    }

    /// Holds it against what was measured. Of one that leaves the map nothing is said, nor of a vehicle that stands.
    pub(super) fn compare(&self, predictor: &Predictor, noise: &RolloutNoise, map: &Arc<WorldMap>, check: &mut ForecastCheck) {
        if Predictor::stands(&self.steps[HISTORY - 1..]) {
            return;
        }
        let soil = SoilByClass::new(Some(map), self.corrections.clone());
        let errors = predictor.forecast_errors(&self.steps, HISTORY - 1, FORECAST_STEPS, &soil, map);
        if let (Some(errors), Some(expected)) = (errors, noise.of_position(FORECAST_STEPS, self.noise_scale)) {
            check.observe(&errors, &expected);
        }
    }

    /// Whether a session can hold this.
    pub(super) fn is_possible(&self) -> bool {
        let steps = (HISTORY..FORECAST_HELD).contains(&self.steps.len());
        let finite = self.corrections.iter().all(|c| c.delta.iter().all(|v| v.is_finite()));
        steps && finite && self.noise_scale.is_finite() && self.noise_scale > 0.0
    }
}
