//! The whole diagnosis of a set: detect, select, refit, prove on drives that were not fitted.

use nesam_evaluation::{DriveMaps, ErrorTree, paired_difference};
use nesam_model::Predictor;
use nesam_physics::SoilCorrection;
use nesam_trajectories::Trajectory;
use rayon::prelude::*;

use crate::candidates::Candidate;
use crate::channels::CHANNELS;
use crate::error::DiscoveryError;
use crate::held_out::{HeldOut, Learned, Scoring, score_held_out};
use crate::normal::Normal;
use crate::observe::{ObservedDrive, observe_all};
use crate::reference::Reference;
use crate::refit::{Bench, Fit, Member, fit_effect, fit_soil};
use crate::scan::{Prepared, Stepping, prepare, strength};
use crate::select::{DECISIVE_BIC, Selection, select};
use crate::whitening::Whitening;

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

/// Mean whitened deviation of one channel over the set.
#[derive(Clone, Debug)]
pub struct ChannelDeviation {
    /// Channel.
    pub channel: usize,
    /// Mean deviation in standard deviations of one segment.
    pub mean: f64,
    /// The same divided by what such a mean scatters without an effect.
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
    /// Deviations by channel.
    pub channels: Vec<ChannelDeviation>,
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
    let available = core::array::from_fn(|c| observed.iter().all(|d| d.available[c]));
    let whitening = Whitening::new(&reference, &available)?;
    let stepping = Stepping { dt_s: bundle.normalization.dt_s, substeps: bundle.normalization.substeps };
    let bench = Bench { whitening: &whitening, vehicle: &bundle.vehicle, stepping };
    let prepared: Vec<Prepared> = observed.par_iter().map(|d| prepare(&whitening, &bundle.vehicle, stepping, d)).collect();
    let members: Vec<Member<'_>> = observed.iter().zip(&prepared).collect();

    let selection = select(&bench, &reference, &members, &options.without);
    let without_one = |left_out: usize| -> Vec<Member<'_>> { (0..total).filter(|i| *i != left_out).map(|i| members[i]).collect() };
    let folds: Vec<usize> = if total > 1 { (0..total).collect() } else { Vec::new() };
    let learned = learn(&bench, &reference, &members, &selection, options, &folds, drives.len() - total, progress);
    let estimates = selection.claimed().map_or_else(Vec::new, |best| {
        let jackknife: Vec<Fit> =
            folds.par_iter().map(|&d| fit_effect(&bench, &without_one(d), best.fit.candidate, best.fit.values.clone())).collect();
        estimates(&best.fit, &jackknife, selection.dispersion)
    });
    let stability = selection.claimed().map(|best| stability(&members, &selection, best.fit.candidate));

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
        channels: channel_deviations(&reference, &bench, &observed),
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

/// What each held-out drive is predicted with: learned without it, selection included.
#[allow(clippy::too_many_arguments)]
fn learn(
    bench: &Bench<'_>,
    reference: &Reference,
    members: &[Member<'_>],
    selection: &Selection,
    options: &Options,
    folds: &[usize],
    held_out: usize,
    progress: OnProgress<'_>,
) -> Vec<Learned> {
    if options.fit_on.is_some() {
        let effects = selection.claimed().map(|r| r.fit.effect()).into_iter().collect();
        return vec![Learned { soil: fit_soil(bench, members), effects }; held_out];
    }
    folds
        .iter()
        .map(|&left_out| {
            progress("drives left out", left_out + 1, folds.len());
            let rest: Vec<Member<'_>> = (0..members.len()).filter(|i| *i != left_out).map(|i| members[i]).collect();
            let fold = if selection.detected() { Some(select(bench, reference, &rest, &options.without)) } else { None };
            let effects = fold.as_ref().and_then(Selection::claimed).map(|r| r.fit.effect()).into_iter().collect();
            Learned { soil: fit_soil(bench, &rest), effects }
        })
        .collect()
}

/// Values with intervals: the wider of the model's own and the jackknife over drives with Student's t.
fn estimates(fit: &Fit, jackknife: &[Fit], dispersion: f64) -> Vec<Estimate> {
    const T_975: [f64; 10] = [12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23];
    let n = jackknife.len();
    let free = fit.candidate.free();
    fit.effect()
        .parameters()
        .iter()
        .enumerate()
        .map(|(p, parameter)| {
            let ci95 = free.iter().position(|f| f.parameter == p).map(|i| {
                let mut half = 1.96 * fit.sd[i] * dispersion.sqrt();
                if n > 1 {
                    let mean = jackknife.iter().map(|f| f.values[i]).sum::<f64>() / n as f64;
                    let square = jackknife.iter().map(|f| (f.values[i] - mean).powi(2)).sum::<f64>();
                    let t = T_975.get(n - 2).copied().unwrap_or(2.1);
                    half = half.max(t * (square * (n - 1) as f64 / n as f64).sqrt());
                }
                [fit.values[i] - half, fit.values[i] + half]
            });
            Estimate { name: parameter.name, unit: parameter.unit, value: parameter.value, ci95 }
        })
        .collect()
}

/// Share of half-samples of the drives whose strongest evidence is for the id of `candidate`.
fn stability(members: &[Member<'_>], selection: &Selection, candidate: Candidate) -> f64 {
    let n = members.len().min(12);
    let half = n.div_ceil(2);
    let spread = |e: usize| selection.z[e].map_or(f64::INFINITY, |z| (selection.strength.z[e] / z.max(1e-9)).max(1.0));
    let (mut hits, mut count) = (0usize, 0usize);
    for subset in (0u32..1 << n).filter(|s| s.count_ones() as usize == half) {
        let chosen = (0..n).filter(|i| subset & (1 << i) != 0).map(|i| &members[i].1.scores);
        let z = strength(&Normal::sum(chosen).expect("half of the drives is not none; this is a bug")).z;
        let best = (0..z.len()).max_by(|&a, &b| (z[a] / spread(a)).total_cmp(&(z[b] / spread(b))));
        hits += usize::from(best.is_some_and(|e| Candidate::ALL[e].id() == candidate.id()));
        count += 1;
    }
    hits as f64 / count.max(1) as f64
}

fn verdict(selection: &Selection, scores: Option<&HeldOut>) -> (Verdict, String) {
    if !selection.detected() {
        return (Verdict::None, "no hypothesis stands out from drives without an effect".into());
    }
    let best = &selection.ranked[0];
    if let Some(refused) = &best.refused {
        return (
            Verdict::Unexplained,
            format!("the drives differ from the reference, but {} cannot be claimed: {refused}", best.fit.candidate.label()),
        );
    }
    if let Some(scores) = scores {
        if let Some(reason) = not_proven(scores) {
            return (Verdict::Unexplained, format!("{} fits, but {reason}", best.fit.candidate.label()));
        }
    }
    let rival =
        selection.ranked.iter().skip(1).find(|r| r.fit.candidate.id() != best.fit.candidate.id() && r.bic - best.bic < DECISIVE_BIC);
    match rival {
        Some(rival) => {
            (Verdict::Ambiguous, format!("{} and {} explain it about as well", best.fit.candidate.label(), rival.fit.candidate.label()))
        }
        None => (Verdict::Explained, format!("{} explains it and helps on drives that were not fitted", best.fit.candidate.label())),
    }
}

/// Why the proof on held-out drives fails: nothing improves surely, or something worsens surely by more than 2 %.
fn not_proven(scores: &HeldOut) -> Option<String> {
    let [before, soil, after] = &scores.scores;
    let numbers = |t: &ErrorTree<f64>| [t.mae_mean.to_array().to_vec(), vec![t.position_m.mean]].concat();
    let ends = |t: &ErrorTree<[f64; 2]>| [t.mae_mean.to_array().to_vec(), vec![t.position_m.mean]].concat();
    for against in [soil, before] {
        let (_, interval) = paired_difference(&against.errors, &after.errors, &scores.resamples);
        if !ends(&interval).iter().flatten().any(|[low, _]| *low > 0.0) {
            return Some("no error falls surely on drives that were not fitted".into());
        }
    }
    let (difference, interval) = paired_difference(&after.errors, &before.errors, &scores.resamples);
    let base = numbers(&before.summary.tree);
    let worse = numbers(&difference).iter().zip(ends(&interval)).zip(&base).any(|((d, i), b)| match (d, i, b) {
        (Some(d), Some([low, _]), Some(b)) => low > 0.0 && *d > 0.02 * b,
        _ => false,
    });
    worse.then(|| "an error rises surely on drives that were not fitted".into())
}

fn channel_deviations(reference: &Reference, bench: &Bench<'_>, observed: &[ObservedDrive]) -> Vec<ChannelDeviation> {
    let model = bench.stepping.model(bench.vehicle);
    let mut sums = [[0.0f64; 2]; CHANNELS];
    for drive in observed {
        for (s, row) in drive.deviations(&model, &SoilCorrection::NONE).iter().enumerate() {
            for &c in bench.whitening.used() {
                sums[c][0] += reference.scaled(c, drive, s, row);
                sums[c][1] += 1.0;
            }
        }
    }
    bench
        .whitening
        .used()
        .iter()
        .map(|&channel| {
            let [sum, count] = sums[channel];
            let statistics = &reference.channels[channel];
            let by_chance = (1.0 + statistics.colour) / (1.0 - statistics.colour) / count;
            let between = statistics.offset_sd.powi(2) / observed.len() as f64;
            ChannelDeviation { channel, mean: sum / count, significance: sum / count / (by_chance + between).sqrt() }
        })
        .collect()
}
