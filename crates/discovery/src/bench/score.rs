//! What a diagnosis of a hidden effect is worth.

use serde::Serialize;

use super::{Comparison, Hidden};
use crate::claims::Finding;
use crate::judgement::{Judgement, Verdict};
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
    /// What other methods made of it; empty when they were not asked.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub comparisons: Vec<Comparison>,
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
            comparisons: Vec::new(),
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
    /// 95 % interval of the rate of false alarms (Clopper and Pearson 1934), as if the groups were independent.
    pub false_alarm_ci95: Option<[f64; 2]>,
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
    /// Share of the gain of the refitted true effects that is reached on drives that were not fitted; `None` without comparators.
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
        false_alarm_ci95: null.then(|| clopper_pearson(runs.iter().filter(|r| !r.claims.is_empty()).count(), runs.len())),
        wrong_claim: share(&Outcome::wrong),
        unexplained: share(&|r| r.verdict == Verdict::Unexplained.as_str()),
        magnitude_error_median: median(&sizes.iter().map(|s| s.0).collect::<Vec<_>>()),
        ci_coverage: mean(&sizes.iter().map(|s| f64::from(u8::from(s.1))).collect::<Vec<_>>()),
        onset_error_median_s: median(&onsets),
        share_of_oracle: share_of_oracle(runs, "diagnosis"),
    }
}

/// Scores of a method over the runs of a set.
#[derive(Clone, Debug, Serialize)]
pub struct MethodScores {
    /// Runs.
    pub runs: usize,
    /// Share of the gain of the oracle.
    pub share_of_oracle: Option<f64>,
    /// Mean over runs of (error with the method) / (error before).
    pub error_ratio: Option<f64>,
    /// Share of runs with one effect whose strongest name is right.
    pub top1: Option<f64>,
    /// Share of null runs in which it names something.
    pub false_alarm: Option<f64>,
}

/// Scores of one method over the runs of one set.
pub fn method_scores(runs: &[&Outcome], method: &str) -> MethodScores {
    let of: Vec<(&Outcome, &Comparison)> =
        runs.iter().filter_map(|r| Some((*r, r.comparisons.iter().find(|c| c.method == method)?))).collect();
    let share = |is: &dyn Fn(&Outcome, &Comparison) -> bool| of.iter().filter(|(r, c)| is(r, c)).count() as f64 / of.len().max(1) as f64;
    let known = !of.is_empty() && of.iter().all(|(r, _)| !r.truth.is_empty());
    let null = !of.is_empty() && of.iter().all(|(r, _)| r.set.starts_with("null"));
    MethodScores {
        runs: of.len(),
        share_of_oracle: share_of_oracle(runs, method),
        error_ratio: (!of.is_empty()).then(|| of.iter().map(|(_, c)| c.error_ratio).sum::<f64>() / of.len() as f64),
        top1: known.then(|| share(&|r, c| c.named.first().is_some_and(|id| r.truth.iter().any(|(t, _)| t == id)))),
        false_alarm: null.then(|| share(&|_, c| !c.named.is_empty())),
    }
}

/// Sum of the gains of a method over that of the oracle, over the runs that have one; `None` where the oracle gains nothing.
fn share_of_oracle(runs: &[&Outcome], method: &str) -> Option<f64> {
    let gain = |r: &Outcome, method: &str| r.comparisons.iter().find(|c| c.method == method).map(|c| 1.0 - c.error_ratio);
    let pairs: Vec<(f64, f64)> = runs.iter().filter_map(|r| Some((gain(r, method)?, gain(r, "oracle")?))).collect();
    let best: f64 = pairs.iter().map(|p| p.1).sum();
    (best > 0.0).then(|| pairs.iter().map(|p| p.0).sum::<f64>() / best)
}

/// Exact 95 % interval of a rate from `hits` of `runs` (Clopper and Pearson 1934), by bisection of the binomial tails.
pub fn clopper_pearson(hits: usize, runs: usize) -> [f64; 2] {
    const TAIL: f64 = 0.025;
    if runs == 0 {
        return [0.0, 1.0];
    }
    // P(X <= k) for X binomial(runs, p).
    let below = |k: usize, p: f64| -> f64 {
        let (mut ln_choose, mut sum) = (0.0f64, 0.0f64);
        for i in 0..=k {
            if i > 0 {
                ln_choose += (((runs - i + 1) as f64) / i as f64).ln();
            }
            sum += (ln_choose + i as f64 * p.ln() + (runs - i) as f64 * (-p).ln_1p()).exp();
        }
        sum
    };
    let root = |is_low: &dyn Fn(f64) -> bool| {
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..60 {
            let middle = 0.5 * (low + high);
            if is_low(middle) { low = middle } else { high = middle }
        }
        0.5 * (low + high)
    };
    let lower = if hits == 0 { 0.0 } else { root(&|p| 1.0 - below(hits - 1, p) < TAIL) };
    let upper = if hits == runs { 1.0 } else { root(&|p| below(hits, p) > TAIL) };
    [lower, upper]
}

#[cfg(test)]
mod tests {
    use super::clopper_pearson;

    #[test]
    fn published_exact_intervals_of_a_rate() {
        // 0 of n: upper end 1 - 0.025^(1/n). 5 of 60 and 10 of 10: tables of the exact interval.
        let close = |got: [f64; 2], want: [f64; 2]| got.iter().zip(want).all(|(g, w)| (g - w).abs() < 5e-4);
        assert!(close(clopper_pearson(0, 6), [0.0, 1.0 - 0.025f64.powf(1.0 / 6.0)]), "{:?}", clopper_pearson(0, 6));
        assert!(close(clopper_pearson(0, 60), [0.0, 0.0596]), "{:?}", clopper_pearson(0, 60));
        assert!(close(clopper_pearson(10, 10), [0.6915, 1.0]), "{:?}", clopper_pearson(10, 10));
        assert!(close(clopper_pearson(5, 10), [0.1871, 0.8129]), "{:?}", clopper_pearson(5, 10));
    }
}
