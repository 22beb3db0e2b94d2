//! Learning the ground while driving: the buffered extended Kalman filter of the paper (§III-D2, Algorithm 1).
//!
//! Everything learned stays as it is; only a correction Δθ of the soil prior is estimated. A [`SoilFilter`] collects B measured
//! transitions, predicts the velocities after each of them from its *measured* start, and makes one update from the stacked differences.
//! What the network says of a transition (sinkage, residual, prior) does not depend on Δθ, so a [`BufferedTransition`] carries it as
//! numbers, ∂Ŷ/∂Δθ flows through the physics alone, and this crate needs no network, no map and no clock. Same pushes, same bytes.
//!
//! | of Algorithm 1 | here |
//! |---|---|
//! | buffer 𝒟, Y | [`SoilFilter::push`] |
//! | Ŷ and H by forward duals | [`predict_velocity`] |
//! | R_B | [`VelocityNoise::covariance`] |
//! | S, K, Δθ⁺, P⁺ | [`kalman_update`] |
#![forbid(unsafe_code)]

mod chi_square;
mod config;
mod error;
mod filter;
mod noise;
mod prediction;
mod update;

pub use chi_square::chi_square_tail;
pub use config::FilterConfig;
pub use error::AdaptationError;
pub use filter::{SoilFilter, SoilPosterior, SoilUpdate};
pub use noise::{ChannelNoise, VelocityNoise};
pub use prediction::{BufferedTransition, VELOCITY_DIM, VelocityPrediction, predict_velocity};
pub use update::{KalmanStep, kalman_update};
