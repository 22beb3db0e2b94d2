//! The whole diagnosis of a set: detect, select, refit, prove on drives that were not fitted.

use nesam_evaluation::{DIMENSION_KEYS, DriveMaps, paired_difference};
use nesam_model::{ModelBundle, Predictor};
use nesam_physics::SoilCorrection;
use nesam_physics::effects::Layer;
use nesam_trajectories::Trajectory;
use rayon::prelude::*;

use crate::candidates::{Candidate, catalogue};
use crate::channels::Row;
use crate::claims::{Case, Estimate, Finding, Trace};
use crate::condense::{best_soil, condense, signatures};
use crate::error::DiscoveryError;
use crate::evidence::Nulls;
use crate::fit::{Fit, Prepared};
use crate::held_out::{HeldOut, Learned, Scoring, score_held_out};
use crate::observe::{Bench, ObservedDrive, Stepping, observe_all};
use crate::reference::{NullGroups, Reference};
use crate::select::{Selection, Yardstick};

/// Share of the largest evidence that may be left after the claimed effects, when it is beyond chance (chosen): the model's answer to an effect is not
/// exact, but most of what is different must be explained before anything is claimed.
const LEFT_MAX: f64 = 0.35;
/// How far beyond the family-wise threshold the largest evidence must be before drives count as different without a known cause (chosen, as in ADR 0008):
/// one set in twenty without an effect is beyond the threshold itself.
const UNEXPLAINED_MARGIN: f64 = 1.5;
/// [`LEFT_MAX`] where every claimed effect is geometry, such as a steering ratio or a gyro bias.
const LEFT_MAX_GEOMETRY: f64 = 0.15;

/// What the command line says.
#[derive(Clone, Debug)]
pub struct Options {
    /// Ids to fit on; `None` = each drive is left out once.
    pub fit_on: Option<Vec<String>>,
    /// Ids of effects that are not considered.
    pub without: Vec<String>,
    /// Rollouts of the proof.
    pub scoring: Scoring,
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
    /// The strongest hypothesis that was not chosen, where something was claimed: sized alone, as a control.
    pub placebo: Option<Candidate>,
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

/// What a diagnosis is made with: the reference of a bundle, read once.
#[derive(Clone, Debug)]
pub struct Judge {
    reference: Reference,
    nulls: Vec<crate::condense::Condensed>,
}

impl Judge {
    /// From the reference that a bundle carries.
    ///
    /// # Errors
    /// `DiscoveryError::Reference` without a usable reference.
    pub fn of(bundle: &ModelBundle) -> Result<Self, DiscoveryError> {
        let text = bundle.reference_json.as_deref().ok_or_else(|| DiscoveryError::Reference {
            reason: format!(
                "bundle {} carries none; make it with `nesam diagnose --make-reference --bundle DIR --data ROOT --set NAME --split train`",
                bundle.name
            ),
        })?;
        Ok(Self::new(Reference::from_json(text)?))
    }

    /// From a reference.
    pub fn new(reference: Reference) -> Self {
        let nulls = reference.condensed();
        Self { reference, nulls }
    }

    /// The same without some drives of the reference: what a pseudo-vehicle made of them is judged by.
    pub fn without(&self, ids: &[&str]) -> Self {
        let mut reference = self.reference.clone();
        reference.drives.retain(|d| !ids.contains(&d.trajectory.as_str()));
        Self::new(reference)
    }

    /// Ids of the drives behind the reference.
    pub fn drives(&self) -> Vec<String> {
        self.reference.drives.iter().map(|d| d.trajectory.clone()).collect()
    }

    /// What `drives` drives are compared with.
    ///
    /// # Errors
    /// `DiscoveryError::Reference` with fewer than four null drives.
    pub fn yardstick(&self, channels: &[usize], drives: usize, without: &[String]) -> Result<Yardstick, DiscoveryError> {
        let nulls = Nulls::new(&self.nulls.iter().collect::<Vec<_>>())
            .ok_or_else(|| DiscoveryError::Reference { reason: "has too few drives".into() })?;
        let catalogue = catalogue();
        let groups = NullGroups::draw(&self.nulls, &catalogue, channels, drives);
        let considered = catalogue.iter().map(|c| !without.iter().any(|id| id == c.id())).collect();
        Ok(Yardstick { nulls, groups, channels: channels.to_vec(), catalogue, considered })
    }

    /// Compares observed drives with the reference.
    ///
    /// # Errors
    /// As [`Reference::metric`].
    pub fn case<'a>(&self, bench: Bench<'a>, observed: Vec<ObservedDrive>, progress: OnProgress<'_>) -> Result<Case<'a>, DiscoveryError> {
        let available = core::array::from_fn(|c| observed.iter().all(|d| d.available[c]));
        let metric = self.reference.metric(&available)?;
        let catalogue = catalogue();
        let total = observed.len();
        let rows: Vec<Vec<Row>> = observed.iter().map(|d| d.deviations(&bench, &[], &SoilCorrection::NONE)).collect();
        let prepared = observed
            .into_iter()
            .zip(&rows)
            .enumerate()
            .map(|(done, (drive, rows))| {
                progress("drives held against every effect", done, total);
                let signatures = signatures(&bench, &drive, &catalogue);
                let condensed = condense(&metric, rows, &signatures);
                Prepared { drive, signatures, condensed }
            })
            .collect();
        Ok(Case { bench, metric, prepared, rows })
    }
}

/// A judgement without the proof on held-out drives.
#[derive(Debug)]
pub struct Judgement {
    /// Selection on all fitted drives.
    pub selection: Selection,
    /// Findings, refused or not.
    pub findings: Vec<Finding>,
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
    case.settle(yardstick, &mut selection, &onsets);
    let mut left_out = Vec::new();
    loop {
        if selection.chosen.is_empty() {
            let (verdict, reason) = nothing_chosen(&selection);
            return Judgement { selection, findings: left_out, fit: None, verdict, reason };
        }
        let group = yardstick.group(case.condensed());
        let fit = case.size(yardstick, &group, &selection.chosen, &onsets);
        let mut findings = case.findings(yardstick, &selection, &onsets, &fit);
        // A further effect that may not be claimed is dropped and the others are sized again without it.
        let dropped = findings.iter().rposition(|f| f.refused.is_some());
        match dropped {
            Some(i) if findings.len() > 1 => {
                left_out.push(findings.remove(i));
                selection.drop_chosen(yardstick, &group, i);
                case.settle(yardstick, &mut selection, &onsets);
            }
            _ => {
                let (verdict, reason) = provisional(&selection, &findings);
                findings.extend(left_out);
                return Judgement { selection, findings, fit: Some(fit), verdict, reason };
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

fn provisional(selection: &Selection, findings: &[Finding]) -> (Verdict, String) {
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
    let force = findings.iter().any(|f| f.candidate.layer().is_force());
    if *left >= selection.threshold && share > if force { LEFT_MAX } else { LEFT_MAX_GEOMETRY } {
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
        (Verdict::Explained, format!("{} explains it", named.join(" with ")))
    } else {
        (Verdict::Ambiguous, format!("{} explains it, but {} would do about as well", named.join(" with "), rivals.join(" or ")))
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
    let bundle = predictor.bundle();
    let judge_by = Judge::of(bundle)?;
    let fit_at = fitted(drives, options)?;
    let fit_drives: Vec<Trajectory> = fit_at.iter().map(|&d| drives[d].clone()).collect();
    let fit_maps: Vec<_> = fit_at.iter().map(|&d| maps[d].clone()).collect();
    let total = fit_at.len();
    let observed = observe_all(predictor, &fit_drives, &fit_maps, &|done| progress("drives compared with the reference", done, total))?;
    let stepping = Stepping { dt_s: bundle.normalization.dt_s, substeps: bundle.normalization.substeps };
    let mut case = judge_by.case(Bench { vehicle: &bundle.vehicle, stepping }, observed, progress)?;
    let channels = case.metric.channels.clone();
    let yardstick = judge_by.yardstick(&channels, total, &options.without)?;

    progress("hypotheses", 0, 1);
    let judgement = judge(&mut case, &yardstick);
    let learned = learn(&judge_by, &case, &judgement, options, drives.len())?;
    let held_at: Vec<usize> = match options.fit_on {
        Some(_) => (0..drives.len()).filter(|d| !fit_at.contains(d)).collect(),
        None if total > 1 => (0..drives.len()).collect(),
        None => Vec::new(),
    };
    let held: Vec<Trajectory> = held_at.iter().map(|&d| drives[d].clone()).collect();
    let held_maps: Vec<_> = held_at.iter().map(|&d| maps[d].clone()).collect();
    progress("held-out windows", 0, held.len());
    let placebo = placebo(&case, &yardstick, &judgement);
    let placebo_learned = placebo.as_ref().map(|(_, fit)| {
        let of = |d: usize| if options.fit_on.is_some() { fit.effects() } else { fit.effects_without(d) };
        (0..held.len()).map(|d| Learned { soil: SoilCorrection::NONE, effects: of(d) }).collect::<Vec<_>>()
    });
    let scores = if held.is_empty() {
        None
    } else {
        Some(score_held_out(predictor, &held, &held_maps, &learned, placebo_learned.as_deref(), &options.scoring)?)
    };
    let (verdict, reason) = proven(&judgement, scores.as_ref());
    let claimed = if matches!(verdict, Verdict::Explained | Verdict::Ambiguous) {
        judgement.fit.as_ref().map_or_else(Vec::new, |f| keep(&judgement, f.effects()))
    } else {
        Vec::new()
    };
    let estimates = if claimed.is_empty() {
        Vec::new()
    } else {
        judgement.claimed().iter().flat_map(|i| judgement.findings[*i].estimates.clone()).collect()
    };
    Ok(Diagnosis {
        verdict,
        reason,
        traces: case.traces(&judgement.selection, &claimed),
        placebo: placebo.map(|(candidate, _)| candidate),
        levels: levels(&case),
        catalogue: yardstick.catalogue,
        channels,
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

/// What each held-out drive is predicted with, of `drives` drives in all.
fn learn(
    judge_by: &Judge,
    case: &Case<'_>,
    judgement: &Judgement,
    options: &Options,
    drives: usize,
) -> Result<Vec<Learned>, DiscoveryError> {
    let total = case.prepared.len();
    Ok(match options.fit_on {
        Some(_) => {
            let effects = judgement.fit.as_ref().map_or_else(Vec::new, |f| keep(judgement, f.effects()));
            vec![Learned { soil: best_soil(case.condensed()), effects }; drives - total]
        }
        None if total > 1 => {
            let fewer = judge_by.yardstick(&case.metric.channels, total - 1, &options.without)?;
            leave_each_out(&fewer, case, judgement)
        }
        None => Vec::new(),
    })
}

/// Indices of the drives to fit on.
fn fitted(drives: &[Trajectory], options: &Options) -> Result<Vec<usize>, DiscoveryError> {
    let Some(ids) = &options.fit_on else { return Ok((0..drives.len()).collect()) };
    ids.iter()
        .map(|id| {
            let present = || drives.iter().map(|d| d.id.as_str()).collect::<Vec<_>>().join(", ");
            drives
                .iter()
                .position(|d| d.id == *id)
                .ok_or_else(|| DiscoveryError::Drives { reason: format!("no drive `{id}` to fit on; the set has {}", present()) })
        })
        .collect()
}

/// The fitted effects that are claimed.
fn keep<T: Clone>(judgement: &Judgement, effects: Vec<T>) -> Vec<T> {
    judgement.claimed().iter().filter_map(|i| effects.get(*i).cloned()).collect()
}

/// What each drive is predicted with: learned without it. Detection and choice follow from the other drives alone, the size from one step of the whole fit.
fn leave_each_out(yardstick: &Yardstick, case: &Case<'_>, judgement: &Judgement) -> Vec<Learned> {
    (0..case.prepared.len())
        .map(|left_out| {
            let others = || (0..case.prepared.len()).filter(|d| *d != left_out).map(|d| &case.prepared[d].condensed);
            let soil = best_soil(others());
            let chosen = yardstick.select(&yardstick.group(others())).chosen;
            let effects = judgement.fit.as_ref().map_or_else(Vec::new, |fit| {
                let without = fit.effects_without(left_out);
                judgement
                    .claimed()
                    .iter()
                    .filter(|i| chosen.contains(&judgement.findings[**i].hypothesis))
                    .filter_map(|i| without.get(*i).copied())
                    .collect()
            });
            Learned { soil, effects }
        })
        .collect()
}

/// The strongest hypothesis that is neither chosen nor a rival nor of a chosen id, sized alone; `None` when nothing is claimed.
fn placebo(case: &Case<'_>, yardstick: &Yardstick, judgement: &Judgement) -> Option<(Candidate, Fit)> {
    let claimed = judgement.claimed();
    let named: Vec<&str> = claimed
        .iter()
        .flat_map(|i| {
            let f = &judgement.findings[*i];
            f.rivals.iter().map(|r| r.candidate.id()).chain([f.candidate.id()])
        })
        .collect();
    if named.is_empty() {
        return None;
    }
    let z = &judgement.selection.z;
    let open = (0..z.len()).filter(|h| z[*h].is_some() && !named.contains(&yardstick.catalogue[*h].id()));
    let strongest = open.max_by(|a, b| z[*a].unwrap_or(0.0).total_cmp(&z[*b].unwrap_or(0.0)))?;
    let group = yardstick.group(case.condensed());
    let onsets = vec![None; yardstick.catalogue.len()];
    Some((yardstick.catalogue[strongest], case.size(yardstick, &group, &[strongest], &onsets)))
}

/// Verdict after the proof on held-out drives.
fn proven(judgement: &Judgement, scores: Option<&HeldOut>) -> (Verdict, String) {
    let Some(scores) = scores.filter(|_| !judgement.claimed().is_empty()) else {
        return (judgement.verdict, judgement.reason.clone());
    };
    let claimed: Vec<&Finding> = judgement.claimed().iter().map(|i| &judgement.findings[*i]).collect();
    // A wrong sensor shows in the sensors; whether predictions from it get better is another question.
    let must_help = claimed.iter().any(|f| matches!(f.candidate.layer(), Layer::Force | Layer::Actuator | Layer::Soil));
    match not_proven(scores, must_help) {
        Some(reason) => (Verdict::Unexplained, format!("{} fits, but {reason}", claimed[0].candidate.label())),
        None if must_help => (judgement.verdict, format!("{}; it helps on drives that were not fitted", judgement.reason)),
        None => (judgement.verdict, judgement.reason.clone()),
    }
}

/// Why the proof on held-out drives fails: nothing improves surely where it must, or something worsens surely by more than 2 %.
fn not_proven(scores: &HeldOut, must_help: bool) -> Option<String> {
    let [before, soil, after] = &scores.scores;
    for against in [soil, before] {
        let (_, interval) = paired_difference(&against.errors, &after.errors, &scores.resamples);
        if must_help && !interval.row(false).iter().flatten().any(|[low, _]| *low > 0.0) {
            return Some("no error falls surely on drives that were not fitted".into());
        }
    }
    let (difference, interval) = paired_difference(&after.errors, &before.errors, &scores.resamples);
    let names = DIMENSION_KEYS.iter().chain(&["position_m"]);
    let rows = difference.row(false).into_iter().zip(interval.row(false)).zip(before.summary.tree.row(false));
    rows.zip(names).find_map(|(((d, i), b), name)| match (d, i, b) {
        (Some(d), Some([low, _]), Some(b)) if low > 0.0 && d > 0.02 * b => {
            Some(format!("the error of {name} rises surely on drives that were not fitted, from {b:.4} by {d:.4}"))
        }
        _ => None,
    })
}

/// Mean deviation of each compared channel from its usual level over all segments.
fn levels(case: &Case<'_>) -> Vec<f64> {
    let count = case.rows.iter().map(Vec::len).sum::<usize>().max(1) as f64;
    let mean = |c: usize| case.rows.par_iter().flatten().map(|r| r[c]).sum::<f64>() / count;
    case.metric.channels.iter().enumerate().map(|(i, c)| mean(*c) - case.metric.centre[i]).collect()
}
