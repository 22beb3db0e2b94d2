//! Predictions that came true: how far the vehicle was from where it was predicted to be, and what that says of predictions to come.
//!
//! A soil filter judges a second at a time. What errs more the further ahead one looks (soil of the next patch, a wrong slope of the drive line) it does not see;
//! a prediction that is compared with what was measured in the end does. The height is held apart: it is wrong where the ground is softer than it looks, the way is
//! wrong where it holds less, and one of them may be right while the other is not.

/// Steps ahead at which a prediction is compared.
pub const FORECAST_STEPS: [usize; 3] = [8, 16, 32];
/// Steps from the start of a prediction to its last comparison.
pub const FORECAST_AHEAD: usize = FORECAST_STEPS[FORECAST_STEPS.len() - 1];
/// One of something at each of [`FORECAST_STEPS`].
type AtSteps<T> = [T; FORECAST_STEPS.len()];
/// Comparisons that count: an older one weighs e⁻¹ as much.
const MEMORY: f64 = 20.0;
/// Comparisons that the bundle's own word counts for.
const PRIOR: f64 = 1.0;
/// Squared error over its expectation beyond which one comparison says no more.
const RATIO_MAX: f64 = 30.0;
/// Least scale: a few lucky predictions do not make the model better than its bundle says by more than that.
const SCALE_MIN: f64 = 0.5;
/// Numbers behind a [`ForecastCheck`].
pub const FORECAST_VALUES: usize = 3 + 2 * FORECAST_STEPS.len();
/// The same as services wrote them that held no heights against anything.
const VALUES_WITHOUT_HEIGHT: usize = FORECAST_VALUES - 1;

/// What the predictions of one drive have been worth so far. Memory, prior and bounds were chosen on the validation drives and o01-o06 of `ood_soil`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ForecastCheck {
    /// Comparisons so far.
    checked: u64,
    /// Comparisons that still count, and the sums of their ratios in (x, y) and in z.
    weight: f64,
    sum: f64,
    height_sum: f64,
    /// Sums of squared errors and of what was expected of them at each of [`FORECAST_STEPS`], m².
    squared_m2: AtSteps<f64>,
    expected_m2: AtSteps<f64>,
}

impl ForecastCheck {
    /// Takes a prediction that has come true: measured minus predicted (x, y, z), m, at each of [`FORECAST_STEPS`], and the covariance that was expected of it, m².
    /// Says whether it counts: one that is not finite, or was expected without doubt, does not.
    pub fn observe(&mut self, errors_m: &AtSteps<[f64; 3]>, expected_m2: &AtSteps<[[f64; 3]; 3]>) -> bool {
        let planar: AtSteps<f64> = core::array::from_fn(|i| planar_mahalanobis(&errors_m[i], &expected_m2[i]) / 2.0);
        let height: AtSteps<f64> = core::array::from_fn(|i| errors_m[i][2].powi(2) / expected_m2[i][2][2]);
        if !planar.iter().chain(&height).all(|ratio| ratio.is_finite() && *ratio >= 0.0) {
            return false;
        }
        let mean = |ratios: AtSteps<f64>| ratios.map(|r| r.min(RATIO_MAX)).iter().sum::<f64>() / FORECAST_STEPS.len() as f64;
        let kept = (-1.0 / MEMORY).exp();
        let follow = |sum: f64, value: f64| kept * sum + value;
        self.checked += 1;
        self.weight = follow(self.weight, 1.0);
        self.sum = follow(self.sum, mean(planar));
        self.height_sum = follow(self.height_sum, mean(height));
        for i in 0..FORECAST_STEPS.len() {
            let [x, y, _] = errors_m[i];
            self.squared_m2[i] = follow(self.squared_m2[i], x * x + y * y);
            self.expected_m2[i] = follow(self.expected_m2[i], expected_m2[i][0][0] + expected_m2[i][1][1]);
        }
        true
    }

    /// How many times the covariance that is expected of predictions counts: the mean ratio of squared error to expectation in (x, y), with the bundle's word as
    /// one more comparison of ratio 1. It is 1 before the first.
    pub fn scale(&self) -> f64 {
        self.mean_ratio(self.sum)
    }

    /// The same of the height alone.
    pub fn height_scale(&self) -> f64 {
        self.mean_ratio(self.height_sum)
    }

    fn mean_ratio(&self, sum: f64) -> f64 {
        ((PRIOR + sum) / (PRIOR + self.weight)).max(SCALE_MIN)
    }

    /// Predictions compared so far.
    pub fn checked(&self) -> u64 {
        self.checked
    }

    /// Root mean square of the distance in (x, y) at each of [`FORECAST_STEPS`] over the comparisons that count, m; `None` before the first.
    pub fn error_rms_m(&self) -> Option<AtSteps<f64>> {
        self.rms(&self.squared_m2)
    }

    /// The same as it was expected before what was compared is taken into account, m.
    pub fn expected_rms_m(&self) -> Option<AtSteps<f64>> {
        self.rms(&self.expected_m2)
    }

    fn rms(&self, sums: &AtSteps<f64>) -> Option<AtSteps<f64>> {
        (self.checked > 0).then(|| sums.map(|sum| (sum / self.weight).sqrt()))
    }

    /// Comparisons so far and the numbers behind the rest, for [`ForecastCheck::restored`].
    pub fn parts(&self) -> (u64, [f64; FORECAST_VALUES]) {
        let all = [self.weight, self.sum].into_iter().chain(self.squared_m2).chain(self.expected_m2);
        let mut all = all.chain([self.height_sum]);
        (self.checked, core::array::from_fn(|_| all.next().unwrap_or(0.0)))
    }

    /// The inverse of [`ForecastCheck::parts`]; `None` for numbers that none can have. Where the last is missing, as services wrote them before, heights count as
    /// the rest did.
    pub fn restored(checked: u64, values: &[f64]) -> Option<Self> {
        let complete = [VALUES_WITHOUT_HEIGHT, FORECAST_VALUES].contains(&values.len());
        let possible = complete && values.iter().all(|v| v.is_finite() && *v >= 0.0) && (checked > 0) == (values[0] > 0.0);
        let steps = FORECAST_STEPS.len();
        possible.then(|| Self {
            checked,
            weight: values[0],
            sum: values[1],
            height_sum: values.get(VALUES_WITHOUT_HEIGHT).copied().unwrap_or(values[1]),
            squared_m2: core::array::from_fn(|i| values[2 + i]),
            expected_m2: core::array::from_fn(|i| values[2 + steps + i]),
        })
    }
}

/// eᵀ P⁻¹ e of (x, y) alone, of an error and its covariance, which is symmetric.
pub fn planar_mahalanobis<const N: usize>(e: &[f64; N], covariance: &[[f64; N]; N]) -> f64 {
    let (xx, xy, yy) = (covariance[0][0], covariance[0][1], covariance[1][1]);
    (yy * e[0] * e[0] - 2.0 * xy * e[0] * e[1] + xx * e[1] * e[1]) / (xx * yy - xy * xy)
}

#[cfg(test)]
mod tests {
    use super::*;

    const EXPECTED: [[[f64; 3]; 3]; 3] = [[[4.0, 1.0, 0.5], [1.0, 2.0, 0.0], [0.5, 0.0, 9.0]]; 3];

    #[test]
    fn analytic_errors_as_expected_leave_the_scale_at_one_and_larger_ones_raise_it() {
        let mut check = ForecastCheck::default();
        assert_eq!((check.scale(), check.error_rms_m()), (1.0, None));
        // eᵀ P⁻¹ e = (2 · 4) / 7 for e = (2, 0): twice the dimension at e = 2 · √(7 / 4).
        let usual = [[(7.0f64).sqrt(), 0.0, 3.0]; 3];
        for _ in 0..50 {
            assert!(check.observe(&usual, &EXPECTED));
        }
        assert!((check.scale() - 1.0).abs() < 1e-12 && (check.height_scale() - 1.0).abs() < 1e-12, "{check:?}");
        let [rms, expected] = [check.error_rms_m(), check.expected_rms_m()].map(|rms| rms.expect("there are comparisons"));
        assert!((rms[2] - 7.0f64.sqrt()).abs() < 1e-12 && (expected[2] - 6.0f64.sqrt()).abs() < 1e-12);
        for _ in 0..400 {
            check.observe(&usual.map(|[x, y, z]| [2.0 * x, 2.0 * y, 3.0 * z]), &EXPECTED);
        }
        let weight = 1.0 / (1.0 - (-1.0 / MEMORY).exp());
        assert!((check.scale() - (1.0 + 4.0 * weight) / (1.0 + weight)).abs() < 1e-6, "{}", check.scale());
        assert!((check.height_scale() - (1.0 + 9.0 * weight) / (1.0 + weight)).abs() < 1e-6, "{}", check.height_scale());
    }

    #[test]
    fn analytic_one_wild_prediction_says_no_more_than_its_bound_and_none_is_free() {
        let mut check = ForecastCheck::default();
        check.observe(&[[1e6, 0.0, 0.0]; 3], &EXPECTED);
        assert!((check.scale() - (1.0 + RATIO_MAX) / 2.0).abs() < 1e-12 && check.height_scale() == SCALE_MIN);
        let mut lucky = ForecastCheck::default();
        for _ in 0..100 {
            lucky.observe(&[[0.0, 0.0, 1e6]; 3], &EXPECTED);
        }
        assert!(lucky.scale() == SCALE_MIN && lucky.height_scale() > 0.9 * RATIO_MAX, "{lucky:?}");
    }

    #[test]
    fn analytic_what_cannot_be_compared_leaves_no_trace() {
        let mut check = ForecastCheck::default();
        check.observe(&[[1.0, 1.0, 1.0]; 3], &EXPECTED);
        let before = check;
        for wrong in [[f64::NAN, 0.0, 0.0], [0.0, 0.0, f64::NAN]] {
            assert!(!check.observe(&[wrong; 3], &EXPECTED));
        }
        assert!(!check.observe(&[[1.0, 0.0, 0.0]; 3], &[[[0.0; 3]; 3]; 3]));
        assert_eq!(check, before);
    }

    #[test]
    fn regress_parts_round_trip_and_impossible_ones_are_refused() {
        let mut check = ForecastCheck::default();
        assert_eq!(ForecastCheck::restored(0, &[0.0; FORECAST_VALUES]), Some(check));
        check.observe(&[[1.0, 0.5, 2.0]; 3], &EXPECTED);
        let (checked, values) = check.parts();
        assert_eq!(ForecastCheck::restored(checked, &values), Some(check));
        // As it was written before heights were held against anything.
        let older = ForecastCheck::restored(checked, &values[..VALUES_WITHOUT_HEIGHT]).expect("a state of before");
        assert_eq!((older.scale(), older.height_scale()), (check.scale(), check.scale()));
        assert_eq!(ForecastCheck::restored(checked, &values[..3]), None);
        for (checked, value) in [(0, 1.0), (1, f64::NAN), (1, -1.0)] {
            let mut values = values;
            values[0] = value;
            assert_eq!(ForecastCheck::restored(checked, &values), None, "{checked} {value}");
        }
    }
}
