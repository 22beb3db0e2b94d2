//! Why a recording cannot be written or read.

use std::path::{Path, PathBuf};

/// Failure of writing, reading or repeating a recording.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    /// The system refused a file or a folder.
    #[error("{}: {source}", path.display())]
    File {
        /// File or folder at fault.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is not MCAP at all.
    #[error("{}: is not an MCAP file; give a file that `nesam serve --record DIR` wrote", path.display())]
    NotMcap {
        /// File at fault.
        path: PathBuf,
    },
    /// The file cannot be used as a recording.
    #[error("{}: {reason}", path.display())]
    Unusable {
        /// File at fault.
        path: PathBuf,
        /// What was wrong and what to do.
        reason: String,
    },
    /// The files are not the parts of one recording from its beginning.
    #[error("{reason}")]
    Parts {
        /// What is missing or does not fit.
        reason: String,
    },
    /// No session of that name was open in the recorded run.
    #[error("{run}: session `{session}` is not in it")]
    NoSession {
        /// Name of the run.
        run: String,
        /// Session that was asked for.
        session: String,
    },
    /// The recording was made with another bundle.
    #[error("the recording was made with bundle {recorded_name} {recorded}, this is {given_name} {given}; its answers would differ")]
    Bundle {
        /// Name of the recorded bundle.
        recorded_name: String,
        /// Hash of the recorded bundle.
        recorded: String,
        /// Name of the given bundle.
        given_name: String,
        /// Hash of the given bundle.
        given: String,
    },
    /// The engine cannot be made from the bundle.
    #[error("bundle {bundle}: {reason}")]
    Engine {
        /// Name of the bundle.
        bundle: String,
        /// What is wrong with it.
        reason: String,
    },
}

impl RecordingError {
    pub(crate) fn file(path: &Path, source: std::io::Error) -> Self {
        Self::File { path: path.into(), source }
    }

    pub(crate) fn unusable(path: &Path, reason: impl Into<String>) -> Self {
        Self::Unusable { path: path.into(), reason: reason.into() }
    }
}
