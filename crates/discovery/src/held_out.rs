//! Proof on drives that were not fitted: full rollouts of the bundle before, with the best soil alone, and with the effect.

use nesam_evaluation::{
    DriveMaps, EvaluationError, ModelName, ModelPaths, ModelScore, PosePath, Resamples, Truth, all_windows, roll_out, score,
};
use nesam_model::{Predictor, Variant};
use nesam_physics::SoilCorrection;
use nesam_trajectories::Trajectory;
use rayon::prelude::*;

use nesam_physics::effects::ScheduledEffect;

/// What was learned without a drive, for that drive.
#[derive(Clone, Debug)]
pub struct Learned {
    /// Best soil correction without an effect.
    pub soil: SoilCorrection,
    /// Effects claimed; empty when nothing was.
    pub effects: Vec<ScheduledEffect>,
}

/// Scores on the held-out drives.
#[derive(Clone, Debug)]
pub struct HeldOut {
    /// Before, soil only, after.
    pub scores: [ModelScore; 3],
    /// Draws behind the intervals.
    pub resamples: Resamples,
}

/// How the rollouts are cut and scored.
#[derive(Clone, Copy, Debug)]
pub struct Scoring {
    /// Steps K.
    pub horizon: usize,
    /// Steps of history.
    pub history: usize,
    /// Bootstrap draws.
    pub resamples: usize,
    /// Seed of the bootstrap.
    pub seed: u64,
}

/// Rolls every window of the held-out drives out three times. `learned[i]` belongs to `drives[i]`.
///
/// # Errors
/// `EvaluationError::NoWindows` when no window fits; the first error of the model.
pub fn score_held_out(
    predictor: &Predictor,
    drives: &[Trajectory],
    maps: &DriveMaps,
    learned: &[Learned],
    scoring: &Scoring,
) -> Result<HeldOut, EvaluationError> {
    let windows = all_windows(drives, scoring.horizon, scoring.history, Truth::Measured)?;
    let patched: Vec<Predictor> = learned.iter().map(|l| predictor.with_effects(&l.effects)).collect();
    let paths: Vec<[PosePath; 3]> = windows
        .par_iter()
        .map(|w| {
            let map = maps[w.drive].as_ref();
            let with = |predictor: &Predictor, soil| roll_out(predictor, Variant::Full, soil, w, None, map);
            let before = with(predictor, SoilCorrection::NONE)?;
            let soil = with(predictor, learned[w.drive].soil)?;
            let after = if learned[w.drive].effects.is_empty() { before.clone() } else { with(&patched[w.drive], SoilCorrection::NONE)? };
            Ok([before, soil, after])
        })
        .collect::<Result<_, EvaluationError>>()?;
    let resamples = Resamples::draw(drives.len(), scoring.resamples, scoring.seed);
    let scores = core::array::from_fn(|m| {
        let paths = paths.iter().map(|p| p[m].clone()).collect();
        let model = ModelPaths { name: ModelName::Nesam, parameters: predictor.bundle().parameters, paths };
        score(&model, &windows, Truth::Measured, &resamples)
    });
    Ok(HeldOut { scores, resamples })
}
