//! Durable sessions.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// Durable sessions: what a restarted server begins with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StoreConfig {
    /// Whether to keep sessions and maps on stable storage.
    pub enabled: bool,
    /// Folder of the store; made if needed. One server at a time.
    pub directory: PathBuf,
    /// Longest time that an accepted measurement waits for a commit, s; a buffer of the soil filter that ends brings it sooner.
    pub interval_s: f64,
}

impl Default for StoreConfig {
    fn default() -> Self {
        Self { enabled: false, directory: "sessions".into(), interval_s: 1.0 }
    }
}
