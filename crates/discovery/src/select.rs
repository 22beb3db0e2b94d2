//! Which hypothesis a group of drives supports, if any.

use nesam_physics::SoilCorrection;
use nesam_physics::effects::Effect;

use crate::candidates::Candidate;
use crate::expectation::{Expectation, Strength, mean, mean_signature};
use crate::features::FEATURES;
use crate::fit::{Bench, Fit, Member, SoilFit, Weighing};
use crate::reference::NullGroups;

/// Most hypotheses that are fitted.
const FITTED: usize = 4;
/// Share of the strongest evidence below which a hypothesis is not fitted.
const FITTED_SHARE: f64 = 0.4;
/// Difference of the information criterion that decides.
pub const DECISIVE_BIC: f64 = 6.0;
/// Largest half of the 95 % interval of a claimed magnitude, as a share of it. The interval contains the disagreement between drives: another effect may
/// pass for this one on a drive, but seldom with the same size on all.
const MAGNITUDE_HALF_MAX: f64 = 0.7;
/// Smallest share of the squared distance that a claimed effect explains (chosen).
const EXPLAINED_MIN: f64 = 0.6;
/// Threshold without null groups: twice that of 28 candidates at 5 % family-wise.
const THRESHOLD_ALONE: f64 = 6.2;

/// A fitted hypothesis with its criterion.
#[derive(Clone, Debug)]
pub struct Ranked {
    /// The hypothesis.
    pub candidate: Candidate,
    /// The fit.
    pub fit: Fit,
    /// Information criterion relative to "no effect": negative = better.
    pub bic: f64,
    /// Weight among the fitted hypotheses.
    pub weight: f64,
    /// Factor by which the fit's own standard deviations are too small: null spread, or what the fit leaves unexplained.
    pub inflation: f64,
    /// Why it cannot be claimed.
    pub refused: Option<String>,
}

impl Ranked {
    /// The effect with its fitted parameters.
    pub fn effect(&self) -> Effect {
        self.candidate.effect(&self.fit.values)
    }
}

/// What a group of drives says.
#[derive(Clone, Debug)]
pub struct Selection {
    /// Evidence by hypothesis in units of its null spread; `None` for those left out.
    pub z: Vec<Option<f64>>,
    /// Family-wise threshold.
    pub threshold: f64,
    /// Family-wise probability of the largest evidence, and the smallest that could be shown.
    pub probability: Option<[f64; 2]>,
    /// Squared distance from drives without an effect, per statistic, and the largest that counts as usual.
    pub distance: [f64; 2],
    /// Fitted hypotheses, best first; empty when nothing is detected.
    pub ranked: Vec<Ranked>,
    /// Criterion of another soil, common to all drives, relative to "no effect".
    pub soil_bic: Option<f64>,
    /// Best soil without an effect.
    pub soil: SoilCorrection,
    /// Squared distance per statistic that the best fit leaves, in units of what is usual; at least 1.
    pub dispersion: f64,
}

impl Selection {
    /// The best hypothesis, if it may be claimed.
    pub fn claimed(&self) -> Option<&Ranked> {
        self.ranked.first().filter(|r| r.refused.is_none() && !self.soil_explains())
    }

    /// Whether any hypothesis stands out.
    pub fn detected(&self) -> bool {
        self.z.iter().flatten().any(|z| *z >= self.threshold)
    }

    /// Whether the drives differ from the reference, known cause or not.
    pub fn differs(&self) -> bool {
        self.detected() || self.distance[0] > self.distance[1]
    }

    /// Whether another soil explains the drives at least as well as any effect.
    pub fn soil_explains(&self) -> bool {
        let best = self.ranked.first().map_or(0.0, |r| r.bic);
        self.soil_bic.is_some_and(|soil| soil < -DECISIVE_BIC && soil < best)
    }
}

/// What a group of drives is compared with.
#[derive(Clone, Debug)]
pub struct Yardstick {
    /// What such a group says without an effect.
    pub expectation: Expectation,
    /// Null groups of as many drives.
    pub nulls: Option<NullGroups>,
}

impl Yardstick {
    fn threshold(&self) -> f64 {
        self.nulls.as_ref().map_or(THRESHOLD_ALONE, |n| n.threshold)
    }

    fn spread(&self, e: usize) -> f64 {
        self.nulls.as_ref().map_or(1.0, |n| n.spread[e])
    }

    /// Evidence of the drives, and each hypothesis' z in units of its null spread; `None` for those in `without`.
    fn evidence(&self, members: &[Member<'_>], without: &[String]) -> (Strength, Vec<Option<f64>>) {
        let signature = mean_signature(members.iter().map(|(_, p)| &p.signature));
        let strength = self.expectation.strength(&mean(members.iter().map(|(_, p)| &p.statistics)), &signature);
        let kept = |c: &Candidate| !without.iter().any(|id| id == c.id());
        let z = Candidate::ALL.iter().enumerate().map(|(e, c)| kept(c).then(|| strength.z[e] / self.spread(e))).collect();
        (strength, z)
    }
}

/// Judges a group of drives; hypotheses in `without` are left out.
pub fn select(bench: &Bench<'_>, yardstick: &Yardstick, members: &[Member<'_>], without: &[String]) -> Selection {
    let (strength, z) = yardstick.evidence(members, without);
    let largest = z.iter().flatten().copied().fold(0.0, f64::max);
    let weighing = Weighing::new(&yardstick.expectation, members.iter().map(|(_, p)| &p.statistics));
    let soil = weighing.fit_soil(members);
    let nulls = yardstick.nulls.as_ref();
    let mut selection = Selection {
        z,
        threshold: yardstick.threshold(),
        probability: nulls.map(|n| [n.probability(largest), n.attainable()]),
        distance: [strength.distance, nulls.map_or(f64::INFINITY, |n| n.distance)],
        ranked: Vec::new(),
        soil_bic: None,
        soil: soil.correction,
        dispersion: 1.0,
    };
    if selection.detected() {
        rank(bench, yardstick, &weighing, members, &strength, &soil, &mut selection);
    }
    selection
}

fn rank(
    bench: &Bench<'_>,
    yardstick: &Yardstick,
    weighing: &Weighing<'_>,
    members: &[Member<'_>],
    strength: &Strength,
    soil: &SoilFit,
    selection: &mut Selection,
) {
    let mut order: Vec<(usize, f64)> = selection.z.iter().enumerate().filter_map(|(e, z)| z.map(|z| (e, z))).collect();
    order.sort_by(|a, b| b.1.total_cmp(&a.1));
    let strongest = order.first().map_or(0.0, |o| o.1);
    let fits: Vec<(usize, Fit)> = order
        .iter()
        .take(FITTED)
        .filter(|(_, z)| *z >= FITTED_SHARE * strongest)
        .map(|(e, _)| (*e, weighing.fit(bench, members, Candidate::ALL[*e], Candidate::ALL[*e].start(&strength.shares[*e]))))
        .collect();
    let statistics = yardstick.expectation.used().len() as f64;
    let usual = selection.distance[1].clamp(1.0, FEATURES as f64);
    let best = fits.iter().map(|(_, f)| f.misfit).fold(weighing.misfit, f64::min);
    selection.dispersion = (best / statistics / usual).max(1.0);
    let criterion = |misfit: f64, values: usize| (misfit - weighing.misfit) / selection.dispersion + values as f64 * statistics.ln();
    selection.soil_bic = Some(criterion(soil.misfit, soil.correction.delta.len()));
    let bics: Vec<f64> = fits.iter().map(|(_, f)| criterion(f.misfit, f.values.len())).collect();
    let lowest = bics.iter().copied().fold(f64::INFINITY, f64::min);
    let total: f64 = bics.iter().map(|b| (-0.5 * (b - lowest)).exp()).sum();
    let mut ranked: Vec<Ranked> = fits
        .into_iter()
        .zip(bics)
        .map(|((e, fit), bic)| {
            let candidate = Candidate::ALL[e];
            let inflation = yardstick.spread(e).max(selection.dispersion.sqrt());
            let refused = refusal(candidate, &fit, bic, inflation, 1.0 - fit.misfit / weighing.misfit);
            Ranked { candidate, bic, weight: (-0.5 * (bic - lowest)).exp() / total, inflation, refused, fit }
        })
        .collect();
    ranked.sort_by(|a, b| a.bic.total_cmp(&b.bic));
    selection.ranked = ranked;
}

/// What a part of the drives says by itself, given the fits of all: the best soil, and the effect it would claim.
///
/// Detection, choice and size follow from the part; only the point of linearisation is that of the whole.
pub fn reselect(
    yardstick: &Yardstick,
    members: &[Member<'_>],
    kept: &[usize],
    whole: &Selection,
    without: &[String],
) -> (SoilCorrection, Option<Effect>) {
    let part: Vec<Member<'_>> = kept.iter().map(|&d| members[d]).collect();
    let weighing = Weighing::new(&yardstick.expectation, part.iter().map(|(_, p)| &p.statistics));
    let soil = weighing.fit_soil(&part).correction;
    let (_, z) = yardstick.evidence(&part, without);
    if whole.claimed().is_none() || !z.iter().flatten().any(|z| *z >= yardstick.threshold()) {
        return (soil, None);
    }
    let count = yardstick.expectation.used().len() as f64;
    let criterion = |r: &Ranked| {
        let (values, misfit) = weighing.refit(&r.fit, kept);
        (r.candidate.effect(&values), misfit + values.len() as f64 * count.ln())
    };
    let best = whole.ranked.iter().filter(|r| r.refused.is_none()).map(criterion).min_by(|a, b| a.1.total_cmp(&b.1));
    (soil, best.map(|(effect, _)| effect))
}

/// Why a fit is not claimed even if it is the best.
fn refusal(candidate: Candidate, fit: &Fit, bic: f64, inflation: f64, explained: f64) -> Option<String> {
    let names = candidate.effect(&fit.values).parameters();
    if let Some(i) = fit.held.iter().position(|h| *h) {
        let p = &names[candidate.free()[i].parameter];
        return Some(format!("{} = {:.3} {} lies at the end of its physical range", p.name, p.value, p.unit));
    }
    if bic > -DECISIVE_BIC {
        return Some(format!("explains too little for its parameters (criterion {bic:+.1} against no effect)"));
    }
    if explained < EXPLAINED_MIN {
        return Some(format!("explains {:.0} % of what is different", 100.0 * explained));
    }
    let relative = fit.half_width(0, inflation) / fit.values[0].abs().max(1e-12);
    (relative > MAGNITUDE_HALF_MAX).then(|| format!("its size is known to ±{:.0} % only", 100.0 * relative))
}
