//! Proof on drives that were not fitted: full rollouts of the bundle before, with the best soil alone, and with the effect.

use nesam_evaluation::{
    DriveMaps, EvaluationError, ModelName, ModelPaths, ModelScore, PosePath, Resamples, Truth, Window, WindowPredictor, all_windows,
    roll_out, score,
};
use nesam_model::{Predictor, Variant};
use nesam_physics::SoilCorrection;
use nesam_trajectories::Trajectory;
use rayon::prelude::*;

use nesam_physics::effects::ScheduledEffect;

use crate::proof::{Counted, counted};
use crate::work::Work;

/// What was learned without a drive, for that drive.
#[derive(Clone, Debug)]
pub struct Learned {
    /// Best soil correction without an effect; of a model on trial without a map none where predictions are no better on it.
    pub soil: SoilCorrection,
    /// Soil correction beside the effects; none where the ground is neither on trial nor another than the map shows.
    pub beside: SoilCorrection,
    /// Effects claimed; empty when nothing was.
    pub effects: Vec<ScheduledEffect>,
    /// Hypothesis of each of them, as its index in the catalogue.
    pub hypotheses: Vec<usize>,
}

impl Learned {
    /// The effects but for that of a hypothesis, and that one, if it was learned.
    pub fn apart(&self, hypothesis: usize) -> [Vec<ScheduledEffect>; 2] {
        let of = |own: bool| {
            let effects = self.effects.iter().zip(&self.hypotheses);
            effects.filter(|(_, h)| (**h == hypothesis) == own).map(|(effect, _)| *effect).collect()
        };
        [of(false), of(true)]
    }
}

/// Scores on the held-out drives.
#[derive(Clone, Debug)]
pub struct HeldOut {
    /// Before, soil only, after.
    pub scores: [ModelScore; 3],
    /// With each control, in the order of the diagnosis.
    pub controls: Vec<ModelScore>,
    /// Before and after on the windows that end before every claimed effect begins; `None` where none does.
    pub before_onset: Option<[ModelScore; 2]>,
    /// Draws behind the intervals.
    pub resamples: Resamples,
    /// Errors that prove or refute something.
    pub counted: Counted,
    /// Whether what was learned for a drive begins before its last window ends; true where nothing was learned.
    pub shows: Vec<bool>,
    /// Whether effects stand on a soil that was fitted beside them, since the ground is another than the map shows.
    pub another_ground: bool,
}

impl HeldOut {
    /// What effects must not make worse: the model before, or on another ground the model on that.
    pub(crate) fn base(&self) -> &ModelScore {
        &self.scores[usize::from(self.another_ground)]
    }

    /// As nothing is claimed, nothing is added: after is before, and there is no onset.
    pub(crate) fn add_nothing(&mut self) {
        self.scores[2] = self.scores[0].clone();
        self.before_onset = None;
    }
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

impl Scoring {
    /// All windows of some drives.
    ///
    /// # Errors
    /// `EvaluationError::NoWindows` when none fits.
    pub fn windows<'a>(&self, drives: &'a [Trajectory]) -> Result<Vec<Window<'a>>, EvaluationError> {
        all_windows(drives, self.horizon, self.history, Truth::Measured)
    }

    /// Draws of the bootstrap over so many drives.
    pub(crate) fn resamples_of(&self, drives: usize) -> Resamples {
        Resamples::draw(drives, self.resamples, self.seed)
    }
}

/// Rolls every window of the held-out drives out before, with the best soil, and after. `learned[i]` belongs to `drives[i]`.
///
/// # Errors
/// `EvaluationError::NoWindows` when no window fits; the first error of the model.
pub fn score_held_out(
    predictor: &Predictor,
    drives: &[Trajectory],
    maps: &DriveMaps,
    learned: &[Learned],
    scoring: &Scoring,
    work: &Work<'_>,
) -> Result<HeldOut, EvaluationError> {
    let windows = scoring.windows(drives)?;
    work.add(windows.len());
    let after: Vec<Predictor> = learned.iter().map(|l| predictor.with_effects(&l.effects)).collect();
    let paths: Vec<[PosePath; 3]> = windows
        .par_iter()
        .map(|w| {
            let map = maps[w.drive].as_ref();
            let with = |predictor: &Predictor, soil| roll_out(predictor, Variant::Full, soil, w, None, map);
            let before = with(predictor, SoilCorrection::NONE)?;
            let soil = with(predictor, learned[w.drive].soil)?;
            let (effects, beside) = (&learned[w.drive].effects, learned[w.drive].beside);
            let as_before = effects.is_empty() && beside == SoilCorrection::NONE;
            let after = if as_before { before.clone() } else { with(&after[w.drive], beside)? };
            work.done();
            Ok([before, soil, after])
        })
        .collect::<Result<_, EvaluationError>>()?;
    let resamples = scoring.resamples_of(drives.len());
    let of = |m: usize, chosen: &[usize]| {
        let windows: Vec<Window<'_>> = chosen.iter().map(|w| windows[*w]).collect();
        let paths = chosen.iter().map(|w| paths[*w][m].clone()).collect();
        let model = ModelPaths { name: ModelName::Nesam, parameters: predictor.bundle().parameters, paths };
        score(&model, &windows, Truth::Measured, &resamples)
    };
    let all: Vec<usize> = (0..windows.len()).collect();
    let early: Vec<usize> = all.iter().copied().filter(|w| ends_before_onset(&windows[*w], &learned[windows[*w].drive].effects)).collect();
    Ok(HeldOut {
        scores: core::array::from_fn(|m| of(m, &all)),
        controls: Vec::new(),
        before_onset: (!early.is_empty()).then(|| [of(0, &early), of(2, &early)]),
        resamples,
        counted: counted(maps),
        shows: shows(&windows, drives.len(), |d| &learned[d].effects),
        another_ground: false,
    })
}

/// Times the error of a vehicle that goes on as it begins, above which nobody may say that nothing is wrong (chosen).
const FAR_OFF: f64 = 2.0;

/// What is to be said of a model that errs to no side and is far off all the same, in position or yaw: more than twice as far as a vehicle that goes on as it begins.
pub(crate) fn far_off(scores: &HeldOut, drives: &[Trajectory], scoring: &Scoring) -> Option<String> {
    let windows = scoring.windows(drives).ok()?;
    let paths = windows.iter().map(|w| WindowPredictor::ConstantVelocity.predict(w, None)).collect::<Result<_, _>>().ok()?;
    let going_on =
        score(&ModelPaths { name: ModelName::ConstantVelocity, parameters: 0, paths }, &windows, Truth::Measured, &scores.resamples);
    let off = |score: &ModelScore| Some([score.summary.tree.position_m.mean?, score.summary.tree.mae_mean.yaw_deg?]);
    let ([position_m, yaw_deg], [on_m, on_deg]) = (off(&scores.scores[0])?, off(&going_on)?);
    let seconds = scoring.horizon as f64 * windows.first()?.trajectory.dt_s;
    (position_m > FAR_OFF * on_m || yaw_deg > FAR_OFF * on_deg).then(|| {
        format!(
            "; predictions over {seconds:.1} s are off by {position_m:.2} m and {yaw_deg:.1}° all the same, those of a vehicle that goes on as it begins by {on_m:.2} m and \
             {on_deg:.1}°: what is wrong these drives do not tell; are the signs and units of all columns right (`nesam check`), and are there enough drives?"
        )
    })
}

/// Any windows with a model and soil for each drive.
///
/// # Errors
/// The first error of the model.
pub fn score_models(
    windows: &[Window<'_>],
    maps: &DriveMaps,
    models: &[(&Predictor, SoilCorrection)],
    parameters: usize,
    resamples: &Resamples,
    work: &Work<'_>,
) -> Result<ModelScore, EvaluationError> {
    work.add(windows.len());
    let roll = |w: &Window<'_>| {
        let (predictor, soil) = models[w.drive];
        let path = roll_out(predictor, Variant::Full, soil, w, None, maps[w.drive].as_ref());
        work.done();
        path
    };
    let paths = windows.par_iter().map(roll).collect::<Result<_, _>>()?;
    Ok(score(&ModelPaths { name: ModelName::Nesam, parameters, paths }, windows, Truth::Measured, resamples))
}

/// Whether each of some drives has a window that does not end before all effects learned for it begin.
pub(crate) fn shows<'a>(windows: &[Window<'_>], drives: usize, effects: impl Fn(usize) -> &'a [ScheduledEffect]) -> Vec<bool> {
    (0..drives).map(|d| windows.iter().any(|w| w.drive == d && !ends_before_onset(w, effects(d)))).collect()
}

/// Whether a window ends before any of some effects begins.
fn ends_before_onset(window: &Window<'_>, effects: &[ScheduledEffect]) -> bool {
    let end_s = window.since_log_start_s() + window.horizon as f64 * window.trajectory.dt_s;
    !effects.is_empty() && effects.iter().all(|e| e.onset_s > end_s)
}
