//! What can be wrong with a log.

use std::path::{Path, PathBuf};

/// Failure of an import; nothing was written.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// A file could not be read or written.
    #[error("{}: {source}", path.display())]
    File {
        /// File at fault.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The content of a log cannot be used.
    #[error("{}: {reason}", path.display())]
    Log {
        /// File at fault.
        path: PathBuf,
        /// What, where, and what to do.
        reason: String,
    },
    /// The mapping of columns cannot be used.
    #[error("column mapping `{entry}`: {reason}")]
    Mapping {
        /// Entry at fault.
        entry: String,
        /// What is wrong and what is allowed.
        reason: String,
    },
}

impl ImportError {
    pub(crate) fn log(path: &Path, reason: impl Into<String>) -> Self {
        Self::Log { path: path.into(), reason: reason.into() }
    }

    pub(crate) fn file(path: &Path, source: std::io::Error) -> Self {
        Self::File { path: path.into(), source }
    }

    pub(crate) fn mapping(entry: &str, reason: impl Into<String>) -> Self {
        Self::Mapping { entry: entry.into(), reason: reason.into() }
    }
}
