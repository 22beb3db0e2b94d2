//! What drives that were not fitted are predicted with, and whether that proves a judgement.

use nesam_evaluation::{DriveMaps, EvaluationError, ModelScore, Resamples};
use nesam_model::Predictor;
use nesam_physics::SoilCorrection;
use nesam_physics::effects::{Layer, ScheduledEffect};
use nesam_trajectories::Trajectory;

use crate::claims::{Case, Finding};
use crate::diagnose::Options;
use crate::drive_line::DriveLine;
use crate::ground::Ground;
use crate::judgement::{Judgement, Verdict, judge, together};
use crate::observe::condense::best_soil;
use crate::observe::consistency::Contradictions;
use crate::proof::held_out::{HeldOut, Learned, score_held_out, score_models, shows};
use crate::proof::{Counted, Rise, falls, falls_surely, not_proven, rises_surely, several_scored, several_show};
use crate::select::Yardstick;
use crate::work::Work;

/// Share by which an error on held-out drives must surely fall where the model itself is on trial (chosen). A model of a new vehicle is wrong in many ways at
/// once, and evidence by the scatter of the judged drives themselves saturates; what is left is therefore no measure of what was explained there.
const GAIN_ON_TRIAL: f64 = 0.1;
/// Evidence, in thresholds, from which an effect is claimed where no drive is left to prove it on (chosen).
const WITHOUT_PROOF: f64 = 2.5;

/// Most effects that a proof may refute one after the other (chosen): those that resemble a sensor that is mounted askew are five.
const REFUTED_MAX: usize = 5;

/// Drives that are predicted to prove a judgement.
#[derive(Clone, Copy, Debug)]
pub(crate) struct HeldDrives<'a> {
    /// The model without effects.
    pub predictor: &'a Predictor,
    /// What wheel speeds tell of the drive line: part of whatever is claimed.
    pub told: &'a DriveLine,
    /// The drives.
    pub drives: &'a [Trajectory],
    /// Their maps.
    pub maps: &'a DriveMaps,
    /// What the command line says.
    pub options: &'a Options,
    /// Whether they are those that were fitted: each is predicted with what the others teach.
    pub fitted: bool,
    /// Who is told how far predictions are.
    pub work: &'a Work<'a>,
}

/// A judgement with what held-out drives say of it.
#[derive(Debug)]
pub(crate) struct Proven {
    /// The judgement, without the claims that were not needed.
    pub judgement: Judgement,
    /// What each held-out drive was predicted with.
    pub learned: Vec<Learned>,
    /// What all fitted drives teach together, proven or not.
    pub taught: Learned,
    /// Scores; `None` when no drive is held out.
    pub scores: Option<HeldOut>,
    /// Verdict after the proof.
    pub verdict: Verdict,
    /// Why.
    pub reason: String,
}

/// Predicts held-out drives with what is claimed. Where an error surely rises by one of the claims, the drives are judged again without that effect: what resembles the
/// true one may explain as much of them and predicts worse. What then proves itself stands if it leaves no more. `fewer` judges one drive less than were fitted. The case is
/// that of the judgement that comes out.
///
/// # Errors
/// Those of the model.
pub(crate) fn prove(
    case: &mut Case<'_>,
    yardstick: &Yardstick,
    fewer: &Yardstick,
    judgement: Judgement,
    held: &HeldDrives<'_>,
) -> Result<Proven, EvaluationError> {
    let mut first = tried(case, yardstick, fewer, judgement, held)?;
    if yardstick.model_on_trial {
        // What wheel speeds tell may be proven where what was found beside it is not.
        let with_more = !held.told.is_empty() && !first.verdict.claims() && first.judgement.verdict.claims();
        return if with_more { of_rims_alone(case, yardstick, fewer, first, held) } else { Ok(first) };
    }
    let mut worse = worsening(case, &first, held)?;
    if worse.is_none() {
        return Ok(first);
    }
    let mut refuted: Vec<Finding> = Vec::new();
    let (mut again, mut yardstick, mut fewer) = (case.clone(), yardstick.clone(), fewer.clone());
    let admitted = first.judgement.selection.remaining.0.max(yardstick.threshold());
    while let Some(finding) = worse.filter(|_| refuted.len() < REFUTED_MAX) {
        for judging in [&mut yardstick, &mut fewer] {
            judging.withheld.push(finding.hypothesis);
        }
        refuted.push(finding);
        again.forget_onsets();
        let judgement = judge(&mut again, &yardstick);
        let mut next = tried(&again, &yardstick, &fewer, judgement, held)?;
        if next.verdict.claims() && next.judgement.selection.remaining.0 <= admitted {
            next.judgement.findings.extend(refuted);
            *case = again;
            return Ok(next);
        }
        worse = worsening(&again, &next, held)?;
    }
    // What was refuted first is among the claims of the first judgement, which says so for each of them.
    if let Some(own) = refuted.first() {
        first.judgement.findings.iter_mut().filter(|f| f.hypothesis == own.hypothesis).for_each(|f| f.refused.clone_from(&own.refused));
    }
    Ok(first)
}

/// A judgement that is not proven without its claims, if what wheel speeds tell is proven by itself; else as it was.
fn of_rims_alone(
    case: &Case<'_>,
    yardstick: &Yardstick,
    fewer: &Yardstick,
    first: Proven,
    held: &HeldDrives<'_>,
) -> Result<Proven, EvaluationError> {
    let own: Vec<&Finding> = first.judgement.claimed().into_iter().map(|i| &first.judgement.findings[i]).collect();
    let said = format!("{} would fit and is not proven", labels(&own));
    let judgement = first.judgement.unproven(&first.reason, said);
    let alone = tried(case, yardstick, fewer, judgement, held)?;
    Ok(if alone.verdict.claims() { alone } else { Proven { judgement: alone.judgement, ..first } })
}

/// The claim by which an error of a judgement that is not proven surely rises, refused for that: the only one, or the last of several without which that error is surely
/// smaller and surely rises no more. `None` where no error rises, or that of none of them.
fn worsening(case: &Case<'_>, proven: &Proven, held: &HeldDrives<'_>) -> Result<Option<Finding>, EvaluationError> {
    let (judgement, claimed) = (&proven.judgement, proven.judgement.claimed());
    let Some(scores) = proven.scores.as_ref().filter(|_| !proven.verdict.claims() && !claimed.is_empty()) else { return Ok(None) };
    let (before, [_, _, after]) = (scores.base(), &scores.scores);
    let rises =
        |from: &ModelScore, to: &ModelScore, counted: Counted, shows: &[bool]| rises_surely(from, to, counted, &scores.resamples, shows);
    let Some(risen) = rises(before, after, scores.counted, &scores.shows) else { return Ok(None) };
    let refuted = |i: usize| {
        let Rise { name, from, by, .. } = &risen;
        let refused = Some(format!("the error of {name} rises surely with it on drives that were not fitted, from {from} by {by}"));
        Finding { refused, ..judgement.findings[i].clone() }
    };
    if let [only] = claimed[..] {
        return Ok(Some(refuted(only)));
    }
    let same = core::array::from_fn(|dimension| dimension == risen.dimension);
    for i in claimed.into_iter().rev() {
        let (without, shows) = held.without(case, judgement.findings[i].hypothesis, (&proven.learned, &proven.taught), scores)?;
        if rises(&without, after, same, &shows).is_some() && rises(before, &without, same, &scores.shows).is_none() {
            return Ok(Some(refuted(i)));
        }
    }
    Ok(None)
}

/// Predicts held-out drives with what a judgement claims. Of several claims, one that the others do as well without is dropped; they are sized again and have to prove
/// themselves again.
fn tried(
    case: &Case<'_>,
    yardstick: &Yardstick,
    fewer: &Yardstick,
    mut judgement: Judgement,
    held: &HeldDrives<'_>,
) -> Result<Proven, EvaluationError> {
    let HeldDrives { predictor, drives, maps, options, work, .. } = *held;
    loop {
        let mut taught = learned_by_all(case, &judgement, held.told);
        let mut learned = match drives.len() {
            count if !held.fitted => vec![taught.clone(); count],
            0 => Vec::new(),
            _ => leave_each_out(fewer, case, &judgement, held.told),
        };
        if yardstick.model_on_trial
            && let Some(i) = held.last_contradicted(&judgement, &learned)
        {
            let why = "measurements of drives that were not fitted contradict one another no less with it";
            judgement = judgement.dropping(case, yardstick, i, why.into());
            continue;
        }
        let score = |learned: &[Learned]| score_held_out(predictor, drives, maps, learned, &options.scoring, work);
        let mut scores = if drives.is_empty() { None } else { Some(score(&learned)?) };
        // What a sensor or the map is wrong by is no matter of the soil. Where no map tells the ground it was found before, and effects stand on it.
        let acting = judgement.claimed().into_iter().any(|i| acts(&judgement.findings[i]));
        if case.bench.ground == SoilCorrection::NONE && acting && scores.as_ref().is_some_and(ground_may_be_another) {
            held.seek_ground(case, &mut learned, &mut taught);
            held.stand_on_ground(case, &mut learned, &mut taught);
            scores = Some(HeldOut { another_ground: true, ..score(&learned)? });
        }
        let needless = match &scores {
            Some(scores) => {
                last_needless(&judgement, held.told, scores, |hypothesis| held.without(case, hypothesis, (&learned, &taught), scores))?
            }
            None => None,
        };
        let Some(i) = needless else {
            let agree = || scores.as_ref().is_some_and(|scores| held.sensors_agree(&learned, scores));
            let (verdict, reason) = proven(&judgement, held.told, scores.as_ref(), yardstick.model_on_trial, agree);
            return Ok(Proven { judgement, learned, taught, scores, verdict, reason });
        };
        let why = "no error falls surely with it beside the others on drives that were not fitted";
        judgement = judgement.dropping(case, yardstick, i, why.into());
    }
}

impl<'a> HeldDrives<'a> {
    /// The fitted drives in the place of others, each predicted with what the others teach; none of them where one is alone or none holds a window, as pieces of a few
    /// seconds.
    pub(crate) fn among_fitted(self, drives: &'a [Trajectory], maps: &'a DriveMaps) -> Self {
        let usable = drives.len() > 1 && self.options.scoring.windows(drives).is_ok();
        Self { drives: if usable { drives } else { &[] }, maps, fitted: true, ..self }
    }

    /// The ground beside effects, where the ground is on trial too and there are effects, these or those of the drive line.
    fn ground(case: &Case<'_>, effects: &[ScheduledEffect], told: &DriveLine) -> Option<Ground> {
        let any = !effects.is_empty() || !told.is_empty();
        (case.bench.ground != SoilCorrection::NONE && any).then(|| Ground::beside(case, effects))
    }

    /// Score of the drives with a model for each.
    pub(crate) fn score(
        &self,
        models: &[(&Predictor, SoilCorrection)],
        parameters: usize,
        resamples: &Resamples,
    ) -> Result<ModelScore, EvaluationError> {
        let windows = self.options.scoring.windows(self.drives)?;
        score_models(&windows, self.maps, models, parameters, resamples, self.work)
    }

    /// Whether the measurements of the drives surely contradict one another less, by a share as errors of predictions must fall, with what was learned.
    fn sensors_agree(&self, learned: &[Learned], scores: &HeldOut) -> bool {
        let vehicle = &self.predictor.bundle().vehicle;
        let before = Contradictions::of(vehicle, self.drives, |_| &[]);
        let after = Contradictions::of(vehicle, self.drives, |d| learned[d].effects.as_slice());
        before.fall_surely(&after, GAIN_ON_TRIAL, &scores.resamples)
    }

    /// Position of the last claimed sensor that the measurements of the drives can tell of and do not: with it beside the other claims they do not surely contradict one
    /// another less. Predictions of a wrong model gain by it as by anything else that bends them.
    fn last_contradicted(&self, judgement: &Judgement, learned: &[Learned]) -> Option<usize> {
        let is_sensor = |i: &usize| judgement.findings[*i].candidate.layer() == Layer::Sensor;
        let sensors: Vec<usize> = judgement.claimed().into_iter().rev().filter(is_sensor).collect();
        if sensors.is_empty() || self.drives.is_empty() {
            return None;
        }
        let resamples = self.options.scoring.resamples_of(self.drives.len());
        let vehicle = &self.predictor.bundle().vehicle;
        let with = Contradictions::of(vehicle, self.drives, |d| learned[d].effects.as_slice());
        let speaks_against = |i: &usize| {
            let hypothesis = judgement.findings[*i].hypothesis;
            let others: Vec<Vec<ScheduledEffect>> = learned
                .iter()
                .map(|own| {
                    let [others, _] = own.apart(hypothesis);
                    others
                })
                .collect();
            let without = Contradictions::of(vehicle, self.drives, |d| others[d].as_slice());
            !without.changed(&with).is_empty() && !without.fall_surely(&with, 0.0, &resamples)
        };
        sensors.into_iter().find(speaks_against)
    }

    /// Fits the best soil without an effect through the physics, as the one beside effects is: what is compared with it must not be better for that.
    fn seek_ground(&self, case: &Case<'_>, learned: &mut [Learned], taught: &mut Learned) {
        let ground = Ground::beside(case, &[]);
        taught.soil = ground.correction();
        for (d, own) in learned.iter_mut().enumerate() {
            own.soil = self.told_of(&ground, d);
        }
    }

    /// The soil that a drive is predicted on: by the others, if it is one of the fitted.
    fn told_of(&self, ground: &Ground, drive: usize) -> SoilCorrection {
        if self.fitted { ground.correction_without(drive) } else { ground.correction() }
    }

    /// Fits a soil to the drives of a case beside what they taught, on which each drive is predicted with what the others say of it. Where nothing was learned for a drive
    /// that is the best soil alone.
    fn stand_on_ground(&self, case: &Case<'_>, learned: &mut [Learned], taught: &mut Learned) {
        let ground = Ground::beside(case, &taught.effects);
        taught.beside = ground.correction();
        for (d, own) in learned.iter_mut().enumerate() {
            own.beside = if own.effects.is_empty() { own.soil } else { self.told_of(&ground, d) };
        }
    }

    /// Score of the drives with what was learned but for a hypothesis, and in which of them that one shows. On another ground the soil is fitted again, as it makes up
    /// for what is missing.
    fn without(
        &self,
        case: &Case<'_>,
        hypothesis: usize,
        (learned, taught): (&[Learned], &Learned),
        scores: &HeldOut,
    ) -> Result<(ModelScore, Vec<bool>), EvaluationError> {
        let apart: Vec<_> = learned.iter().map(|l| l.apart(hypothesis)).collect();
        let but = |own: &Learned| {
            let [effects, _] = own.apart(hypothesis);
            Learned { effects, ..own.clone() }
        };
        let mut others: Vec<Learned> = learned.iter().map(but).collect();
        if scores.another_ground {
            self.stand_on_ground(case, &mut others, &mut but(taught));
        }
        let predictors: Vec<Predictor> = others.iter().map(|l| self.predictor.with_effects(&l.effects)).collect();
        let models: Vec<(&Predictor, SoilCorrection)> = predictors.iter().zip(&others).map(|(p, l)| (p, l.beside)).collect();
        let score = self.score(&models, scores.scores[2].parameters, &scores.resamples)?;
        let windows = self.options.scoring.windows(self.drives)?;
        Ok((score, shows(&windows, self.drives.len(), |d| &apart[d][1])))
    }
}

/// Position of the last of several claims that changes how the vehicle moves and without which no error is surely larger; `without` scores the drives with all others,
/// and says in which it shows.
fn last_needless<E>(
    judgement: &Judgement,
    told: &DriveLine,
    scores: &HeldOut,
    without: impl Fn(usize) -> Result<(ModelScore, Vec<bool>), E>,
) -> Result<Option<usize>, E> {
    let claimed = judgement.claimed();
    if claimed.len() + told.findings.len() < 2 || !several_scored(&scores.scores[2].errors) {
        return Ok(None);
    }
    for i in claimed.into_iter().rev().filter(|i| acts(&judgement.findings[*i])) {
        let (without, shows) = without(judgement.findings[i].hypothesis)?;
        if !falls_surely(&without, &scores.scores[2], 0.0, scores.counted, &scores.resamples, &shows) {
            return Ok(Some(i));
        }
    }
    Ok(None)
}

/// What all fitted drives teach together.
fn learned_by_all(case: &Case<'_>, judgement: &Judgement, told: &DriveLine) -> Learned {
    let own: Vec<ScheduledEffect> = judgement.fit.as_ref().map_or_else(Vec::new, |f| keep(judgement, f.effects()));
    let beside = HeldDrives::ground(case, &own, told).map_or(SoilCorrection::NONE, |ground| ground.correction());
    let effects = told.effects.iter().copied().chain(own).collect();
    let hypotheses = told.hypotheses().into_iter().chain(keep(judgement, judgement.selection.chosen.clone())).collect();
    let soil = case.ground_alone.as_ref().map_or_else(|| best_soil(case.condensed()), Ground::correction);
    Learned { soil, beside, effects, hypotheses }
}

/// The fitted effects that are claimed.
pub(crate) fn keep<T: Clone>(judgement: &Judgement, effects: Vec<T>) -> Vec<T> {
    judgement.claimed().iter().filter_map(|i| effects.get(*i).cloned()).collect()
}

/// What each drive is predicted with: learned without it. Detection and choice follow from the other drives alone, the size from one step of the whole fit.
/// What was compared through the physics on all drives is compared in the same way on the others ([`Settled::stands`](crate::select::settled::Settled::stands)).
fn leave_each_out(yardstick: &Yardstick, case: &Case<'_>, judgement: &Judgement, told: &DriveLine) -> Vec<Learned> {
    let own = judgement.fit.as_ref().map_or_else(Vec::new, |f| keep(judgement, f.effects()));
    let ground = HeldDrives::ground(case, &own, told);
    (0..case.prepared.len())
        .map(|left_out| {
            let inside = |d: usize| d != left_out;
            let others = || (0..case.prepared.len()).filter(|d| inside(*d)).map(|d| &case.prepared[d].condensed);
            let alone = case.ground_alone.as_ref().map(|ground| ground.correction_without(left_out));
            let soil = alone.unwrap_or_else(|| best_soil(others()));
            let group = yardstick.group(others());
            let chosen = yardstick.select(&group).chosen;
            let stands = |i: usize| {
                let named = judgement.findings[i].hypothesis;
                let settled = judgement.settled.get(i).and_then(Option::as_ref);
                chosen.contains(&named) || settled.is_some_and(|s| s.stands(yardstick, &chosen, &group, inside, |h| h == named))
            };
            let without = judgement.fit.as_ref().map_or_else(Vec::new, |fit| fit.effects_without(left_out));
            let stood = judgement.claimed().into_iter().filter(|i| stands(*i));
            let of_rims = told.effects_without(left_out).into_iter().zip(told.hypotheses());
            let own = stood.filter_map(|i| Some((*without.get(i)?, judgement.findings[i].hypothesis)));
            let (effects, hypotheses) = of_rims.chain(own).unzip();
            let beside = ground.as_ref().map_or(SoilCorrection::NONE, |ground| ground.correction_without(left_out));
            Learned { soil, beside, effects, hypotheses }
        })
        .collect()
}

/// Verdict after the proof on held-out drives. `sensors_agree` says whether their measurements surely contradict one another less with what is claimed.
fn proven(
    judgement: &Judgement,
    told: &DriveLine,
    scores: Option<&HeldOut>,
    model_on_trial: bool,
    sensors_agree: impl FnOnce() -> bool,
) -> (Verdict, String) {
    let own: Vec<&Finding> = judgement.claimed().into_iter().map(|i| &judgement.findings[i]).collect();
    let claimed: Vec<&Finding> = told.findings.iter().chain(own.iter().copied()).collect();
    let (verdict, reason) = told.said_with(judgement);
    if claimed.is_empty() {
        return (verdict, reason);
    }
    let fits = if claimed.len() > 1 { "fit" } else { "fits" };
    let refused = |why: String| (Verdict::Unexplained, format!("{} {fits}, but {why}", labels(&claimed)));
    let Some(scores) = scores else {
        let stands = !model_on_trial && beyond_doubt(&claimed, judgement.selection.threshold);
        return if stands { (verdict, reason) } else { refused("no drive is left to prove it on".into()) };
    };
    // Predictions hardly hang on a sensor that measurements speak against: a gyro's bias is gone from them after the first step.
    let sensors = model_on_trial && !own.is_empty() && own.iter().all(|f| f.candidate.layer() == Layer::Sensor);
    let agree = sensors && sensors_agree();
    if sensors && !agree && !told.is_empty() {
        return refused(format!("with {} measurements of drives that were not fitted contradict one another no less", labels(&own)));
    }
    let agree = agree && told.is_empty();
    let must_help = model_on_trial && !agree || claimed.iter().any(|f| acts(f));
    let least_gain = must_help.then_some(if model_on_trial { GAIN_ON_TRIAL } else { 0.0 });
    if let Some(why) = not_proven(scores, least_gain, claimed.len() > 1 && !model_on_trial) {
        return refused(why);
    }
    let helps = if must_help {
        "; it helps on drives that were not fitted"
    } else if agree {
        "; with it the measurements of drives that were not fitted contradict one another less"
    } else {
        ""
    };
    let more = if model_on_trial && judgement.verdict.claims() { format!(", and {}", left(judgement)) } else { String::new() };
    (verdict, format!("{reason}{helps}{more}"))
}

/// What findings are of, in words.
fn labels(findings: &[&Finding]) -> String {
    together(&findings.iter().map(|f| f.candidate.label()).collect::<Vec<_>>())
}

/// What drives beside those that were fitted say of a proven judgement, and of what wheel speeds told.
pub(crate) fn said_by_others(judgement: &Judgement, told: &DriveLine, model_on_trial: bool, scores: &HeldOut) -> String {
    let claimed: Vec<&Finding> = judgement.claimed().iter().map(|i| &judgement.findings[*i]).collect();
    if !several_show(scores) {
        return "; the other drives are too few to say".into();
    }
    let least_gain = (!told.is_empty() || claimed.iter().any(|f| acts(f))).then_some(0.0);
    match not_proven(scores, least_gain, claimed.len() > 1 && !model_on_trial) {
        Some(why) => format!("; the other drives do not bear it out: {why}"),
        None if least_gain.is_some() => "; so it does on the other drives".into(),
        None => "; no error of the other drives surely rises".into(),
    }
}

/// Whether another soil alone makes predictions surely better, by a tenth.
fn ground_is_another(scores: &HeldOut) -> bool {
    let ([before, soil, _], shows) = (&scores.scores, vec![true; scores.shows.len()]);
    falls_surely(before, soil, GAIN_ON_TRIAL, scores.counted, &scores.resamples, &shows)
}

/// Whether another soil alone makes predictions better by a tenth in the mean, sure or not: what is compared with it stands on a soil of its own then.
fn ground_may_be_another(scores: &HeldOut) -> bool {
    let [before, soil, _] = &scores.scores;
    falls(before, soil, GAIN_ON_TRIAL, scores.counted)
}

/// What held-out drives say of the soil that is assumed: by the bundle under a model on trial, else by the map.
pub(crate) fn said_of_ground(scores: &HeldOut, model_on_trial: bool) -> String {
    let [before, soil, _] = &scores.scores;
    if ground_is_another(scores) {
        let assumed = if model_on_trial { "the bundle assumes" } else { "the map shows" };
        return format!("; the ground is another than {assumed}, which alone makes predictions better");
    }
    let shows = vec![true; scores.shows.len()];
    if model_on_trial && rises_surely(before, soil, scores.counted, &scores.resamples, &shows).is_some() {
        return "; no other soil alone makes predictions better".into();
    }
    String::new()
}

/// Whether an effect changes how the vehicle moves. A wrong sensor shows in the sensors; whether predictions from it get better is another question, unless the model
/// itself is on trial and nothing that is measured twice speaks for it.
fn acts(finding: &Finding) -> bool {
    matches!(finding.candidate.layer(), Layer::Force | Layer::Actuator | Layer::Soil)
}

/// Whether claims stand without a proof: each far beyond chance, and no more than one of those that change how the vehicle moves, which stand in for one another.
fn beyond_doubt(claimed: &[&Finding], threshold: f64) -> bool {
    claimed.iter().all(|f| f.alone >= WITHOUT_PROOF * threshold) && claimed.iter().filter(|f| acts(f)).count() <= 1
}

fn left(judgement: &Judgement) -> String {
    let (z, what) = &judgement.selection.remaining;
    format!("the model lacks more than that: what is left shows most in {what} (z = {z:.1})")
}

#[cfg(test)]
mod tests {
    use nesam_evaluation::POSE_DIM;

    use super::*;
    use crate::candidates::catalogue;
    use crate::select::Selection;

    /// A judgement that claims effects of this evidence after the others, held against a threshold of 4.
    fn judgement(claims: &[(&str, f64)]) -> Judgement {
        let catalogue = catalogue(&[]);
        let finding = |&(id, alone): &(&str, f64)| Finding::of(&catalogue, id, alone, Vec::new());
        let findings: Vec<Finding> = claims.iter().map(finding).collect();
        let selection = Selection {
            chosen: findings.iter().map(|f| f.hypothesis).collect(),
            alone: findings.iter().map(|f| f.alone).collect(),
            rivals: vec![Vec::new(); findings.len()],
            remaining: (1.0, String::new()),
            remaining_level: (1.0, String::new()),
            remaining_bend: (0.0, String::new()),
            ..Selection::empty(4.0)
        };
        Judgement {
            selection,
            findings,
            onsets: Vec::new(),
            settled: Vec::new(),
            fit: None,
            verdict: Verdict::Explained,
            reason: "they explain it".into(),
        }
    }

    /// Goal: nothing weak or ambiguous is claimed of drives that prove nothing. Method: judgements without scores; 2.5 thresholds of 4 are 10.
    #[test]
    fn analytic_without_a_drive_to_prove_it_on_only_what_stands_far_out_is_claimed() {
        let said = |claims: &[(&str, f64)], on_trial: bool| proven(&judgement(claims), &DriveLine::default(), None, on_trial, || false);
        let explained = (Verdict::Explained, "they explain it".to_string());
        assert_eq!(said(&[("steering_offset", 10.0)], false), explained);
        assert_eq!(said(&[("steering_offset", 12.0), ("gyro_bias", 11.0)], false), explained);
        for claims in [&[("map_offset", 9.9)][..], &[("steering_offset", 12.0), ("tow", 12.0)], &[("gyro_bias", 12.0), ("tow", 9.0)]] {
            let (verdict, reason) = said(claims, false);
            let (names, fits) =
                (claims.iter().map(|claim| claim.0).collect::<Vec<_>>().join(" with "), if claims.len() > 1 { "fit" } else { "fits" });
            let why = format!("{names} {fits}, but no drive is left to prove it on");
            assert_eq!((verdict, reason), (Verdict::Unexplained, why));
        }
        assert_eq!(said(&[("steering_offset", 40.0)], true).0, Verdict::Unexplained);
    }

    /// Scores of six drives of one window in which every error is this large.
    fn score(error: f64) -> ModelScore {
        crate::proof::tests::score([error; POSE_DIM])
    }

    /// Scores before, with the best soil, after.
    fn held_out(errors: [f64; 3]) -> HeldOut {
        let (resamples, counted) = (Resamples::draw(6, 50, 1), [true; POSE_DIM + 1]);
        HeldOut {
            scores: errors.map(score),
            controls: Vec::new(),
            before_onset: None,
            resamples,
            counted,
            shows: vec![true; 6],
            another_ground: false,
        }
    }

    /// The claim that is needless where the drives have this error without each of some hypotheses, and `after` with all.
    fn needless(claims: &[&str], scores: &HeldOut, without: &[(&str, f64)]) -> Option<usize> {
        let judged = judgement(&claims.iter().map(|id| (*id, 12.0)).collect::<Vec<_>>());
        let of = |hypothesis: usize| {
            let id = judged.findings.iter().find(|f| f.hypothesis == hypothesis).unwrap().candidate.id();
            without.iter().find(|w| w.0 == id).map(|w| (score(w.1), vec![true; 6])).ok_or(id)
        };
        last_needless(&judged, &DriveLine::default(), scores, of).unwrap()
    }

    /// Goal: each of several effects is proven by itself. Method: scores by hand. Two that cancel in part help only together; a second that rides on the first does not
    /// help; sensors and single claims are not asked.
    #[test]
    fn analytic_each_of_several_claims_has_to_help_beside_the_others() {
        let cancelling = held_out([0.10, 0.12, 0.10]);
        assert_eq!(needless(&["steering_offset", "tow"], &cancelling, &[("steering_offset", 0.2), ("tow", 0.3)]), None);
        let two = judgement(&[("steering_offset", 12.0), ("tow", 12.0)]);
        assert_eq!(proven(&two, &DriveLine::default(), Some(&cancelling), false, || false).0, Verdict::Explained);
        assert_eq!(
            proven(&two, &DriveLine::default(), Some(&cancelling), true, || false).0,
            Verdict::Unexplained,
            "a model on trial has to get better"
        );
        let one = judgement(&[("tow", 12.0)]);
        assert_eq!(proven(&one, &DriveLine::default(), Some(&cancelling), false, || false).0, Verdict::Unexplained);
        let riding = held_out([0.20, 0.18, 0.10]);
        assert_eq!(needless(&["steering_offset", "tow"], &riding, &[("steering_offset", 0.2), ("tow", 0.1)]), Some(1));
        assert_eq!(needless(&["tow", "steering_offset"], &riding, &[("steering_offset", 0.2), ("tow", 0.1)]), Some(0));
        assert_eq!(needless(&["steering_offset", "gyro_bias"], &riding, &[("steering_offset", 0.2)]), None);
        assert_eq!(needless(&["tow"], &riding, &[]), None);
    }

    /// Goal: a sensor that measurements speak against is proven by them, though predictions are as before, and nothing else is. Method: scores that stay and that rise,
    /// under a model on trial, with and without measurements that agree.
    #[test]
    fn analytic_a_sensor_of_a_model_on_trial_is_proven_by_what_measurements_contradict() {
        let (same, worse) = (held_out([0.1, 0.1, 0.1]), held_out([0.1, 0.1, 0.11]));
        let verdict = |claims: &[(&str, f64)], scores: &HeldOut, agree: bool| {
            proven(&judgement(claims), &DriveLine::default(), Some(scores), true, || agree).0
        };
        let (bias, tow) = (("gyro_bias", 12.0), ("tow", 12.0));
        assert_eq!(verdict(&[bias], &same, true), Verdict::Explained);
        assert_eq!(verdict(&[bias], &same, false), Verdict::Unexplained);
        assert_eq!(verdict(&[bias], &worse, true), Verdict::Unexplained, "predictions may not get worse");
        for acting in [&[tow][..], &[bias, tow], &[("map_offset", 12.0)]] {
            assert_eq!(verdict(acting, &same, true), Verdict::Unexplained, "{acting:?} must help");
        }
        let (_, reason) = proven(&judgement(&[bias]), &DriveLine::default(), Some(&same), true, || true);
        assert!(reason.contains("contradict one another less") && !reason.contains("it helps"), "{reason}");
    }
}
