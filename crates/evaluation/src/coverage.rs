//! How honest the covariance along a rollout is: errors of recorded windows against what was said of them.

use std::sync::atomic::{AtomicUsize, Ordering};

use nesam_model::rollout_noise::{NoiseScale, SoilCovariance, StateCovariance, sandwich, turned};
use nesam_model::{Predictor, RolloutQuery, Variant};
use nesam_physics::{Control, SOIL_DIM, STATE_DIM, SoilCorrection, VehicleState, wrap_angle};
use rayon::prelude::*;

use crate::adapt::DriveAdaptation;
use crate::error::EvaluationError;
use crate::evaluate::DriveMaps;
use crate::windows::Window;

/// A window with what start and soil make of its covariance.
#[derive(Clone, Debug)]
pub struct LinearisedWindow {
    /// Drive of the window.
    pub drive: usize,
    /// Sample at which it starts.
    pub start: usize,
    /// Measured state minus predicted state after steps 1…K; x and y in the heading frame of the predicted state, angles wrapped.
    pub errors: Vec<[f64; STATE_DIM]>,
    /// J_x P_x J_xᵀ of these steps in the same frame.
    pub of_start: Vec<StateCovariance>,
    /// J_θ P_θ J_θᵀ of these steps in the same frame.
    pub of_soil: Vec<StateCovariance>,
    /// How many times the model's noise counts on this ground, as far as the drive has told; as the bundle says without a filter.
    pub noise_scale: NoiseScale,
}

/// What is known of the soil of each window.
#[derive(Clone, Copy, Debug)]
pub enum SoilKnowledge<'a> {
    /// The prior with its covariance.
    Prior(&'a SoilCovariance),
    /// What the filter had learned by the start of the window; the covariance before its first update.
    Learned(&'a [DriveAdaptation], &'a SoilCovariance),
}

/// Rolls out and linearises every window, on all cores. `progress` is called with the number of finished windows.
///
/// # Errors
/// `EvaluationError::Model` naming drive and window when the model refuses the query.
pub fn linearise_windows(
    predictor: &Predictor,
    windows: &[Window<'_>],
    maps: &DriveMaps,
    start: &StateCovariance,
    soil: SoilKnowledge<'_>,
    progress: &(dyn Fn(usize) + Sync),
) -> Result<Vec<LinearisedWindow>, EvaluationError> {
    let done = AtomicUsize::new(0);
    let of_window = |window: &Window<'_>| {
        let linearised = linearise(predictor, window, maps, start, soil)?;
        progress(done.fetch_add(1, Ordering::Relaxed) + 1);
        Ok(linearised)
    };
    windows.par_iter().map(of_window).collect()
}

fn linearise(
    predictor: &Predictor,
    window: &Window<'_>,
    maps: &DriveMaps,
    start: &StateCovariance,
    soil: SoilKnowledge<'_>,
) -> Result<LinearisedWindow, EvaluationError> {
    let drive = window.trajectory;
    let (correction, soil_covariance, noise_scale) = match soil {
        SoilKnowledge::Prior(covariance) => (SoilCorrection::NONE, *covariance, NoiseScale::USUAL),
        SoilKnowledge::Learned(filtered, prior) => {
            let of_drive = &filtered[window.drive];
            let scale = of_drive.noise_scale_at(window.start);
            (of_drive.correction_at(window.start), of_drive.at(window.start).map_or(*prior, |posterior| posterior.covariance), scale)
        }
    };
    let history = window.history();
    let future: &[Control<f64>] = &drive.controls[window.start..window.start + window.horizon];
    let controls: Vec<f32> = future.iter().flat_map(Control::packed).collect();
    let query = RolloutQuery {
        history: &history,
        start: drive.states[window.start],
        controls: &controls,
        samples: 1,
        horizon: window.horizon,
        map: maps[window.drive].as_ref(),
        soil_correction: correction,
        variant: Variant::Full,
        start_time_s: Some(window.since_log_start_s()),
        wheels: None,
    };
    let refused = |source| EvaluationError::Model { trajectory: drive.id.clone(), start: window.start, source };
    let linearisations = predictor.linearise(&query).map_err(refused)?;
    let linearisation = &linearisations[0];
    let jacobians = linearisation.by_start_and_soil();
    let measured = &drive.states[window.start + 1..=window.start + window.horizon];
    let (mut errors, mut of_start, mut of_soil) = (Vec::new(), Vec::new(), Vec::new());
    for ((predicted, measured), jacobian) in linearisation.states().zip(measured).zip(&jacobians) {
        let yaw = predicted.attitude_rad[2];
        errors.push(error_in_heading_frame(predicted, measured));
        of_start.push(turned(&sandwich(&jacobian.start, start), -yaw));
        of_soil.push(turned(&sandwich::<SOIL_DIM>(&jacobian.soil, &soil_covariance), -yaw));
    }
    Ok(LinearisedWindow { drive: window.drive, start: window.start, errors, of_start, of_soil, noise_scale })
}

/// Measured minus predicted, x and y in the heading frame of the prediction.
fn error_in_heading_frame(predicted: &VehicleState<f64>, measured: &VehicleState<f64>) -> [f64; STATE_DIM] {
    let (p, m) = (predicted.to_array(), measured.to_array());
    let mut e: [f64; STATE_DIM] = core::array::from_fn(|i| if (3..6).contains(&i) { wrap_angle(m[i] - p[i]) } else { m[i] - p[i] });
    let (sin, cos) = p[5].sin_cos();
    (e[0], e[1]) = (cos * e[0] + sin * e[1], cos * e[1] - sin * e[0]);
    e
}
