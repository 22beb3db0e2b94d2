//! From a selection to claims: size with interval, stability over sub-samples of drives, and the reasons why a claim is refused.

pub(crate) mod constancy;
pub mod fit;

use std::collections::BTreeMap;

use nesam_evaluation::report::Short;
use nesam_physics::SoilCorrection;
use nesam_physics::effects::ScheduledEffect;
use rayon::prelude::*;

use crate::candidates::Candidate;
use crate::claims::fit::{Fit, Prepared, Start, Term, fit};
use crate::ground::Ground;
use crate::observe::channels::{self, Row};
use crate::observe::condense::{Condensed, condense, part_of};
use crate::observe::metric::Metric;
use crate::observe::{Bench, ObservedDrive};
use crate::select::dating::Dating;
use crate::select::evidence::Group;
use crate::select::onset::{Onset, PossibleOnset};
use crate::select::settled::Settled;
use crate::select::{DECISIVE, RIVALS_MAX, Selection, Yardstick, mismatch_of_size};
use crate::work::Work;

/// Largest half of the 95 % interval of a claimed magnitude, as a share of it. The interval contains the disagreement between drives: another effect may
/// pass for this one on a drive, but seldom with the same size on all.
pub(crate) const MAGNITUDE_HALF_MAX: f64 = 0.7;
/// The same from which it is no longer told in percent: a size near zero has any share.
const MAGNITUDE_HALF_UNKNOWN: f64 = 100.0;
/// Most drives whose own sizes are told.
const BY_DRIVE_MAX: usize = 12;
/// Share of half-samples of the drives that must choose a claimed effect or one of its rivals.
const STABILITY_MIN: f64 = 0.6;
/// Parts of neighbouring drives of which all half-samples are looked at; every drive is a part where there are fewer.
pub(crate) const STABILITY_PARTS: usize = 10;
/// Weight of the priors of a fit where the model itself is on trial: they only keep in place what cannot be seen (chosen).
const PRIOR_ON_TRIAL: f64 = 0.01;
/// Student's t for the thirty drives behind a reference.
const T_NULLS: f64 = 2.05;
const T_975: [f64; 10] = [12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23];
/// The same for more degrees of freedom (of 20).
const T_975_MANY: f64 = 2.1;

/// Student's t of a two-sided 95 % interval by so many drives.
pub(crate) fn t_975(drives: usize) -> f64 {
    T_975.get(drives.saturating_sub(2)).copied().unwrap_or(T_975_MANY)
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

/// A member of the class of hypotheses that the drives cannot tell apart.
#[derive(Clone, Copy, Debug)]
pub struct Member {
    /// The hypothesis.
    pub candidate: Candidate,
    /// Weight; those of a class sum to one.
    pub weight: f64,
}

/// An effect that was chosen, with everything that speaks for and against it.
#[derive(Clone, Debug)]
pub struct Finding {
    /// Index in the catalogue.
    pub hypothesis: usize,
    /// The hypothesis.
    pub candidate: Candidate,
    /// Weight in its class.
    pub weight: f64,
    /// Evidence alone.
    pub z: f64,
    /// Evidence after the other effects.
    pub alone: f64,
    /// Criterion against the closest hypothesis of another id.
    pub delta_bic: f64,
    /// Share of half-samples of the drives that choose it or a rival.
    pub stability: f64,
    /// Parameters.
    pub estimates: Vec<Estimate>,
    /// When it began; `None` = there from the start.
    pub onset: Option<Onset>,
    /// When it may have begun, s, where drives speak for an onset and do not decide; the interval of its size allows for that.
    pub may_have_begun_s: Option<f64>,
    /// Rivals within the criterion, closest first.
    pub rivals: Vec<Member>,
    /// Why it is not claimed.
    pub refused: Option<String>,
    /// Whether that is for its size, which lies at the end of its range or is hardly known.
    pub refused_for_size: bool,
}

impl Finding {
    /// A hypothesis of a catalogue that is chosen in all half-samples, with this evidence, alone and after others.
    #[cfg(test)]
    pub(crate) fn of(catalogue: &[Candidate], id: &str, z: f64, estimates: Vec<Estimate>) -> Self {
        let hypothesis = catalogue.iter().position(|c| c.id() == id).unwrap();
        Self {
            hypothesis,
            candidate: catalogue[hypothesis],
            weight: 1.0,
            z,
            alone: z,
            delta_bic: 50.0,
            stability: 1.0,
            estimates,
            onset: None,
            may_have_begun_s: None,
            rivals: Vec::new(),
            refused: None,
            refused_for_size: false,
        }
    }

    /// Lets the interval of a size hold what it would be with an onset that is possible; of an effect of several parameters, which have no common factor, it says only
    /// when.
    fn allow_for(&mut self, possible: PossibleOnset) {
        self.may_have_begun_s = Some(possible.at_s);
        let (candidate, [least, most]) = (self.candidate, possible.factor);
        let Some(parameter) = candidate.free().first().map(|f| f.parameter).filter(|_| candidate.unit().is_some()) else { return };
        let Some([low, high]) = self.estimates.get_mut(parameter).and_then(|e| e.ci95.as_mut()) else { return };
        let with = [*low * least, *low * most, *high * least, *high * most];
        (*low, *high) = with.iter().fold((*low, *high), |(low, high), v| (low.min(*v), high.max(*v)));
    }
}

/// Course of a channel over the drives.
#[derive(Clone, Debug)]
pub struct Trace {
    /// The channel.
    pub channel: usize,
    /// Mean deviation by time (s), without effects.
    pub before: Vec<(f64, f64)>,
    /// The same with the claimed effects.
    pub after: Vec<(f64, f64)>,
}

/// A set of drives, ready to be judged.
#[derive(Clone, Debug)]
pub struct Case<'a> {
    /// Reference.
    pub bench: Bench<'a>,
    /// Metric of what is judged.
    pub metric: Metric,
    /// Metric of the drives without any effect.
    pub metric_without: Metric,
    /// Drives.
    pub prepared: Vec<Prepared>,
    /// Deviations of each drive without any effect.
    pub rows: Vec<Vec<Row>>,
    /// From when on the columns of each hypothesis are there; `None` until onsets were looked for.
    pub(crate) dating: Option<Dating>,
    /// The soil that explains the drives best without an effect, where a model on trial has no map to tell it.
    pub(crate) ground_alone: Option<Ground>,
    /// Who is told how far the work on it is.
    pub(crate) work: Work<'a>,
}

impl Case<'_> {
    /// All drives.
    pub(crate) fn drives(&self) -> Vec<&ObservedDrive> {
        self.prepared.iter().map(|p| &p.drive).collect()
    }

    /// Scores of all drives.
    pub fn condensed(&self) -> impl Iterator<Item = &Condensed> {
        self.prepared.iter().map(|p| &p.condensed)
    }

    /// Sizes the chosen effects together.
    pub fn size(&self, yardstick: &Yardstick, group: &Group, chosen: &[usize], onsets: &[Option<Onset>]) -> Fit {
        let terms: Vec<Term> = chosen
            .iter()
            .map(|h| Term { candidate: yardstick.catalogue[*h], onset_s: onsets[*h].map_or(0.0, |o| o.at_s.max(0.0)) })
            .collect();
        let columns = yardstick.columns(chosen);
        let mut shares = group.joint_shares(&columns);
        let mut offset = Vec::new();
        let values = terms
            .iter()
            .map(|term| {
                let own = term.candidate.columns();
                let rest = shares.split_off(own.len());
                let start = term.candidate.start(&shares, self.bench.vehicle.mass_kg);
                shares = rest;
                match term.candidate.unit() {
                    Some(unit) => offset.push(unit * yardstick.nulls.share[own[0]]),
                    None => offset.extend(term.candidate.free().iter().map(|_| 0.0)),
                }
                start
            })
            .collect();
        let drives: Vec<&Prepared> = self.prepared.iter().collect();
        // What a data sheet lacks is no small change of what a vehicle was.
        let prior = if yardstick.model_on_trial { PRIOR_ON_TRIAL } else { 1.0 };
        fit(&self.bench, &self.metric, &drives, &terms, Start { values, offset, prior })
    }

    /// Scores of what fitted effects leave of each drive.
    pub(crate) fn left(&self, fit: &Fit) -> Vec<Condensed> {
        let effects = fit.effects();
        self.prepared
            .par_iter()
            .map(|p| condense(&self.metric, &p.drive.deviations(&self.bench, &effects, &SoilCorrection::NONE), &p.signatures))
            .collect()
    }

    /// Findings of a selection, in its order, refused or not; with what each was compared with through the physics.
    pub fn findings(
        &self,
        yardstick: &Yardstick,
        selection: &Selection,
        onsets: &[Option<Onset>],
        fit: &Fit,
        settled: &[Option<Settled>],
    ) -> Vec<Finding> {
        let group = yardstick.group(self.condensed());
        self.work.add(selection.chosen.len());
        let mut changes = self.changes(yardstick, fit, &selection.chosen);
        (0..selection.chosen.len())
            .map(|i| {
                let hypothesis = selection.chosen[i];
                let candidate = yardstick.catalogue[hypothesis];
                let (weight, rivals) = class(yardstick, selection, i);
                let other = selection.rivals[i].iter().find(|r| yardstick.catalogue[r.hypothesis].id() != candidate.id());
                let mut finding = Finding {
                    hypothesis,
                    candidate,
                    weight,
                    z: selection.z[hypothesis].unwrap_or(0.0),
                    alone: selection.alone[i],
                    delta_bic: other.map_or(selection.alone[i].powi(2), |r| r.difference),
                    stability: self.stability(yardstick, candidate, &rivals, settled.get(i).and_then(Option::as_ref)),
                    estimates: estimates(&group, fit, i),
                    onset: onsets[hypothesis],
                    may_have_begun_s: None,
                    rivals,
                    refused: None,
                    refused_for_size: false,
                };
                let changed = changes[i].take().map(|change| (change, false));
                // That a size changes says more than how often halves of the drives choose it.
                let refused = match refusal(&group, &finding, fit, i) {
                    Some((_, false)) if changed.is_some() => changed,
                    refused => refused.or(changed),
                };
                if let Some((why, for_size)) = refused {
                    let by_drive = if for_size { self.by_drive(candidate) } else { String::new() };
                    (finding.refused, finding.refused_for_size) = (Some(format!("{why}{by_drive}")), for_size);
                }
                if let Some(possible) = self.possible_onset(hypothesis).filter(|_| finding.onset.is_none()) {
                    finding.allow_for(possible);
                }
                self.work.done();
                finding
            })
            .collect()
    }

    /// What each drive alone makes of the size of an effect of one column, by the slope of its answer; empty for others and for more drives than a line holds.
    fn by_drive(&self, candidate: Candidate) -> String {
        let Some(unit) = candidate.unit().filter(|_| (2..=BY_DRIVE_MAX).contains(&self.prepared.len())) else { return String::new() };
        let column = candidate.columns()[0];
        let size = |own: &Condensed| unit * own.score[column] / own.information[(column, column)].max(1e-12);
        let each: Vec<String> = self.prepared.iter().map(|p| format!("{} {}", p.drive.id, Short(size(&p.condensed)))).collect();
        format!(" (by drive: {})", each.join(", "))
    }

    /// Share of half-samples of the drives that choose a hypothesis, one of its rivals, or something that they cannot tell from it. Halves of drives in none of which it
    /// shows, as all end before it begins, are not asked.
    ///
    /// What was compared through the physics on all drives is compared in the same way on the half ([`Settled::stands`]).
    fn stability(&self, yardstick: &Yardstick, own: Candidate, rivals: &[Member], settled: Option<&Settled>) -> f64 {
        let drives = self.prepared.len();
        let n = drives.min(STABILITY_PARTS);
        let half = n.div_ceil(2);
        let holds = |subset: u32, i: usize| subset & (1 << part_of(i, drives, STABILITY_PARTS)) != 0;
        let answers = |i: usize| own.columns().into_iter().any(|c| self.prepared[i].condensed.information[(c, c)] > 0.0);
        let subsets: Vec<u32> =
            (0u32..1 << n).filter(|s| s.count_ones() as usize == half && (0..drives).any(|i| holds(*s, i) && answers(i))).collect();
        let in_class = |h: usize| {
            let id = yardstick.catalogue[h].id();
            id == own.id() || rivals.iter().any(|r| r.candidate.id() == id)
        };
        let hits = subsets
            .par_iter()
            .filter(|subset| {
                let inside = |i: usize| holds(**subset, i);
                let part = yardstick.group((0..drives).filter(|i| inside(*i)).map(|i| &self.prepared[i].condensed));
                let chosen = yardstick.select(&part).chosen;
                chosen.iter().any(|h| in_class(*h)) || settled.is_some_and(|s| s.stands(yardstick, &chosen, &part, inside, in_class))
            })
            .count();
        hits as f64 / subsets.len().max(1) as f64
    }

    /// Course of the most unusual channel of each residual layer, before and with effects.
    pub fn traces(&self, selection: &Selection, effects: &[ScheduledEffect]) -> Vec<Trace> {
        let with: Vec<Vec<Row>> = if effects.is_empty() {
            self.rows.clone()
        } else {
            self.prepared.iter().map(|p| p.drive.deviations(&self.bench, effects, &SoilCorrection::NONE)).collect()
        };
        let levels = &self.metric.channels;
        ["actuator", "force", "kinematic", "map"]
            .into_iter()
            .filter_map(|layer| {
                let own = (0..levels.len()).filter(|i| channels::layer(levels[*i]) == layer);
                let i = own.max_by(|a, b| selection.levels[*a].total_cmp(&selection.levels[*b]))?;
                Some(Trace { channel: levels[i], before: self.course(&self.rows, i), after: self.course(&with, i) })
            })
            .collect()
    }

    /// Mean over the drives of the deviation of a compared channel from its usual level, by time (s).
    fn course(&self, rows: &[Vec<Row>], i: usize) -> Vec<(f64, f64)> {
        let mut sums: BTreeMap<usize, (f64, f64)> = BTreeMap::new();
        for (prepared, rows) in self.prepared.iter().zip(rows) {
            for (start, row) in prepared.drive.starts.iter().zip(rows) {
                let sum = sums.entry(*start).or_default();
                *sum = (sum.0 + row[self.metric.channels[i]] - self.metric.centre[i], sum.1 + 1.0);
            }
        }
        sums.into_iter().map(|(start, (sum, count))| (start as f64 * self.bench.stepping.dt_s, sum / count)).collect()
    }
}

/// The class of the `i`-th chosen hypothesis: its weight, and its rivals of other ids with theirs.
fn class(yardstick: &Yardstick, selection: &Selection, i: usize) -> (f64, Vec<Member>) {
    let own = yardstick.catalogue[selection.chosen[i]].id();
    let mut ids = vec![own];
    let mut close: Vec<(Candidate, f64)> = Vec::new();
    for rival in selection.rivals[i].iter().filter(|r| r.difference < DECISIVE) {
        let candidate = yardstick.catalogue[rival.hypothesis];
        if !ids.contains(&candidate.id()) && close.len() < RIVALS_MAX {
            ids.push(candidate.id());
            close.push((candidate, (-0.5 * rival.difference.max(0.0)).exp()));
        }
    }
    let total = 1.0 + close.iter().map(|c| c.1).sum::<f64>();
    (1.0 / total, close.into_iter().map(|(candidate, weight)| Member { candidate, weight: weight / total }).collect())
}

/// Half width of the 95 % interval of what follows from the values of a term: the wider of the scatter of null drives and the jackknife over drives.
fn half_width(group: &Group, fit: &Fit, term: usize, derivatives: &[(usize, f64)], of: impl Fn(&[f64]) -> f64) -> f64 {
    let columns = fit.terms[term].candidate.columns();
    let dispersion = columns.iter().map(|c| group.covariance[(*c, *c)] / group.information[(*c, *c)].max(1e-12)).fold(1.0, f64::max);
    let posterior = T_NULLS * fit.sd(term, derivatives) * dispersion.sqrt();
    fit.jackknife_sd(term, of).map_or(posterior, |sd| posterior.max(t_975(fit.jackknife.len()) * sd))
}

fn estimates(group: &Group, fit: &Fit, term: usize) -> Vec<Estimate> {
    let candidate = fit.terms[term].candidate;
    let free = candidate.free();
    let effect = candidate.effect(&fit.values[term]);
    let quantities = effect.quantities();
    effect
        .parameters()
        .iter()
        .enumerate()
        .map(|(p, parameter)| {
            let ci95 = free.iter().position(|f| f.parameter == p).map(|i| {
                // The first value is the magnitude, which answers for the scale of the response.
                let scale =
                    if i == 0 { 1.96 * mismatch_of_size(candidate.layer()) * candidate.magnitude(i, fit.values[term][i]) } else { 0.0 };
                let half = half_width(group, fit, term, &[(i, 1.0)], |values| values[i]).hypot(scale);
                let end = if quantities[p].complete { parameter.range[1] } else { f64::INFINITY };
                [parameter.value - half, (parameter.value + half).min(end)]
            });
            Estimate { name: parameter.name, unit: parameter.unit, value: parameter.value, ci95 }
        })
        .collect()
}

/// Half width of the moments m x, m y and m z of a payload, as shares of them: a vehicle feels them besides the mass, and knows them where it cannot tell a heavy
/// load near the axle from a light one far out.
fn moments(group: &Group, fit: &Fit, term: usize) -> impl Iterator<Item = f64> {
    let values = &fit.values[term];
    (1..values.len()).map(move |i| {
        let half = half_width(group, fit, term, &[(0, values[i]), (i, values[0])], |values| values[0] * values[i]);
        half / (values[0] * values[i]).abs().max(1e-12)
    })
}

/// Why a fit is not claimed even if it is the best, and whether that is for its size.
fn refusal(group: &Group, finding: &Finding, fit: &Fit, term: usize) -> Option<(String, bool)> {
    let free = finding.candidate.free();
    if let Some(i) = fit.held[term].iter().position(|h| *h) {
        let e = &finding.estimates[free[i].parameter];
        return Some((format!("{} = {} {} lies at the end of its physical range", e.name, Short(e.value), e.unit), true));
    }
    if finding.stability < STABILITY_MIN {
        return Some((format!("only {:.0} % of half-samples of the drives choose it", 100.0 * finding.stability), false));
    }
    // An effect of several magnitudes, such as a wind, is known when one of them is.
    let payload = finding.candidate.id() == "payload";
    let relative = free
        .iter()
        .enumerate()
        .filter(|(_, f)| f.parameter == free[0].parameter || finding.candidate.unit().is_none() && f.mean == 0.0 && !payload)
        .filter_map(|(i, f)| {
            let e = finding.estimates.get(f.parameter)?;
            e.ci95.map(|[low, high]| 0.5 * (high - low) / finding.candidate.magnitude(i, e.value).max(1e-12))
        })
        .chain(payload.then(|| moments(group, fit, term)).into_iter().flatten())
        .fold(f64::INFINITY, f64::min);
    if relative > MAGNITUDE_HALF_UNKNOWN {
        return Some(("its size is as good as unknown: half of its interval is more than a hundred times as large".into(), true));
    }
    (relative > MAGNITUDE_HALF_MAX).then(|| (format!("its size is known to ±{:.0} % only", 100.0 * relative), true))
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;
    use crate::candidates::catalogue;

    /// Why a torque limit of 0.95 is refused that is known to ±`half`.
    fn refused(half: f64) -> Option<(String, bool)> {
        let catalogue = catalogue(&[]);
        let estimate = Estimate { name: "fraction", unit: "-", value: 0.95, ci95: Some([0.95 - half, 0.95 + half]) };
        let finding = Finding::of(&catalogue, "torque_limit", 9.0, vec![estimate]);
        let group = Group { score: DVector::zeros(0), information: DMatrix::zeros(0, 0), covariance: DMatrix::zeros(0, 0) };
        let fit = Fit {
            terms: vec![Term { candidate: finding.candidate, onset_s: 0.0 }],
            values: vec![vec![0.95]],
            covariance: DMatrix::zeros(1, 1),
            held: vec![vec![false]],
            jackknife: Vec::new(),
        };
        refusal(&group, &finding, &fit, 0)
    }

    /// Goal: the interval of a size holds what it would be with an onset that is possible. Method: a gain of 0.05 [0.02, 0.08] that is 1.5 to 1.8 times as large if it began midway.
    #[test]
    fn analytic_an_interval_allows_for_an_onset_that_is_possible() {
        let catalogue = catalogue(&[]);
        let estimate = Estimate { name: "relative", unit: "-", value: 0.05, ci95: Some([0.02, 0.08]) };
        let mut finding = Finding::of(&catalogue, "speed_gain", 9.0, vec![estimate]);
        finding.allow_for(PossibleOnset { at_s: 8.8, factor: [1.5, 1.8] });
        let [low, high] = finding.estimates[0].ci95.unwrap();
        assert!((low - 0.02).abs() < 1e-12 && (high - 0.144).abs() < 1e-12);
        assert_eq!(finding.may_have_begun_s, Some(8.8));
    }

    /// A torque that is whole is a fraction of 1: 0.95 takes 0.05 of it away, and 0.5 is ten times that.
    #[test]
    fn analytic_a_factor_is_known_by_its_distance_from_one() {
        assert!(refused(0.5).is_some_and(|(why, for_size)| why.contains("its size is known to") && for_size));
        assert_eq!(refused(0.02), None);
        assert!(refused(1e9).is_some_and(|(why, _)| !why.contains('%')), "as good as unknown");
    }
}
