//! What libraries read from the environment before this program can speak to them.

use std::os::unix::process::CommandExt;

use crate::failure::{Failure, OrFail};

/// Milliseconds after which mimalloc returns memory that is not used to the system; -1 = never.
///
/// What is asked for again sooner comes back as pages that the system has to clear: a third of what lay between a planner and the engine, 6 % of training.
pub const PURGE_DELAY: &str = "MIMALLOC_PURGE_DELAY";

/// Whether the system may gather memory into huge pages; 1 = yes, as mimalloc asks for.
const HUGE_PAGES: &str = "MIMALLOC_ALLOW_THP";

/// What a server asks of mimalloc: to keep memory for longer than the pause between the questions of a planner, and no huge pages.
///
/// The system makes huge pages of memory that a server has given back, fills them with zeros, and counts them to the server: memory rises in steps under a load
/// that does not change, to twice of what is used. Rollouts are no slower without (ADR 0056).
pub const OF_A_SERVER: [(&str, &str); 2] = [(PURGE_DELAY, "1000"), (HUGE_PAGES, "0")];

/// Restarts this program once, in the same process, with those variables that are not set yet. Returns when all are.
///
/// # Errors
/// `Failure::Failed` when the system does not start it.
pub fn restart_with(variables: &[(&str, &str)]) -> Result<(), Failure> {
    let unset: Vec<_> = variables.iter().filter(|(name, _)| std::env::var_os(name).is_none()).collect();
    if unset.is_empty() {
        return Ok(());
    }
    let program = std::env::current_exe().or_failed()?;
    let error = std::process::Command::new(program).args(std::env::args_os().skip(1)).envs(unset.into_iter().copied()).exec();
    Err(Failure::Failed(format!("the program could not restart itself: {error}")))
}
