//! Diagnoses that clients start.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::check::THREADS_MAX;
use crate::error::ServerError;

/// Diagnoses of what was recorded, each in a process of its own.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DiagnosisConfig {
    /// Diagnoses that may run at a time; more are refused. 0 = none.
    pub at_once: usize,
    /// Longest duration of one, s.
    pub limit_s: f64,
    /// Threads of one; they compete with predictions for the processors.
    pub threads: usize,
    /// Folder for reports and patched bundles; made if needed.
    pub directory: PathBuf,
    /// Finished diagnoses whose folders are kept; older ones are removed.
    pub kept_max: usize,
    /// Program that is run with the arguments of `nesam diagnose`; empty = this one.
    pub executable: PathBuf,
    /// Folder of the bundle to diagnose with; empty = the one that is served, where `nesam serve` serves it, else the recorded one, found by its hash.
    pub bundle: PathBuf,
}

impl Default for DiagnosisConfig {
    fn default() -> Self {
        let (executable, bundle) = Default::default();
        Self { at_once: 1, limit_s: 1800.0, threads: 1, directory: "diagnoses".into(), kept_max: 16, executable, bundle }
    }
}

impl DiagnosisConfig {
    /// Checks what the types do not; the duration is checked with the others.
    ///
    /// # Errors
    /// `ServerError::Value` naming the key.
    pub(super) fn check(&self) -> Result<(), ServerError> {
        for (key, value) in [("diagnosis.threads", self.threads), ("diagnosis.at_once", self.at_once.max(1))] {
            if !(1..=THREADS_MAX).contains(&value) {
                return Err(ServerError::Value {
                    key,
                    reason: format!("is {value}, allowed is up to {THREADS_MAX}, and at least one thread"),
                });
            }
        }
        if self.kept_max == 0 {
            return Err(ServerError::value("diagnosis.kept_max", "is 0, at least 1 is needed"));
        }
        Ok(())
    }
}
