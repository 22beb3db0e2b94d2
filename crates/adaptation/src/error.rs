//! What can go wrong in the filter.

/// Errors of this crate. After any of them the estimate is what it was before.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AdaptationError {
    /// A transition or a prediction from it holds a number that is not finite.
    #[error("{what} of transition {index} of the buffer is not finite; the buffer starts anew")]
    NotFinite {
        /// `input`, `measurement`, `prediction` or `snapshot`.
        what: &'static str,
        /// Place in the buffer.
        index: usize,
    },
    /// The innovation covariance S = H P Hᵀ + R is not positive definite.
    #[error("the innovation covariance of {rows} rows is not positive definite; every channel of the noise needs a positive white part")]
    SingularInnovation {
        /// Rows of S.
        rows: usize,
    },
    /// A setting of the filter is unusable.
    #[error("filter setting `{setting}` {reason}")]
    Config {
        /// The setting.
        setting: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// Too few buffers to estimate R_B from.
    #[error("{found} buffers are too few to estimate the covariance of their innovation, at least {needed} are needed; give more drives")]
    TooFewBuffers {
        /// Buffers given.
        found: usize,
        /// Buffers needed.
        needed: usize,
    },
    /// A file of settings cannot be read.
    #[error("filter settings: {reason}")]
    Settings {
        /// What was wrong.
        reason: String,
    },
}
