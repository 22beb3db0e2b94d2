//! Settings that a model's own errors tell: R_B, and how many buffers say no more than one.

use nalgebra::{DMatrix, DVector, SVector};
use nesam_physics::SOIL_DIM;

use crate::error::AdaptationError;
use crate::noise::BufferNoise;

/// Buffers needed for each row of R_B.
const BUFFERS_PER_ROW: usize = 10;

/// Y - Ŷ and H of one buffer with the soil prior as it is.
#[derive(Clone, Debug, PartialEq)]
pub struct UncorrectedBuffer {
    /// Y - Ŷ.
    pub innovation: DVector<f64>,
    /// ∂Ŷ/∂Δθ, rows × 6.
    pub jacobian: DMatrix<f64>,
}

/// R_B and its companion, see [`calibrate`].
#[derive(Clone, Debug, PartialEq)]
pub struct NoiseCalibration {
    /// R_B.
    pub noise: BufferNoise,
    /// Buffers in a row that say no more than one, at least 1.
    pub shared_buffers: f64,
    /// Buffers behind both.
    pub buffers: usize,
}

/// Both from drives on ground that the model was trained for, one list of buffers per drive in order of time.
///
/// R_B is the second moment E[e eᵀ]. The mean counts as noise: a filter must not explain a constant error of the model by soil. With it, what a buffer
/// says of the soil, g = Hᵀ R_B⁻¹ e, has about the variance that the filter believes. Buffers of one drive err alike, so the sum G of a drive's
/// g varies more than a sum of independent ones; Σ|G|² / Σ|g|² (lengths in units of the prior) is how many times too often the
/// filter would count the same evidence: the design effect of a cluster sample.
///
/// # Errors
/// `TooFewBuffers` with fewer than ten buffers per row, `NotFinite` when a number is not finite or rows differ in number, `SingularInnovation` when
/// the second moment has no Cholesky factor.
pub fn calibrate(drives: &[Vec<UncorrectedBuffer>], prior_sd: &[f64; SOIL_DIM]) -> Result<NoiseCalibration, AdaptationError> {
    let all: Vec<&UncorrectedBuffer> = drives.iter().flatten().collect();
    let rows = all.first().map_or(0, |b| b.innovation.len());
    let (buffers, needed) = (all.len(), BUFFERS_PER_ROW * rows.max(1));
    if buffers < needed {
        return Err(AdaptationError::TooFewBuffers { found: buffers, needed });
    }
    let usable = |b: &UncorrectedBuffer| {
        b.innovation.len() == rows
            && b.jacobian.shape() == (rows, SOIL_DIM)
            && b.innovation.iter().chain(b.jacobian.iter()).all(|v| v.is_finite())
    };
    if let Some(index) = all.iter().position(|b| !usable(b)) {
        return Err(AdaptationError::NotFinite { what: "difference", index });
    }
    let mut moment = DMatrix::zeros(rows, rows);
    for buffer in &all {
        moment.ger(1.0 / buffers as f64, &buffer.innovation, &buffer.innovation, 1.0);
    }
    let factor = moment.clone().cholesky().ok_or(AdaptationError::SingularInnovation { rows })?;
    let evidence = |buffer: &UncorrectedBuffer| {
        let g = buffer.jacobian.tr_mul(&factor.solve(&buffer.innovation));
        SVector::<f64, SOIL_DIM>::from_fn(|i, _| prior_sd[i] * g[i])
    };
    let (mut of_buffers, mut of_drives) = (0.0, 0.0);
    for drive in drives {
        let each: Vec<SVector<f64, SOIL_DIM>> = drive.iter().map(evidence).collect();
        of_buffers += each.iter().map(|g| g.norm_squared()).sum::<f64>();
        of_drives += each.iter().sum::<SVector<f64, SOIL_DIM>>().norm_squared();
    }
    let shared_buffers = if of_buffers > 0.0 { (of_drives / of_buffers).max(1.0) } else { 1.0 };
    Ok(NoiseCalibration { noise: BufferNoise::Sampled(moment), shared_buffers, buffers })
}
