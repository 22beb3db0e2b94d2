//! `nesam serve`: the service until interrupted.

use std::path::{Path, PathBuf};

use clap::Args;

use crate::args::BundleArgs;
use crate::failure::Failure;

/// Options of `nesam serve`.
#[derive(Args, Debug)]
pub struct ServeArgs {
    #[command(flatten)]
    bundle: BundleArgs,
    /// Configuration file (TOML)
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

/// Runs the command.
pub fn run(args: &ServeArgs) -> Result<(), Failure> {
    let _ = args;
    Err(Failure::Failed("the server is not wired yet".into()))
}

/// Reads a configuration file and says what is wrong with it.
pub fn check_configuration(path: &Path) -> Result<(), String> {
    let _ = path;
    Err("configurations are not wired yet".into())
}
