//! What one buffer adds to what was known.

use nalgebra::{SMatrix, SVector};
use nesam_physics::SOIL_DIM;

use crate::error::FleetSoilError;

pub(crate) type Matrix = SMatrix<f64, SOIL_DIM, SOIL_DIM>;
pub(crate) type Vector = SVector<f64, SOIL_DIM>;

/// A Gaussian belief of Δθ.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SoilBelief {
    /// Mean, in the coordinates of the correction.
    pub delta: [f64; SOIL_DIM],
    /// Covariance.
    pub covariance: [[f64; SOIL_DIM]; SOIL_DIM],
}

impl SoilBelief {
    /// Λ = P⁻¹ and η = Λ m.
    fn information(&self, what: &'static str) -> Result<(Matrix, Vector), FleetSoilError> {
        let covariance = Matrix::from_fn(|r, c| self.covariance[r][c]);
        let inverse = covariance.cholesky().ok_or(FleetSoilError::Belief { what })?.inverse();
        let vector = inverse * Vector::from_fn(|i, _| self.delta[i]);
        if !inverse.iter().chain(vector.iter()).all(|v| v.is_finite()) {
            return Err(FleetSoilError::Belief { what });
        }
        Ok((inverse, vector))
    }
}

/// Information that one buffer brought: ΔΛ and Δη, and its vote on whether the correction helps at all.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Increment {
    pub(crate) matrix: Matrix,
    pub(crate) vector: Vector,
    pub(crate) vote: f64,
}

impl Increment {
    /// What the posterior of an update knows more than its prior: Λ⁺ - Λ⁻ and η⁺ - η⁻. For the update of a linear filter these are Hᵀ R⁻¹ H and Hᵀ R⁻¹ y, whatever the prior was:
    /// nothing that came from elsewhere is in them. `vote` in units of log odds.
    ///
    /// # Errors
    /// `FleetSoilError::Belief` when either has no information form.
    pub fn between(prior: &SoilBelief, posterior: &SoilBelief, vote: f64) -> Result<Self, FleetSoilError> {
        let ((before, from), (after, to)) = (prior.information("prior")?, posterior.information("posterior")?);
        let vote = if vote.is_finite() { vote } else { 0.0 };
        Ok(Self { matrix: after - before, vector: to - from, vote })
    }
}
