//! The whole diagnosis of a set: detect, select, refit, prove on drives that were not fitted.

use nesam_evaluation::{DIMENSION_KEYS, DriveMaps, paired_difference};
use nesam_model::Predictor;
use nesam_physics::effects::Layer;
use nesam_trajectories::Trajectory;
use rayon::prelude::*;

use crate::candidates::Candidate;
use crate::error::DiscoveryError;
use crate::expectation::{Expectation, mean, mean_signature};
use crate::features::{FEATURES, Prepared, Stepping, prepare};
use crate::fit::{Bench, Member};
use crate::held_out::{HeldOut, Learned, Scoring, score_held_out};
use crate::observe::observe_all;
use crate::reference::Reference;
use crate::select::{DECISIVE_BIC, Ranked, Selection, Yardstick, reselect, select};

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
    /// One effect explains it and helps on drives that were not fitted.
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

/// A parameter of a claimed effect.
#[derive(Clone, Debug)]
pub struct Estimate {
    /// Name.
    pub name: &'static str,
    /// Unit.
    pub unit: &'static str,
    /// Value.
    pub value: f64,
    /// 95 % interval; `None` for a choice such as the wheel.
    pub ci95: Option<[f64; 2]>,
}

/// Mean of one statistic over the set against drives without an effect.
#[derive(Clone, Debug)]
pub struct StatisticDeviation {
    /// Index among [`crate::features::names`].
    pub statistic: usize,
    /// Difference from the centre of drives without an effect, in the unit of the statistic.
    pub difference: f64,
    /// The same in standard deviations of such a group without an effect.
    pub significance: f64,
}

/// Everything that was found.
#[derive(Debug)]
pub struct Diagnosis {
    /// Outcome.
    pub verdict: Verdict,
    /// Why, in one sentence.
    pub reason: String,
    /// Judgement on all fitted drives together.
    pub selection: Selection,
    /// Parameters of the claimed effect.
    pub estimates: Vec<Estimate>,
    /// Share of sub-samples of drives that point at the claimed id.
    pub stability: Option<f64>,
    /// Ids of fitted drives.
    pub fit_on: Vec<String>,
    /// Ids of scored drives.
    pub held_out: Vec<String>,
    /// What each held-out drive was predicted with.
    pub learned: Vec<Learned>,
    /// Scores; `None` when no drive is held out.
    pub scores: Option<HeldOut>,
    /// Deviations by statistic.
    pub statistics: Vec<StatisticDeviation>,
}

/// Told how far a diagnosis is.
pub type OnProgress<'a> = &'a (dyn Fn(&str, usize, usize) + Sync);

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
    let reference = bundle.reference_json.as_deref().ok_or_else(|| DiscoveryError::Reference {
        reason: format!(
            "bundle {} carries none; make it with `nesam diagnose --make-reference --bundle DIR --data ROOT --set NAME --split train`",
            bundle.name
        ),
    })?;
    let reference = Reference::from_json(reference)?;
    let fit_at = fitted(drives, options)?;
    let fit_drives: Vec<Trajectory> = fit_at.iter().map(|&d| drives[d].clone()).collect();
    let fit_maps: Vec<_> = fit_at.iter().map(|&d| maps[d].clone()).collect();
    let total = fit_at.len();
    let observed = observe_all(predictor, &fit_drives, &fit_maps, &|done| progress("drives compared with the reference", done, total))?;
    let stepping = Stepping { dt_s: bundle.normalization.dt_s, substeps: bundle.normalization.substeps };
    let scale = reference.segment_scale();
    let prepared: Vec<Prepared> = observed.par_iter().map(|d| prepare(&scale, &bundle.vehicle, stepping, d)).collect();
    let available = core::array::from_fn(|c| observed.iter().all(|d| d.available[c]));
    let usable = reference.usable(&available);
    let yardstick = yardstick(&reference, &usable, total)?;
    let bench = Bench { vehicle: &bundle.vehicle, stepping };
    let members: Vec<Member<'_>> = observed.iter().zip(&prepared).collect();

    progress("hypotheses", 0, 1);
    let selection = select(&bench, &yardstick, &members, &options.without);
    let learned = match options.fit_on {
        Some(_) => {
            let effects = selection.claimed().map(Ranked::effect).into_iter().collect();
            vec![Learned { soil: selection.soil, effects }; drives.len() - total]
        }
        None if total > 1 => {
            let fewer = self::yardstick(&reference, &usable, total - 1)?;
            leave_each_out(&fewer, &members, &selection, &options.without)
        }
        None => Vec::new(),
    };
    let estimates = selection.claimed().map_or_else(Vec::new, estimates);
    let stability = selection.claimed().map(|best| stability(&yardstick.expectation, &members, &selection, best.candidate));

    let held_at: Vec<usize> = match options.fit_on {
        Some(_) => (0..drives.len()).filter(|d| !fit_at.contains(d)).collect(),
        None if total > 1 => (0..drives.len()).collect(),
        None => Vec::new(),
    };
    let held: Vec<Trajectory> = held_at.iter().map(|&d| drives[d].clone()).collect();
    let held_maps: Vec<_> = held_at.iter().map(|&d| maps[d].clone()).collect();
    progress("held-out windows", 0, held.len());
    let scores = if held.is_empty() { None } else { Some(score_held_out(predictor, &held, &held_maps, &learned, &options.scoring)?) };
    let (verdict, reason) = verdict(&selection, scores.as_ref());
    Ok(Diagnosis {
        verdict,
        reason,
        estimates,
        stability,
        fit_on: fit_drives.iter().map(|d| d.id.clone()).collect(),
        held_out: held.iter().map(|d| d.id.clone()).collect(),
        learned,
        scores,
        statistics: deviations(&yardstick.expectation, &prepared),
        selection,
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

fn yardstick(reference: &Reference, usable: &[bool; FEATURES], drives: usize) -> Result<Yardstick, DiscoveryError> {
    let expectation = reference
        .expectation(usable, drives)
        .ok_or_else(|| DiscoveryError::Reference { reason: "has no statistic that is measured in this set".into() })?;
    Ok(Yardstick { expectation, nulls: reference.null_groups(usable, drives) })
}

/// What each drive is predicted with: learned without it.
fn leave_each_out(yardstick: &Yardstick, members: &[Member<'_>], selection: &Selection, without: &[String]) -> Vec<Learned> {
    (0..members.len())
        .map(|left_out| {
            let kept: Vec<usize> = (0..members.len()).filter(|d| *d != left_out).collect();
            let (soil, effect) = reselect(yardstick, members, &kept, selection, without);
            Learned { soil, effects: effect.into_iter().collect() }
        })
        .collect()
}

/// How wrong the predicted response to an effect may be as a whole, as a share of it: two accepted pressure laws give drawbar pulls that differ by a
/// quarter at the same slip, while the angle of a road wheel is geometry (chosen).
fn scale_sd(layer: Layer) -> f64 {
    match layer {
        Layer::Force | Layer::Soil => 0.25,
        Layer::Actuator | Layer::Sensor | Layer::Map => 0.02,
    }
}

fn estimates(best: &Ranked) -> Vec<Estimate> {
    let (fit, free) = (&best.fit, best.candidate.free());
    best.candidate
        .effect(&fit.values)
        .parameters()
        .iter()
        .enumerate()
        .map(|(p, parameter)| {
            let ci95 = free.iter().position(|f| f.parameter == p).map(|i| {
                // The first value is the magnitude, which answers for the scale of the response.
                let scale = if i == 0 { 1.96 * scale_sd(best.effect().layer()) * fit.values[i] } else { 0.0 };
                let half = fit.half_width(i, best.inflation).hypot(scale);
                [fit.values[i] - half, fit.values[i] + half]
            });
            Estimate { name: parameter.name, unit: parameter.unit, value: parameter.value, ci95 }
        })
        .collect()
}

/// Share of half-samples of the drives whose strongest evidence is for the id of `candidate`.
fn stability(expectation: &Expectation, members: &[Member<'_>], selection: &Selection, candidate: Candidate) -> f64 {
    let n = members.len().min(12);
    let half = n.div_ceil(2);
    let (mut hits, mut count) = (0usize, 0usize);
    for subset in (0u32..1 << n).filter(|s| s.count_ones() as usize == half) {
        let chosen: Vec<&Prepared> = (0..n).filter(|i| subset & (1 << i) != 0).map(|i| members[i].1).collect();
        let statistics = mean(chosen.iter().map(|p| &p.statistics));
        let z = expectation.strength(&statistics, &mean_signature(chosen.iter().map(|p| &p.signature))).z;
        let best = (0..z.len()).filter(|e| selection.z[*e].is_some()).max_by(|&a, &b| z[a].total_cmp(&z[b]));
        hits += usize::from(best.is_some_and(|e| Candidate::ALL[e].id() == candidate.id()));
        count += 1;
    }
    hits as f64 / count.max(1) as f64
}

fn verdict(selection: &Selection, scores: Option<&HeldOut>) -> (Verdict, String) {
    if !selection.differs() {
        return (Verdict::None, "no hypothesis stands out from drives without an effect".into());
    }
    if !selection.detected() {
        let [distance, usual] = selection.distance;
        return (
            Verdict::Unexplained,
            format!(
                "the drives differ from the reference ({distance:.1} per statistic, usual up to {usual:.1}), but no effect of the catalogue stands out"
            ),
        );
    }
    if selection.soil_explains() {
        return (Verdict::None, "another soil explains the drives better than any effect".into());
    }
    let best = &selection.ranked[0];
    if let Some(refused) = &best.refused {
        return (
            Verdict::Unexplained,
            format!("the drives differ from the reference, but {} cannot be claimed: {refused}", best.candidate.label()),
        );
    }
    if let Some(scores) = scores {
        if let Some(reason) = not_proven(scores) {
            return (Verdict::Unexplained, format!("{} fits, but {reason}", best.candidate.label()));
        }
    }
    let rival = selection.ranked.iter().skip(1).find(|r| r.candidate.id() != best.candidate.id() && r.bic - best.bic < DECISIVE_BIC);
    match rival {
        Some(rival) => (Verdict::Ambiguous, format!("{} and {} explain it about as well", best.candidate.label(), rival.candidate.label())),
        None => (Verdict::Explained, format!("{} explains it and helps on drives that were not fitted", best.candidate.label())),
    }
}

/// Why the proof on held-out drives fails: nothing improves surely, or something worsens surely by more than 2 %.
fn not_proven(scores: &HeldOut) -> Option<String> {
    let [before, soil, after] = &scores.scores;
    for against in [soil, before] {
        let (_, interval) = paired_difference(&against.errors, &after.errors, &scores.resamples);
        if !interval.row(false).iter().flatten().any(|[low, _]| *low > 0.0) {
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

fn deviations(expectation: &Expectation, prepared: &[Prepared]) -> Vec<StatisticDeviation> {
    let statistics = mean(prepared.iter().map(|p| &p.statistics));
    let (difference, significance) = (expectation.deviation(&statistics), expectation.significance(&statistics));
    let of = |(i, statistic): (usize, &usize)| StatisticDeviation {
        statistic: *statistic,
        difference: difference[i],
        significance: significance[i],
    };
    expectation.used().iter().enumerate().map(of).collect()
}
