//! When an effect began: the profile of the generalised likelihood ratio over the start of the segments (Basseville and Nikiforov 1993, ch. 2.4).

use crate::channels::{CHANNELS, Row};
use crate::condense::profiled;
use crate::fit::Prepared;
use crate::metric::Metric;
use rayon::prelude::*;

/// Gain over an effect that was always there, in dispersions, from which an onset is named (chosen; 6.6 would be 1 % for one onset given beforehand).
const DECISIVE: f64 = 14.0;
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

/// The onset of an effect that shifts deviations by `shares` of the columns `columns`; `None` when it was there from the start as far as the drives tell.
///
/// `dispersion` is how much more scores scatter than the metric says (a ratio of variances).
pub fn find(
    metric: &Metric,
    drives: &[&Prepared],
    rows: &[&[Row]],
    dt_s: f64,
    columns: &[usize],
    shares: &[f64],
    dispersion: f64,
) -> Option<Onset> {
    let mut times: Vec<f64> = drives.iter().flat_map(|d| d.drive.times_s(dt_s)).collect();
    times.sort_by(f64::total_cmp);
    times.dedup();
    let segments = |at: &dyn Fn(f64) -> bool| drives.iter().flat_map(|d| d.drive.times_s(dt_s)).filter(|t| at(*t)).count();
    let least = SEGMENTS_MIN * drives.len();
    let candidates: Vec<f64> =
        times.iter().copied().filter(|t| segments(&|s| s < *t) >= least && segments(&|s| s >= *t) >= least).collect();
    let starts: Vec<f64> = std::iter::once(f64::NEG_INFINITY).chain(candidates).collect();
    let (mut score, mut information) = (vec![0.0; starts.len()], vec![0.0; starts.len()]);
    let condensed: Vec<_> = drives
        .par_iter()
        .zip(rows)
        .map(|(prepared, rows)| {
            let full: Vec<Row> = (0..rows.len())
                .map(|k| {
                    core::array::from_fn(|c: usize| {
                        debug_assert!(c < CHANNELS);
                        columns.iter().zip(shares).map(|(j, s)| s * prepared.signatures.columns[*j][k][c]).sum()
                    })
                })
                .collect();
            let own = prepared.drive.times_s(dt_s);
            let masked: Vec<Vec<Row>> = starts
                .iter()
                .map(|from| full.iter().zip(&own).map(|(row, t)| if t >= from { *row } else { [0.0; CHANNELS] }).collect())
                .collect();
            profiled(metric, rows, &masked, &prepared.signatures.soil)
        })
        .collect();
    for c in &condensed {
        for i in 0..starts.len() {
            score[i] += c.score[i];
            information[i] += c.information[(i, i)];
        }
    }
    let gain: Vec<f64> = score.iter().zip(&information).map(|(s, a)| s.max(0.0).powi(2) / a.max(1e-12)).collect();
    let best = (1..gain.len()).max_by(|a, b| gain[*a].total_cmp(&gain[*b]))?;
    if gain[best] - gain[0] < DECISIVE * dispersion.max(1.0) {
        return None;
    }
    let inside: Vec<f64> = (1..gain.len()).filter(|i| gain[*i] >= gain[best] - INTERVAL * dispersion.max(1.0)).map(|i| starts[i]).collect();
    let segment = crate::channels::SEGMENT_STEPS as f64 * dt_s;
    let low = inside.iter().copied().fold(f64::INFINITY, f64::min) - segment;
    let high = inside.iter().copied().fold(f64::NEG_INFINITY, f64::max) + 0.5 * segment;
    // A segment that begins at the onset is the first with the whole effect: on average it began half a segment earlier.
    Some(Onset { at_s: starts[best] - 0.5 * segment, ci95_s: [low, high], gain: gain[best] - gain[0] })
}
