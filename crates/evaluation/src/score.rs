//! The `ERR` block of the JSON contract: mean absolute errors with intervals.

use serde::{Deserialize, Serialize};

use crate::bootstrap::{Resamples, median};
use crate::dimension::POSE_DIM;
use crate::errors::{WindowErrors, above_path_floor};

/// One value per scored dimension; `None` (JSON `null`) where the model predicts none or the set measures none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PerDimension<T> {
    /// x, m.
    pub x_m: Option<T>,
    /// y, m.
    pub y_m: Option<T>,
    /// z, m.
    pub z_m: Option<T>,
    /// Roll, degrees.
    pub roll_deg: Option<T>,
    /// Pitch, degrees.
    pub pitch_deg: Option<T>,
    /// Yaw, degrees.
    pub yaw_deg: Option<T>,
}

impl<T: Copy> PerDimension<T> {
    /// From an array in the order of `DIMENSION_KEYS`.
    pub fn from_array(v: [Option<T>; POSE_DIM]) -> Self {
        Self { x_m: v[0], y_m: v[1], z_m: v[2], roll_deg: v[3], pitch_deg: v[4], yaw_deg: v[5] }
    }

    /// As an array in the order of `DIMENSION_KEYS`.
    pub fn to_array(&self) -> [Option<T>; POSE_DIM] {
        [self.x_m, self.y_m, self.z_m, self.roll_deg, self.pitch_deg, self.yaw_deg]
    }
}

/// Horizontal position error.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PositionError<T> {
    /// Mean over steps 1…K, m.
    pub mean: Option<T>,
    /// At step K, m.
    #[serde(rename = "final")]
    pub final_: Option<T>,
    /// Median over windows of (error at step K) / (path driven in the window), -. Windows of no more than [`PATH_FLOOR_M`](crate::PATH_FLOOR_M) of path are left out:
    /// [`WindowErrors::below_path_floor`].
    pub final_over_path_median: Option<T>,
}

/// The tree of numbers that `ERR` carries once as values and once as intervals.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ErrorTree<T> {
    /// Mean absolute error over windows and steps 1…K.
    pub mae_mean: PerDimension<T>,
    /// Mean absolute error over windows at step K.
    pub mae_final: PerDimension<T>,
    /// Horizontal position.
    pub position_m: PositionError<T>,
}

impl<T: Copy> ErrorTree<T> {
    /// The row of a table: x, y, z, roll, pitch, yaw and horizontal position, as means over the horizon or at the last step.
    pub fn row(&self, last: bool) -> [Option<T>; POSE_DIM + 1] {
        let six = if last { &self.mae_final } else { &self.mae_mean }.to_array();
        let position = if last { self.position_m.final_ } else { self.position_m.mean };
        core::array::from_fn(|d| six.get(d).copied().unwrap_or(position))
    }
}

/// `ERR` of the JSON contract.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ErrorSummary {
    /// Values.
    #[serde(flatten)]
    pub tree: ErrorTree<f64>,
    /// 95 % intervals of the values by bootstrap over drives; `null` with fewer than two drives.
    pub ci95: ErrorTree<[f64; 2]>,
    /// Number of windows behind the values.
    pub windows: usize,
}

const STATISTICS: usize = 2 * POSE_DIM + 3;
const RATIO: usize = STATISTICS - 1;

/// One row per statistic, one column per window; NaN where a window does not tell it.
struct Columns {
    values: Vec<Vec<f64>>,
    present: [bool; STATISTICS],
}

fn columns(errors: &WindowErrors) -> Columns {
    let k = errors.horizon as f64;
    let mut values: Vec<Vec<f64>> = (0..STATISTICS).map(|_| Vec::with_capacity(errors.windows())).collect();
    for w in 0..errors.windows() {
        let steps = errors.window(w);
        for d in 0..POSE_DIM {
            values[d].push(steps.iter().map(|s| s.absolute[d]).sum::<f64>() / k);
            values[POSE_DIM + d].push(steps[steps.len() - 1].absolute[d]);
        }
        let last = steps[steps.len() - 1].position_m;
        values[2 * POSE_DIM].push(steps.iter().map(|s| s.position_m).sum::<f64>() / k);
        values[2 * POSE_DIM + 1].push(last);
        let path = errors.path_m[w];
        values[RATIO].push(if above_path_floor(path) { last / path } else { f64::NAN });
    }
    let d = errors.scored;
    let horizontal = d[0] && d[1];
    let present = std::array::from_fn(|s| if s < 2 * POSE_DIM { d[s % POSE_DIM] } else { horizontal });
    Columns { values, present }
}

fn tree<T: Copy>(v: [Option<T>; STATISTICS]) -> ErrorTree<T> {
    let six = |from: usize| PerDimension::from_array(std::array::from_fn(|d| v[from + d]));
    ErrorTree {
        mae_mean: six(0),
        mae_final: six(POSE_DIM),
        position_m: PositionError { mean: v[2 * POSE_DIM], final_: v[2 * POSE_DIM + 1], final_over_path_median: v[RATIO] },
    }
}

/// Mean over the windows that tell it; NaN where none does.
pub(crate) fn mean_told(values: &[f64]) -> f64 {
    let (sum, count) = values.iter().filter(|v| !v.is_nan()).fold((0.0, 0), |(sum, count), v| (sum + v, count + 1));
    sum / f64::from(count)
}

fn finite(v: f64) -> Option<f64> {
    v.is_finite().then_some(v)
}

/// The values of the tree over all windows, without intervals.
pub fn values(errors: &WindowErrors) -> ErrorTree<f64> {
    let c = columns(errors);
    tree(std::array::from_fn(|s| {
        let value = if s == RATIO { median(&c.values[s]) } else { mean_told(&c.values[s]) };
        if c.present[s] { finite(value) } else { None }
    }))
}

/// The values with their intervals. `cluster` of `errors` must index the drives of `resamples`.
pub fn summarise(errors: &WindowErrors, resamples: &Resamples) -> ErrorSummary {
    let c = columns(errors);
    let ci95 = tree(std::array::from_fn(|s| {
        let rows = &c.values[s];
        let interval = |r: &[f64]| {
            if s == RATIO { resamples.median_interval(r, &errors.trajectory) } else { resamples.mean_interval(r, &errors.trajectory) }
        };
        if c.present[s] { interval(rows) } else { None }
    }));
    ErrorSummary { tree: values(errors), ci95, windows: errors.windows() }
}

/// Paired difference `a - b` of the mean statistics with 95 % intervals: negative = `a` is better. The ratio is left out (`null`).
pub fn paired_difference(a: &WindowErrors, b: &WindowErrors, resamples: &Resamples) -> (ErrorTree<f64>, ErrorTree<[f64; 2]>) {
    let (ca, cb) = (columns(a), columns(b));
    let rows: Vec<Vec<f64>> = (0..STATISTICS).map(|s| ca.values[s].iter().zip(&cb.values[s]).map(|(x, y)| x - y).collect()).collect();
    let present = |s: usize| s != RATIO && ca.present[s] && cb.present[s];
    let difference = tree(std::array::from_fn(|s| if present(s) { finite(mean_told(&rows[s])) } else { None }));
    let interval = tree(std::array::from_fn(|s| if present(s) { resamples.mean_interval(&rows[s], &a.trajectory) } else { None }));
    (difference, interval)
}

/// 95 % intervals of the ratio of the mean statistics `a / b`, paired by drive: below 1 = `a` is better. The median of relative errors is left out (`null`).
pub fn paired_ratio(a: &WindowErrors, b: &WindowErrors, resamples: &Resamples) -> ErrorTree<[f64; 2]> {
    let (ca, cb) = (columns(a), columns(b));
    let present = |s: usize| s != RATIO && ca.present[s] && cb.present[s];
    let interval = |s: usize| resamples.ratio_interval(&ca.values[s], &cb.values[s], &a.trajectory);
    tree(std::array::from_fn(|s| if present(s) { interval(s) } else { None }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::errors::{PosePath, StepError};

    fn two_windows() -> WindowErrors {
        let step = |x: f64, yaw: f64| StepError { absolute: [x, 0.0, 1.0, 0.0, 0.0, yaw], position_m: x };
        WindowErrors {
            horizon: 2,
            scored: [true, true, false, true, true, true],
            trajectory: vec![0, 1],
            path_m: vec![4.0, 10.0],
            steps: vec![step(1.0, 2.0), step(3.0, 4.0), step(0.0, 0.0), step(1.0, 6.0)],
            broken: vec![false; 2],
        }
    }

    #[test]
    fn analytic_values_by_hand() {
        let t = values(&two_windows());
        assert_eq!(t.mae_mean.x_m, Some(1.25));
        assert_eq!(t.mae_final.x_m, Some(2.0));
        assert_eq!(t.mae_mean.yaw_deg, Some(3.0));
        assert_eq!(t.mae_final.yaw_deg, Some(5.0));
        assert_eq!(t.mae_mean.z_m, None, "a dimension that is not scored is null");
        assert_eq!(t.position_m.mean, Some(1.25));
        assert_eq!(t.position_m.final_, Some(2.0));
        let ratio = t.position_m.final_over_path_median.unwrap();
        assert!((ratio - 0.5 * (0.75 + 0.1)).abs() < 1e-12, "{ratio}");
    }

    #[test]
    fn analytic_schema_has_exactly_the_keys_of_the_contract() {
        let summary = summarise(&two_windows(), &Resamples::draw(2, 1000, 1));
        let json = serde_json::to_value(&summary).unwrap();
        let keys = |v: &serde_json::Value| v.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
        let mut top = keys(&json);
        top.sort();
        assert_eq!(top, ["ci95", "mae_final", "mae_mean", "position_m", "windows"]);
        for tree in [&json, &json["ci95"]] {
            for mae in ["mae_mean", "mae_final"] {
                let mut found = keys(&tree[mae]);
                found.sort();
                let mut wanted = crate::DIMENSION_KEYS.map(String::from).to_vec();
                wanted.sort();
                assert_eq!(found, wanted);
            }
            let mut found = keys(&tree["position_m"]);
            found.sort();
            assert_eq!(found, ["final", "final_over_path_median", "mean"]);
        }
        assert!(json["mae_mean"]["z_m"].is_null() && json["ci95"]["mae_mean"]["z_m"].is_null());
        assert_eq!(json["ci95"]["mae_mean"]["x_m"].as_array().unwrap().len(), 2);
        assert_eq!(serde_json::from_value::<ErrorSummary>(json).unwrap(), summary);
    }

    /// Goal: a drive that does not measure a dimension does not take it from the others. Method: four drives of one window, all 1 m off in x and the third and fourth of
    /// them 2 m and 4 m in z, of which two drives know nothing: z is the mean of the two that know it, with an interval between them.
    #[test]
    fn regress_a_dimension_is_scored_over_the_drives_that_measure_it() {
        let start = [0.0; POSE_DIM];
        let scored = |half: f64, knows_z: [bool; 4]| {
            let mut errors = WindowErrors::empty(1);
            for (drive, (z, knows)) in [0.5, 7.0, 2.0, 4.0].into_iter().zip(knows_z).enumerate() {
                let path = PosePath { poses: vec![[2.0, 0.0, half * z, 0.0, 0.0, 0.0]], predicts: [true; POSE_DIM] };
                let truth = [[1.0, 0.0, 0.0, 0.0, 0.0, 0.0]];
                errors.push(drive, &start, &path, &truth, 1.0, [true, true, knows, true, true, true]);
            }
            errors
        };
        let resamples = Resamples::draw(4, 1000, 1);
        let some = scored(1.0, [false, false, true, true]);
        let summary = summarise(&some, &resamples);
        assert_eq!((summary.tree.mae_mean.x_m, summary.tree.mae_mean.z_m, summary.tree.mae_final.z_m), (Some(1.0), Some(3.0), Some(3.0)));
        let [low, high] = summary.ci95.mae_mean.z_m.unwrap();
        assert!((2.0..=3.0).contains(&low) && (3.0..=4.0).contains(&high), "{low} {high}");
        // Paired with a model that is half as far off.
        let better = scored(0.5, [false, false, true, true]);
        let (difference, interval) = paired_difference(&better, &some, &resamples);
        assert_eq!(difference.mae_mean.z_m, Some(-1.5));
        assert!(interval.mae_mean.z_m.is_some_and(|[low, high]| -2.0 <= low && high <= -1.0), "{interval:?}");
        assert_eq!(paired_ratio(&better, &some, &resamples).mae_mean.z_m, Some([0.5, 0.5]));
        // One drive tells it, without an interval; none does.
        let one = summarise(&scored(1.0, [false, false, false, true]), &resamples);
        assert_eq!((one.tree.mae_mean.z_m, one.ci95.mae_mean.z_m), (Some(4.0), None));
        let none = summarise(&scored(1.0, [false; 4]), &resamples);
        assert_eq!((none.tree.mae_mean.z_m, none.ci95.mae_mean.z_m, none.tree.mae_mean.x_m), (None, None, Some(1.0)));
    }

    #[test]
    fn analytic_a_model_against_itself_differs_by_zero() {
        let e = two_windows();
        let (difference, interval) = paired_difference(&e, &e, &Resamples::draw(2, 1000, 1));
        assert_eq!(difference.mae_mean.x_m, Some(0.0));
        assert_eq!(interval.position_m.final_, Some([0.0, 0.0]));
        assert_eq!(paired_ratio(&e, &e, &Resamples::draw(2, 1000, 1)).position_m.final_, Some([1.0, 1.0]));
        assert_eq!(difference.mae_mean.z_m, None);
    }
}
