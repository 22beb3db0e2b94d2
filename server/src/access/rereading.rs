//! Files that are read again while the server runs, and what is told of them.

use std::path::Path;
use std::time::Duration;

use tokio::sync::watch;

use crate::error::ServerError;
use crate::grpc::stopped;
use crate::telemetry::{Part, Reloads};

/// The bytes of the file of a key; none where no file is configured. What is in the file never reaches a message.
///
/// # Errors
/// `ServerError::Tls` naming the key and the file.
pub(crate) fn read_file(key: &'static str, path: &Path) -> Result<Vec<u8>, ServerError> {
    match path.as_os_str().is_empty() {
        true => Ok(Vec::new()),
        false => std::fs::read(path).map_err(|source| ServerError::Tls { key, reason: format!("{}: {source}", path.display()) }),
    }
}

/// Reads again until the server stops, this often, and hears of each time; `what` is read stands in the log where that panics.
pub(crate) async fn reread<T: Send + 'static, R: Send + 'static>(
    what: &str,
    mut state: T,
    every: Duration,
    stopping: watch::Receiver<bool>,
    read: fn(&mut T) -> R,
    mut heard: impl FnMut(&T, R),
) {
    let stop = stopped(stopping);
    tokio::pin!(stop);
    let mut tick = tokio::time::interval(every);
    tick.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            _ = tick.tick() => {}
            () = &mut stop => return,
        }
        // A file system that hangs holds up no request.
        let again = tokio::task::spawn_blocking(move || {
            let result = read(&mut state);
            (state, result)
        });
        let Ok((back, result)) = again.await else {
            tracing::error!(target: "nesam::audit", "reading {what} panicked: they are not read again; this is a bug");
            return;
        };
        state = back;
        heard(&state, result);
    }
}

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
