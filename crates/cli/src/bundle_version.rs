//! The next version of a bundle.

use std::path::{Path, PathBuf};

use nesam_model::{ModelBundle, Provenance};
use nesam_physics::effects::ScheduledEffect;

use crate::cli::command_without_paths;
use crate::failure::{Failure, OrFail};
use crate::output::note;

/// Where a bundle that is made of another comes from: this command without its paths, the data, and the bundle before as its parent.
pub fn derived_from(base: &ModelBundle, data_hash: &str) -> Provenance {
    Provenance {
        command: command_without_paths(),
        data_hash: data_hash.into(),
        program: format!("nesam {}", env!("CARGO_PKG_VERSION")),
        parent: Some(base.hash.clone()),
        ..base.provenance.clone()
    }
}

/// Moves patched bundles that an earlier diagnosis left in a folder out of the way of this one, which may find nothing: beside its report they would pass for what
/// it found. An older one that was moved before goes.
pub fn set_aside(out: &Path) -> Result<(), Failure> {
    for name in ["bundle", "bundle-free-form"] {
        let (found, aside) = (out.join(name), out.join(format!("{name}-before")));
        if ModelBundle::load(&found).is_ok_and(|bundle| !bundle.effects.is_empty()) {
            if aside.exists() {
                std::fs::remove_dir_all(&aside).or_failed()?;
            }
            std::fs::rename(&found, &aside).or_failed()?;
            note!("the bundle of an earlier diagnosis is {} now", aside.display());
        }
    }
    Ok(())
}

/// Writes a bundle with further effects into a folder; its manifest names this command, the data it was made from and the bundle before as its parent.
pub fn save_with_effects(base: &ModelBundle, effects: &[ScheduledEffect], data_hash: &str, to: &Path) -> Result<PathBuf, Failure> {
    let mut bundle = base.with_effects(effects);
    bundle.provenance = derived_from(base, data_hash);
    bundle.save(to).or_failed()
}
