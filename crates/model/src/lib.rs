//! The neural half: encoders, soil prior, Transformer, rollout, bundle.

mod bundle;
mod predictor;
mod rollout;

pub use bundle::ModelBundle;
pub use predictor::Predictor;
pub use rollout::{HistoryStep, Rollout, RolloutQuery, Variant, flag};

/// Tokens of measured history the Transformer sees, the current one included (paper §IV-C).
pub const HISTORY: usize = 32;
/// Longest horizon: the positions left after the history (paper §IV-C: 64 positions).
pub const MAX_HORIZON: usize = 32;

/// What can go wrong with a bundle or a query.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// A bundle cannot be used.
    #[error("bundle {}: {reason}", path.display())]
    Bundle {
        /// File or folder at fault.
        path: std::path::PathBuf,
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
    /// candle reported an error.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}
