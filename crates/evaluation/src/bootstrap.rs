//! Percentile bootstrap by trajectory.
//!
//! Windows of one drive share soil, vehicle state and driver, so they are not independent; whole drives are. Each resample therefore
//! draws drives with replacement and takes all their windows. One set of draws serves every model and every number, so that
//! differences between models are paired: what both models find hard cancels.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Resamples taken when the caller does not choose.
pub const DEFAULT_RESAMPLES: usize = 2000;

/// How often each drive occurs in each resample.
#[derive(Clone, Debug)]
pub struct Resamples {
    clusters: usize,
    weights: Vec<Vec<u32>>,
}

impl Resamples {
    /// Draws `resamples` times `clusters` drives with replacement from a ChaCha8 stream seeded with `seed`.
    pub fn draw(clusters: usize, resamples: usize, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let weights = (0..resamples)
            .map(|_| {
                let mut weight = vec![0u32; clusters];
                for _ in 0..clusters {
                    weight[rng.random_range(0..clusters)] += 1;
                }
                weight
            })
            .collect();
        Self { clusters, weights }
    }

    /// Number of resamples.
    pub fn count(&self) -> usize {
        self.weights.len()
    }

    /// 95 % interval of the mean over windows. `rows` holds one value per window, `cluster` the drive of each window.
    ///
    /// Rows that are NaN are left out. `None` where an interval would mean nothing: windows of fewer than two drives, or a value that is infinite.
    pub fn mean_interval(&self, rows: &[f64], cluster: &[usize]) -> Option<[f64; 2]> {
        let (mut sum, mut number, mut kept) = (vec![0.0; self.clusters], vec![0.0; self.clusters], Vec::with_capacity(rows.len()));
        for (&value, &c) in rows.iter().zip(cluster).filter(|(value, _)| !value.is_nan()) {
            sum[c] += value;
            number[c] += 1.0;
            kept.push(c);
        }
        self.interval(&kept, |weight| {
            let pick = |per: &[f64]| -> f64 { per.iter().zip(weight).map(|(v, &w)| v * f64::from(w)).sum() };
            pick(&sum) / pick(&number)
        })
    }

    /// 95 % interval of (mean of `over`) / (mean of `under`), both over the same windows; rows of which one is NaN are left out, `None` as in
    /// [`Resamples::mean_interval`]. Resamples in which nothing is to divide by are left out.
    pub fn ratio_interval(&self, over: &[f64], under: &[f64], cluster: &[usize]) -> Option<[f64; 2]> {
        let (mut sums, mut kept) = (vec![[0.0; 2]; self.clusters], Vec::with_capacity(over.len()));
        for ((&above, &below), &c) in over.iter().zip(under).zip(cluster).filter(|((above, below), _)| !(above.is_nan() || below.is_nan()))
        {
            sums[c][0] += above;
            sums[c][1] += below;
            kept.push(c);
        }
        self.interval(&kept, |weight| {
            let pick = |which: usize| -> f64 { sums.iter().zip(weight).map(|(s, &w)| s[which] * f64::from(w)).sum() };
            let below = pick(1);
            if below > 0.0 { pick(0) / below } else { f64::NAN }
        })
    }

    /// 95 % interval of the median over windows; arguments as [`Resamples::mean_interval`].
    pub fn median_interval(&self, rows: &[f64], cluster: &[usize]) -> Option<[f64; 2]> {
        let mut sorted: Vec<(f64, usize)> = rows.iter().copied().zip(cluster.iter().copied()).filter(|(v, _)| !v.is_nan()).collect();
        sorted.sort_by(|a, b| a.0.total_cmp(&b.0));
        let kept: Vec<usize> = sorted.iter().map(|(_, c)| *c).collect();
        self.interval(&kept, |weight| weighted_median(&sorted, weight))
    }

    /// Of a statistic of rows of these drives: one drive that is drawn more or less often says nothing of how drives differ.
    fn interval(&self, cluster: &[usize], mut statistic: impl FnMut(&[u32]) -> f64) -> Option<[f64; 2]> {
        if cluster.iter().all(|c| Some(c) == cluster.first()) || self.weights.is_empty() {
            return None;
        }
        let mut values: Vec<f64> = self.weights.iter().map(|w| statistic(w)).filter(|v| !v.is_nan()).collect();
        values.sort_by(f64::total_cmp);
        let ends = [quantile_sorted(&values, 0.025), quantile_sorted(&values, 0.975)];
        (!values.is_empty() && ends.iter().all(|v| v.is_finite())).then_some(ends)
    }
}

/// Quantile of an ascending slice with linear interpolation between order statistics (Hyndman and Fan 1996, type 7); NaN if empty.
pub fn quantile_sorted(sorted: &[f64], share: f64) -> f64 {
    let Some(last) = sorted.len().checked_sub(1) else { return f64::NAN };
    let at = share * last as f64;
    let (low, fraction) = (at.floor() as usize, at.fract());
    sorted[low] + fraction * (sorted[(low + 1).min(last)] - sorted[low])
}

/// Median of the finite values; NaN if there is none.
pub fn median(values: &[f64]) -> f64 {
    let mut sorted: Vec<f64> = values.iter().copied().filter(|v| !v.is_nan()).collect();
    sorted.sort_by(f64::total_cmp);
    quantile_sorted(&sorted, 0.5)
}

fn weighted_median(sorted: &[(f64, usize)], weight: &[u32]) -> f64 {
    let total: u64 = sorted.iter().map(|(_, c)| u64::from(weight[*c])).sum();
    if total == 0 {
        return f64::NAN;
    }
    let at = |rank: u64| {
        let mut seen = 0;
        sorted
            .iter()
            .find(|(_, c)| {
                seen += u64::from(weight[*c]);
                seen > rank
            })
            .map_or(f64::NAN, |(v, _)| *v)
    };
    0.5 * (at((total - 1) / 2) + at(total / 2))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn property_same_seed_gives_the_same_interval_and_another_seed_another() {
        let rows: Vec<f64> = (0..60).map(|i| f64::from(i % 7)).collect();
        let cluster: Vec<usize> = (0..60).map(|i| i / 6).collect();
        let of = |seed| Resamples::draw(10, 1000, seed).mean_interval(&rows, &cluster);
        assert_eq!(of(7), of(7));
        assert_ne!(of(7), of(8));
    }

    /// Goal: the interval covers the true mean about 95 % of the time. Method: 400 synthetic experiments of 40 drives of 5 windows,
    /// drive effect N(0, 1) plus window noise N(0, 0.5), seed 11. The percentile bootstrap is slightly narrow at 40 clusters, hence
    /// 0.90 as the lower limit; 0.985 guards against intervals that are simply huge.
    #[test]
    fn analytic_interval_covers_the_true_mean_of_clustered_normals() {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        let mut normal = move || -> f64 { (0..12).map(|_| rng.random_range(0.0..1.0)).sum::<f64>() - 6.0 };
        let cluster: Vec<usize> = (0..200).map(|i| i / 5).collect();
        let covered = (0..400)
            .filter(|&seed| {
                let drive: Vec<f64> = (0..40).map(|_| normal()).collect();
                let rows: Vec<f64> = cluster.iter().map(|&c| 3.0 + drive[c] + 0.5 * normal()).collect();
                let [lo, hi] = Resamples::draw(40, 400, seed).mean_interval(&rows, &cluster).unwrap();
                (lo..hi).contains(&3.0)
            })
            .count();
        let share = covered as f64 / 400.0;
        assert!((0.90..0.985).contains(&share), "coverage {share}");
    }

    #[test]
    fn analytic_medians_and_quantiles() {
        assert_eq!(median(&[3.0, 1.0, f64::NAN, 2.0]), 2.0);
        assert_eq!(median(&[1.0, 2.0, 3.0, 4.0]), 2.5);
        assert_eq!(quantile_sorted(&[0.0, 10.0], 0.25), 2.5);
        assert!(median(&[]).is_nan());
        let sorted = [(1.0, 0), (2.0, 1), (5.0, 2)];
        assert_eq!(weighted_median(&sorted, &[1, 1, 1]), 2.0);
        assert_eq!(weighted_median(&sorted, &[0, 1, 3]), 5.0);
        assert_eq!(weighted_median(&sorted, &[2, 2, 0]), 1.5);
    }

    #[test]
    fn analytic_one_drive_has_no_interval() {
        assert_eq!(Resamples::draw(1, 1000, 0).mean_interval(&[1.0, 2.0], &[0, 0]), None);
        // Of five drives one alone has windows.
        let five = Resamples::draw(5, 1000, 0);
        assert_eq!(five.mean_interval(&[1.0, 2.0], &[3, 3]), None);
        assert_eq!(five.ratio_interval(&[1.0, 2.0], &[2.0, 2.0], &[3, 3]), None);
        assert_eq!(five.median_interval(&[1.0, 2.0, f64::NAN], &[3, 3, 4]), None);
        assert_eq!(five.mean_interval(&[], &[]), None);
        assert!(five.mean_interval(&[1.0, 2.0], &[3, 4]).is_some());
    }
}
