//! Runs the models over the windows and turns the errors into scores.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use nesam_terrain::WorldMap;
use rayon::prelude::*;

use crate::bootstrap::{Resamples, median};
use crate::dimension::POSE_DIM;
use crate::error::EvaluationError;
use crate::errors::{PosePath, WindowErrors};
use crate::models::ModelName;
use crate::predictors::WindowPredictor;
use crate::score::{ErrorSummary, mean_told, summarise};
use crate::windows::{Truth, Window};

/// What one model predicted for every window, in window order.
#[derive(Clone, Debug)]
pub struct ModelPaths {
    /// The model.
    pub name: ModelName,
    /// Learned or fitted parameters.
    pub parameters: usize,
    /// One path per window.
    pub paths: Vec<PosePath>,
}

/// Mean error after each step with its interval: the curve over the horizon.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct HorizonCurve {
    /// Mean over windows at steps 1…K.
    pub mean: Vec<f64>,
    /// 95 % interval at each step; empty where there is none.
    pub ci95: Vec<[f64; 2]>,
}

/// Score of one model.
#[derive(Clone, Debug)]
pub struct ModelScore {
    /// The model.
    pub name: ModelName,
    /// Learned or fitted parameters.
    pub parameters: usize,
    /// `ERR` of the contract.
    pub summary: ErrorSummary,
    /// Errors behind it.
    pub errors: WindowErrors,
    /// x, y, z, roll, pitch, yaw, then horizontal position, over the horizon; `None` where not scored.
    pub curves: [Option<HorizonCurve>; POSE_DIM + 1],
}

/// Map of each drive, in the order of the drives; `None` where the drive has no world.
pub type DriveMaps = [Option<Arc<WorldMap>>];

/// Runs every model over every window on all cores. `progress` is called with the number of finished windows.
///
/// Windows are taken world by world and all models of a window together, because a predictor keeps terrain features of a few maps only.
/// The result does not depend on that order.
///
/// # Errors
/// The first error of a predictor, naming drive and window.
pub fn predict_all(
    models: &[(ModelName, WindowPredictor)],
    windows: &[Window<'_>],
    maps: &DriveMaps,
    progress: &(dyn Fn(usize) + Sync),
) -> Result<Vec<ModelPaths>, EvaluationError> {
    let mut order: Vec<usize> = (0..windows.len()).collect();
    order.sort_by_key(|&w| maps[windows[w].drive].as_ref().map(|m| m.hash()));
    let done = AtomicUsize::new(0);
    let mut predicted = order
        .par_iter()
        .map(|&w| {
            let map = maps[windows[w].drive].as_ref();
            let paths = models.iter().map(|(_, m)| m.predict(&windows[w], map)).collect::<Result<Vec<_>, _>>()?;
            progress(done.fetch_add(1, Ordering::Relaxed) + 1);
            Ok((w, paths))
        })
        .collect::<Result<Vec<_>, EvaluationError>>()?;
    predicted.sort_by_key(|(w, _)| *w);
    let mut out: Vec<ModelPaths> = models
        .iter()
        .map(|(name, model)| ModelPaths { name: *name, parameters: model.parameters(), paths: Vec::with_capacity(windows.len()) })
        .collect();
    for (_, paths) in predicted {
        for (model, path) in out.iter_mut().zip(paths) {
            model.paths.push(path);
        }
    }
    Ok(out)
}

/// Scores predictions against the truth, all models with the same bootstrap draws.
pub fn score(model: &ModelPaths, windows: &[Window<'_>], truth: Truth, resamples: &Resamples) -> ModelScore {
    let horizon = windows.first().map_or(0, |w| w.horizon);
    let mut errors = WindowErrors::empty(horizon);
    for (window, path) in windows.iter().zip(&model.paths) {
        let measured = window.trajectory.measured.pose();
        errors.push(window.drive, &window.start_pose(), path, &window.truth(truth), window.path_m(truth), measured);
    }
    let curves = std::array::from_fn(|d| {
        let scored = if d < POSE_DIM { errors.scored[d] } else { errors.scored[0] && errors.scored[1] };
        scored.then(|| curve(&errors, d, resamples))
    });
    ModelScore { name: model.name, parameters: model.parameters, summary: summarise(&errors, resamples), errors, curves }
}

fn curve(errors: &WindowErrors, dimension: usize, resamples: &Resamples) -> HorizonCurve {
    let columns: Vec<Vec<f64>> = (0..errors.horizon).map(|k| errors.column(k, dimension)).collect();
    let mean = columns.iter().map(|c| mean_told(c)).collect();
    let ci95 = columns.par_iter().filter_map(|c| resamples.mean_interval(c, &errors.trajectory)).collect();
    HorizonCurve { mean, ci95 }
}

/// Median over windows of the true path length, m.
pub fn path_median_m(windows: &[Window<'_>], truth: Truth) -> f64 {
    let lengths: Vec<f64> = windows.iter().map(|w| w.path_m(truth)).collect();
    median(&lengths)
}
