//! What can go wrong while an evaluation runs.

use std::path::PathBuf;

/// Errors of this crate.
#[derive(Debug, thiserror::Error)]
pub enum EvaluationError {
    /// No window fits the drives that were given.
    #[error(
        "no window of {horizon} steps fits any of the {trajectories} drives; use a shorter --horizon (the longest drive has {longest} samples)"
    )]
    NoWindows {
        /// Steps asked for.
        horizon: usize,
        /// Number of drives looked at.
        trajectories: usize,
        /// Samples of the longest drive.
        longest: usize,
    },
    /// Ground truth was asked for, but a drive has none.
    #[error("drive `{trajectory}` has no ground-truth channels; use the measured channels as truth")]
    NoGroundTruth {
        /// The drive at fault.
        trajectory: String,
    },
    /// A model name is not one of the contract.
    #[error("unknown model `{name}`; choose from {choices}")]
    UnknownModel {
        /// Name as given.
        name: String,
        /// Names that can be evaluated.
        choices: String,
    },
    /// Predictions from measured wheels were asked for where there are none.
    #[error("drive {trajectory} has no measured wheel speeds, or no angles of its steered wheels; use --inputs commands")]
    NoWheels {
        /// Drive.
        trajectory: String,
    },
    /// The kinematic baseline needs a fit that is not there.
    #[error("the kinematic baseline was never fitted: {reason}")]
    KinematicNotFitted {
        /// Why, and what to do.
        reason: String,
    },
    /// A model of the bundle was asked for without a bundle.
    #[error("model `{name}` needs a bundle")]
    NoBundle {
        /// The model.
        name: &'static str,
    },
    /// The text of fitted baselines cannot be used.
    #[error("baselines.json: {reason}")]
    Baselines {
        /// What was wrong.
        reason: String,
    },
    /// The fit of a baseline has too little to work with.
    #[error("cannot fit the kinematic baseline: {reason}")]
    Fit {
        /// What was missing.
        reason: String,
    },
    /// The model refused a window.
    #[error("drive `{trajectory}`, window at sample {start}: {source}")]
    Model {
        /// Drive.
        trajectory: String,
        /// First sample of the window.
        start: usize,
        /// The model's own error.
        source: nesam_model::ModelError,
    },
    /// The soil filter refused its settings.
    #[error(transparent)]
    Filter(#[from] nesam_adaptation::AdaptationError),
    /// A file could not be written or read.
    #[error("{}: {reason}", path.display())]
    File {
        /// File at fault.
        path: PathBuf,
        /// What went wrong.
        reason: String,
    },
}

impl EvaluationError {
    /// A file error with the path and the reason as text.
    pub(crate) fn file(path: &std::path::Path, reason: impl std::fmt::Display) -> Self {
        Self::File { path: path.to_path_buf(), reason: reason.to_string() }
    }
}
