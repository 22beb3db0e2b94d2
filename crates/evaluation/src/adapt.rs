//! Runs the soil filter over recorded drives: what a session would have learned by each instant.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use nesam_adaptation::{
    AdaptationError, BufferedTransition, FORECAST_AHEAD, FORECAST_STEPS, FilterConfig, ForecastCheck, Innovation, NoiseCalibration,
    SoilFilter, SoilPosterior, SoilUpdate, UncorrectedBuffer, calibrate, uncorrected,
};
use nesam_model::rollout_noise::NoiseScale;
use nesam_model::{HISTORY, HistoryStep, Predictor, RolloutNoise, SoilByClass, SoilField, Transition};
use nesam_physics::{SOIL_DIM, SoilCorrection};
use nesam_terrain::WorldMap;
use nesam_trajectories::Trajectory;
use rayon::prelude::*;

use crate::error::EvaluationError;
use crate::evaluate::DriveMaps;
use crate::known_soil::inside_95;
use crate::windows::history_steps;

/// An update and the instant at which it was known.
#[derive(Clone, Debug)]
pub struct TimedUpdate {
    /// Newest measured sample that went in: windows from here on may use it.
    pub sample: usize,
    /// Prior soil θ̄ under that sample.
    pub prior: [f64; SOIL_DIM],
    /// The update.
    pub update: SoilUpdate,
    /// Class of the ground under that sample: 0 = not known, i + 1 = class i of the map.
    pub class: usize,
    /// Corrections of all classes from then on.
    pub corrections: Vec<SoilCorrection>,
}

impl TimedUpdate {
    /// Soil under the vehicle at that instant: prior plus correction, clipped.
    pub fn soil(&self) -> [f64; SOIL_DIM] {
        self.update.posterior.correction.apply(&self.prior)
    }
}

/// What the filter made of one drive, starting from the prior at its first sample.
#[derive(Clone, Debug, Default)]
pub struct DriveAdaptation {
    /// Updates in order of time, rejected buffers included.
    pub updates: Vec<TimedUpdate>,
    /// Buffers that were given up because a number was not finite or S was singular.
    pub failed: usize,
    /// Last samples of predictions that came true, ascending, and how they have come true until then ([`check_forecasts`]).
    pub forecasts: Vec<(usize, ForecastCheck)>,
}

impl DriveAdaptation {
    /// The posterior from measurements up to `sample`; `None` before the first update.
    pub fn at(&self, sample: usize) -> Option<&SoilPosterior> {
        let known = self.updates.partition_point(|u| u.sample <= sample);
        known.checked_sub(1).map(|last| &self.updates[last].update.posterior)
    }

    /// How many times the model's noise counts as far as measurements up to `sample` tell: by accepted updates of the filter, times what predictions that came true
    /// have told; 1 before the first of either.
    pub fn noise_scale_at(&self, sample: usize) -> NoiseScale {
        let told = self.forecasts.partition_point(|(last, _)| *last <= sample);
        let forecasts = told.checked_sub(1).map_or_else(ForecastCheck::default, |last| self.forecasts[last].1);
        let filter = self.filter_scale_at(sample);
        NoiseScale { height: filter * forecasts.height_scale(), rest: filter * forecasts.scale() }
    }

    /// The filter's part of it.
    fn filter_scale_at(&self, sample: usize) -> f64 {
        let known = self.updates.partition_point(|u| u.sample <= sample);
        let accepted = self.updates[..known].iter().rfind(|u| !u.update.rejected);
        accepted.map_or(1.0, |last| last.update.noise_scale)
    }

    /// The correction that a prediction from `sample` applies where the vehicle was then.
    pub fn correction_at(&self, sample: usize) -> SoilCorrection {
        self.at(sample).map_or(SoilCorrection::NONE, |posterior| posterior.correction)
    }

    /// The corrections that a prediction from `sample` applies along its way.
    pub fn soil_at(&self, sample: usize, map: Option<&Arc<WorldMap>>) -> SoilByClass {
        let known = self.updates.partition_point(|u| u.sample <= sample);
        SoilByClass::new(map, known.checked_sub(1).map_or(Vec::new(), |last| self.updates[last].corrections.clone()))
    }
}

/// Share of buffers whose NIS a consistent filter would give, and how large it is on average.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Consistency {
    /// Mean of NIS over its degrees of freedom, 1 for a consistent filter; `None` without a buffer.
    pub nis_mean_over_dof: Option<f64>,
    /// Median of the same ratio, which a few wild buffers do not move.
    pub nis_median_over_dof: Option<f64>,
    /// Share of buffers with NIS inside the two-sided 95 % interval of χ².
    pub inside_95: Option<f64>,
    /// Accepted buffers.
    pub updates: usize,
    /// Buffers that the gate refused.
    pub rejected: usize,
    /// Buffers that were given up because of a number that is not finite.
    pub failed: usize,
}

impl Consistency {
    /// Over all buffers of all drives.
    pub fn of(drives: &[DriveAdaptation]) -> Self {
        let all: Vec<&SoilUpdate> = drives.iter().flat_map(|d| d.updates.iter().map(|u| &u.update)).collect();
        let ratios: Vec<f64> = all.iter().map(|u| u.nis / u.dof as f64).collect();
        let inside = all.iter().filter(|u| inside_95(u.dof, u.nis)).count();
        let share = |part: f64| (!all.is_empty()).then(|| part / all.len() as f64);
        let rejected = all.iter().filter(|u| u.rejected).count();
        Self {
            nis_mean_over_dof: share(ratios.iter().sum()),
            nis_median_over_dof: share(1.0).map(|_| crate::median(&ratios)),
            inside_95: share(inside as f64),
            updates: all.len() - rejected,
            rejected,
            failed: drives.iter().map(|d| d.failed).sum(),
        }
    }
}

/// Runs the filter over every drive, each from the prior, on all cores. `progress` is called with the number of finished drives.
///
/// # Errors
/// `EvaluationError::Filter` when the settings are unusable.
pub fn adapt_all(
    predictor: &Predictor,
    drives: &[Trajectory],
    maps: &DriveMaps,
    config: &FilterConfig,
    progress: &(dyn Fn(usize) + Sync),
) -> Result<Vec<DriveAdaptation>, EvaluationError> {
    SoilFilter::new(config.clone())?;
    let done = AtomicUsize::new(0);
    drives
        .par_iter()
        .zip(maps)
        .map(|(drive, map)| {
            let adapted = adapt_drive(predictor, drive, map.as_ref(), config);
            progress(done.fetch_add(1, Ordering::Relaxed) + 1);
            adapted
        })
        .collect()
}

/// Holds predictions of each drive against what was measured in the end, as a session does: one every 32 samples, with what the filter knew at its start.
pub fn check_forecasts(
    predictor: &Predictor,
    drives: &[Trajectory],
    maps: &DriveMaps,
    noise: &RolloutNoise,
    adapted: &mut [DriveAdaptation],
) {
    adapted.par_iter_mut().zip(drives).zip(maps).for_each(|((adapted, drive), map)| {
        let Some(map) = map else { return };
        let steps = history_steps(drive);
        let mut check = ForecastCheck::default();
        adapted.forecasts = (HISTORY - 1..steps.len().saturating_sub(FORECAST_AHEAD))
            .step_by(FORECAST_AHEAD)
            .map(|start| {
                let soil = adapted.soil_at(start, Some(map));
                let stands = Predictor::stands(&steps[start..=start + FORECAST_AHEAD]);
                let errors = if stands { None } else { predictor.forecast_errors(&steps, start, FORECAST_STEPS, &soil, map) };
                if let (Some(errors), Some(expected)) = (errors, noise.of_position(FORECAST_STEPS, adapted.filter_scale_at(start))) {
                    check.observe(&errors, &expected);
                }
                (start + FORECAST_AHEAD, check)
            })
            .collect();
    });
}

/// Runs the filter over one drive from its first sample, as a session that receives the samples one by one.
///
/// A buffer with a wheel off the map is left out, and a drive without a map teaches nothing: where the slope of the ground is a guess,
/// its error would be taken for soil. No buffer holds a step in which the vehicle sets off ([`Predictor::sets_off`]), and one over which it stands teaches nothing.
///
/// # Errors
/// As [`adapt_all`].
pub fn adapt_drive(
    predictor: &Predictor,
    drive: &Trajectory,
    map: Option<&Arc<WorldMap>>,
    config: &FilterConfig,
) -> Result<DriveAdaptation, EvaluationError> {
    let mut out = DriveAdaptation::default();
    let Some(map) = map else { return Ok(out) };
    let wider = predictor.unseen_soil_sd(map).map(|soil_sd| config.on_unseen_soil(soil_sd));
    let config = wider.as_ref().unwrap_or(config);
    let mut filter = SoilFilter::new(config.clone())?;
    let steps = history_steps(drive);
    let mut start = 0;
    while start + config.buffer < steps.len() {
        let sets_off = |k: &usize| predictor.sets_off(&steps[..*k], &steps[*k]);
        if let Some(last) = (start..=start + config.buffer).rev().find(sets_off) {
            start = last + 1;
            continue;
        }
        let soil = SoilByClass::new(Some(map), filter.estimates());
        let buffer = buffer_at(predictor, &steps, start, config, map, &soil);
        start += config.buffer;
        for transition in buffer.into_iter().flatten() {
            match filter.push(predictor.step_model(), transition) {
                Ok(None) => {}
                Ok(Some(update)) => {
                    let corrections = filter.posteriors().iter().map(|p| p.correction).collect();
                    let (prior, class) = (transition.input.soil.to_array(), transition.ground_class);
                    out.updates.push(TimedUpdate { sample: start, prior, update, class, corrections });
                }
                Err(AdaptationError::NotFinite { .. } | AdaptationError::SingularInnovation { .. }) => {
                    filter.clear_buffer();
                    out.failed += 1;
                    break;
                }
                Err(other) => return Err(other.into()),
            }
        }
    }
    Ok(out)
}

/// The transitions from sample `start` to `start + B`; `None` when one leaves the known map or the vehicle stands.
fn buffer_at(
    predictor: &Predictor,
    steps: &[HistoryStep],
    start: usize,
    config: &FilterConfig,
    map: &Arc<WorldMap>,
    soil: &dyn SoilField,
) -> Option<Vec<BufferedTransition>> {
    if Predictor::stands(&steps[start..=start + config.buffer]) {
        return None;
    }
    let along = (config.innovation == Innovation::Rollout).then_some(soil);
    let transitions = predictor.measured_transitions(steps, start..start + config.buffer, along, map)?;
    let both = transitions.into_iter().zip(&steps[start + 1..]);
    let seen = |(t, end): (Transition, &HistoryStep)| {
        let [x, y, _] = t.input.state.position_m;
        let ground_class = SoilByClass::class_at(Some(map), [x, y]);
        BufferedTransition {
            observed_share: t.observed_share,
            ground_class,
            ..BufferedTransition::new(t.input, t.residual, &predictor.true_state(&end.state))
        }
    };
    Some(both.map(seen).collect())
}

/// What these drives, on ground that the model was trained for, say of the filter's noise.
///
/// # Errors
/// `EvaluationError::Filter` when the settings are unusable or the drives too few.
pub fn calibrate_noise(
    predictor: &Predictor,
    drives: &[Trajectory],
    maps: &DriveMaps,
    config: &FilterConfig,
    by_conditions: bool,
) -> Result<NoiseCalibration, EvaluationError> {
    config.check()?;
    let of_drive = |(drive, map): (&Trajectory, &Option<Arc<WorldMap>>)| -> Vec<UncorrectedBuffer> {
        let Some(map) = map else { return Vec::new() };
        let steps = history_steps(drive);
        let starts = (0..steps.len().saturating_sub(config.buffer)).step_by(config.buffer);
        let buffers = starts.filter_map(|start| buffer_at(predictor, &steps, start, config, map, &SoilCorrection::NONE));
        buffers.filter_map(|buffer| uncorrected(config, predictor.step_model(), &buffer).ok()).collect()
    };
    let buffers: Vec<Vec<UncorrectedBuffer>> = drives.par_iter().zip(maps).map(of_drive).collect();
    Ok(calibrate(&buffers, config, by_conditions)?)
}
