//! What can go wrong.

/// Why a drive is not degraded.
#[derive(Debug, thiserror::Error)]
pub enum DegradationError {
    /// A specification is not understood.
    #[error("`{part}`: {reason}")]
    Spec {
        /// The part at fault.
        part: String,
        /// What was wrong and what is allowed.
        reason: String,
    },
    /// The engine refused what it needs to begin.
    #[error("drive {drive}: {reason}")]
    Engine {
        /// The drive.
        drive: String,
        /// What the engine said.
        reason: String,
    },
}
