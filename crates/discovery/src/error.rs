//! What can go wrong during a diagnosis.

/// Errors of this crate.
#[derive(Debug, thiserror::Error)]
pub enum DiscoveryError {
    /// A drive is too short or stands off its map.
    #[error(
        "drive `{trajectory}` has no segment of {steps} steps that is measured, and on a map that is known; leave it out with --trajectories, which names all others"
    )]
    NoSegments {
        /// Drive.
        trajectory: String,
        /// Steps of a segment.
        steps: usize,
    },
    /// The reference statistics of the bundle cannot be used.
    #[error("reference.json: {reason}")]
    Reference {
        /// What was wrong and what to do.
        reason: String,
    },
    /// The drives behind the reference of the bundle cannot be used.
    #[error("{reason}")]
    ReferenceDrives {
        /// What was wrong and what to do.
        reason: String,
    },
    /// A drive was asked for that the set does not have, too few are left, or nothing moves in any of them.
    #[error("{reason}")]
    Drives {
        /// What was wrong and what to do.
        reason: String,
    },
    /// Hypotheses that do not exist or cannot act together.
    #[error("{reason}")]
    Hypotheses {
        /// What was wrong and what to do.
        reason: String,
    },
    /// The model refused a window.
    #[error(transparent)]
    Evaluation(#[from] nesam_evaluation::EvaluationError),
}
