//! How the error of the model depends on what the vehicle is doing, as far as it is known before the buffer is judged.

use serde::{Deserialize, Serialize};

use crate::prediction::BufferedTransition;

/// Number of conditions.
pub const CONDITIONS: usize = 4;
/// Bounds of the factor on R_B.
const FACTOR: (f64, f64) = (0.1, 10.0);

/// Conditions of a buffer: ln(1 + speed) with the speed in m/s, lateral acceleration |v ω| in m/s², relief as the root mean square of how slopes under the wheels
/// differ from their mean, and ln k_phi of the soil prior. All of them follow from the predicted path, not from what is to be explained.
pub fn conditions(buffer: &[BufferedTransition]) -> [f64; CONDITIONS] {
    let count = buffer.len().max(1) as f64;
    let mean = |of: &dyn Fn(&BufferedTransition) -> f64| buffer.iter().map(of).sum::<f64>() / count;
    let speed = mean(&|t| t.input.state.velocity_m_s[0].abs());
    let lateral = mean(&|t| (t.input.state.velocity_m_s[0] * t.input.state.angular_velocity_rad_s[2]).abs());
    let slopes = |of: &dyn Fn(usize, &BufferedTransition) -> f64| -> f64 {
        let all: Vec<f64> = buffer.iter().flat_map(|t| (0..t.input.ground.len()).map(move |w| (w, t))).map(|(w, t)| of(w, t)).collect();
        let mean = all.iter().sum::<f64>() / all.len().max(1) as f64;
        all.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / all.len().max(1) as f64
    };
    let relief = (slopes(&|w, t| t.input.ground[w].slope_ahead) + slopes(&|w, t| t.input.ground[w].slope_left)).sqrt();
    let firmness = mean(&|t| t.input.soil.k_phi.max(f64::MIN_POSITIVE).ln());
    [(1.0 + speed).ln(), lateral, relief, firmness]
}

/// Log-linear model of the factor on R_B.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoiseConditions {
    /// Conditions at which the factor is 1.
    pub mean: [f64; CONDITIONS],
    /// Change of the logarithm of the factor with each condition.
    pub slope: [f64; CONDITIONS],
}

impl NoiseConditions {
    /// The factor on R_B.
    pub fn factor(&self, conditions: &[f64; CONDITIONS]) -> f64 {
        let log: f64 = (0..CONDITIONS).map(|i| self.slope[i] * (conditions[i] - self.mean[i])).sum();
        log.exp().clamp(FACTOR.0, FACTOR.1)
    }
}
