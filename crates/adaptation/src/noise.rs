//! How far measured velocities lie from one-step predictions when the soil is right: sensor noise and the error of the model.

use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

use crate::AdaptationError;
use crate::prediction::VELOCITY_DIM;

/// Noise of one channel: white, plus a model error that forgets itself from step to step (first-order autoregressive).
///
/// The coloured part is what keeps a buffer honest: ten predictions that share an error say less than ten that do not, and a filter that
/// is told otherwise becomes certain of a wrong soil.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChannelNoise {
    /// Standard deviation of the part that is independent from step to step, m/s or rad/s.
    pub white_sd: f64,
    /// Standard deviation of the coloured part, m/s or rad/s.
    pub coloured_sd: f64,
    /// Correlation of the coloured part from one step to the next, -.
    pub correlation: f64,
}

/// R_B: how a full buffer errs when the soil is right.
#[derive(Clone, Debug, PartialEq)]
pub enum BufferNoise {
    /// The same six channels at every step, independent of each other.
    Channels(VelocityNoise),
    /// The second moment of the innovations of measured buffers, one row per row of the innovation: growth along a rollout, channels that err together
    /// and a bias of the model are all in it, and so is the spread of soils that look alike.
    Sampled(DMatrix<f64>),
}

/// The part of R_B that is the same error of the model from buffer to buffer, E[e_k e_{k+l}ᵀ] = a^l B: a first-order autoregressive state beside the soil.
#[derive(Clone, Debug, PartialEq)]
pub struct SharedError {
    /// B, row by row as R_B; R_B - B must be a covariance.
    pub covariance: DMatrix<f64>,
    /// a, correlation from one buffer to the next, -.
    pub correlation: f64,
}

impl SharedError {
    /// R_B - B, what single buffers err by.
    pub(crate) fn rest(&self, noise: &DMatrix<f64>) -> DMatrix<f64> {
        noise - &self.covariance
    }

    /// Refuses what leaves no noise to single buffers.
    pub(crate) fn check(&self, noise: &DMatrix<f64>) -> Result<(), AdaptationError> {
        let fail = |reason: String| Err(AdaptationError::Config { setting: "shared_error", reason });
        if self.covariance.shape() != noise.shape() {
            return fail(format!("has {} rows, R_B has {}", self.covariance.nrows(), noise.nrows()));
        }
        if !(0.0..1.0).contains(&self.correlation) {
            return fail(format!("has a correlation of {}, it must lie in [0, 1)", self.correlation));
        }
        let finite = self.covariance.iter().all(|v| v.is_finite());
        if !finite || self.rest(noise).cholesky().is_none() {
            return fail("is not a part of R_B that leaves a positive definite rest".into());
        }
        Ok(())
    }
}

impl From<VelocityNoise> for BufferNoise {
    fn from(noise: VelocityNoise) -> Self {
        Self::Channels(noise)
    }
}

impl BufferNoise {
    /// R_B of a buffer of `steps` transitions, averaged over blocks, row 6 k + c for channel c of block k.
    pub fn covariance(&self, steps: usize, block: usize) -> DMatrix<f64> {
        let noise = match self {
            Self::Sampled(moment) => return moment.clone(),
            Self::Channels(noise) => noise.covariance(steps),
        };
        let mean = DMatrix::from_fn(steps / block * VELOCITY_DIM, steps * VELOCITY_DIM, |row, column| {
            let same = row % VELOCITY_DIM == column % VELOCITY_DIM && column / VELOCITY_DIM / block == row / VELOCITY_DIM;
            if same { 1.0 / block as f64 } else { 0.0 }
        });
        &mean * noise * mean.transpose()
    }

    /// Refuses what cannot make a covariance of `rows` rows.
    pub(crate) fn check(&self, rows: usize) -> Result<(), AdaptationError> {
        let fail = |reason| Err(AdaptationError::Config { setting: "noise", reason });
        match self {
            Self::Channels(noise) => noise.check(),
            Self::Sampled(moment) if moment.shape() != (rows, rows) => fail(format!(
                "was sampled for {} rows, buffer and block make {rows}; estimate it again for these settings or give the noise of channels",
                moment.nrows()
            )),
            Self::Sampled(moment) if !moment.iter().all(|v| v.is_finite()) || moment.clone().cholesky().is_none() => {
                fail("is not a positive definite covariance".into())
            }
            Self::Sampled(_) => Ok(()),
        }
    }
}

/// Noise of the six channels [v, ω]; channels are independent of each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VelocityNoise {
    /// vx, vy, vz, ωx, ωy, ωz.
    pub channels: [ChannelNoise; VELOCITY_DIM],
}

impl VelocityNoise {
    /// R_B of a buffer of `steps` transitions, row 6 k + c for channel c of transition k.
    pub fn covariance(&self, steps: usize) -> DMatrix<f64> {
        DMatrix::from_fn(steps * VELOCITY_DIM, steps * VELOCITY_DIM, |row, column| {
            let (k, c, j, d) = (row / VELOCITY_DIM, row % VELOCITY_DIM, column / VELOCITY_DIM, column % VELOCITY_DIM);
            if c != d {
                return 0.0;
            }
            let noise = &self.channels[c];
            let white = if k == j { noise.white_sd * noise.white_sd } else { 0.0 };
            white + noise.coloured_sd * noise.coloured_sd * noise.correlation.powi(k.abs_diff(j) as i32)
        })
    }

    /// Refuses what cannot make a covariance.
    pub(crate) fn check(&self) -> Result<(), AdaptationError> {
        let usable = |n: &ChannelNoise| {
            let positive = n.white_sd.is_finite() && n.white_sd > 0.0;
            positive && n.coloured_sd.is_finite() && n.coloured_sd >= 0.0 && (0.0..1.0).contains(&n.correlation)
        };
        match self.channels.iter().position(|n| !usable(n)) {
            None => Ok(()),
            Some(c) => {
                let reason = format!(
                    "channel {c} is {:?}; white_sd must be positive, coloured_sd at least 0, correlation in [0, 1)",
                    self.channels[c]
                );
                Err(AdaptationError::Config { setting: "noise", reason })
            }
        }
    }
}
