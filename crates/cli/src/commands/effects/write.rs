//! `nesam effects write`: a new version of a bundle, with effects that somebody wrote down.

use std::path::PathBuf;

use clap::Args;
use nesam_model::{ModelBundle, effects_from_toml};
use nesam_physics::effects::Effect;
use nesam_physics::effects::written::WRITTEN_MAX;

use crate::bundle_path::bundle_dir;
use crate::bundle_version::save_with_effects;
use crate::failure::{Failure, OrFail};
use crate::output::say;

/// Options of `nesam effects write`.
#[derive(Args, Debug)]
pub struct WriteArgs {
    /// Effects, named or written as formulas (docs/your-own-effect.md)
    #[arg(long, value_name = "FILE")]
    file: PathBuf,
    /// Folder of the new version
    #[arg(long, value_name = "DIR")]
    to: PathBuf,
    /// Bundle that they are added to [default: the shipped one]
    #[arg(long, value_name = "DIR")]
    bundle: Option<PathBuf>,
}

/// Runs the command.
pub fn run(args: &WriteArgs) -> Result<(), Failure> {
    let text = std::fs::read_to_string(&args.file).map_err(|e| Failure::input(format!("{}: {e}", args.file.display())))?;
    let effects = effects_from_toml(&text).map_err(|reason| Failure::input(format!("{} {reason}", args.file.display())))?;
    if effects.is_empty() {
        return Err(Failure::input(format!("{} has no effect", args.file.display())));
    }
    if args.to.exists() {
        return Err(Failure::input(format!("{} is there already; give another folder", args.to.display())));
    }
    let base = ModelBundle::load(&bundle_dir(args.bundle.as_deref())?).or_input()?;
    let written = base.effects.iter().chain(&effects).filter(|e| matches!(e.effect, Effect::Written(_))).count();
    if written > WRITTEN_MAX {
        return Err(Failure::input(format!("with those of {} there are more than {WRITTEN_MAX} written effects", base.name)));
    }
    let to = save_with_effects(&base, &effects, &base.provenance.data_hash, &args.to)?;
    let ids: Vec<&str> = effects.iter().map(|e| e.effect.id()).collect();
    say!("{}: {} with {}", to.display(), base.name, ids.join(", "));
    Ok(())
}
