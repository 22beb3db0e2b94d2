//! The whole diagnosis of a set: detect, select, refit, prove on drives that were not fitted.

use nesam_evaluation::DriveMaps;
use nesam_model::{ModelBundle, Predictor};
use nesam_physics::SoilCorrection;
use nesam_physics::effects::written::WRITTEN_MAX;
use nesam_physics::effects::{Effect, Layer, Written};
use nesam_trajectories::Trajectory;

use crate::candidates::{Candidate, catalogue};
use crate::claims::{Case, Estimate, Finding, Settled, Trace};
use crate::condense::{Condensed, best_soil};
use crate::controls::{Kind, NullDrives, Setting};
use crate::error::DiscoveryError;
use crate::fit::Fit;
use crate::held_out::{HeldOut, Learned, Scoring, score_held_out, score_models};
use crate::judge::{Judge, case_of, own_yardstick};
use crate::observe::{Bench, ObservedDrive, Stepping, observe_all};
use crate::own_reference;
use crate::proof::{Trial, not_proven};
use crate::pursuit::{Pursued, pursue};
use crate::select::{EFFECTS_MAX, Selection, Yardstick, without};

/// Share of the largest evidence that may be left after the claimed effects, when it is beyond chance (chosen): the model's answer to an effect is not
/// exact, but most of what is different must be explained before anything is claimed.
const LEFT_MAX: f64 = 0.4;
/// How far beyond the family-wise threshold the largest evidence must be before drives count as different without a known cause (chosen, as in ADR 0008):
/// one set in twenty without an effect is beyond the threshold itself.
const UNEXPLAINED_MARGIN: f64 = 1.5;
/// [`LEFT_MAX`] where every claimed effect is geometry, such as a steering ratio or a gyro bias.
const LEFT_MAX_GEOMETRY: f64 = 0.2;

/// Share by which an error on held-out drives must surely fall where the model itself is on trial (chosen). A model of a new vehicle is wrong in many ways at
/// once, and evidence by the scatter of the judged drives themselves saturates; what is left is therefore no measure of what was explained there.
const GAIN_ON_TRIAL: f64 = 0.1;

/// What drives are held against.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Against {
    /// The frozen bundle: what has changed against drives that it knows.
    #[default]
    Bundle,
    /// The symbolic model itself: what it lacks on average over these drives.
    Physics,
}

/// What the command line says.
#[derive(Clone, Debug)]
pub struct Options {
    /// Ids to fit on, in any order; `None` = each drive is left out once.
    pub fit_on: Option<Vec<String>>,
    /// Ids of effects that are not considered.
    pub without: Vec<String>,
    /// Effects that somebody wrote down, considered beside the catalogue. A reference must have been measured for them; those that it was measured for are
    /// considered anyway.
    pub hypotheses: Vec<Written>,
    /// What drives are held against.
    pub against: Against,
    /// Rollouts of the proof.
    pub scoring: Scoring,
    /// Whether the controls are made too: rivals refitted, a black box, a free form of what is left.
    pub controls: bool,
}

impl Options {
    /// Each drive left out once, everything considered against the bundle, no controls.
    pub fn of(scoring: Scoring) -> Self {
        Self { fit_on: None, without: Vec::new(), hypotheses: Vec::new(), against: Against::Bundle, scoring, controls: false }
    }
}

/// Outcome for a person in a hurry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Nothing differs from the reference beyond chance.
    None,
    /// One effect, or several together, explain it and help on drives that were not fitted.
    Explained,
    /// Several effects explain it about as well.
    Ambiguous,
    /// Something differs, but no effect of the catalogue may be claimed.
    Unexplained,
}

impl Verdict {
    /// As in JSON.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Explained => "explained",
            Self::Ambiguous => "ambiguous",
            Self::Unexplained => "unexplained",
        }
    }
}

/// Everything that was found.
#[derive(Debug)]
pub struct Diagnosis {
    /// Outcome.
    pub verdict: Verdict,
    /// Why, in one sentence.
    pub reason: String,
    /// All hypotheses, in the order of the selection's evidence.
    pub catalogue: Vec<Candidate>,
    /// Channels that were compared, in the order of the selection's levels.
    pub channels: Vec<usize>,
    /// Mean deviation of each compared channel from its usual level, in its unit.
    pub levels: Vec<f64>,
    /// Course of the most unusual channel of each residual layer.
    pub traces: Vec<Trace>,
    /// What each control of the scores is, with the number of its parameters.
    pub controls: Vec<(Kind, usize)>,
    /// The free form of what is left by all fitted drives; `None` where it explains nothing on drives it was not fitted on.
    pub free_form: Option<Effect>,
    /// The claimed effects on drives that do not have them.
    pub null_drives: Option<NullDrives>,
    /// Judgement on all fitted drives together.
    pub selection: Selection,
    /// Chosen effects, refused or not.
    pub findings: Vec<Finding>,
    /// Parameters of all claimed effects.
    pub estimates: Vec<Estimate>,
    /// The claimed effects; empty when nothing is claimed.
    pub claimed: Vec<nesam_physics::effects::ScheduledEffect>,
    /// Ids of fitted drives.
    pub fit_on: Vec<String>,
    /// Ids of scored drives.
    pub held_out: Vec<String>,
    /// What each held-out drive was predicted with.
    pub learned: Vec<Learned>,
    /// Scores; `None` when no drive is held out.
    pub scores: Option<HeldOut>,
}

impl Diagnosis {
    /// The claimed findings.
    pub fn claims(&self) -> impl Iterator<Item = &Finding> {
        let any = matches!(self.verdict, Verdict::Explained | Verdict::Ambiguous);
        self.findings.iter().filter(move |f| any && f.refused.is_none())
    }
}

/// Told how far a diagnosis is.
pub type OnProgress<'a> = &'a (dyn Fn(&str, usize, usize) + Sync);

/// A judgement without the proof on held-out drives.
#[derive(Debug)]
pub struct Judgement {
    /// Selection on all fitted drives.
    pub selection: Selection,
    /// Findings, refused or not.
    pub findings: Vec<Finding>,
    /// What was compared through the physics with the first finding; `None` when nothing was.
    pub settled: Option<Settled>,
    /// Fit of all chosen effects together; `None` when nothing was chosen.
    pub fit: Option<Fit>,
    /// Verdict before the proof.
    pub verdict: Verdict,
    /// Why.
    pub reason: String,
}

impl Judgement {
    /// Positions in the findings of those that may be claimed.
    pub fn claimed(&self) -> Vec<usize> {
        let any = matches!(self.verdict, Verdict::Explained | Verdict::Ambiguous);
        (0..self.findings.len()).filter(|i| any && self.findings[*i].refused.is_none()).collect()
    }
}

/// Detects, selects and sizes, without the proof.
pub fn judge(case: &mut Case<'_>, yardstick: &Yardstick) -> Judgement {
    let (mut selection, onsets) = case.select(yardstick);
    let mut settled = case.settle(yardstick, &mut selection, &onsets);
    let mut left_out = Vec::new();
    loop {
        if selection.chosen.is_empty() {
            let (verdict, reason) = nothing_chosen(&selection);
            return Judgement { selection, findings: left_out, settled, fit: None, verdict, reason };
        }
        let group = yardstick.group(case.condensed());
        let fit = case.size(yardstick, &group, &selection.chosen, &onsets);
        let mut findings = case.findings(yardstick, &selection, &onsets, &fit, settled.as_ref());
        // A further effect that may not be claimed is dropped and the others are sized again without it.
        let dropped = findings.iter().rposition(|f| f.refused.is_some());
        match dropped {
            Some(i) if findings.len() > 1 => {
                left_out.push(findings.remove(i));
                let others = without(&selection.chosen, i);
                selection.choose(yardstick, &group, others);
                settled = case.settle(yardstick, &mut selection, &onsets);
            }
            _ => {
                let (verdict, reason) = provisional(&selection, &findings, yardstick.model_on_trial);
                left_out.retain(|dropped| findings.iter().all(|f| f.hypothesis != dropped.hypothesis));
                findings.extend(left_out);
                return Judgement { selection, findings, settled, fit: Some(fit), verdict, reason };
            }
        }
    }
}

fn nothing_chosen(selection: &Selection) -> (Verdict, String) {
    if !surely_differs(selection) && selection.differs() {
        let z = selection.largest();
        return (Verdict::None, format!("the evidence that anything differs is weak (z = {z:.1}), and no effect may be claimed"));
    }
    if selection.differs() {
        let (z, what) = &selection.remaining;
        return (
            Verdict::Unexplained,
            format!("the drives differ from the reference, most in {what} (z = {z:.1}), but no effect of the catalogue stands out"),
        );
    }
    (Verdict::None, "nothing stands out from drives without an effect".into())
}

/// Whether the drives differ from the reference beyond doubt, so that it must be said even when no cause can be named.
fn surely_differs(selection: &Selection) -> bool {
    selection.largest() >= UNEXPLAINED_MARGIN * selection.threshold
}

fn provisional(selection: &Selection, findings: &[Finding], model_on_trial: bool) -> (Verdict, String) {
    let first = &findings[0];
    if let Some(refused) = first.refused.as_ref().filter(|_| !surely_differs(selection)) {
        let (z, label) = (selection.largest(), first.candidate.label());
        return (
            Verdict::None,
            format!("the evidence that anything differs is weak (z = {z:.1}), and {label} cannot be claimed: {refused}"),
        );
    }
    if let Some(refused) = &first.refused {
        return (
            Verdict::Unexplained,
            format!("the drives differ from the reference, but {} cannot be claimed: {refused}", first.candidate.label()),
        );
    }
    let (left, what) = &selection.remaining;
    let share = left / selection.largest().max(1e-9);
    let force = findings.iter().any(|f| f.candidate.through_contact());
    if !model_on_trial && *left >= selection.threshold && share > if force { LEFT_MAX } else { LEFT_MAX_GEOMETRY } {
        return (
            Verdict::Unexplained,
            format!(
                "{} explains too little: {what} still stands out with z = {left:.1} of {:.1}",
                first.candidate.label(),
                selection.largest()
            ),
        );
    }
    let named: Vec<String> = findings.iter().map(|f| f.candidate.label()).collect();
    let rivals: Vec<String> = findings.iter().flat_map(|f| &f.rivals).map(|m| m.candidate.label()).collect();
    if rivals.is_empty() {
        (Verdict::Explained, format!("{} explains it", together(&named)))
    } else {
        (Verdict::Ambiguous, format!("{} explains it, but {} would do about as well", together(&named), rivals.join(" or ")))
    }
}

fn together(named: &[String]) -> String {
    match named {
        [first, others @ ..] if !others.is_empty() => format!("{first} with {}", others.join(" and ")),
        _ => named.concat(),
    }
}

/// Diagnoses a set with the reference that the predictor's bundle carries.
///
/// # Errors
/// `DiscoveryError::Reference` without a usable reference, `Drives` for unknown ids, `NoSegments`, and the model's own errors.
pub fn diagnose(
    predictor: &Predictor,
    drives: &[Trajectory],
    maps: &DriveMaps,
    options: &Options,
    progress: OnProgress<'_>,
) -> Result<Diagnosis, DiscoveryError> {
    let own;
    let predictor = match options.against {
        Against::Bundle => predictor,
        Against::Physics => {
            own = own_reference::symbolic(predictor.bundle())?;
            &own
        }
    };
    let bundle = predictor.bundle();
    let judge_by = match options.against {
        Against::Bundle => Some(Judge::of(bundle)?),
        Against::Physics => None,
    };
    let catalogue = hypotheses(bundle, judge_by.as_ref(), options)?;
    let fit_at = fitted(drives, options)?;
    // The model itself is judged from the best that is known of each state; a bundle's network knows what the past tells, and is judged from that.
    let fit_drives: Vec<Trajectory> = fit_at.iter().map(|&d| drives[d].clone()).collect();
    let in_hindsight: Option<Vec<Trajectory>> =
        (options.against == Against::Physics).then(|| fit_drives.iter().map(Trajectory::in_hindsight).collect());
    let seen = in_hindsight.as_ref().unwrap_or(&fit_drives);
    let fit_maps: Vec<_> = fit_at.iter().map(|&d| maps[d].clone()).collect();
    let total = fit_at.len();
    let observed = observe_all(predictor, seen, &fit_maps, &|done| progress("drives as the model sees them", done, total))?;
    let bench = Bench { vehicle: &bundle.vehicle, stepping: Stepping::of(bundle), catalogue: &catalogue };
    let trial = Trial { predictor, drives: &fit_drives, maps: &fit_maps, scoring: &options.scoring };
    let (mut case, Pursued { yardstick, refused }) = held_against(judge_by.as_ref(), bench, observed, options, &trial, progress)?;
    progress("hypotheses", 0, 1);
    let mut judgement = judge(&mut case, &yardstick);
    judgement.findings.extend(refused);
    let fewer = match &judge_by {
        Some(judge_by) if options.fit_on.is_none() && total > 1 => {
            Some(judge_by.yardstick(&case.metric.channels, total - 1, &options.without)?)
        }
        _ => None,
    };
    let held_at: Vec<usize> = match options.fit_on {
        Some(_) => (0..drives.len()).filter(|d| !fit_at.contains(d)).collect(),
        None if total > 1 => (0..drives.len()).collect(),
        None => Vec::new(),
    };
    let learned = learn(fewer.as_ref().unwrap_or(&yardstick), &case, &judgement, options, held_at.len());
    let held: Vec<Trajectory> = held_at.iter().map(|&d| drives[d].clone()).collect();
    let held_maps: Vec<_> = held_at.iter().map(|&d| maps[d].clone()).collect();
    progress("held-out windows", 0, held.len());
    let mut scores = if held.is_empty() { None } else { Some(score_held_out(predictor, &held, &held_maps, &learned, &options.scoring)?) };
    let (verdict, reason) = proven(&judgement, scores.as_ref(), yardstick.model_on_trial);
    let any = matches!(verdict, Verdict::Explained | Verdict::Ambiguous);
    let places: Vec<Option<usize>> = held_at.iter().map(|d| options.fit_on.is_none().then_some(*d)).collect();
    let setting = Setting { case: &case, yardstick: &yardstick, judgement: &judgement, claimed: any, predictor, held_out: &places };
    let (controls, free_form) = match scores.as_mut().filter(|_| options.controls) {
        Some(scores) => {
            progress("controls", 0, held.len());
            score_controls(&setting, scores, &held, &held_maps, options)?
        }
        None => (Vec::new(), None),
    };
    let null_drives = judge_by.as_ref().and_then(|j| setting.on_null_drives(&j.nulls));
    let claimed = if any { judgement.fit.as_ref().map_or_else(Vec::new, |f| keep(&judgement, f.effects())) } else { Vec::new() };
    let estimates = if claimed.is_empty() {
        Vec::new()
    } else {
        judgement.claimed().iter().flat_map(|i| judgement.findings[*i].estimates.clone()).collect()
    };
    Ok(Diagnosis {
        verdict,
        reason,
        traces: case.traces(&judgement.selection, &claimed),
        controls,
        free_form,
        null_drives,
        levels: levels(&case),
        catalogue: yardstick.catalogue,
        channels: yardstick.channels,
        findings: judgement.findings,
        selection: judgement.selection,
        estimates,
        claimed,
        fit_on: fit_drives.iter().map(|d| d.id.clone()).collect(),
        held_out: held.iter().map(|d| d.id.clone()).collect(),
        learned,
        scores,
    })
}

/// All hypotheses of a diagnosis.
fn hypotheses(bundle: &ModelBundle, judge_by: Option<&Judge>, options: &Options) -> Result<Vec<Candidate>, DiscoveryError> {
    let all = judge_by.map_or_else(|| catalogue(&options.hypotheses), |judge| judge.catalogue.clone());
    let written: Vec<Written> = all.iter().filter_map(Candidate::written).collect();
    if let Some(unknown) = options.hypotheses.iter().find(|h| !written.contains(&h.at(1.0))) {
        let reason = format!(
            "was not measured for `{}` as it is written; run `nesam diagnose --make-reference` with the same --hypotheses first",
            unknown.id()
        );
        return Err(DiscoveryError::Reference { reason });
    }
    let in_bundle = bundle.effects.iter().filter(|e| e.effect.written().is_some()).count();
    if in_bundle + written.len().min(EFFECTS_MAX) > WRITTEN_MAX {
        let reason = format!(
            "bundle {} has {in_bundle} written effects; with these hypotheses more than {WRITTEN_MAX} could act at once",
            bundle.name
        );
        return Err(DiscoveryError::Hypotheses { reason });
    }
    if let Some(unknown) = options.without.iter().find(|id| !Effect::IDS.contains(&id.as_str()) && !all.iter().any(|c| c.id() == *id)) {
        let mut known: Vec<&str> = all.iter().map(Candidate::id).collect();
        known.dedup();
        return Err(DiscoveryError::Hypotheses {
            reason: format!("--without {unknown}: no such effect; considered are {}", known.join(", ")),
        });
    }
    Ok(all)
}

/// Drives of a case with what they are compared with: a reference, or themselves.
fn held_against<'a>(
    judge_by: Option<&Judge>,
    bench: Bench<'a>,
    observed: Vec<ObservedDrive>,
    options: &Options,
    trial: &Trial<'_>,
    progress: OnProgress<'_>,
) -> Result<(Case<'a>, Pursued), DiscoveryError> {
    let total = observed.len();
    let Some(judge_by) = judge_by else {
        let mut case = case_of(own_reference::metric(&bench, &observed)?, bench, observed, progress);
        let drives: Vec<Condensed> = case.condensed().cloned().collect();
        let first = own_yardstick(&case, &drives, &options.without)?;
        let pursued = pursue(&mut case, first, &options.without, trial, progress)?;
        return Ok((case, pursued));
    };
    let case = judge_by.case(bench, observed, progress)?;
    let yardstick = judge_by.yardstick(&case.metric.channels, total, &options.without)?;
    Ok((case, Pursued { yardstick, refused: Vec::new() }))
}

/// Kind and number of parameters of each control, and the free form of what all drives leave.
type Tried = (Vec<(Kind, usize)>, Option<Effect>);

/// Makes the controls and adds their scores on the held-out drives to `scores`.
fn score_controls(
    setting: &Setting<'_>,
    scores: &mut HeldOut,
    held: &[Trajectory],
    maps: &DriveMaps,
    options: &Options,
) -> Result<Tried, DiscoveryError> {
    let (made, free_form) = setting.controls()?;
    let windows = options.scoring.windows(held)?;
    for control in &made {
        let models: Vec<_> = control.predictors.iter().map(|p| (p, SoilCorrection::NONE)).collect();
        let score = score_models(&windows, maps, &models, control.parameters, &scores.resamples)?;
        scores.controls.push(score);
    }
    Ok((made.iter().map(|c| (c.kind, c.parameters)).collect(), free_form))
}

/// What each of `held_out` drives is predicted with; `fewer` judges one drive less than were fitted.
fn learn(fewer: &Yardstick, case: &Case<'_>, judgement: &Judgement, options: &Options, held_out: usize) -> Vec<Learned> {
    match options.fit_on {
        Some(_) => {
            let effects = judgement.fit.as_ref().map_or_else(Vec::new, |f| keep(judgement, f.effects()));
            vec![Learned { soil: best_soil(case.condensed()), effects }; held_out]
        }
        None if held_out > 0 => leave_each_out(fewer, case, judgement),
        None => Vec::new(),
    }
}

/// Indices of the drives to fit on, each once, in the order of the set.
fn fitted(drives: &[Trajectory], options: &Options) -> Result<Vec<usize>, DiscoveryError> {
    let Some(ids) = &options.fit_on else { return Ok((0..drives.len()).collect()) };
    let mut at = ids
        .iter()
        .map(|id| {
            let present = || match drives {
                [first, .., last] => format!("{} drives from {} to {}", drives.len(), first.id, last.id),
                _ => drives.iter().map(|d| d.id.as_str()).collect(),
            };
            drives
                .iter()
                .position(|d| d.id == *id)
                .ok_or_else(|| DiscoveryError::Drives { reason: format!("no drive `{id}` to fit on; the set has {}", present()) })
        })
        .collect::<Result<Vec<usize>, _>>()?;
    at.sort_unstable();
    at.dedup();
    Ok(at)
}

/// The fitted effects that are claimed.
fn keep<T: Clone>(judgement: &Judgement, effects: Vec<T>) -> Vec<T> {
    judgement.claimed().iter().filter_map(|i| effects.get(*i).cloned()).collect()
}

/// What each drive is predicted with: learned without it. Detection and choice follow from the other drives alone, the size from one step of the whole fit.
/// What was compared through the physics on all drives is compared in the same way on the others ([`Settled::stands`]).
fn leave_each_out(yardstick: &Yardstick, case: &Case<'_>, judgement: &Judgement) -> Vec<Learned> {
    (0..case.prepared.len())
        .map(|left_out| {
            let inside = |d: usize| d != left_out;
            let others = || (0..case.prepared.len()).filter(|d| inside(*d)).map(|d| &case.prepared[d].condensed);
            let soil = best_soil(others());
            let group = yardstick.group(others());
            let chosen = yardstick.select(&group).chosen;
            let stands = |i: usize| {
                let named = judgement.findings[i].hypothesis;
                let settled = judgement.settled.as_ref().filter(|_| i == 0);
                chosen.contains(&named) || settled.is_some_and(|s| s.stands(yardstick, &chosen, &group, inside, |h| h == named))
            };
            let effects = judgement.fit.as_ref().map_or_else(Vec::new, |fit| {
                let without = fit.effects_without(left_out);
                judgement.claimed().iter().filter(|i| stands(**i)).filter_map(|i| without.get(*i).copied()).collect()
            });
            Learned { soil, effects }
        })
        .collect()
}

/// Verdict after the proof on held-out drives.
fn proven(judgement: &Judgement, scores: Option<&HeldOut>, model_on_trial: bool) -> (Verdict, String) {
    let claimed: Vec<&Finding> = judgement.claimed().iter().map(|i| &judgement.findings[*i]).collect();
    let (verdict, reason) = (judgement.verdict, judgement.reason.clone());
    let Some(first) = claimed.first() else { return (verdict, reason) };
    let refused = |why: String| (Verdict::Unexplained, format!("{} fits, but {why}", first.candidate.label()));
    let Some(scores) = scores else {
        return if model_on_trial { refused("no drive is left to prove it on".into()) } else { (verdict, reason) };
    };
    // A wrong sensor shows in the sensors; whether predictions from it get better is another question, unless the model itself is on trial.
    let acts = |f: &&Finding| matches!(f.candidate.layer(), Layer::Force | Layer::Actuator | Layer::Soil);
    let must_help = model_on_trial || claimed.iter().any(acts);
    if let Some(why) = not_proven(scores, must_help.then_some(if model_on_trial { GAIN_ON_TRIAL } else { 0.0 })) {
        return refused(why);
    }
    let helps = if must_help { "; it helps on drives that were not fitted" } else { "" };
    let more = if model_on_trial { format!(", and {}", left(judgement)) } else { String::new() };
    (verdict, format!("{reason}{helps}{more}"))
}

fn left(judgement: &Judgement) -> String {
    let (z, what) = &judgement.selection.remaining;
    format!("the model lacks more than that: what is left shows most in {what} (z = {z:.1})")
}

/// Mean deviation of each compared channel from its usual level over all segments.
fn levels(case: &Case<'_>) -> Vec<f64> {
    let count = case.rows.iter().map(Vec::len).sum::<usize>().max(1) as f64;
    let mean = |c: usize| case.rows.iter().flatten().map(|r| r[c]).sum::<f64>() / count;
    case.metric.channels.iter().enumerate().map(|(i, c)| mean(*c) - case.metric.centre[i]).collect()
}
