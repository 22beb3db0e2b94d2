//! The update of an extended Kalman filter, on plain matrices.

use nalgebra::{DMatrix, DVector};

use crate::AdaptationError;

/// What an update does to the estimate.
#[derive(Clone, Debug, PartialEq)]
pub struct KalmanStep {
    /// K e, to be added to the estimate.
    pub change: DVector<f64>,
    /// K.
    pub gain: DMatrix<f64>,
    /// eᵀ S⁻¹ e, which follows χ² with one degree of freedom per row when the filter is consistent.
    pub nis: f64,
    /// ln det S.
    pub log_det: f64,
}

impl KalmanStep {
    /// P⁺ = (I - K H) P (I - K H)ᵀ + K R Kᵀ for the matrices of the step. The Joseph form equals the (I - K H) P of the paper for the exact gain and, unlike
    /// it, stays positive definite in floating point; the result is symmetrised.
    pub fn covariance(&self, prior: &DMatrix<f64>, jacobian: &DMatrix<f64>, noise: &DMatrix<f64>) -> DMatrix<f64> {
        let kept = DMatrix::identity(prior.nrows(), prior.nrows()) - &self.gain * jacobian;
        let covariance = &kept * prior * kept.transpose() + &self.gain * noise * self.gain.transpose();
        (&covariance + covariance.transpose()) * 0.5
    }
}

/// S = H P Hᵀ + R, K = P Hᵀ S⁻¹, change = K e (paper Alg. 1). S is factorised, never inverted; it has a row per row of the buffer, fewer than an
/// information form would have states.
///
/// # Errors
/// `AdaptationError::SingularInnovation` when S has no Cholesky factor.
pub fn kalman_update(
    prior: &DMatrix<f64>,
    jacobian: &DMatrix<f64>,
    noise: &DMatrix<f64>,
    innovation: &DVector<f64>,
) -> Result<KalmanStep, AdaptationError> {
    let cross = jacobian * prior; // H P, rows × states
    let spread = &cross * jacobian.transpose() + noise;
    let factor = spread.cholesky().ok_or(AdaptationError::SingularInnovation { rows: innovation.len() })?;
    let gain = factor.solve(&cross).transpose(); // K = (S⁻¹ H P)ᵀ because S and P are symmetric
    let nis = innovation.dot(&factor.solve(innovation));
    let log_det = 2.0 * factor.l_dirty().diagonal().iter().map(|v| v.ln()).sum::<f64>();
    Ok(KalmanStep { change: &gain * innovation, gain, nis, log_det })
}

#[cfg(test)]
mod tests {
    use nesam_physics::SOIL_DIM;

    use super::*;

    #[test]
    fn analytic_one_measurement_of_one_parameter_by_hand() {
        // P = 4, H = 2, R = 9: S = 25, K = 8/25, P⁺ = (1 - 16/25) 4 = 1.44, NIS = 25/25 = 1 for e = 5.
        let mut prior = DMatrix::identity(SOIL_DIM, SOIL_DIM);
        prior[(2, 2)] = 4.0;
        let mut jacobian = DMatrix::zeros(1, SOIL_DIM);
        jacobian[(0, 2)] = 2.0;
        let noise = DMatrix::from_element(1, 1, 9.0);
        let step = kalman_update(&prior, &jacobian, &noise, &DVector::from_element(1, 5.0)).unwrap();
        let covariance = step.covariance(&prior, &jacobian, &noise);
        assert!((step.change[2] - 1.6).abs() < 1e-14 && (covariance[(2, 2)] - 1.44).abs() < 1e-14 && (step.nis - 1.0).abs() < 1e-14);
        assert!((step.log_det - 25.0_f64.ln()).abs() < 1e-14);
        assert_eq!(step.change.iter().filter(|v| **v != 0.0).count(), 1, "what is not seen does not move");
        assert_eq!(covariance[(0, 0)], 1.0);
    }

    #[test]
    fn analytic_equals_the_information_form() {
        // P⁺ = (P⁻¹ + Hᵀ R⁻¹ H)⁻¹ and change = P⁺ Hᵀ R⁻¹ e.
        let wave = |i: usize| (1.7 * i as f64 + 0.3).sin();
        let half = DMatrix::from_fn(SOIL_DIM, SOIL_DIM, |r, c| wave(6 * r + c) + if r == c { 2.0 } else { 0.0 });
        let prior = &half * half.transpose();
        let jacobian = DMatrix::from_fn(12, SOIL_DIM, |r, c| wave(40 + 6 * r + c));
        let spread = DMatrix::from_fn(12, 12, |r, c| 0.4 * wave(200 + 12 * r + c));
        let noise = &spread * spread.transpose() + DMatrix::identity(12, 12);
        let innovation = DVector::from_fn(12, |r, _| wave(500 + r));
        let step = kalman_update(&prior, &jacobian, &noise, &innovation).unwrap();
        let covariance = step.covariance(&prior, &jacobian, &noise);
        let weight = noise.clone().try_inverse().unwrap();
        let information = prior.try_inverse().unwrap() + jacobian.transpose() * &weight * &jacobian;
        let posterior = information.try_inverse().unwrap();
        let change = &posterior * jacobian.transpose() * weight * innovation;
        assert!((&covariance - &posterior).amax() < 1e-9, "{}", (covariance - posterior).amax());
        assert!((step.change - change).amax() < 1e-9);
    }

    #[test]
    fn property_a_singular_innovation_is_refused() {
        let outcome = kalman_update(&DMatrix::identity(6, 6), &DMatrix::zeros(2, 6), &DMatrix::zeros(2, 2), &DVector::zeros(2));
        assert_eq!(outcome, Err(AdaptationError::SingularInnovation { rows: 2 }));
    }
}
