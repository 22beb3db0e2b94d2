//! Axis scales.

/// Round tick positions that cover `low..high`, about `wanted` of them: steps of 1, 2 or 5 times a power of ten.
pub fn ticks(low: f64, high: f64, wanted: usize) -> Vec<f64> {
    let span = high - low;
    if !(span.is_finite() && span > 0.0) {
        return vec![low];
    }
    let rough = span / wanted.max(1) as f64;
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * power).find(|s| *s >= rough).unwrap_or(rough);
    let first = (low / step - 1e-9).ceil() as i64;
    let last = (high / step + 1e-9).floor() as i64;
    (first..=last).map(|i| i as f64 * step).collect()
}

/// A tick's label with just the digits that its step needs.
pub(super) fn label(value: f64, step: f64) -> String {
    let digits = (-step.abs().log10().floor()).clamp(0.0, 6.0) as usize;
    let value = if value.abs() < step * 1e-6 { 0.0 } else { value };
    format!("{value:.digits$}")
}

/// A linear map from values to pixels.
#[derive(Clone, Copy, Debug)]
pub(super) struct Linear {
    from: [f64; 2],
    to: [f64; 2],
}

impl Linear {
    pub(super) fn new(from: [f64; 2], to: [f64; 2]) -> Self {
        Self { from, to }
    }

    pub(super) fn at(&self, v: f64) -> f64 {
        self.to[0] + (v - self.from[0]) / (self.from[1] - self.from[0]) * (self.to[1] - self.to[0])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_ticks_are_round_and_inside() {
        assert_eq!(ticks(0.0, 10.0, 5), [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]);
        let t = ticks(-0.03, 0.11, 4);
        assert!(t.iter().all(|v| (-0.03..=0.11).contains(v)) && t.len() >= 3, "{t:?}");
        assert_eq!(ticks(1.0, 1.0, 4), [1.0]);
        assert_eq!(label(0.30000000000000004, 0.1), "0.3");
        assert_eq!(label(-0.0, 0.5), "0.0");
    }
}
