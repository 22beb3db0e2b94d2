//! Settings that a model's own errors tell: R_B, what drives it, what of it carries on from buffer to buffer.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn, SMatrix, SVector};
use nesam_physics::SOIL_DIM;

use crate::conditions::{CONDITIONS, NoiseConditions};
use crate::config::FilterConfig;
use crate::error::AdaptationError;
use crate::noise::{BufferNoise, SharedError};

/// Buffers needed for each row of R_B.
const BUFFERS_PER_ROW: usize = 10;
/// Passes over R_B and what drives it.
const PASSES: usize = 6;
/// Pull of the slopes to zero, in buffers per squared unit of standardised condition.
const SLOPE_PULL: f64 = 1.0;
/// Lags over which errors are followed from buffer to buffer.
const LAGS: usize = 6;
/// Share of any direction of R_B that may be taken for an error that carries on.
const SHARED_MAX: f64 = 0.9;

/// Y - Ŷ and H of one buffer with the soil prior as it is.
#[derive(Clone, Debug, PartialEq)]
pub struct UncorrectedBuffer {
    /// Y - Ŷ.
    pub innovation: DVector<f64>,
    /// ∂Ŷ/∂Δθ, rows × 6.
    pub jacobian: DMatrix<f64>,
    /// What it was driven under, see [`crate::conditions`].
    pub conditions: [f64; CONDITIONS],
}

/// R_B and its companions, see [`calibrate`].
#[derive(Clone, Debug, PartialEq)]
pub struct NoiseCalibration {
    /// R_B.
    pub noise: BufferNoise,
    /// How R_B grows with what the vehicle does; `None` when it was not asked for.
    pub conditions: Option<NoiseConditions>,
    /// Buffers in a row that say no more than one, at least 1.
    pub shared_buffers: f64,
    /// The part of R_B that carries on, an alternative to `shared_buffers`.
    pub shared_error: SharedError,
    /// Buffers behind all of them.
    pub buffers: usize,
}

/// All from drives on ground that the model was trained for, one list of buffers per drive in order of time.
///
/// R_B is the second moment E[e eᵀ / s]. The mean counts as noise: a filter must not explain a constant error of the model by soil. s is 1, or with
/// `by_conditions` the log-linear factor under which the squared whitened errors are most likely (gamma regression).
///
/// Buffers of one drive err alike. Two descriptions of that, of which a filter uses one:
/// - `shared_error`: E[e_k e_{k+l}ᵀ] = a^l B, the part of R_B that a filter can follow as a state of its own;
/// - `shared_buffers`: what a buffer says of the soil, g = Hᵀ R_B⁻¹ e (R_B under the caution of the settings), has about the variance that the
///   filter believes, but the sum G of a drive's g varies more than a sum of independent ones; Σ|G|² / Σ|g|² (lengths in units of the prior) is
///   how many times too often the filter would count the same evidence: the design effect of a cluster sample.
///
/// # Errors
/// `TooFewBuffers` with fewer than ten buffers per row, `NotFinite` when a number is not finite or rows differ in number, `SingularInnovation` when
/// the second moment has no Cholesky factor.
pub fn calibrate(
    drives: &[Vec<UncorrectedBuffer>],
    config: &FilterConfig,
    by_conditions: bool,
) -> Result<NoiseCalibration, AdaptationError> {
    let all: Vec<&UncorrectedBuffer> = drives.iter().flatten().collect();
    let rows = all.first().map_or(0, |b| b.innovation.len());
    let (buffers, needed) = (all.len(), BUFFERS_PER_ROW * rows.max(1));
    if buffers < needed {
        return Err(AdaptationError::TooFewBuffers { found: buffers, needed });
    }
    let usable = |b: &UncorrectedBuffer| {
        b.innovation.len() == rows
            && b.jacobian.shape() == (rows, SOIL_DIM)
            && b.innovation.iter().chain(b.jacobian.iter()).chain(&b.conditions).all(|v| v.is_finite())
    };
    if let Some(index) = all.iter().position(|b| !usable(b)) {
        return Err(AdaptationError::NotFinite { what: "difference", index });
    }
    let (moment, conditions) = second_moment(&all, by_conditions)?;
    let factored = |noise: DMatrix<f64>| noise.cholesky().ok_or(AdaptationError::SingularInnovation { rows });
    let (factor, cautious) = (factored(moment.clone())?, factored(config.with_caution(&moment))?);
    let root = |b: &UncorrectedBuffer| conditions.map_or(1.0, |c| c.factor(&b.conditions)).sqrt();
    Ok(NoiseCalibration {
        shared_buffers: design_effect(drives, &config.prior_sd, &cautious, &root),
        shared_error: shared_error(drives, &factor, &root),
        noise: BufferNoise::Sampled(moment),
        conditions,
        buffers,
    })
}

type Factor = Cholesky<f64, Dyn>;

/// E[e eᵀ / s] with the s that goes with it.
fn second_moment(all: &[&UncorrectedBuffer], by_conditions: bool) -> Result<(DMatrix<f64>, Option<NoiseConditions>), AdaptationError> {
    let (rows, count) = (all[0].innovation.len(), all.len() as f64);
    let mean: [f64; CONDITIONS] = std::array::from_fn(|i| all.iter().map(|b| b.conditions[i]).sum::<f64>() / count);
    let mut conditions = NoiseConditions { mean, slope: [0.0; CONDITIONS] };
    let mut moment = DMatrix::zeros(rows, rows);
    for _ in 0..if by_conditions { PASSES } else { 1 } {
        moment.fill(0.0);
        for b in all {
            moment.ger(1.0 / (count * conditions.factor(&b.conditions)), &b.innovation, &b.innovation, 1.0);
        }
        if !by_conditions {
            return Ok((moment, None));
        }
        let factor = moment.clone().cholesky().ok_or(AdaptationError::SingularInnovation { rows })?;
        let squares: Vec<f64> = all.iter().map(|b| b.innovation.dot(&factor.solve(&b.innovation)) / rows as f64).collect();
        conditions.slope = gamma_regression(all, &squares, &mean);
    }
    Ok((moment, Some(conditions)))
}

/// Slopes β (and an intercept that is left to the second moment) with E[square] = exp(β₀ + β·(f - mean)): Newton steps on the gamma likelihood
/// Σ β·f + square e^(-β·f), which is convex.
fn gamma_regression(all: &[&UncorrectedBuffer], squares: &[f64], mean: &[f64; CONDITIONS]) -> [f64; CONDITIONS] {
    type Row = SVector<f64, { CONDITIONS + 1 }>;
    let sd: [f64; CONDITIONS] = std::array::from_fn(|i| {
        let variance = all.iter().map(|b| (b.conditions[i] - mean[i]).powi(2)).sum::<f64>() / all.len() as f64;
        variance.sqrt().max(1e-9)
    });
    let rows: Vec<Row> =
        all.iter().map(|b| Row::from_fn(|i, _| if i == 0 { 1.0 } else { (b.conditions[i - 1] - mean[i - 1]) / sd[i - 1] })).collect();
    let mut beta = Row::zeros();
    for _ in 0..30 {
        let mut gradient = beta * SLOPE_PULL;
        let mut curvature = SMatrix::<f64, { CONDITIONS + 1 }, { CONDITIONS + 1 }>::identity() * SLOPE_PULL;
        for (row, square) in rows.iter().zip(squares) {
            let ratio = square * (-beta.dot(row)).clamp(-20.0, 20.0).exp();
            gradient += row * (1.0 - ratio);
            curvature += row * row.transpose() * ratio;
        }
        let Some(factor) = curvature.cholesky() else { break };
        let step = factor.solve(&gradient);
        beta -= step * (1.0 / step.norm().max(1.0));
    }
    std::array::from_fn(|i| beta[i + 1] / sd[i])
}

fn design_effect(
    drives: &[Vec<UncorrectedBuffer>],
    prior_sd: &[f64; SOIL_DIM],
    factor: &Factor,
    root: &dyn Fn(&UncorrectedBuffer) -> f64,
) -> f64 {
    let evidence = |buffer: &UncorrectedBuffer| {
        let g = buffer.jacobian.tr_mul(&factor.solve(&buffer.innovation)) / root(buffer).powi(2);
        SVector::<f64, SOIL_DIM>::from_fn(|i, _| prior_sd[i] * g[i])
    };
    let (mut of_buffers, mut of_drives) = (0.0, 0.0);
    for drive in drives {
        let each: Vec<SVector<f64, SOIL_DIM>> = drive.iter().map(evidence).collect();
        of_buffers += each.iter().map(|g| g.norm_squared()).sum::<f64>();
        of_drives += each.iter().sum::<SVector<f64, SOIL_DIM>>().norm_squared();
    }
    if of_buffers > 0.0 { (of_drives / of_buffers).max(1.0) } else { 1.0 }
}

/// a by least squares over the mean whitened autocovariances of all rows, B from all lags together, its eigenvalues between 0 and 0.9 of R_B.
fn shared_error(drives: &[Vec<UncorrectedBuffer>], factor: &Factor, root: &dyn Fn(&UncorrectedBuffer) -> f64) -> SharedError {
    let lower = factor.l();
    let rows = lower.nrows();
    let mut lags = vec![DMatrix::<f64>::zeros(rows, rows); LAGS];
    for (lag, sum) in lags.iter_mut().enumerate() {
        let mut pairs = 0.0;
        for drive in drives {
            let white: Vec<DVector<f64>> = drive
                .iter()
                .map(|b| lower.solve_lower_triangular(&b.innovation).unwrap_or_else(|| DVector::zeros(rows)) / root(b))
                .collect();
            for k in lag + 1..white.len() {
                sum.ger(0.5, &white[k], &white[k - lag - 1], 1.0);
                sum.ger(0.5, &white[k - lag - 1], &white[k], 1.0);
                pairs += 1.0;
            }
        }
        *sum /= f64::max(pairs, 1.0);
    }
    let traces: Vec<f64> = lags.iter().map(|m| m.trace() / rows as f64).collect();
    let fit = |correlation: f64| {
        let power = |lag: usize| correlation.powi(lag as i32 + 1);
        let norm: f64 = (0..LAGS).map(|l| power(l).powi(2)).sum();
        let share = (0..LAGS).map(|l| traces[l] * power(l)).sum::<f64>() / norm.max(f64::MIN_POSITIVE);
        (0..LAGS).map(|l| (traces[l] - share * power(l)).powi(2)).sum::<f64>()
    };
    let grid = (1..=49).map(|i| f64::from(i) * 0.02);
    let correlation = grid.min_by(|a, b| fit(*a).total_cmp(&fit(*b))).unwrap_or(0.5);
    let power = |lag: usize| correlation.powi(lag as i32 + 1);
    let norm: f64 = (0..LAGS).map(|l| power(l).powi(2)).sum();
    let mut white = DMatrix::zeros(rows, rows);
    for (lag, matrix) in lags.iter().enumerate() {
        white += matrix * (power(lag) / norm);
    }
    let mut eigen = white.symmetric_eigen();
    eigen.eigenvalues.apply(|v| *v = v.clamp(0.0, SHARED_MAX));
    let covariance = &lower * eigen.recompose() * lower.transpose();
    SharedError { covariance: (&covariance + covariance.transpose()) * 0.5, correlation }
}
