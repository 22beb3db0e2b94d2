//! Threads that compute predictions: one pool of the process.

use crate::config::WorkersConfig;
use crate::error::ServerError;

/// Starts the threads that compute predictions, named `nesam-worker-<number>`; once in a process, before its first prediction.
///
/// # Errors
/// `ServerError::Workers` when they are there already, or the system gives no more threads.
pub fn start_workers(config: &WorkersConfig) -> Result<(), ServerError> {
    let processors = if config.pinned { core_affinity::get_core_ids().unwrap_or_default() } else { Vec::new() };
    if config.pinned && processors.is_empty() {
        tracing::warn!("this system does not say which processors there are: workers are not pinned");
    }
    rayon::ThreadPoolBuilder::new()
        .num_threads(config.threads)
        .thread_name(|number| format!("nesam-worker-{number}"))
        .start_handler(move |number| {
            if !processors.is_empty() && !core_affinity::set_for_current(processors[number % processors.len()]) {
                tracing::warn!(number, "a worker could not be pinned");
            }
        })
        .build_global()
        .map_err(|error| ServerError::Workers { reason: error.to_string() })
}
