//! `nesam demo`: the whole loop on one machine.

use clap::Args;

use crate::args::BundleArgs;
use crate::failure::Failure;

/// Options of `nesam demo`.
#[derive(Args, Debug)]
pub struct DemoArgs {
    #[command(flatten)]
    bundle: BundleArgs,
}

/// Runs the command.
pub fn run(args: &DemoArgs) -> Result<(), Failure> {
    let _ = args;
    Err(Failure::Failed("the server is not wired yet".into()))
}
