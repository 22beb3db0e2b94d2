//! How a buffer agrees with what was expected of it, on the bundle's own scale.

use nalgebra::{DMatrix, DVector};

use crate::AdaptationError;
use crate::prediction::VELOCITY_DIM;

/// Agreement of a buffer with S = H P⁻ Hᵀ + R_B, where R_B is that of the bundle under the conditions of the buffer and *not* matched to the drive: the filter
/// matches it so that it stays sober on strange ground, and would hide from whoever watches it that the ground, or the vehicle, is strange.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Agreement {
    /// eᵀ S⁻¹ e.
    pub nis: f64,
    /// Its degrees of freedom.
    pub dof: usize,
    /// Mean of e over the blocks of the buffer by channel [v, ω], m/s and rad/s.
    pub mean: [f64; VELOCITY_DIM],
    /// The same over its standard deviation by S.
    pub normalised: [f64; VELOCITY_DIM],
    /// eᵀ R_B⁻¹ e.
    pub weighed: f64,
    /// eᵀ (R_B + H P₀ Hᵀ)⁻¹ e: what would be left of it at least if the soil were whatever the prior allows.
    pub beyond_soil: f64,
}

/// The agreement of an innovation e. `known` is H P⁻ Hᵀ, `possible` H P₀ Hᵀ, `noise` R_B with all that is considered; rows 6 k + c for channel c of block k.
///
/// # Errors
/// `SingularInnovation` when one of the covariances has no Cholesky factor.
pub(crate) fn agreement(
    innovation: &DVector<f64>,
    known: DMatrix<f64>,
    possible: DMatrix<f64>,
    noise: &DMatrix<f64>,
) -> Result<Agreement, AdaptationError> {
    let rows = innovation.len();
    let squared = |covariance: &DMatrix<f64>| -> Result<f64, AdaptationError> {
        let factor = covariance.clone().cholesky().ok_or(AdaptationError::SingularInnovation { rows })?;
        Ok(innovation.dot(&factor.solve(innovation)))
    };
    let spread = known + noise;
    let blocks = rows / VELOCITY_DIM;
    let count = blocks.max(1) as f64;
    let mean = core::array::from_fn(|c| (0..blocks).map(|k| innovation[VELOCITY_DIM * k + c]).sum::<f64>() / count);
    let variance = |c: usize| {
        let of = |j: usize| (0..blocks).map(|k| spread[(VELOCITY_DIM * j + c, VELOCITY_DIM * k + c)]).sum::<f64>();
        (0..blocks).map(of).sum::<f64>() / (count * count)
    };
    let normalised = core::array::from_fn(|c| mean[c] / variance(c).max(f64::MIN_POSITIVE).sqrt());
    Ok(Agreement {
        nis: squared(&spread)?,
        dof: rows,
        mean,
        normalised,
        weighed: squared(noise)?,
        beyond_soil: squared(&(possible + noise))?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_a_buffer_of_two_blocks_by_hand() {
        // R = 4 I, H P⁻ Hᵀ = 5 in channel 0 of both blocks, fully correlated; H P₀ Hᵀ = 12 likewise; e = 3 there.
        let shared = |size: f64| DMatrix::from_fn(12, 12, |r, c| if r % 6 == 0 && c % 6 == 0 { size } else { 0.0 });
        let innovation = DVector::from_fn(12, |r, _| if r % 6 == 0 { 3.0 } else { 0.0 });
        let found = agreement(&innovation, shared(5.0), shared(12.0), &(DMatrix::identity(12, 12) * 4.0)).unwrap();
        // Along (1, 1)/√2 the innovation is 3 √2 with variance 4 + 2 · 5 = 14, or 4 + 2 · 12 = 28.
        assert!((found.nis - 18.0 / 14.0).abs() < 1e-12 && (found.weighed - 18.0 / 4.0).abs() < 1e-12);
        assert!((found.beyond_soil - 18.0 / 28.0).abs() < 1e-12);
        // The mean of two blocks has variance (4 + 4)/4 + 5 = 7.
        assert_eq!(found.mean, [3.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        assert!((found.normalised[0] - 3.0 / 7.0_f64.sqrt()).abs() < 1e-12 && found.dof == 12);
    }
}
