//! The ceiling of what a soil correction can gain with a given network: the correction that predicts the very windows best that it is judged by.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};
use nesam_model::{Predictor, RolloutQuery, SoilField, Variant};
use nesam_physics::{Control, SOIL_DIM, SoilCoordinates, SoilCorrection, wrap_angle};
use nesam_terrain::WorldMap;
use rayon::prelude::*;

use crate::dimension::{POSE_DIM, Pose, pose_of};
use crate::error::EvaluationError;
use crate::true_soil::TrueSoil;
use crate::windows::{Truth, Window};

/// Gauss-Newton passes at most.
const PASSES: usize = 8;
/// Step of a finite difference and of the weakest pull to the prior, in standard deviations of the prior.
const DIFFERENCE_SHARE: f64 = 0.1;
/// Dampings tried at once, in units of the mean diagonal of the normal matrix.
const DAMPINGS: [f64; 8] = [0.0, 1e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 10.0];
/// Relative fall of the objective below which the fit has converged.
const CONVERGED: f64 = 2e-3;
/// What each dimension counts in the objective: position and yaw are what the correction is for.
const WEIGHTS: [f64; POSE_DIM] = [1.0, 1.0, 0.3, 0.3, 0.3, 1.0];
/// Pull to the prior, per window, so that what is not seen stays where it is.
const PULL: f64 = 1e-3;

/// One correction for everywhere, or one for each class of ground.
#[derive(Clone, Debug)]
pub struct BestCorrection {
    deltas: Vec<[f64; SOIL_DIM]>,
    classes: Option<Arc<TrueSoil>>,
}

impl BestCorrection {
    fn of(parameters: &[f64], classes: Option<&Arc<TrueSoil>>) -> Self {
        let deltas = parameters.as_chunks::<SOIL_DIM>().0.to_vec();
        Self { deltas, classes: classes.cloned() }
    }

    /// The corrections, one for each class.
    pub fn deltas(&self) -> &[[f64; SOIL_DIM]] {
        &self.deltas
    }
}

impl SoilField for BestCorrection {
    fn soil(&self, _sample: usize, position_m: [f64; 2], prior: &[f64; SOIL_DIM]) -> [f64; SOIL_DIM] {
        let class = self.classes.as_ref().map_or(Some(0), |classes| classes.class_at(position_m));
        let delta = class.and_then(|c| self.deltas.get(c)).copied().unwrap_or([0.0; SOIL_DIM]);
        SoilCorrection { coordinates: SoilCoordinates::Logarithmic, delta }.apply(prior)
    }
}

/// Every sample on its own soil.
#[derive(Debug)]
struct WhatIf(Vec<BestCorrection>);

impl SoilField for WhatIf {
    fn soil(&self, sample: usize, position_m: [f64; 2], prior: &[f64; SOIL_DIM]) -> [f64; SOIL_DIM] {
        self.0[sample].soil(sample, position_m, prior)
    }
}

/// The correction, constant over a drive or over each class of its ground, under which the model predicts these windows of the drive best: Gauss-Newton
/// through the whole rollout on root mean squares per window, relative to those of the prior (a robust sum: no window rules it). For evaluation only: it is
/// fitted to what it is scored on, so it bounds from above what any filter of such corrections could reach, and overstates it by the fit of
/// 6 (or 6 per class) numbers.
///
/// # Errors
/// `EvaluationError::Model` when the model refuses a window.
pub fn best_correction(
    predictor: &Predictor,
    windows: &[Window<'_>],
    map: Option<&Arc<WorldMap>>,
    truth: Truth,
    prior_sd: &[f64; SOIL_DIM],
    classes: Option<&Arc<TrueSoil>>,
) -> Result<BestCorrection, EvaluationError> {
    let size = SOIL_DIM * classes.map_or(1, |c| c.classes());
    let fit = Fit { predictor, windows, map, truth, prior_sd, classes };
    let mut at = vec![0.0; size];
    let mut scale = [1.0; POSE_DIM];
    let mut best = f64::INFINITY;
    for pass in 0..PASSES {
        let moved = (0..size).map(|i| {
            let mut p = at.clone();
            p[i] += DIFFERENCE_SHARE * prior_sd[i % SOIL_DIM];
            p
        });
        let errors = fit.errors(&std::iter::once(at.clone()).chain(moved).collect::<Vec<_>>())?;
        if pass == 0 {
            scale = mean_squares(&errors);
            best = fit.objective(&errors, 0, &at, &scale);
        }
        let (normal, gradient) = fit.normal_equations(&errors, &at, &scale);
        let size_of = normal.diagonal().mean();
        let candidates: Vec<Vec<f64>> = DAMPINGS
            .iter()
            .filter_map(|damping| {
                let damped = &normal + DMatrix::from_diagonal_element(size, size, damping * size_of);
                let step = damped.cholesky()?.solve(&gradient);
                Some(at.iter().enumerate().map(|(i, v)| v + step[i] * prior_sd[i % SOIL_DIM]).collect())
            })
            .collect();
        let errors = fit.errors(&candidates)?;
        let found = (0..candidates.len()).map(|c| (fit.objective(&errors, c, &candidates[c], &scale), c));
        let Some((value, c)) = found.min_by(|a, b| a.0.total_cmp(&b.0)) else { break };
        let gain = 1.0 - value / best;
        if gain > 0.0 {
            at.clone_from(&candidates[c]);
            best = value;
        }
        if gain.is_nan() || gain < CONVERGED {
            break;
        }
    }
    Ok(BestCorrection::of(&at, classes))
}

/// Errors truth - prediction of one window: one list over the steps for each candidate.
type Errors = Vec<Vec<Pose>>;

/// Mean over windows of the root mean square of each dimension, first candidate.
fn mean_squares(errors: &[Errors]) -> [f64; POSE_DIM] {
    let mut mean = [0.0; POSE_DIM];
    for window in errors {
        for (sum, v) in mean.iter_mut().zip(root_mean_squares(&window[0])) {
            *sum += v / errors.len() as f64;
        }
    }
    mean.map(|v| v.max(1e-9))
}

/// Root mean square over the steps; x and y count together.
fn root_mean_squares(steps: &[Pose]) -> [f64; POSE_DIM] {
    let mut sum = [0.0; POSE_DIM];
    for step in steps {
        for (s, v) in sum.iter_mut().zip(step) {
            *s += v * v / steps.len() as f64;
        }
    }
    let both = sum[0] + sum[1];
    (sum[0], sum[1]) = (both, both);
    sum.map(f64::sqrt)
}

struct Fit<'a> {
    predictor: &'a Predictor,
    windows: &'a [Window<'a>],
    map: Option<&'a Arc<WorldMap>>,
    truth: Truth,
    prior_sd: &'a [f64; SOIL_DIM],
    classes: Option<&'a Arc<TrueSoil>>,
}

impl Fit<'_> {
    /// Errors of every window under every candidate.
    fn errors(&self, candidates: &[Vec<f64>]) -> Result<Vec<Errors>, EvaluationError> {
        let soils = WhatIf(candidates.iter().map(|p| BestCorrection::of(p, self.classes)).collect());
        self.windows.par_iter().map(|window| self.window_errors(window, &soils)).collect()
    }

    fn window_errors(&self, window: &Window<'_>, soils: &WhatIf) -> Result<Errors, EvaluationError> {
        let (drive, samples) = (window.trajectory, soils.0.len());
        let future = &drive.controls[window.start..window.start + window.horizon];
        let one: Vec<f32> = future.iter().flat_map(Control::packed).collect();
        let history = window.history();
        let query = RolloutQuery {
            history: &history,
            start: drive.states[window.start],
            controls: &one.repeat(samples),
            samples,
            horizon: window.horizon,
            map: self.map,
            soil_correction: SoilCorrection::NONE,
            variant: Variant::Full,
            start_time_s: Some(window.since_log_start_s()),
            wheels: None,
        };
        let rollout = self.predictor.rollout_on(&query, soils).map_err(|source| EvaluationError::Model {
            trajectory: drive.id.clone(),
            start: window.start,
            source,
        })?;
        let truth = window.truth(self.truth);
        let error = |n: usize, k: usize| -> Pose {
            let predicted = pose_of(&rollout.state_f64(n, k));
            std::array::from_fn(|d| {
                let difference = truth[k][d] - predicted[d];
                if d < 3 { difference } else { wrap_angle(difference) }
            })
        };
        Ok((0..samples).map(|n| (0..window.horizon).map(|k| error(n, k)).collect()).collect())
    }

    fn objective(&self, errors: &[Errors], candidate: usize, at: &[f64], scale: &[f64; POSE_DIM]) -> f64 {
        let of_window = |window: &Errors| -> f64 {
            let rms = root_mean_squares(&window[candidate]);
            // x and y stand for one number.
            (1..POSE_DIM).map(|d| WEIGHTS[d] * rms[d] / scale[d]).sum()
        };
        let pull: f64 = at.iter().enumerate().map(|(i, v)| (v / self.prior_sd[i % SOIL_DIM]).powi(2)).sum();
        errors.iter().map(of_window).sum::<f64>() / errors.len() as f64 + 0.5 * PULL * pull
    }

    /// Normal equations in units of the prior: first candidate at the point, the others moved in one parameter each.
    fn normal_equations(&self, errors: &[Errors], at: &[f64], scale: &[f64; POSE_DIM]) -> (DMatrix<f64>, DVector<f64>) {
        let size = at.len();
        let mut normal = DMatrix::from_diagonal_element(size, size, PULL);
        let mut gradient = DVector::from_fn(size, |i, _| -PULL * at[i] / self.prior_sd[i % SOIL_DIM]);
        for window in errors {
            let rms = root_mean_squares(&window[0]);
            let steps = window[0].len() as f64;
            // The derivative of a root mean square: squares over the root, with a floor where the window is met exactly.
            let weight: [f64; POSE_DIM] =
                std::array::from_fn(|d| WEIGHTS[d] / (scale[d] * rms[d].max(0.1 * scale[d]) * steps * errors.len() as f64));
            for k in 0..window[0].len() {
                for d in 0..POSE_DIM {
                    let slope = DVector::from_fn(size, |i, _| (window[0][k][d] - window[i + 1][k][d]) / DIFFERENCE_SHARE);
                    normal.ger(weight[d], &slope, &slope, 1.0);
                    gradient.axpy(weight[d] * window[0][k][d], &slope, 1.0);
                }
            }
        }
        (normal, gradient)
    }
}
