//! What a degradation costs, and whether the soil estimate is still to be believed.

use std::collections::BTreeMap;

use nesam_evaluation::{ErrorSummary, ErrorTree, Resamples, WindowErrors, median, paired_ratio, path_length_m, summarise as errors_of};
use nesam_trajectories::Trajectory;
use serde::Serialize;

use crate::{Passage, SoilBuffer};

/// Mean NIS over degrees of freedom of a filter that is still called consistent (chosen: a factor of two either way of the 1 of an exact filter; the
/// validation drives give 1.0, single drives scatter).
const CONSISTENT: std::ops::RangeInclusive<f64> = 0.5..=2.0;

/// Whether the soil estimate is to be believed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// The innovations are as large as the filter expects.
    Consistent,
    /// They are not: the estimate is more certain, or less, than it should be.
    Inconsistent,
    /// Nothing was learned, and every prediction says so.
    NotLearned,
}

/// The soil filter over all drives.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SoilSummary {
    /// Full buffers.
    pub buffers: usize,
    /// Buffers that the gate refused.
    pub rejected: usize,
    /// Mean of NIS over degrees of freedom, 1 for an exact filter.
    pub nis_mean_over_dof: Option<f64>,
    /// Median of the same.
    pub nis_median_over_dof: Option<f64>,
    /// Verdict over all drives.
    pub verdict: Verdict,
    /// Drives whose own mean lies within the bounds.
    pub drives_consistent: usize,
    /// Drives whose own mean does not.
    pub drives_inconsistent: usize,
    /// Drives in which nothing was learned.
    pub drives_not_learned: usize,
    /// Share of the predictions that say that the soil is not learned.
    pub predictions_not_learned: Option<f64>,
}

/// One degradation over all drives, against the clean drives at the same windows.
#[derive(Clone, Debug, Serialize)]
pub struct RowSummary {
    /// The specification in full.
    pub degradation: String,
    /// Messages sent.
    pub sent: usize,
    /// Messages that arrived.
    pub arrived: usize,
    /// Answers to them, by kind.
    pub answers: BTreeMap<&'static str, usize>,
    /// Windows asked.
    pub windows: usize,
    /// Windows without an answer.
    pub unanswered: usize,
    /// Mean age of the state that a prediction starts from, s.
    pub age_s_mean: Option<f64>,
    /// Mean number of measured steps before it.
    pub history_steps_mean: Option<f64>,
    /// Errors of the degraded drives, where both are answered.
    pub degraded: ErrorSummary,
    /// Errors of the clean drives at the same windows.
    pub clean: ErrorSummary,
    /// Degraded over clean: value and 95 % interval by drive.
    pub position_ratio: (Option<f64>, Option<[f64; 2]>),
    /// The same for yaw.
    pub yaw_ratio: (Option<f64>, Option<[f64; 2]>),
    /// The soil filter.
    pub soil: SoilSummary,
}

/// Sums the passages of one degradation up; `clean` are those of the undegraded drives, both in the order of `drives`.
pub fn summarise(
    degradation: &str,
    drives: &[Trajectory],
    passages: &[Passage],
    clean: &[Passage],
    horizon: usize,
    resamples: &Resamples,
) -> RowSummary {
    let [mut of_degraded, mut of_clean] = [WindowErrors::empty(horizon), WindowErrors::empty(horizon)];
    for (at, drive) in drives.iter().enumerate() {
        let measured = drive.measured.pose();
        for asked in &passages[at].asked {
            let Some(other) = clean[at].asked.iter().find(|other| other.sample == asked.sample) else { continue };
            for (errors, asked) in [(&mut of_degraded, asked), (&mut of_clean, other)] {
                let path_m = path_length_m(&asked.start, &asked.truth);
                errors.push(at, &asked.start, &asked.path, &asked.truth, path_m, measured);
            }
        }
    }
    let (degraded, clean) = (errors_of(&of_degraded, resamples), errors_of(&of_clean, resamples));
    let intervals = paired_ratio(&of_degraded, &of_clean, resamples);
    let ratio =
        |of: fn(&ErrorTree<f64>) -> Option<f64>| of(&degraded.tree).zip(of(&clean.tree)).map(|(a, b)| a / b).filter(|r| r.is_finite());
    let position_ratio = (ratio(|tree| tree.position_m.mean), intervals.position_m.mean);
    let yaw_ratio = (ratio(|tree| tree.mae_mean.yaw_deg), intervals.mae_mean.yaw_deg);
    let asked = || passages.iter().flat_map(|passage| &passage.asked);
    let mut answers = BTreeMap::new();
    for (label, count) in passages.iter().flat_map(|passage| &passage.answers) {
        *answers.entry(*label).or_default() += count;
    }
    let unanswered = passages.iter().map(|passage| passage.unanswered).sum();
    RowSummary {
        degradation: degradation.into(),
        sent: passages.iter().map(|passage| passage.sent).sum(),
        arrived: answers.values().sum(),
        answers,
        windows: asked().count() + unanswered,
        unanswered,
        age_s_mean: mean(asked().map(|asked| asked.age_s)),
        history_steps_mean: mean(asked().map(|asked| asked.history_steps as f64)),
        degraded,
        clean,
        position_ratio,
        yaw_ratio,
        soil: soil(passages),
    }
}

fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
    (count > 0.0).then(|| sum / count)
}

fn verdict(buffers: &[SoilBuffer]) -> Verdict {
    let of_all = mean(buffers.iter().map(|buffer| buffer.nis / buffer.dof as f64));
    match of_all {
        Some(_) if buffers.iter().all(|buffer| buffer.rejected) => Verdict::NotLearned,
        Some(ratio) if CONSISTENT.contains(&ratio) => Verdict::Consistent,
        Some(_) => Verdict::Inconsistent,
        None => Verdict::NotLearned,
    }
}

fn soil(passages: &[Passage]) -> SoilSummary {
    let all: Vec<SoilBuffer> = passages.iter().flat_map(|passage| passage.buffers.iter().copied()).collect();
    let ratios: Vec<f64> = all.iter().map(|buffer| buffer.nis / buffer.dof as f64).collect();
    let drives = |kind: Verdict| passages.iter().filter(|passage| verdict(&passage.buffers) == kind).count();
    SoilSummary {
        buffers: all.len(),
        rejected: all.iter().filter(|buffer| buffer.rejected).count(),
        nis_mean_over_dof: mean(ratios.iter().copied()),
        nis_median_over_dof: (!ratios.is_empty()).then(|| median(&ratios)),
        verdict: verdict(&all),
        drives_consistent: drives(Verdict::Consistent),
        drives_inconsistent: drives(Verdict::Inconsistent),
        drives_not_learned: drives(Verdict::NotLearned),
        predictions_not_learned: mean(
            passages.iter().flat_map(|passage| &passage.asked).map(|asked| f64::from(u8::from(!asked.soil_learned))),
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_verdicts_by_hand() {
        let buffer = |ratio: f64, rejected: bool| SoilBuffer { nis: 60.0 * ratio, dof: 60, rejected };
        assert_eq!(verdict(&[]), Verdict::NotLearned);
        assert_eq!(verdict(&[buffer(9.0, true)]), Verdict::NotLearned);
        assert_eq!(verdict(&[buffer(0.8, false), buffer(1.4, false)]), Verdict::Consistent);
        assert_eq!(verdict(&[buffer(0.8, false), buffer(9.0, true)]), Verdict::Inconsistent);
        assert_eq!(verdict(&[buffer(0.1, false)]), Verdict::Inconsistent);
        let passage = |buffers: Vec<SoilBuffer>| Passage { buffers, ..Passage::default() };
        let sum = soil(&[passage(vec![buffer(1.0, false)]), passage(Vec::new()), passage(vec![buffer(3.0, false)])]);
        assert_eq!((sum.buffers, sum.rejected, sum.nis_mean_over_dof, sum.verdict), (2, 0, Some(2.0), Verdict::Consistent));
        assert_eq!((sum.drives_consistent, sum.drives_inconsistent, sum.drives_not_learned), (1, 1, 1));
    }
}
