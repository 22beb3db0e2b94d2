//! What proves an effect of a drive line: that errors fall in most drives, and that nothing in its place does as well.

use super::rims::Rims;
use super::sized::{Sized, T_MIN};
use crate::candidates::Candidate;
use crate::claims::{Estimate, Finding, Member, STABILITY_PARTS};
use crate::observe::condense::part_of;
use crate::select::RIVALS_MAX;

/// Standard errors over drives below which two effects explain as much.
const T_RIVAL: f64 = 2.0;

/// What was held against an effect: everything else without it, and with another in its place.
#[derive(Debug)]
pub(super) struct Doubt {
    pub without: Sized,
    pub instead: Vec<Sized>,
}

impl Rims<'_> {
    pub(super) fn doubt(&self, found: &Sized, i: usize) -> Doubt {
        let without = self.dropped(found, i);
        Doubt { instead: self.instead(found, &without), without }
    }

    /// Others in the place of an effect, sized together with the rest. What takes away less than half of what the effect does at its first size seldom comes up to it.
    fn instead(&self, found: &Sized, without: &Sized) -> Vec<Sized> {
        let open = (0..self.family.len()).filter(|term| !found.terms.contains(term));
        let promising = |begun: &Sized| without.error() - begun.error() > 0.5 * (without.error() - found.error());
        open.map(|term| self.first(without, term)).filter(promising).map(|begun| self.polished(begun)).collect()
    }

    /// What was found, but for what drives do not surely ask for beside the rest, the weakest first: an effect may be sure only beside another that was found after it.
    pub(super) fn proven(&self, mut found: Sized) -> Sized {
        loop {
            let without = (0..found.terms.len()).map(|i| self.dropped(&found, i));
            let weakest = without.map(|without| (found.less_than(&without), without)).min_by(|a, b| a.0.total_cmp(&b.0));
            match weakest {
                Some((t, without)) if t < T_MIN || !found.falls_from(&without) => found = without,
                _ => return found,
            }
        }
    }

    pub(super) fn finding(&self, found: &Sized, i: usize, half_95: f64, doubt: &Doubt, place: impl Fn(Candidate) -> usize) -> Finding {
        let candidate = self.family[found.terms[i]];
        let z = found.less_than(&doubt.without);
        let rival = |rival: &Sized| Some((*rival.terms.last()?, found.less_than(rival)));
        let mut close: Vec<(usize, f64)> = doubt.instead.iter().filter_map(rival).collect();
        close.sort_by(|a, b| a.1.total_cmp(&b.1));
        let rivals = close.iter().filter(|(_, t)| *t < T_RIVAL).take(RIVALS_MAX);
        let rivals = rivals.map(|(term, t)| (self.family[*term], (-0.5 * t.max(0.0).powi(2)).exp())).collect();
        let mut parts = [0.0; STABILITY_PARTS];
        for (d, (without, with)) in doubt.without.by_drive.iter().zip(&found.by_drive).enumerate() {
            parts[part_of(d, self.logs.len(), STABILITY_PARTS)] += without - with;
        }
        let helped = parts.iter().filter(|gain| **gain > 0.0).count();
        let told = Told {
            z,
            difference: close.first().map_or(z * z, |(_, t)| t * t.abs()),
            stability: helped as f64 / self.logs.len().min(STABILITY_PARTS) as f64,
            half_95,
            rivals,
        };
        finding(candidate, place(candidate), found.values[i], told)
    }
}

/// What is told of an effect beside its size.
#[derive(Debug)]
pub(super) struct Told {
    pub z: f64,
    pub difference: f64,
    pub stability: f64,
    pub half_95: f64,
    pub rivals: Vec<(Candidate, f64)>,
}

/// An effect of this size as a finding.
pub(super) fn finding(candidate: Candidate, hypothesis: usize, value: f64, told: Told) -> Finding {
    let effect = candidate.effect(&[value]);
    let at = candidate.free()[0].parameter;
    let (parameter, quantity) = (&effect.parameters()[at], &effect.quantities()[at]);
    let end = if quantity.complete { parameter.range[1] } else { f64::INFINITY };
    let total = 1.0 + told.rivals.iter().map(|(_, weight)| weight).sum::<f64>();
    Finding {
        hypothesis,
        candidate,
        weight: 1.0 / total,
        z: told.z,
        alone: told.z,
        delta_bic: told.difference,
        stability: told.stability,
        estimates: vec![Estimate {
            name: parameter.name,
            unit: parameter.unit,
            value,
            ci95: Some([value - told.half_95, (value + told.half_95).min(end)]),
        }],
        onset: None,
        may_have_begun_s: None,
        rivals: told.rivals.iter().map(|(candidate, weight)| Member { candidate: *candidate, weight: weight / total }).collect(),
        refused: None,
        refused_for_size: false,
    }
}
