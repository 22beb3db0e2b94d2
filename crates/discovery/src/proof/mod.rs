//! When predictions count as better: by errors of full rollouts, paired by drive, with intervals; and when measurements contradict one another less.

pub(crate) mod black_box;
pub mod controls;
pub(crate) mod free_form;
pub mod held_out;
pub(crate) mod proven;
pub(crate) mod ridge;

use std::borrow::Cow;

use nesam_evaluation::{
    DIMENSION_KEYS, DriveMaps, EvaluationError, ModelScore, POSE_DIM, Resamples, Window, WindowErrors, paired_difference, values,
};
use nesam_model::Predictor;
use nesam_physics::SoilCorrection;
use nesam_physics::effects::ScheduledEffect;
use nesam_trajectories::Trajectory;

use crate::observe::consistency::Contradictions;
use crate::proof::held_out::{HeldOut, Scoring, score_models, shows};
use crate::work::Work;

/// Most windows of a trial.
const WINDOWS_MAX: usize = 1000;
/// Share of an error by which it may rise without being counted (chosen).
pub(crate) const RISE_MIN: f64 = 0.02;
/// The same as a part of the largest share by which another error surely falls (chosen): what takes half of an error may cost twentieths of others.
const RISE_OF_FALL: f64 = 0.1;

/// Which errors prove or refute something, in the order of the dimensions, then the position.
pub type Counted = [bool; POSE_DIM + 1];

/// Errors that count on drives with these maps. Where one has none, height, roll and pitch tell of the ground and not of the vehicle, as in
/// [`available`](crate::observe::channels::available).
pub fn counted(maps: &DriveMaps) -> Counted {
    let mapped = maps.iter().all(Option::is_some);
    [true, true, mapped, mapped, mapped, true, true]
}

/// Why effects are not proven on held-out drives; `None` where they are. With a least gain an error has to fall surely by that share of itself, against the best soil
/// alone and against the model before, which errors of one drive cannot show. Effects that `each` proved themselves beside the others may cancel in part: the model
/// before is then no measure of what they explain, and must only not be surely better. On another ground it is the model on that ground.
pub fn not_proven(scores: &HeldOut, least_gain: Option<f64>, each: bool) -> Option<String> {
    const WHERE: &str = "on drives that were not fitted";
    let [before, soil, after] = &scores.scores;
    if least_gain.is_some() && !several_scored(&after.errors) {
        return Some("only one drive that was left out can be scored, which proves nothing: leave out two or more".into());
    }
    if least_gain.is_some() && !several_show(scores) {
        return Some(
            "what was found shows in one of the drives that were left out alone, which proves nothing: leave out two in which it shows"
                .into(),
        );
    }
    let against = [soil, before].into_iter().take(if each { 1 } else { 2 });
    for (against, gain) in against.filter_map(|score| Some((score, least_gain?))) {
        if !falls_surely(against, after, gain, scores.counted, &scores.resamples, &scores.shows) {
            let share = if gain > 0.0 { format!(" by {:.0} %", 100.0 * gain) } else { String::new() };
            return Some(format!("no error falls surely{share} {WHERE}"));
        }
    }
    rises_surely(scores.base(), after, scores.counted, &scores.resamples, &scores.shows)
        .map(|Rise { name, from, by, .. }| format!("the error of {name} rises surely {WHERE}, from {from} by {by}"))
}

/// Whether more than one drive has windows.
pub(crate) fn several_scored(errors: &WindowErrors) -> bool {
    let scored = &errors.trajectory;
    scored.iter().any(|d| Some(d) != scored.first())
}

/// Whether what was learned shows in more than one drive that has windows.
pub(crate) fn several_show(scores: &HeldOut) -> bool {
    several_scored(&telling(&scores.scores[2].errors, &scores.shows))
}

/// The errors on drives in which what was learned shows. One that ends before every effect begins is predicted alike to the bit with them and without: it says nothing,
/// and drawn often enough it would keep any fall from being sure.
fn telling<'a>(errors: &'a WindowErrors, shows: &[bool]) -> Cow<'a, WindowErrors> {
    if errors.trajectory.iter().all(|d| shows[*d]) {
        return Cow::Borrowed(errors);
    }
    Cow::Owned(errors.filter(|w| shows[errors.trajectory[w]]))
}

/// Whether an error that counts surely falls by at least a share of itself, on the drives in which it could.
pub(crate) fn falls_surely(
    before: &ModelScore,
    after: &ModelScore,
    gain: f64,
    counted: Counted,
    resamples: &Resamples,
    shows: &[bool],
) -> bool {
    let [before, after] = [before, after].map(|score| telling(&score.errors, shows));
    let (_, interval) = paired_difference(&before, &after, resamples);
    let falls = |(interval, error): (Option<[f64; 2]>, Option<f64>)| error.is_some_and(|error| sure_fall(interval, error, gain));
    counting(interval.row(false).into_iter().zip(values(&before).row(false)), counted).any(falls)
}

/// Whether an error that counts falls by at least a share of itself, in the mean.
pub(crate) fn falls(before: &ModelScore, after: &ModelScore, gain: f64, counted: Counted) -> bool {
    let [before, after] = [before, after].map(|score| counting(values(&score.errors).row(false).into_iter(), counted).collect::<Vec<_>>());
    before.into_iter().zip(after).any(|pair| matches!(pair, (Some(before), Some(after)) if before - after >= gain * before))
}

/// Whether a fall with this interval is sure, and at least this share of what falls.
pub(crate) fn sure_fall(interval: Option<[f64; 2]>, of: f64, gain: f64) -> bool {
    interval.is_some_and(|[low, _]| low > 0.0 && low >= gain * of)
}

/// The errors that count.
fn counting<T>(errors: impl Iterator<Item = T>, counted: Counted) -> impl Iterator<Item = T> {
    errors.zip(counted).filter_map(|(error, counts)| counts.then_some(error))
}

/// An error that surely rises.
#[derive(Clone, Debug)]
pub(crate) struct Rise {
    /// Its place among the errors.
    pub dimension: usize,
    /// Its name.
    pub name: &'static str,
    /// Where it rises from.
    pub from: String,
    /// By how much.
    pub by: String,
}

/// The first error that counts and surely rises, and by more than is negligible beside what falls.
pub(crate) fn rises_surely(
    before: &ModelScore,
    after: &ModelScore,
    counted: Counted,
    resamples: &Resamples,
    shows: &[bool],
) -> Option<Rise> {
    let [before, after] = [before, after].map(|score| telling(&score.errors, shows));
    let (difference, interval) = paired_difference(&after, &before, resamples);
    let names = DIMENSION_KEYS.iter().copied().chain(["position_m"]).enumerate();
    let rows = difference.row(false).into_iter().zip(interval.row(false)).zip(values(&before).row(false));
    let rows: Vec<_> = counting(rows.zip(names), counted).collect();
    let falls = rows.iter().filter_map(|(((_, interval), before), _)| Some(-(*interval)?[1] / (*before)?));
    let least = RISE_MIN.max(RISE_OF_FALL * falls.fold(0.0, f64::max));
    rows.into_iter().find_map(|(((d, i), b), (dimension, name))| match (d, i, b) {
        (Some(d), Some([low, _]), Some(b)) if low > 0.0 && d > least * b => {
            Some(Rise { dimension, name, from: format!("{b:.4}"), by: format!("{d:.4}") })
        }
        _ => None,
    })
}

/// Drives on which an effect that stands out is tried before others are sought beside it: those that are fitted.
#[derive(Clone, Copy, Debug)]
pub struct Trial<'a> {
    /// The model without effects.
    pub predictor: &'a Predictor,
    /// Drives as measured.
    pub drives: &'a [Trajectory],
    /// Their maps.
    pub maps: &'a DriveMaps,
    /// Rollouts.
    pub scoring: &'a Scoring,
    /// Who is told how far they are.
    pub work: &'a Work<'a>,
}

impl Trial<'_> {
    /// Why predictions of these drives are not better with the second effects, on the second ground, than with the first; `None` where they are. Where `sensors_tell` they must only not be
    /// surely worse.
    ///
    /// # Errors
    /// `EvaluationError::NoWindows` when no window fits; the first error of the model.
    pub fn no_better(
        &self,
        without: (&[ScheduledEffect], &SoilCorrection),
        with: (&[ScheduledEffect], &SoilCorrection),
        sensors_tell: bool,
    ) -> Result<Option<String>, EvaluationError> {
        let windows = self.scoring.windows(self.drives)?;
        let every = windows.len().div_ceil(WINDOWS_MAX);
        let windows: Vec<Window<'_>> = windows.into_iter().step_by(every).collect();
        let (resamples, counted) = (self.resamples(), counted(self.maps));
        let scored = |(effects, ground): (&[ScheduledEffect], &SoilCorrection)| {
            let predictor = self.predictor.with_effects(effects);
            let models = vec![(&predictor, *ground); self.drives.len()];
            score_models(&windows, self.maps, &models, 0, &resamples, self.work)
        };
        let (before, after) = (scored(without)?, scored(with)?);
        let shows = shows(&windows, self.drives.len(), |_| with.0);
        if !sensors_tell && !falls_surely(&before, &after, 0.0, counted, &resamples, &shows) {
            return Ok(Some("no error of predictions of the fitted drives falls surely with it".into()));
        }
        let told = |Rise { name, from, by, .. }: Rise| {
            format!("the error of {name} of predictions of the fitted drives rises surely with it, from {from} by {by}")
        };
        Ok(rises_surely(&before, &after, counted, &resamples, &shows).map(told))
    }

    /// Whether predictions of these drives are better on the second ground than on the first, which drives without a window cannot say.
    ///
    /// # Errors
    /// The first error of the model.
    pub(crate) fn ground_is_better(
        &self,
        before: (&[ScheduledEffect], &SoilCorrection),
        after: (&[ScheduledEffect], &SoilCorrection),
    ) -> Result<bool, EvaluationError> {
        Ok(self.scoring.windows(self.drives).is_ok() && self.no_better(before, after, false)?.is_none())
    }

    /// Channels in which measurements contradict one another otherwise with the second effects than with the first, if they surely do less; else none.
    pub(crate) fn agreeing(&self, without: &[ScheduledEffect], with: &[ScheduledEffect]) -> Vec<usize> {
        let vehicle = &self.predictor.bundle().vehicle;
        let [before, after] = [without, with].map(|effects| Contradictions::of(vehicle, self.drives, |_| effects));
        if before.fall_surely(&after, 0.0, &self.resamples()) { before.changed(&after) } else { Vec::new() }
    }

    fn resamples(&self) -> Resamples {
        self.scoring.resamples_of(self.drives.len())
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use nesam_evaluation::{ModelName, StepError, summarise};

    use super::*;

    /// Scores of six drives of one window with these errors.
    pub(crate) fn score(absolute: [f64; POSE_DIM]) -> ModelScore {
        let drives = 6;
        let errors = WindowErrors {
            horizon: 1,
            scored: [true; POSE_DIM],
            trajectory: (0..drives).collect(),
            path_m: vec![5.0; drives],
            steps: vec![StepError { absolute, position_m: absolute[0] }; drives],
            broken: vec![false; drives],
        };
        let summary = summarise(&errors, &Resamples::draw(drives, 50, 1));
        ModelScore { name: ModelName::Nesam, parameters: 0, summary, errors, curves: core::array::from_fn(|_| None) }
    }

    /// Goal: without a map the tilt of the ground neither proves nor refutes. Method: errors by hand; in one case yaw falls and pitch rises, in the other pitch alone falls.
    #[test]
    fn analytic_height_roll_and_pitch_count_on_a_map_only() {
        let flat = counted(&[None, None]);
        assert_eq!(flat, [true, true, false, false, false, true, true]);
        let proof = |after: [f64; POSE_DIM], counted: Counted| {
            let before = [0.1, 0.1, 0.1, 0.8, 0.8, 20.0];
            let scores = HeldOut {
                scores: [before, before, after].map(score),
                controls: Vec::new(),
                before_onset: None,
                resamples: Resamples::draw(6, 50, 1),
                counted,
                shows: vec![true; 6],
                another_ground: false,
            };
            not_proven(&scores, Some(0.1), false)
        };
        let all = counted(&[]);
        assert_eq!(all, [true; POSE_DIM + 1]);
        let limit = [0.1, 0.1, 0.1, 0.8, 0.88, 10.0];
        assert_eq!(proof(limit, flat), None);
        assert!(proof(limit, all).is_some_and(|why| why.contains("pitch_deg rises surely")));
        let tilt = [0.1, 0.1, 0.1, 0.8, 0.4, 20.0];
        assert!(proof(tilt, flat).is_some_and(|why| why.contains("no error falls surely")));
        assert_eq!(proof(tilt, all), None);
    }

    /// Goal: a small rise does not refute what takes half of another error, and does where nothing falls as much. Method: errors by hand; yaw falls by a half or a fifth while y rises
    /// by 4 %, and y rises by 8 %.
    #[test]
    fn analytic_a_rise_counts_beside_what_falls() {
        let before = [0.1, 0.1, 0.1, 0.8, 0.8, 20.0];
        let rises = |y: f64, yaw: f64| {
            let after = [0.1, y, 0.1, 0.8, 0.8, yaw];
            let rise = rises_surely(&score(before), &score(after), counted(&[]), &Resamples::draw(6, 50, 1), &[true; 6]);
            rise.map(|rise| rise.name)
        };
        assert_eq!([rises(0.104, 10.0), rises(0.104, 16.0), rises(0.108, 10.0)], [None, Some("y_m"), Some("y_m")]);
    }

    /// Goal: drives that end before an effect begins do not keep its proof from being sure. Method: six drives, of which yaw falls in two and nothing in four, which no
    /// interval over all six takes for sure; then those four are known to end before.
    #[test]
    fn analytic_drives_in_which_nothing_has_begun_prove_nothing() {
        let before = [0.1, 0.1, 0.1, 0.8, 0.8, 20.0];
        let mut after = score(before);
        for step in &mut after.errors.steps[..2] {
            step.absolute[5] = 10.0;
        }
        let proof = |shows: Vec<bool>| {
            let (scores, counted) = ([score(before), score(before), after.clone()], counted(&[]));
            let resamples = Resamples::draw(6, 500, 1);
            not_proven(
                &HeldOut { scores, controls: Vec::new(), before_onset: None, resamples, counted, shows, another_ground: false },
                Some(0.0),
                false,
            )
        };
        let two = [[true; 2].to_vec(), vec![false; 4]].concat();
        assert!(proof(vec![true; 6]).is_some_and(|why| why.contains("no error falls surely")));
        assert_eq!(proof(two), None);
        let one = [vec![true], vec![false; 5]].concat();
        assert!(proof(one).is_some_and(|why| why.contains("in one of the drives")));
        after.errors.trajectory.fill(0);
        let (scores, counted) = ([score(before), score(before), after.clone()], counted(&[]));
        let resamples = Resamples::draw(6, 50, 1);
        let alone =
            HeldOut { scores, controls: Vec::new(), before_onset: None, resamples, counted, shows: vec![true; 6], another_ground: false };
        assert!(not_proven(&alone, Some(0.0), false).is_some_and(|why| why.contains("proves nothing: leave out two or more")));
    }
}
