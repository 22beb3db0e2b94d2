//! From linearised windows to the noise of a bundle, and to the share of windows that its 90 % regions hold.

use nalgebra::{SMatrix, SymmetricEigen};
use nesam_adaptation::{FORECAST_STEPS, planar_mahalanobis};
use nesam_model::RolloutNoise;
use nesam_model::rollout_noise::StateCovariance;
use nesam_physics::STATE_DIM;
use serde::Serialize;

use crate::bootstrap::Resamples;
use crate::coverage::LinearisedWindow;
use crate::dimension::{DIMENSION_KEYS, POSE_DIM};

/// Steps at which coverage is reported and the regions are calibrated.
pub const COVERAGE_STEPS: [usize; 3] = FORECAST_STEPS;
/// Share of measured states that a region shall hold.
pub const COVERAGE: f64 = 0.9;

type Matrix = SMatrix<f64, STATE_DIM, STATE_DIM>;

/// Q_k of the windows and the radii of their 90 % regions.
///
/// Q_k is the mean of (e eᵀ - J_x P_x J_xᵀ - J_θ P_θ J_θᵀ) / s over the windows, s their noise scale, with negative eigenvalues set to zero. The mean error
/// counts as noise. Errors have heavier tails than a Gaussian and P_k is an average, so the radii are the empirical 90 % quantile (of rank ⌈0.9 (n + 1)⌉, as in split
/// conformal prediction) of the squared Mahalanobis distance over the windows at the steps of [`COVERAGE_STEPS`] together. `None` without windows or steps.
pub fn calibrate_rollout_noise(windows: &[LinearisedWindow], start_sd: [f64; STATE_DIM]) -> Option<RolloutNoise> {
    let steps = windows.iter().map(|w| w.errors.len()).max().filter(|steps| *steps > 0)?;
    let residual: Vec<StateCovariance> = (0..steps).map(|k| residual_covariance(windows, k)).collect();
    let mut noise = RolloutNoise::new(start_sd, &residual);
    noise.windows = windows.len();
    calibrate_regions(windows, &mut noise)?;
    Some(noise)
}

/// The radii of the 90 % regions alone, for other noise scales of the windows than those that Q_k was made with. `None` without windows.
pub fn calibrate_regions(windows: &[LinearisedWindow], noise: &mut RolloutNoise) -> Option<()> {
    let steps = COVERAGE_STEPS.iter().filter(|k| **k <= noise.steps());
    let distances: Vec<Distances> = steps.flat_map(|k| windows.iter().filter_map(|w| Distances::of(w, *k, noise))).collect();
    let planar = upper_quantile(distances.iter().map(|d| d.planar).collect())?;
    for i in 0..POSE_DIM {
        noise.region_90_single[i] = upper_quantile(distances.iter().map(|d| d.single[i]).collect())?;
    }
    noise.region_90_planar = planar;
    Some(())
}

/// Order statistic of rank ⌈0.9 (n + 1)⌉; the largest where there are fewer.
fn upper_quantile(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let rank = (COVERAGE * (values.len() + 1) as f64).ceil() as usize;
    values.get(rank.min(values.len()).checked_sub(1)?).copied().filter(|v| *v > 0.0)
}

fn residual_covariance(windows: &[LinearisedWindow], k: usize) -> StateCovariance {
    let (mut sum, mut count) = (Matrix::zeros(), 0.0);
    for window in windows.iter().filter(|w| w.errors.len() > k) {
        let e = &window.errors[k];
        sum += Matrix::from_fn(|r, c| (e[r] * e[c] - window.of_start[k][r][c] - window.of_soil[k][r][c]) / window.noise_scale.of(r, c));
        count += 1.0;
    }
    // Units differ by orders of magnitude: the projection is made with every entry scaled to its own size.
    let size = |i: usize| {
        let of = |w: &LinearisedWindow| w.errors.get(k).map_or(0.0, |e| e[i] * e[i]);
        (windows.iter().map(of).sum::<f64>() / f64::max(count, 1.0)).sqrt().max(1e-9)
    };
    let sizes: Vec<f64> = (0..STATE_DIM).map(size).collect();
    let mean = Matrix::from_fn(|r, c| sum[(r, c)] / f64::max(count, 1.0) / (sizes[r] * sizes[c]));
    let eigen = SymmetricEigen::new((mean + mean.transpose()) * 0.5);
    let kept = Matrix::from_diagonal(&eigen.eigenvalues.map(|v| v.max(0.0)));
    let projected = eigen.eigenvectors * kept * eigen.eigenvectors.transpose();
    core::array::from_fn(|r| core::array::from_fn(|c| 0.5 * (projected[(r, c)] + projected[(c, r)]) * sizes[r] * sizes[c]))
}

/// Squared Mahalanobis distances of one window at one step, and the size of its planar ellipse.
struct Distances {
    planar: f64,
    single: [f64; POSE_DIM],
    /// √ of the area over π at distance one, m.
    radius_m: f64,
}

impl Distances {
    /// At step `k` (1 …); `None` where the rollout ended before.
    fn of(window: &LinearisedWindow, k: usize, noise: &RolloutNoise) -> Option<Self> {
        let e = window.errors.get(k - 1)?;
        let q = noise.residual(k);
        let p = |r: usize, c: usize| window.of_start[k - 1][r][c] + window.of_soil[k - 1][r][c] + window.noise_scale.of(r, c) * q[r][c];
        let (xx, xy, yy) = (p(0, 0), p(0, 1), p(1, 1));
        let planar = planar_mahalanobis(&[e[0], e[1]], &[[xx, xy], [xy, yy]]);
        Some(Self { planar, single: core::array::from_fn(|i| e[i] * e[i] / p(i, i)), radius_m: (xx * yy - xy * xy).sqrt().sqrt() })
    }
}

/// Share of windows inside a region, with the 95 % interval of a bootstrap over drives.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Share {
    /// Share.
    pub inside: f64,
    /// 95 % interval; absent with a single drive.
    pub ci95: Option<[f64; 2]>,
}

/// Coverage at one step.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StepCoverage {
    /// Step k.
    pub step: usize,
    /// Windows.
    pub windows: usize,
    /// Share of windows whose measured (x, y) lies in the 90 % ellipse.
    pub planar: Share,
    /// Median radius of the circle of the same area, m.
    pub radius_m_median: f64,
    /// Share of windows inside the 90 % interval of each pose dimension.
    pub single: Vec<(&'static str, Share)>,
}

/// What the 90 % regions of a bundle hold of the windows.
pub fn coverage(windows: &[LinearisedWindow], noise: &RolloutNoise, resamples: &Resamples) -> Vec<StepCoverage> {
    let steps = COVERAGE_STEPS.iter().copied().filter(|k| *k <= noise.steps() && windows.iter().any(|w| w.errors.len() >= *k));
    let at = |k: usize| {
        let (drives, distances): (Vec<usize>, Vec<Distances>) =
            windows.iter().filter_map(|w| Some((w.drive, Distances::of(w, k, noise)?))).unzip();
        let share = |inside: &dyn Fn(&Distances) -> bool| {
            let rows: Vec<f64> = distances.iter().map(|d| f64::from(u8::from(inside(d)))).collect();
            Share { inside: rows.iter().sum::<f64>() / rows.len() as f64, ci95: resamples.mean_interval(&rows, &drives) }
        };
        let radii: Vec<f64> = distances.iter().map(|d| d.radius_m * noise.region_90_planar.sqrt()).collect();
        StepCoverage {
            step: k,
            windows: distances.len(),
            planar: share(&|d| d.planar <= noise.region_90_planar),
            radius_m_median: crate::median(&radii),
            single: (0..POSE_DIM).map(|i| (DIMENSION_KEYS[i], share(&|d| d.single[i] <= noise.region_90_single[i]))).collect(),
        }
    };
    steps.map(at).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nesam_model::rollout_noise::NoiseScale;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    const NOTHING: StateCovariance = [[0.0; STATE_DIM]; STATE_DIM];

    /// Windows of 32 steps whose errors are independent normals of known standard deviation that grows with the step, seeds as given.
    fn windows(seed: u64, count: usize, scale: f64) -> Vec<LinearisedWindow> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = move || -> f64 { (0..12).map(|_| rng.random_range(0.0..1.0)).sum::<f64>() - 6.0 };
        let mut error = |k: usize| core::array::from_fn(|i| scale.sqrt() * 0.01 * (1 + i) as f64 * (k + 1) as f64 * normal());
        (0..count)
            .map(|w| LinearisedWindow {
                drive: w / 10,
                start: w % 10,
                errors: (0..32).map(&mut error).collect(),
                of_start: vec![NOTHING; 32],
                of_soil: vec![NOTHING; 32],
                noise_scale: NoiseScale::alike(scale),
            })
            .collect()
    }

    /// Goal: calibrated on some windows, the regions hold 90 % of others. Method: normal errors (seeds 1 and 2), 3000 windows each: ±0.02 is three standard
    /// errors. Ground on which errors are twice as large and known to be so must not change it.
    #[test]
    fn analytic_regions_hold_what_they_say() {
        let noise = calibrate_rollout_noise(&windows(1, 3000, 1.0), [0.0; STATE_DIM]).unwrap();
        let q = noise.residual(5);
        assert!((q[3][3].sqrt() / 0.2 - 1.0).abs() < 0.05, "{}", q[3][3].sqrt());
        for scale in [1.0, 4.0] {
            let resamples = Resamples::draw(300, 200, 1);
            for step in coverage(&windows(2, 3000, scale), &noise, &resamples) {
                assert!((step.planar.inside - 0.9).abs() < 0.02, "{scale} {step:?}");
                assert!(step.single.iter().all(|(_, share)| (share.inside - 0.9).abs() < 0.02), "{scale} {step:?}");
                assert!(step.planar.ci95.is_some_and(|[low, high]| low < step.planar.inside && step.planar.inside < high));
            }
        }
    }

    #[test]
    fn property_residual_covariances_have_no_negative_eigenvalue() {
        let mut some = windows(3, 40, 1.0);
        // Start and soil say more than the errors: their difference is indefinite.
        for window in &mut some {
            for k in 0..32 {
                window.of_start[k][0][0] = 1.0;
                window.of_soil[k][5][5] = 1e-4;
            }
        }
        let noise = calibrate_rollout_noise(&some, [0.0; STATE_DIM]).unwrap();
        for k in 1..=32 {
            let q = noise.residual(k);
            let matrix = Matrix::from_fn(|r, c| q[r][c]);
            assert_eq!(matrix, matrix.transpose());
            let eigen = SymmetricEigen::new(matrix).eigenvalues;
            assert!(eigen.min() > -1e-12 * eigen.max(), "step {k}: {eigen}");
        }
    }
}
