//! What can be wrong with a map of the soil.

/// Why settings or evidence were refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FleetSoilError {
    /// A setting is unusable.
    #[error("`{setting}` {reason}")]
    Setting {
        /// Its name.
        setting: &'static str,
        /// What is wrong and what is allowed.
        reason: String,
    },
    /// A covariance has no inverse, or a number is not finite.
    #[error("the {what} is not a belief: its covariance is not positive definite or a number is not finite")]
    Belief {
        /// `prior` or `posterior`.
        what: &'static str,
    },
    /// Evidence that another map told is none.
    #[error("evidence of the soil was refused: {reason}")]
    Evidence {
        /// What is wrong.
        reason: String,
    },
}
