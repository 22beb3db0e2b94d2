//! The state of a filter as plain numbers, to move it to another place.

use nesam_physics::SOIL_DIM;

use super::{SoilFilter, SoilMatrix, SoilVector};
use crate::AdaptationError;

/// All that a [`SoilFilter`] has learned, without its settings and without the transitions of a buffer that is not full.
#[derive(Clone, Debug, PartialEq)]
pub struct FilterSnapshot {
    /// Δθ⁺ of the filter itself.
    pub delta: [f64; SOIL_DIM],
    /// P⁺ of the filter itself.
    pub covariance: [[f64; SOIL_DIM]; SOIL_DIM],
    /// Scale of R_B.
    pub noise_scale: f64,
    /// Log odds that the correction helps.
    pub trust_log_odds: f64,
    /// Corrections that later buffers judge, oldest first.
    pub trust_corrections: Vec<[f64; SOIL_DIM]>,
}

impl SoilFilter {
    /// What the filter has learned. Transitions that wait for the next update are not part of it.
    pub fn snapshot(&self) -> FilterSnapshot {
        let Self { config: _, noise: _, delta, covariance, scale, trust, buffer: _ } = self;
        let (trust_log_odds, corrections) = trust.state();
        FilterSnapshot {
            delta: core::array::from_fn(|i| delta[i]),
            covariance: core::array::from_fn(|r| core::array::from_fn(|c| covariance[(r, c)])),
            noise_scale: scale.value(),
            trust_log_odds,
            trust_corrections: corrections.iter().map(|v| core::array::from_fn(|i| v[i])).collect(),
        }
    }

    /// P⁻ of the next update: P⁺ with the process noise of a buffer, in the coordinates of the correction.
    pub fn predicted_covariance(&self) -> [[f64; SOIL_DIM]; SOIL_DIM] {
        let predicted = self.inflated();
        core::array::from_fn(|r| core::array::from_fn(|c| predicted[(r, c)]))
    }

    /// A filter with these settings that goes on, bit for bit, where the one of the snapshot stood. The buffer is empty.
    ///
    /// # Errors
    /// `AdaptationError::NotFinite` when a number of the snapshot is not.
    pub fn restored(mut self, snapshot: &FilterSnapshot) -> Result<Self, AdaptationError> {
        let FilterSnapshot { delta, covariance, noise_scale, trust_log_odds, trust_corrections } = snapshot;
        let numbers = delta.iter().chain(covariance.as_flattened()).chain(trust_corrections.as_flattened());
        if !numbers.chain([noise_scale, trust_log_odds]).all(|v| v.is_finite()) {
            return Err(AdaptationError::NotFinite { what: "snapshot", index: 0 });
        }
        self.delta = SoilVector::from_fn(|i, _| delta[i]);
        self.covariance = SoilMatrix::from_fn(|r, c| covariance[r][c]);
        self.scale.restore(*noise_scale);
        self.trust.restore(*trust_log_odds, trust_corrections.iter().map(|v| SoilVector::from_fn(|i, _| v[i])).collect());
        self.buffer.clear();
        Ok(self)
    }
}
