//! The next version of a bundle.

use std::path::{Path, PathBuf};

use nesam_model::{ModelBundle, Provenance};
use nesam_physics::effects::ScheduledEffect;

use crate::cli::command_without_paths;
use crate::failure::{Failure, OrFail};

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

/// Writes a bundle with further effects into a folder; its manifest names this command, the data it was made from and the bundle before as its parent.
pub fn save_with_effects(base: &ModelBundle, effects: &[ScheduledEffect], data_hash: &str, to: &Path) -> Result<PathBuf, Failure> {
    let mut bundle = base.with_effects(effects);
    bundle.provenance = derived_from(base, data_hash);
    bundle.save(to).or_failed()
}
