//! What can be wrong with a world map.

use std::path::PathBuf;

/// Failure of reading or building a world map.
#[derive(Debug, thiserror::Error)]
pub enum TerrainError {
    /// A file could not be opened or read.
    #[error("{}: cannot be read: {source}", path.display())]
    Read {
        /// File at fault.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A PNG image is damaged, truncated or of another kind than the format asks for.
    #[error("{}: {reason}", path.display())]
    Image {
        /// File at fault.
        path: PathBuf,
        /// What was wrong, with the image row where it applies.
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
    /// Layers or geometry given in memory are inconsistent.
    #[error("world map `{id}`: `{field}`: {reason}")]
    Layers {
        /// World id.
        id: String,
        /// Layer or geometry field at fault.
        field: &'static str,
        /// What was wrong, with row and column (counting from 0, row 0 in the south) where it applies.
        reason: String,
    },
}
