//! Learning the ground while driving: the buffered extended Kalman filter of the paper (§III-D2, Algorithm 1).
//!
//! Everything learned stays as it is; only a correction Δθ of the soil prior is estimated. A [`SoilFilter`] collects B measured
//! transitions, predicts the velocities after each of them, and makes one update from the stacked differences. As in the paper, each prediction may start at
//! its measured state ([`Innovation::OneStep`]); by default the buffer is one rollout ([`Innovation::Rollout`], `docs/adr/0007`).
//! What the network says of a transition (sinkage, residual, prior) does not depend on Δθ, so a [`BufferedTransition`] carries it as
//! numbers, ∂Ŷ/∂Δθ flows through the physics alone, and this crate needs no network, no map and no clock. Same pushes, same bytes.
//!
//! | of Algorithm 1 | here |
//! |---|---|
//! | buffer 𝒟, Y | [`SoilFilter::push`] |
//! | Ŷ and H by forward duals | [`predict_velocity`] |
//! | R_B | [`BufferNoise`] |
//! | S, K, Δθ⁺, P⁺ | `kalman_update` in `update.rs` |
#![forbid(unsafe_code)]

mod agreement;
mod calibration;
mod chi_square;
mod conditions;
mod config;
mod covariance;
mod error;
mod filter;
mod forecast;
mod joint;
mod noise;
mod prediction;
mod settings;
mod trust;
mod update;

pub use agreement::Agreement;
pub use calibration::{NoiseCalibration, UncorrectedBuffer, calibrate};
pub use chi_square::chi_square_tail;
pub use conditions::{NoiseConditions, conditions};
pub use config::{FilterConfig, Innovation};
pub use covariance::check_covariance;
pub use error::AdaptationError;
pub use filter::{ClassBelief, FilterSnapshot, JointSnapshot, SoilFilter, SoilPosterior, SoilUpdate, uncorrected};
pub use forecast::{FORECAST_AHEAD, FORECAST_STEPS, ForecastCheck, planar_mahalanobis};
pub use noise::{BufferNoise, ChannelNoise, SharedError, VelocityNoise};
pub use prediction::{BufferedTransition, VELOCITY_DIM, VelocityPrediction, predict_velocity};
pub use settings::{CalibratedFilter, Coordinates, FilterSettings};
