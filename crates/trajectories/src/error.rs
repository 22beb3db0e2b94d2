//! What can be wrong with recorded drives.

use std::path::{Path, PathBuf};

use nesam_terrain::TerrainError;

/// Failure of reading a data root.
#[derive(Debug, thiserror::Error)]
pub enum TrajectoryError {
    /// A file or folder could not be read.
    #[error("{}: cannot be read: {source}", path.display())]
    Read {
        /// File at fault.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A Parquet file is damaged, truncated or not Parquet at all.
    #[error("{}: not a readable parquet file: {reason}", path.display())]
    Parquet {
        /// File at fault.
        path: PathBuf,
        /// What was wrong.
        reason: String,
    },
    /// A column is missing, of the wrong type or damaged.
    #[error("{}: column `{column}`: {reason}", path.display())]
    Column {
        /// File at fault.
        path: PathBuf,
        /// Column at fault.
        column: String,
        /// What was wrong and what is expected.
        reason: String,
    },
    /// One value is not usable.
    #[error("{}: column `{column}`, row {row}: {reason}", path.display())]
    Cell {
        /// File at fault.
        path: PathBuf,
        /// Column at fault.
        column: String,
        /// Row, counting from 0 over all row groups.
        row: usize,
        /// What was wrong.
        reason: String,
    },
    /// A JSON file is not valid JSON.
    #[error("{}: not valid json: {source}", path.display())]
    Json {
        /// File at fault.
        path: PathBuf,
        /// Line, column and reason.
        source: serde_json::Error,
    },
    /// A key of a JSON file is missing, of the wrong type or out of range.
    #[error("{}: key `{key}`: {reason}", path.display())]
    Key {
        /// File at fault.
        path: PathBuf,
        /// Dotted key.
        key: String,
        /// What was wrong and what is expected.
        reason: String,
    },
    /// A card in the schema of bundles is not valid.
    #[error("{}: {reason}", path.display())]
    Card {
        /// File at fault.
        path: PathBuf,
        /// What was wrong, with the key.
        reason: String,
    },
    /// The layout of the data root is not what was asked for.
    #[error("{}: {reason}", path.display())]
    Layout {
        /// Folder at fault.
        path: PathBuf,
        /// What was wrong and what is there.
        reason: String,
    },
    /// The query asks for drives that the set does not have.
    #[error("set `{set}`: {reason}")]
    Query {
        /// Set asked for.
        set: String,
        /// What was asked for and what is there.
        reason: String,
    },
    /// A world map could not be read.
    #[error(transparent)]
    World(#[from] TerrainError),
}

impl TrajectoryError {
    pub(crate) fn cell(path: &Path, column: &str, row: usize, reason: impl Into<String>) -> Self {
        Self::Cell { path: path.into(), column: column.into(), row, reason: reason.into() }
    }

    /// The same of a value of this drive, with what helps.
    pub(crate) fn in_drive(mut self, id: &str) -> Self {
        const REMEDY: &str = "mend it there, name the other drives with --trajectories, or make the root again with `nesam import` from the bag or CSV, which leaves out rows that lack a value and parts drives at gaps";
        if let Self::Cell { reason, .. } = &mut self {
            *reason = format!("{reason} (in drive `{id}`; {REMEDY})");
        }
        self
    }

    pub(crate) fn column(path: &Path, column: &str, reason: impl Into<String>) -> Self {
        Self::Column { path: path.into(), column: column.into(), reason: reason.into() }
    }

    pub(crate) fn layout(path: &Path, reason: impl Into<String>) -> Self {
        Self::Layout { path: path.into(), reason: reason.into() }
    }
}
