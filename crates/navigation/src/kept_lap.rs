//! A lap in a file of its own, from which a later command takes it.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::score::Run;

/// A lap with the settings that it was driven with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct KeptLap {
    /// Settings of the lap.
    pub settings: Value,
    /// What was driven.
    pub run: Run,
}

impl KeptLap {
    /// The file.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("numbers and texts serialise; this is a bug")
    }

    /// Reads a file.
    ///
    /// # Errors
    /// What is wrong with it, and where.
    pub fn from_json(bytes: &[u8]) -> Result<Self, String> {
        serde_json::from_slice(bytes).map_err(|error| error.to_string())
    }
}
