//! What is told of files that are read again.

use crate::error::ServerError;
use crate::telemetry::{Part, Reloads};

/// Tells of one part: in the log what is new, in the metrics what is so.
pub(crate) struct Rereading {
    part: Part,
    /// What is wrong with the files, as it was last logged; empty = nothing.
    said: String,
}

impl Rereading {
    /// Of a part whose files were usable.
    pub fn of(part: Part) -> Self {
        Self { part, said: String::new() }
    }

    /// Tells what came of reading the files again: whether they have changed, or why they cannot be used. Gives whether something else is in force now.
    pub fn tell(&mut self, read: Result<bool, ServerError>, reloads: &Reloads) -> bool {
        let part = self.part.label();
        reloads.unusable(self.part, read.is_err());
        match read {
            Ok(changed) => {
                if changed {
                    reloads.changed(self.part, true);
                    tracing::info!(target: "nesam::audit", part, "certificates or rights were read anew");
                } else if !self.said.is_empty() {
                    tracing::info!(target: "nesam::audit", part, "certificates or rights can be used again: they are those in force");
                }
                self.said.clear();
                changed
            }
            Err(error) => {
                let error = error.to_string();
                if error != self.said {
                    reloads.changed(self.part, false);
                    tracing::error!(target: "nesam::audit", part, error, "changed certificates or rights cannot be used; those before stay in force");
                    self.said = error;
                }
                false
            }
        }
    }
}
