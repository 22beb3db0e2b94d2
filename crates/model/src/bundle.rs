//! The versioned model bundle on disk.

use std::path::Path;

use nesam_physics::{SOIL_DIM, Vehicle};

use crate::ModelError;

/// A loaded, verified bundle.
#[derive(Clone, Debug)]
pub struct ModelBundle {
    /// Bundle name and version from the manifest.
    pub name: String,
    /// SHA-256 (hex) over the manifest, which itself holds the hash of every file.
    pub hash: String,
    /// The vehicle the bundle was trained for.
    pub vehicle: Vehicle,
    /// Soil used where there is no map or no semantics.
    pub default_soil: [f64; SOIL_DIM],
    /// Trainable parameters of the kinodynamic model (without the frozen encoders).
    pub parameters: usize,
}

impl ModelBundle {
    /// Loads and verifies a bundle directory.
    ///
    /// # Errors
    /// `ModelError::Bundle` naming the file and what was wrong (missing, wrong hash, wrong shape, unknown version).
    pub fn load(dir: &Path) -> Result<Self, ModelError> {
        Err(ModelError::Bundle { path: dir.to_path_buf(), reason: "not wired yet".into() })
    }
}
