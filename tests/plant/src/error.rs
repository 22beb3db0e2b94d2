//! What can go wrong before anything moves.

use std::path::PathBuf;

/// A file, a value or a message that the plant cannot use.
#[derive(Debug, thiserror::Error)]
pub enum PlantError {
    /// A file that cannot be read or written.
    #[error("{path}: {source}")]
    File {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file whose content is not what it should be.
    #[error("{path}: {reason}")]
    Content {
        /// The file.
        path: PathBuf,
        /// What was wrong.
        reason: String,
    },
    /// An effect that does not exist or has a value out of range.
    #[error("effect `{given}`: {reason}")]
    Effect {
        /// As it was given.
        given: String,
        /// What was wrong and what is allowed.
        reason: String,
    },
}

impl PlantError {
    pub(crate) fn content(path: impl Into<PathBuf>, reason: impl Into<String>) -> Self {
        Self::Content { path: path.into(), reason: reason.into() }
    }
}
