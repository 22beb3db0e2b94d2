//! What can end a lap early.

use nesam_client::ClientError;

/// Failure of a lap. A vehicle that leaves its path or gets stuck is a result and no failure.
#[derive(Debug, thiserror::Error)]
pub enum NavigationError {
    /// The service refused or went away.
    #[error("service: {0}")]
    Service(#[from] ClientError),
    /// The plant did not answer, or not as the protocol says.
    #[error("plant {address}: {reason}")]
    Plant {
        /// Where it was expected.
        address: String,
        /// What was wrong.
        reason: String,
    },
    /// The plant has lost a lap that had begun: it answers no more, or was started anew. The lap can be driven again from `reset`.
    #[error("plant {address}: {reason}")]
    Lost {
        /// Where it was expected.
        address: String,
        /// What was wrong.
        reason: String,
    },
    /// Whoever drives has been told to stop.
    #[error("interrupted")]
    Interrupted,
    /// The built-in plant cannot be made.
    #[error(transparent)]
    BuiltIn(#[from] nesam_plant::PlantError),
    /// A setting out of range.
    #[error("{setting}: {reason}")]
    Setting {
        /// Its name.
        setting: &'static str,
        /// What is allowed.
        reason: String,
    },
}
