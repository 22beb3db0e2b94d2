//! When an effect began: the profile of the generalised likelihood ratio over the start of the segments (Basseville and Nikiforov 1993, ch. 2.4).

use std::fmt;

use rayon::prelude::*;

use crate::observe::channels::{CHANNELS, Row, SEGMENT_STEPS};
use crate::observe::condense::{Condensed, profiled};
use crate::observe::metric::Metric;

/// Gain over an effect that was always there, in dispersions, from which an onset is named (chosen; 6.6 would be 1 % for one onset given beforehand).
const DECISIVE: f64 = 14.0;
/// The same from which an onset is possible, so that the size may be another (chosen).
const POSSIBLE: f64 = 6.6;
/// Most by which an onset that is possible makes a size larger (chosen): what is there for a quarter of the drives.
const FACTOR_MAX: f64 = 4.0;
/// Least share of the gain that an onset must bring (chosen): the answer to a strong effect that was always there is not exact, and fits a part of the time best.
const SHARE_MIN: f64 = 0.01;
/// Least dispersion that is believed (chosen): some thirty null drives tell of no smaller one.
pub(crate) const DISPERSION_MIN: f64 = 0.05;
/// Fall of the gain, in dispersions, at the ends of the 95 % interval.
const INTERVAL: f64 = 3.84;
/// Segments that must lie before and after an onset, on average by drive.
const SEGMENTS_MIN: usize = 3;
/// Prior standard deviation of the share of an effect beside which another is dated (chosen): loose, it is whatever the drives say.
const BESIDE_SD: f64 = 10.0;
/// Overlap below which segments only touch, s: sums of steps are not exact.
const TOUCHING_S: f64 = 1e-6;

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

/// An onset that drives speak for and do not decide.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PossibleOnset {
    /// When the effect may have begun, s since the start of the drives.
    pub at_s: f64,
    /// Least and largest size with an onset that the drives allow, in sizes of an effect that was always there.
    pub factor: [f64; 2],
}

/// What drives say of when an effect began.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Dated {
    /// It was there from the start as far as they tell.
    Always,
    /// It may have begun midway.
    Possibly(PossibleOnset),
    /// It began midway.
    From(Onset),
}

impl Dated {
    /// The onset where there is one.
    pub(crate) fn onset(self) -> Option<Onset> {
        if let Self::From(onset) = self { Some(onset) } else { None }
    }

    /// The onset where one is possible.
    pub(crate) fn possible(self) -> Option<PossibleOnset> {
        if let Self::Possibly(onset) = self { Some(onset) } else { None }
    }
}

/// A change of the size of an effect that is already there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Change {
    /// When, s since the start of the drives.
    pub at_s: f64,
    /// By how much, as a share of the effect as fitted.
    pub share: f64,
}

impl fmt::Display for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "it changes by about {:.0} % at {:.1} s", 100.0 * self.share, self.at_s)
    }
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
    /// Segments that do not count.
    pub uncounted: &'a [usize],
}

impl Course<'_> {
    /// Start of each segment that counts and in which the effect shows, s.
    fn shown_s(&self) -> Vec<f64> {
        let shows = |k: usize| !self.uncounted.contains(&k) && self.shift[k].iter().any(|v| *v != 0.0);
        self.times_s.iter().enumerate().filter(|(k, _)| shows(*k)).map(|(_, time)| *time).collect()
    }
}

/// When an effect began.
///
/// `dispersion` is how much more scores scatter than the metric says (a ratio of variances).
pub(crate) fn find(metric: &Metric, drives: &[Course<'_>], dt_s: f64, dispersion: f64) -> Dated {
    let starts = starts(drives);
    let profile = profile(metric, drives, &starts, false);
    dated(&starts, &profile, dispersion, SEGMENT_STEPS as f64 * dt_s)
}

/// The change of size that speaks most against an effect that is the same as long as it is there, of an answer that is `doubted` by a share of what it explains; `None` where it brings
/// less than an onset must. It must bring that share, or, where levels explain most, be as large as a step in the middle that would, with a quarter of the segments on either
/// side: a few at an end may be off by much for what else is wrong there.
///
/// The rows are what the fitted effect leaves, the shift is its answer where it acts, and each drive may have it in a size of its own.
pub(crate) fn change(metric: &Metric, drives: &[Course<'_>], dispersion: f64, doubted: f64) -> Option<Change> {
    let shown_s: Vec<Vec<f64>> = drives.iter().map(Course::shown_s).collect();
    let starts = midway(&shown_s);
    // The whole effect has a share of one.
    let (_, explained) = profile(metric, drives, &[f64::NEG_INFINITY], false)[0];
    let gain = |(score, information): (f64, f64)| score.powi(2) / information.max(1e-12);
    let share = |(score, information): (f64, f64)| score / information.max(1e-12);
    let large = |step: (f64, f64), at_s: f64| share(step).abs() >= 2.0 * doubted.sqrt() && amid(&shown_s, at_s);
    let steps = profile(metric, drives, &starts, true).into_iter().zip(starts);
    let changes = steps.filter(|&(step, at_s)| {
        gain(step) >= DECISIVE * dispersion.max(DISPERSION_MIN) && (gain(step) >= doubted * explained || large(step, at_s))
    });
    let (best, at_s) = changes.max_by(|a, b| gain(a.0).total_cmp(&gain(b.0)))?;
    Some(Change { at_s, share: share(best) })
}

/// Score and information over all drives of an effect from each of some starts on, for itself or beside one that is `always` there in any size.
fn profile(metric: &Metric, drives: &[Course<'_>], starts: &[f64], always: bool) -> Vec<(f64, f64)> {
    let condensed: Vec<Condensed> = drives
        .par_iter()
        .map(|drive| {
            let masked: Vec<Vec<Row>> = starts.iter().map(|from| begun(&drive.shift, &drive.times_s, *from)).collect();
            let with_whole = always.then(|| drive.beside.iter().cloned().chain([loose(&drive.shift)]).collect::<Vec<_>>());
            profiled(metric, drive.rows, &masked, with_whole.as_ref().unwrap_or(&drive.beside), drive.uncounted)
        })
        .collect();
    let sum = |of: &dyn Fn(&Condensed) -> f64| condensed.iter().map(of).sum::<f64>();
    (0..starts.len()).map(|i| (sum(&|c| c.score[i]), sum(&|c| c.information[(i, i)]))).collect()
}

/// A column beside which an effect is dated, by one prior standard deviation of its share.
pub(crate) fn loose(column: &[Row]) -> Vec<Row> {
    column.iter().map(|row| row.map(|v| v * BESIDE_SD)).collect()
}

/// Segments that overlap the interval of one of some onsets: an effect that begins within a segment shows in a part of it, and if it moves positions, with a jump.
pub(crate) fn straddling(times_s: &[f64], dt_s: f64, onsets: &[Onset]) -> Vec<usize> {
    let segment_s = SEGMENT_STEPS as f64 * dt_s;
    let overlaps = |start_s: f64, [low, high]: [f64; 2]| start_s.max(low) + TOUCHING_S < (start_s + segment_s).min(high);
    (0..times_s.len()).filter(|k| onsets.iter().any(|o| overlaps(times_s[*k], o.ci95_s))).collect()
}

/// A column that is there from a time on (s).
pub(crate) fn begun(column: &[Row], times_s: &[f64], at_s: f64) -> Vec<Row> {
    column.iter().zip(times_s).map(|(row, time)| if *time >= at_s { *row } else { [0.0; CHANNELS] }).collect()
}

/// When an effect may have begun, s: always, which comes first, or at a segment with enough of them before and after.
fn starts(drives: &[Course<'_>]) -> Vec<f64> {
    std::iter::once(f64::NEG_INFINITY).chain(midway(&drives.iter().map(|d| d.times_s.clone()).collect::<Vec<_>>())).collect()
}

/// Those of the starts of segments of each drive, s, with enough of them before and after: so many on average of the drives that have any there.
fn midway(each: &[Vec<f64>]) -> Vec<f64> {
    let mut times = each.concat();
    times.sort_by(f64::total_cmp);
    times.dedup();
    let enough = |side: &dyn Fn(&f64) -> bool| {
        let counts = || each.iter().map(|times| times.iter().filter(|t| side(t)).count()).filter(|count| *count > 0);
        counts().sum::<usize>() >= SEGMENTS_MIN * counts().count().max(1)
    };
    times.retain(|time| enough(&|t| t < time) && enough(&|t| t >= time));
    times
}

/// Whether a quarter of the segments lies on either side of a time, s.
fn amid(each: &[Vec<f64>], at_s: f64) -> bool {
    let (before, after): (Vec<f64>, Vec<f64>) = each.concat().into_iter().partition(|t| *t < at_s);
    4 * before.len().min(after.len()) >= before.len() + after.len()
}

/// What a profile of scores and information over starts says; the first start is always.
fn dated(starts: &[f64], profile: &[(f64, f64)], dispersion: f64, segment_s: f64) -> Dated {
    let dispersion = dispersion.max(DISPERSION_MIN);
    let share = |i: usize| profile[i].0.max(0.0) / profile[i].1.max(1e-12);
    let gain: Vec<f64> = (0..profile.len()).map(|i| profile[i].0.max(0.0) * share(i)).collect();
    let Some(best) = (1..gain.len()).max_by(|a, b| gain[*a].total_cmp(&gain[*b])) else { return Dated::Always };
    let over = gain[best] - gain[0];
    let inside = || (1..gain.len()).filter(|i| gain[*i] >= gain[best] - INTERVAL * dispersion);
    let range =
        |of: &dyn Fn(usize) -> f64| [inside().map(of).fold(f64::INFINITY, f64::min), inside().map(of).fold(f64::NEG_INFINITY, f64::max)];
    if over >= (DECISIVE * dispersion).max(SHARE_MIN * gain[best]) {
        // A segment is the first with the effect where more than half of it has it, so it began between half a segment before and half a segment after.
        let [low, high] = range(&|i| starts[i]);
        return Dated::From(Onset { at_s: starts[best], ci95_s: [low - 0.5 * segment_s, high + 0.5 * segment_s], gain: over });
    }
    if over >= (POSSIBLE * dispersion).max(SHARE_MIN * gain[best]) && share(0) > 0.0 {
        return Dated::Possibly(PossibleOnset { at_s: starts[best], factor: range(&|i| (share(i) / share(0)).min(FACTOR_MAX)) });
    }
    Dated::Always
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

    fn metric() -> Metric {
        let one = DMatrix::identity(9, 9);
        Metric::new((0..9).collect(), DVector::zeros(9), one.clone(), one).unwrap().believing(0.1)
    }

    /// Onset of an effect that shifts the first channel by one, in five drives of the same deviations without noise.
    fn found(rows: &[Row], beside: &[Vec<Row>], dispersion: f64) -> Option<Onset> {
        let still = from(0, 0.0);
        let beside: Vec<Vec<Row>> = beside.iter().chain([&still]).cloned().collect();
        let drive = || Course { times_s: times_s(), rows, shift: from(0, 1.0), beside: beside.clone(), uncounted: &[] };
        let drives: Vec<Course<'_>> = (0..5).map(|_| drive()).collect();
        find(&metric(), &drives, 0.1, dispersion).onset()
    }

    fn begins(onset: Option<Onset>, segment: usize) -> bool {
        onset.is_some_and(|o| (o.at_s - times_s()[segment]).abs() < 1e-9)
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
        let of = |always: f64, best: f64, dispersion: f64| {
            // Scores whose squares over an information of one are these gains.
            let profile = [always, 0.5 * always, best, 0.5 * always].map(|gain| (gain.sqrt(), 1.0));
            dated(&starts, &profile, dispersion, 0.8)
        };
        let is = |dated: Dated| dated.onset().is_some();
        assert_eq!(of(1000.0, 1010.0, 0.1), Dated::Always);
        assert!(of(1000.0, 1040.0, 0.1).onset().is_some_and(|o| o.at_s == 4.8 && (o.gain - 40.0).abs() < 1e-9));
        assert!(!is(of(1.0, 1.6, 0.0)));
        assert!(is(of(1.0, 1.8, 0.0)));
        assert!(!is(of(100.0, 113.0, 1.0)) && is(of(100.0, 115.0, 1.0)));
    }

    /// Goal: an onset that is not decided makes another size possible. Method: half of the information, and so half of the score, lies after the start that is best; an onset there
    /// gains 10 and 5 dispersions.
    #[test]
    fn analytic_an_onset_that_is_possible_says_how_large_the_effect_would_be() {
        let starts = [f64::NEG_INFINITY, 4.0, 4.8, 5.6];
        let of = |best: f64| dated(&starts, &[(40.0, 40.0), (1.0, 30.0), (best, 20.0), (1.0, 10.0)], 1.0, 0.8).possible();
        assert_eq!(of(900.0_f64.sqrt() + 1e-9), None, "a gain of 45 where 40 is always there");
        let possible = of(1000.0_f64.sqrt() + 1e-9).unwrap();
        assert_eq!(possible.at_s, 4.8);
        let factor = 1000.0_f64.sqrt() / 20.0;
        assert!(possible.factor.iter().all(|f| (f - factor).abs() < 1e-6), "{possible:?}");
    }

    /// Goal: drives that have ended do not keep the onset of the others from being named. Method: one drive of 24 s beside four of 8 s; three segments of it are enough after
    /// those have ended, and before that as many of each.
    #[test]
    fn analytic_drives_that_ended_are_not_asked_for_what_came_after() {
        let short: Vec<f64> = times_s().into_iter().take(10).collect();
        let whole = midway(&vec![times_s(); 5]);
        let starts = midway(&[vec![times_s()], vec![short; 4]].concat());
        let last = |starts: &[f64]| starts.last().copied().unwrap();
        assert!(last(&whole) == times_s()[SEGMENTS - SEGMENTS_MIN] && last(&starts) == last(&whole), "{starts:?}");
        assert_eq!(starts[0], whole[0]);
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

    /// Change of the size of an effect that is there from segment 6 on, in fifty drives of the same deviations; the segment before does not count.
    fn changed(left: &[Row], doubted: f64) -> Option<Change> {
        let drive = || Course { times_s: times_s(), rows: left, shift: from(6, 1.0), beside: vec![from(0, 0.0)], uncounted: &[5] };
        let drives: Vec<Course<'_>> = (0..50).map(|_| drive()).collect();
        change(&metric(), &drives, 0.05, doubted)
    }

    /// Goal: an effect that ends or grows is seen not to be the same, a step is. Method: what a fit from segment 6 on leaves of an effect that is there from 6 to 17 (half
    /// too large before and half too small after), of one that grows steadily, of one that was sized a little wrong, and of one that jumps where it begins.
    #[test]
    fn analytic_an_effect_that_ends_or_grows_is_not_the_same_throughout() {
        let of = |left: &dyn Fn(usize) -> f64| -> Vec<Row> {
            (0..SEGMENTS).map(|k| core::array::from_fn(|c| if c == 0 && k >= 5 { left(k) } else { 0.0 })).collect()
        };
        let ends = changed(&of(&|k| if k < 18 { 0.5 } else { -0.5 }), 0.02).unwrap();
        assert!((ends.at_s - times_s()[18]).abs() < 1e-9 && (ends.share + 1.0).abs() < 0.05, "{ends:?}");
        assert!(changed(&of(&|k| (k as f64 - 17.5) / 24.0), 0.02).is_some_and(|grows| grows.share > 0.3));
        assert_eq!(changed(&of(&|k| if k < 6 { 0.0 } else { 0.2 }), 0.02), None, "another size is no change of it");
        assert_eq!(changed(&of(&|k| if k == 5 { 3.0 } else { 0.0 }), 0.02), None, "a jump does not count");
        let said = "it changes by about -100 % at 14.4 s";
        assert_eq!(Change { share: -1.0, ..ends }.to_string(), said);
        let smaller = of(&|k| if k < 18 { 0.2 } else { -0.2 });
        assert!(changed(&smaller, 0.02).is_some() && changed(&smaller, 0.12).is_none(), "answers of forces are not exact");
    }

    /// Goal: the segment in which an effect begins is known. Method: an onset whose first whole segment is the fifteenth, and two that are known worse.
    #[test]
    fn analytic_segments_within_the_interval_of_an_onset_straddle_it() {
        let onset = |low: f64, high: f64| Onset { at_s: 0.5 * (low + high), ci95_s: [low, high], gain: 20.0 };
        let first = times_s()[15];
        let sure = onset(first - 0.4, first + 0.4);
        assert_eq!(straddling(&times_s(), 0.1, &[sure]), [14, 15]);
        assert_eq!(straddling(&times_s(), 0.1, &[onset(0.9, 2.3), sure]), [1, 2, 14, 15]);
        assert!(straddling(&times_s(), 0.1, &[]).is_empty());
    }
}
