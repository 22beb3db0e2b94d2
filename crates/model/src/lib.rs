//! The neural half: encoders, soil prior, Transformer, rollout, bundle.
//!
//! A [`ModelBundle`] is loaded from disk and becomes a [`Predictor`], which answers [`RolloutQuery`]s: from one start state, N candidate
//! command sequences over K steps. At every step each sample looks up its terrain token at the predicted pose, the Transformer turns the token
//! into wheel sinkages and a state residual, and `nesam_physics` moves the vehicle (paper Eq. 2). [`reference`] holds the same network as
//! candle tensors: it trains, and the tests hold the fast path against it.

pub mod bundle;
pub mod dims;
mod effects_file;
pub mod encoder;
mod fused;
mod ground;
mod interruption;
pub mod normalization;
mod precision;
mod predictor;
pub mod reference;
mod rollout;
pub mod rollout_noise;
pub mod soil_coordinates;
mod soil_field;
mod soil_prior;
pub mod step_row;
mod symbolic;
mod tangent;
mod terrain_tokens;
pub mod token;
pub mod weights;

pub use bundle::{ModelBundle, Provenance};
pub use dims::{HISTORY, MAX_HORIZON};
pub use effects_file::named_effect;
pub use effects_file::{read as effects_from_toml, write as effects_to_toml};
pub use fused::{Order, Path};
pub use ground::{GroundSource, history_actuators};
pub use interruption::{Gate, Interruption};
pub use normalization::{Normalization, StandIn};
pub use precision::Precision;
pub use predictor::{PartTimes, Predictor, Transition};
pub use rollout::{Due, HistoryStep, MeasuredWheels, RiskOutputs, Rollout, RolloutExtras, RolloutQuery, Variant, flag, is_raised};
pub use rollout_noise::RolloutNoise;
pub use soil_field::{SoilByClass, SoilField};
pub use tangent::{Linearisation, StateJacobian};
pub use terrain_tokens::{CacheCounts, TerrainToken};
pub use weights::Weights;

/// What can go wrong with a bundle or a query.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// A bundle cannot be used.
    #[error("bundle file {}: {reason}", path.display())]
    Bundle {
        /// File or folder at fault.
        path: std::path::PathBuf,
        /// What was wrong and what was expected.
        reason: String,
    },
    /// An array of the weights cannot be used.
    #[error("weights array `{name}` {reason}")]
    Weights {
        /// Array at fault.
        name: String,
        /// What was wrong and what was expected.
        reason: String,
    },
    /// A query cannot be answered.
    #[error("query field `{field}`: {reason}")]
    Query {
        /// Field at fault.
        field: &'static str,
        /// What was wrong and the limit.
        reason: String,
    },
    /// Nobody waits for the answer any more ([`Interruption::abandoned`]).
    #[error("nobody waits for the rollout any more")]
    Abandoned,
    /// What a bundle says of its own errors cannot be used.
    #[error("rollout_noise.json: {reason}")]
    RolloutNoise {
        /// What was wrong and what was expected.
        reason: String,
    },
    /// Tensors cannot live there.
    #[error("device {device}: {reason}")]
    Device {
        /// Device asked for.
        device: reference::ComputeDevice,
        /// What was wrong and what to do.
        reason: String,
    },
    /// candle reported an error.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}
