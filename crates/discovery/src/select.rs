//! Which hypothesis a group of drives supports, if any.

use crate::candidates::Candidate;
use crate::normal::Normal;
use crate::reference::{NullGroups, Reference};
use crate::refit::{Bench, Fit, Member, fit_effect};
use crate::scan::{Strength, shares, strength};

/// Hypotheses that are refitted.
const REFITTED: usize = 4;
/// Difference of the information criterion that decides.
pub const DECISIVE_BIC: f64 = 6.0;
/// Largest relative standard deviation of a magnitude that is claimed.
const MAGNITUDE_SD_MAX: f64 = 0.2;
/// Threshold without null groups: 5 % family-wise for 28 candidates, doubled because offsets between drives are then known badly.
const THRESHOLD_ALONE: f64 = 6.2;

/// A refitted hypothesis with its criterion.
#[derive(Clone, Debug)]
pub struct Ranked {
    /// The fit.
    pub fit: Fit,
    /// Information criterion relative to "no effect": negative = better.
    pub bic: f64,
    /// Weight among the refitted hypotheses.
    pub weight: f64,
    /// Why it cannot be claimed.
    pub refused: Option<String>,
}

/// What a group of drives says.
#[derive(Clone, Debug)]
pub struct Selection {
    /// Evidence by hypothesis, before the null spread is taken out.
    pub strength: Strength,
    /// Evidence by hypothesis in units of its null spread; `None` for those left out.
    pub z: Vec<Option<f64>>,
    /// Family-wise threshold.
    pub threshold: f64,
    /// Family-wise probability of the largest evidence, and the smallest that could be shown.
    pub probability: Option<[f64; 2]>,
    /// Refitted hypotheses, best first; empty when nothing is detected.
    pub ranked: Vec<Ranked>,
    /// Variance that the best refit leaves, at least 1.
    pub dispersion: f64,
}

impl Selection {
    /// The best hypothesis, if it may be claimed.
    pub fn claimed(&self) -> Option<&Ranked> {
        self.ranked.first().filter(|r| r.refused.is_none())
    }

    /// Whether anything is detected.
    pub fn detected(&self) -> bool {
        self.z.iter().flatten().any(|z| *z >= self.threshold)
    }
}

/// Judges a group of drives; hypotheses in `without` are left out.
pub fn select(bench: &Bench<'_>, reference: &Reference, members: &[Member<'_>], without: &[String]) -> Selection {
    let group = Normal::sum(members.iter().map(|(_, p)| &p.scores)).expect("a group has drives; this is a bug");
    let whole = members.iter().all(|(d, _)| (0..d.available.len()).all(|c| d.available[c] || !reference.channels[c].used));
    let nulls = if whole { reference.null_groups(members.len()) } else { None };
    let strength = strength(&group);
    let kept = |c: &Candidate| !without.iter().any(|id| id == c.id());
    let spread = |e: usize| nulls.as_ref().map_or(1.0, |n| n.spread[e]);
    let z: Vec<Option<f64>> = Candidate::ALL.iter().enumerate().map(|(e, c)| kept(c).then(|| strength.z[e] / spread(e))).collect();
    let threshold = nulls.as_ref().map_or(THRESHOLD_ALONE, |n: &NullGroups| n.threshold);
    let largest = z.iter().flatten().copied().fold(0.0, f64::max);
    let probability = nulls.as_ref().map(|n| [n.probability(largest), n.attainable()]);
    let mut selection = Selection { strength, z, threshold, probability, ranked: Vec::new(), dispersion: 1.0 };
    if selection.detected() {
        rank(bench, members, &group, &mut selection);
    }
    selection
}

fn rank(bench: &Bench<'_>, members: &[Member<'_>], group: &Normal, selection: &mut Selection) {
    let mut order: Vec<(usize, f64)> = selection.z.iter().enumerate().filter_map(|(e, z)| z.map(|z| (e, z))).collect();
    order.sort_by(|a, b| b.1.total_cmp(&a.1));
    let fits: Vec<Fit> = order
        .iter()
        .take(REFITTED)
        .map(|(e, _)| {
            let candidate = Candidate::ALL[*e];
            fit_effect(bench, members, candidate, candidate.start(&shares(group, candidate)))
        })
        .collect();
    let best = fits.iter().map(|f| f.misfit).fold(group.misfit, f64::min);
    let dispersion = (best / group.numbers as f64).max(1.0);
    let segments: usize = members.iter().map(|(d, _)| d.starts.len()).sum();
    let criterion = |f: &Fit| (f.misfit - group.misfit) / dispersion + f.values.len() as f64 * (segments as f64).ln();
    let lowest = fits.iter().map(criterion).fold(f64::INFINITY, f64::min);
    let total: f64 = fits.iter().map(|f| (-0.5 * (criterion(f) - lowest)).exp()).sum();
    selection.dispersion = dispersion;
    selection.ranked = fits
        .into_iter()
        .map(|fit| {
            let bic = criterion(&fit);
            let refused = refusal(&fit, bic, dispersion);
            Ranked { bic, weight: (-0.5 * (bic - lowest)).exp() / total, refused, fit }
        })
        .collect();
    selection.ranked.sort_by(|a, b| a.bic.total_cmp(&b.bic));
}

/// Why a fit is not claimed even if it is the best.
fn refusal(fit: &Fit, bic: f64, dispersion: f64) -> Option<String> {
    let names = fit.effect().parameters();
    if let Some(i) = fit.held.iter().position(|h| *h) {
        let p = &names[fit.candidate.free()[i].parameter];
        return Some(format!("{} = {:.3} {} lies at the end of its physical range", p.name, p.value, p.unit));
    }
    if bic > -DECISIVE_BIC {
        return Some(format!("explains too little for its parameters (criterion {bic:+.1} against no effect)"));
    }
    let relative = fit.sd[0] * dispersion.sqrt() / fit.values[0].abs().max(1e-12);
    (relative > MAGNITUDE_SD_MAX).then(|| format!("its size is known to {:.0} % only", 100.0 * relative))
}
