//! The `nesam` binary: one command line for prediction, evaluation and service. See `nesam --help`.

mod args;
mod bundle_path;
mod bundle_version;
mod cli;
mod commands;
mod environment;
mod failure;
mod interrupt;
mod logging;
mod on_map;
mod output;
mod progress;
mod sources;

use std::process::ExitCode;

/// Training and rollouts allocate many short-lived buffers; this allocator keeps their pages.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    match cli::run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            output::note!("error: {failure}");
            failure.exit_code()
        }
    }
}
