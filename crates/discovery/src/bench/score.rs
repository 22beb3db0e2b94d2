//! What a diagnosis of a hidden effect is worth.

use serde::Serialize;

use super::Hidden;
use crate::claims::Finding;
use crate::diagnose::{Judgement, Verdict};
use crate::report::describe;

/// A claim in a run.
#[derive(Clone, Debug, Serialize)]
pub struct Claim {
    /// Claimed id.
    pub id: &'static str,
    /// Ids of its rivals.
    pub rivals: Vec<&'static str>,
    /// Values and intervals of its parameters.
    pub parameters: Vec<(&'static str, f64, Option<[f64; 2]>)>,
    /// When it began, s; `None` = from the start.
    pub onset_s: Option<f64>,
}

/// One pseudo-vehicle.
#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    /// Set of the benchmark.
    pub set: &'static str,
    /// Ids that were there, with the value that is scored.
    pub truth: Vec<(&'static str, f64)>,
    /// Group of drives.
    pub group: usize,
    /// When the effect began, s.
    pub onset_s: f64,
    /// Verdict before the proof on held-out drives, which rolls out predictions and is not part of this benchmark.
    pub verdict: &'static str,
    /// Its reason.
    pub reason: String,
    /// Largest evidence, and the threshold.
    pub evidence: [f64; 2],
    /// Claims.
    pub claims: Vec<Claim>,
    /// Time of the diagnosis, s.
    pub seconds: f64,
}

impl Outcome {
    pub(super) fn of(hidden: &Hidden, group: usize, judgement: &Judgement, seconds: f64) -> Self {
        let claim = |f: &Finding| Claim {
            id: f.candidate.id(),
            rivals: f.rivals.iter().map(|r| r.candidate.id()).collect(),
            parameters: f.estimates.iter().map(|e| (e.name, e.value, e.ci95)).collect(),
            onset_s: f.onset.map(|o| o.at_s),
        };
        let refused: Vec<String> = judgement
            .findings
            .iter()
            .filter_map(|f| f.refused.as_ref().map(|why| format!("{} ({}) refused: {why}", f.candidate.label(), describe(f))))
            .collect();
        Self {
            set: hidden.set,
            truth: hidden.truth.clone(),
            group,
            onset_s: hidden.onset_s,
            verdict: judgement.verdict.as_str(),
            reason: std::iter::once(judgement.reason.clone()).chain(refused).collect::<Vec<_>>().join("; "),
            evidence: [judgement.selection.largest(), judgement.selection.threshold],
            claims: judgement.claimed().into_iter().map(|i| claim(&judgement.findings[i])).collect(),
            seconds,
        }
    }

    fn withheld(&self) -> bool {
        self.set == "left_out"
    }

    /// Whether something is there that may be claimed.
    fn claimable(&self) -> bool {
        !self.truth.is_empty() && !self.withheld()
    }

    /// Whether exactly what is there was claimed.
    pub fn right(&self) -> bool {
        self.claimable()
            && self.claims.len() == self.truth.len()
            && self.truth.iter().all(|(id, _)| self.claims.iter().any(|c| c.id == *id))
    }

    /// The claim whose class has an id.
    fn class_of(&self, id: &str) -> Option<&Claim> {
        self.claims.iter().find(|c| c.id == id || c.rivals.contains(&id))
    }

    /// Whether everything that is there lies in the class of a claim.
    pub fn covered(&self) -> bool {
        self.claimable() && self.truth.iter().all(|(id, _)| self.class_of(id).is_some())
    }

    /// Whether something was claimed that is not there.
    pub fn wrong(&self) -> bool {
        self.claims.iter().any(|c| self.withheld() || !self.truth.iter().any(|(id, _)| c.id == *id || c.rivals.contains(id)))
    }

    /// Relative error and whether the interval holds the truth, of every true effect that was claimed by name and has one scored parameter.
    fn sizes(&self) -> Vec<(f64, bool)> {
        let of = |(id, value): &(&str, f64)| {
            let claim = self.claims.iter().find(|c| c.id == *id)?;
            let (_, found, interval) = claim.parameters.iter().find(|p| p.2.is_some())?;
            let inside = interval.is_some_and(|[low, high]| low <= *value && *value <= high);
            Some(((found - value).abs() / value.abs().max(1e-12), inside))
        };
        self.truth.iter().filter_map(of).collect()
    }
}

/// Scores of a set of the benchmark: shares of its runs, `None` where nothing was scored.
#[derive(Clone, Debug, Serialize)]
pub struct Scores {
    /// Pseudo-vehicles.
    pub runs: usize,
    /// Exactly what is there was claimed.
    pub top1: Option<f64>,
    /// Everything that is there was claimed by name or as a rival, and nothing else.
    pub class_accuracy: Option<f64>,
    /// Everything that is there lies in the class of a claim.
    pub set_coverage: Option<f64>,
    /// Mean members of a class.
    pub set_size: Option<f64>,
    /// Something was claimed where nothing is.
    pub false_alarm: Option<f64>,
    /// Something was claimed that is not there.
    pub wrong_claim: f64,
    /// Something differs, and nothing was claimed.
    pub unexplained: f64,
    /// Median relative error of the sizes.
    pub magnitude_error_median: Option<f64>,
    /// Share of the 95 % intervals that hold the truth.
    pub ci_coverage: Option<f64>,
    /// Median error of the onset, s.
    pub onset_error_median_s: Option<f64>,
    /// Share of the gain of the true effect that is reached; not measured here.
    pub share_of_oracle: Option<f64>,
}

/// Scores of the runs of one set.
pub fn scores(runs: &[&Outcome]) -> Scores {
    let share = |of: &dyn Fn(&Outcome) -> bool| runs.iter().filter(|r| of(r)).count() as f64 / runs.len().max(1) as f64;
    let claimable = runs.iter().any(|r| r.claimable());
    let null = runs.iter().all(|r| r.truth.is_empty()) && runs.iter().all(|r| r.set.starts_with("null"));
    let sizes: Vec<(f64, bool)> = runs.iter().flat_map(|r| r.sizes()).collect();
    let classes: Vec<f64> = runs.iter().flat_map(|r| r.claims.iter().map(|c| 1.0 + c.rivals.len() as f64)).collect();
    let onsets: Vec<f64> = runs
        .iter()
        .filter(|r| r.onset_s > 0.0)
        .flat_map(|r| r.claims.iter().filter_map(|c| c.onset_s.map(|o| (o - r.onset_s).abs())))
        .collect();
    let median = |values: &[f64]| (!values.is_empty()).then(|| nesam_evaluation::median(values));
    let mean = |values: &[f64]| (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64);
    Scores {
        runs: runs.len(),
        top1: claimable.then(|| share(&Outcome::right)),
        class_accuracy: claimable.then(|| share(&|r| r.covered() && !r.wrong())),
        set_coverage: claimable.then(|| share(&Outcome::covered)),
        set_size: mean(&classes),
        false_alarm: null.then(|| share(&|r| !r.claims.is_empty())),
        wrong_claim: share(&Outcome::wrong),
        unexplained: share(&|r| r.verdict == Verdict::Unexplained.as_str()),
        magnitude_error_median: median(&sizes.iter().map(|s| s.0).collect::<Vec<_>>()),
        ci_coverage: mean(&sizes.iter().map(|s| f64::from(u8::from(s.1))).collect::<Vec<_>>()),
        onset_error_median_s: median(&onsets),
        share_of_oracle: None,
    }
}
