//! When an effect began: the profile of the generalised likelihood ratio over the start of the segments (Basseville and Nikiforov 1993, ch. 2.4).

use rayon::prelude::*;

use crate::channels::{CHANNELS, Row, SEGMENT_STEPS};
use crate::condense::{Condensed, profiled};
use crate::metric::Metric;

/// Gain over an effect that was always there, in dispersions, from which an onset is named (chosen; 6.6 would be 1 % for one onset given beforehand).
const DECISIVE: f64 = 14.0;
/// Least share of the gain that an onset must bring (chosen): the answer to a strong effect that was always there is not exact, and fits a part of the time best.
const SHARE_MIN: f64 = 0.01;
/// Least dispersion that is believed (chosen): some thirty null drives tell of no smaller one.
pub(crate) const DISPERSION_MIN: f64 = 0.05;
/// Fall of the gain, in dispersions, at the ends of the 95 % interval.
const INTERVAL: f64 = 3.84;
/// Segments that must lie before and after an onset, on average by drive.
const SEGMENTS_MIN: usize = 3;

/// An onset with its interval.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Onset {
    /// When the effect begins, s since the start of the drives.
    pub at_s: f64,
    /// 95 % interval, s.
    pub ci95_s: [f64; 2],
    /// Gain over an effect that was always there, in the metric.
    pub gain: f64,
}

/// A drive in which an onset is looked for; one row per segment.
#[derive(Clone, Debug)]
pub struct Course<'a> {
    /// Start of each segment, s since the start of the drive.
    pub times_s: Vec<f64>,
    /// Deviations.
    pub rows: &'a [Row],
    /// How the effect shifts them where it acts.
    pub shift: Vec<Row>,
    /// How what is fitted beside it shifts them, such as the soil, by one prior standard deviation of each.
    pub beside: Vec<Vec<Row>>,
}

/// The onset of an effect; `None` when it was there from the start as far as the drives tell.
///
/// `dispersion` is how much more scores scatter than the metric says (a ratio of variances).
pub fn find(metric: &Metric, drives: &[Course<'_>], dt_s: f64, dispersion: f64) -> Option<Onset> {
    let starts = starts(drives);
    let condensed: Vec<Condensed> = drives
        .par_iter()
        .map(|drive| {
            let masked: Vec<Vec<Row>> = starts.iter().map(|from| begun(&drive.shift, &drive.times_s, *from)).collect();
            profiled(metric, drive.rows, &masked, &drive.beside)
        })
        .collect();
    let gain: Vec<f64> = (0..starts.len())
        .map(|i| {
            let score: f64 = condensed.iter().map(|c| c.score[i]).sum();
            let information: f64 = condensed.iter().map(|c| c.information[(i, i)]).sum();
            score.max(0.0).powi(2) / information.max(1e-12)
        })
        .collect();
    dated(&starts, &gain, dispersion, SEGMENT_STEPS as f64 * dt_s)
}

/// A column that is there from a time on (s).
pub(crate) fn begun(column: &[Row], times_s: &[f64], at_s: f64) -> Vec<Row> {
    column.iter().zip(times_s).map(|(row, time)| if *time >= at_s { *row } else { [0.0; CHANNELS] }).collect()
}

/// When an effect may have begun, s: always, which comes first, or at a segment with enough of them before and after.
fn starts(drives: &[Course<'_>]) -> Vec<f64> {
    let every = || drives.iter().flat_map(|d| d.times_s.iter().copied());
    let mut times: Vec<f64> = every().collect();
    times.sort_by(f64::total_cmp);
    times.dedup();
    let least = SEGMENTS_MIN * drives.len();
    let enough = |time: &f64| every().filter(|t| t < time).count() >= least && every().filter(|t| t >= time).count() >= least;
    std::iter::once(f64::NEG_INFINITY).chain(times.into_iter().filter(enough)).collect()
}

/// The onset that a profile of the gain over starts speaks for; the first start is always.
fn dated(starts: &[f64], gain: &[f64], dispersion: f64, segment_s: f64) -> Option<Onset> {
    let dispersion = dispersion.max(DISPERSION_MIN);
    let best = (1..gain.len()).max_by(|a, b| gain[*a].total_cmp(&gain[*b]))?;
    let over = gain[best] - gain[0];
    if over < (DECISIVE * dispersion).max(SHARE_MIN * gain[best]) {
        return None;
    }
    let inside: Vec<f64> = (1..gain.len()).filter(|i| gain[*i] >= gain[best] - INTERVAL * dispersion).map(|i| starts[i]).collect();
    let low = inside.iter().copied().fold(f64::INFINITY, f64::min) - segment_s;
    let high = inside.iter().copied().fold(f64::NEG_INFINITY, f64::max) + 0.5 * segment_s;
    // A segment that begins at the onset is the first with the whole effect: on average it began half a segment earlier.
    Some(Onset { at_s: starts[best] - 0.5 * segment_s, ci95_s: [low, high], gain: over })
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};

    /// Segments of a drive.
    const SEGMENTS: usize = 30;

    fn times_s() -> Vec<f64> {
        (0..SEGMENTS).map(|k| 0.8 * k as f64).collect()
    }

    /// Rows that are `value` in the first channel from a segment on.
    fn from(segment: usize, value: f64) -> Vec<Row> {
        (0..SEGMENTS).map(|k| core::array::from_fn(|c| if c == 0 && k >= segment { value } else { 0.0 })).collect()
    }

    /// Onset of an effect that shifts the first channel by one, in five drives of the same deviations without noise.
    fn found(rows: &[Row], beside: &[Vec<Row>], dispersion: f64) -> Option<Onset> {
        let one = DMatrix::identity(9, 9);
        let metric = Metric::new((0..9).collect(), DVector::zeros(9), one.clone(), one).unwrap().believing(0.1);
        let still = from(0, 0.0);
        let drive = || Course { times_s: times_s(), rows, shift: from(0, 1.0), beside: beside.iter().chain([&still]).cloned().collect() };
        let drives: Vec<Course<'_>> = (0..5).map(|_| drive()).collect();
        find(&metric, &drives, 0.1, dispersion)
    }

    fn begins(onset: Option<Onset>, segment: usize) -> bool {
        onset.is_some_and(|o| (o.at_s - (times_s()[segment] - 0.4)).abs() < 1e-9)
    }

    /// Goal: an onset is held against the scatter of its own effect. Method: five drives whose onset gains 3.7 in the metric; 14 dispersions of 0.1 are 1.4.
    #[test]
    fn analytic_an_onset_is_seen_where_scores_scatter_little() {
        let midway = from(15, 1.0);
        assert!(begins(found(&midway, &[], 0.1), 15), "{:?}", found(&midway, &[], 0.1));
        assert_eq!(found(&midway, &[], 1.0), None);
        assert_eq!(found(&from(0, 1.0), &[], 0.0), None, "an effect that was always there has no onset");
    }

    /// Goal: a strong effect that was always there gets no onset. Method: profiles of the gain; an onset must bring 14 dispersions, 0.05 at least, and 1 %.
    #[test]
    fn analytic_an_onset_brings_a_share_of_what_its_effect_explains() {
        let starts = [f64::NEG_INFINITY, 4.0, 4.8, 5.6];
        let of = |always: f64, best: f64, dispersion: f64| dated(&starts, &[always, 0.5 * always, best, 0.5 * always], dispersion, 0.8);
        assert_eq!(of(1000.0, 1010.0, 0.1), None);
        assert_eq!(of(1000.0, 1040.0, 0.1).map(|o| (o.at_s, o.gain)), Some((4.8 - 0.4, 40.0)));
        assert_eq!(of(1.0, 1.6, 0.0), None);
        assert!(of(1.0, 1.8, 0.0).is_some());
        assert!(of(100.0, 113.0, 1.0).is_none() && of(100.0, 115.0, 1.0).is_some());
    }

    /// Goal: what another effect leaves is no onset. Method: that effect shows from segment 18 on only, whatever its onset, and ours always or from segment 9 on; both
    /// shift the same channel.
    #[test]
    fn analytic_an_effect_is_dated_beside_another() {
        let sum = |a: &[Row], b: &[Row]| -> Vec<Row> { a.iter().zip(b).map(|(a, b)| core::array::from_fn(|c| a[c] + b[c])).collect() };
        let (other, loose) = (from(18, 3.0), [from(18, 10.0)]);
        assert!(begins(found(&other, &[], 0.1), 18), "the other one passes for ours");
        assert_eq!(found(&sum(&other, &from(0, 2.0)), &loose, 0.1), None);
        let both = sum(&other, &from(9, 2.0));
        assert!(begins(found(&both, &[], 0.1), 18), "{:?}", found(&both, &[], 0.1));
        assert!(begins(found(&both, &loose, 0.1), 9), "{:?}", found(&both, &loose, 0.1));
    }
}
