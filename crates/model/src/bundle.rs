//! The versioned model bundle on disk: a folder whose manifest holds the hash of every file.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nesam_physics::effects::{Effect, ScheduledEffect};
use nesam_physics::{SOIL_DIM, Soil, UsualRide, Vehicle};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::ModelError;
use crate::effects_file;
use crate::normalization::Normalization;
use crate::rollout::Variant;
use crate::soil_coordinates;
use crate::weights::Weights;

/// Version of the layout; another version is refused.
pub const FORMAT: &str = "nesam.bundle/1";
/// File that makes a folder a bundle.
pub const MANIFEST: &str = "manifest.toml";
const WEIGHTS: &str = "weights.safetensors";
const VEHICLE: &str = "vehicle.json";
const NORMALIZATION: &str = "normalization.toml";
const EFFECTS: &str = "effects.toml";
const BASELINES: &str = "baselines.json";
const REFERENCE: &str = "reference.json";
const REFERENCE_DRIVES: &str = "reference_drives.safetensors";
const SOIL_FILTER: &str = "soil_filter.json";
const ROLLOUT_NOISE: &str = "rollout_noise.json";
const REQUIRED: [&str; 4] = [WEIGHTS, VEHICLE, NORMALIZATION, EFFECTS];
/// Arrays by which the network says something of sinkage and of the next state.
const HEADS: [&str; 4] = ["sinkage.weight", "sinkage.bias", "residual.weight", "residual.bias"];

/// Where a bundle comes from; shown by `inspect`, copied into every report.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Command that made the bundle.
    pub command: String,
    /// Seed.
    pub seed: u64,
    /// SHA-256 of the training data.
    pub data_hash: String,
    /// Optimiser steps.
    pub steps: u64,
    /// Time that the optimiser took over all resumed runs, s: of bundles of earlier versions, as no two trainings take the same and are the same bundle all the same.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub training_s: Option<f64>,
    /// Version of the program.
    pub program: String,
    /// Hash of the bundle this one was derived from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parent: Option<String>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Manifest {
    format: String,
    name: String,
    /// Form of the model.
    #[serde(default)]
    model: Variant,
    provenance: Provenance,
    /// SHA-256 of each file.
    files: BTreeMap<String, String>,
}

/// A loaded, verified bundle.
#[derive(Clone, Debug)]
pub struct ModelBundle {
    /// Bundle name and version from the manifest.
    pub name: String,
    /// SHA-256 (hex) of the manifest, which holds the hash of every file.
    pub hash: String,
    /// What the weights were trained as.
    pub form: Variant,
    /// The vehicle the bundle was trained for, with the bundle's effects, all of them begun.
    pub vehicle: Vehicle,
    /// Effects on top of the vehicle card, as `effects.toml` lists them; [`ModelBundle::vehicle`] has them already.
    pub effects: Vec<ScheduledEffect>,
    /// Trainable parameters of the kinodynamic model (without the frozen encoders).
    pub parameters: usize,
    /// Scales and trained ranges.
    pub normalization: Normalization,
    /// All arrays.
    pub weights: Weights,
    /// Fitted baselines as JSON, if the bundle carries them.
    pub baselines_json: Option<String>,
    /// What a diagnosis must know of the model's usual errors as JSON, if the bundle carries it.
    pub reference_json: Option<Arc<str>>,
    /// The drives behind that reference, segment by segment, if the bundle carries them: what measures it again for drives that lack a channel or a map.
    pub reference_drives: Option<Arc<[u8]>>,
    /// Settings of the soil filter that were estimated for this model as JSON, if the bundle carries them.
    pub soil_filter_json: Option<String>,
    /// Covariance of the model's own errors along a rollout as JSON, if the bundle carries it ([`crate::RolloutNoise`]).
    pub rollout_noise_json: Option<String>,
    /// Where the bundle comes from.
    pub provenance: Provenance,
}

/// Parameters that training changes in a form of the model: neither encoders nor heads that the form does not have.
pub fn trained_parameters(weights: &Weights, form: Variant) -> usize {
    let unused: &[&str] = if form.has_soil() { &["encoder."] } else { &["encoder.", "soil.", "sinkage."] };
    weights.parameters("") - unused.iter().map(|prefix| weights.parameters(prefix)).sum::<usize>()
}

/// Lower-case hex SHA-256.
pub fn sha256_hex(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}

/// Effects without their onsets.
fn begun(effects: &[ScheduledEffect]) -> Vec<Effect> {
    effects.iter().map(|e| e.effect).collect()
}

struct Folder<'a>(&'a Path);

impl Folder<'_> {
    fn fail(&self, file: &str, reason: impl Into<String>) -> ModelError {
        ModelError::Bundle { path: self.0.join(file), reason: reason.into() }
    }

    fn read(&self, file: &str) -> Result<Vec<u8>, ModelError> {
        std::fs::read(self.0.join(file)).map_err(|e| self.fail(file, format!("cannot be read: {e}")))
    }

    fn text(&self, file: &str, bytes: Vec<u8>) -> Result<String, ModelError> {
        String::from_utf8(bytes).map_err(|_| self.fail(file, "is not UTF-8 text"))
    }

    fn write(&self, file: &str, bytes: &[u8]) -> Result<(), ModelError> {
        std::fs::write(self.0.join(file), bytes).map_err(|e| self.fail(file, format!("cannot be written: {e}")))
    }
}

impl ModelBundle {
    /// The hash of the bundle in a folder, of which nothing else is read; `None` where there is no manifest.
    pub fn hash_of(dir: &Path) -> Option<String> {
        std::fs::read(dir.join(MANIFEST)).ok().map(|manifest| sha256_hex(&manifest))
    }

    /// Loads and verifies a bundle folder.
    ///
    /// # Errors
    /// `ModelError::Bundle` or `ModelError::Weights` naming the file or array and what was wrong (missing, wrong hash, wrong shape, unknown format,
    /// a number that no model runs with).
    pub fn load(dir: &Path) -> Result<Self, ModelError> {
        let folder = Folder(dir);
        let manifest_bytes = folder.read(MANIFEST)?;
        let hash = sha256_hex(&manifest_bytes);
        let text = folder.text(MANIFEST, manifest_bytes)?;
        let manifest: Manifest = toml::from_str(&text).map_err(|e| folder.fail(MANIFEST, format!("is not a manifest: {e}")))?;
        if manifest.format != FORMAT {
            return Err(folder.fail(MANIFEST, format!("has format `{}`, this program reads `{FORMAT}`", manifest.format)));
        }
        let mut files = BTreeMap::new();
        for (name, expected) in &manifest.files {
            if name.contains(['/', '\\']) || name.starts_with('.') {
                return Err(folder.fail(MANIFEST, format!("lists `{name}`, which is not a plain file name")));
            }
            let bytes = folder.read(name)?;
            let found = sha256_hex(&bytes);
            if found != *expected {
                return Err(
                    folder.fail(name, format!("has SHA-256 {found}, the manifest says {expected}: the file was changed or damaged"))
                );
            }
            files.insert(name.as_str(), bytes);
        }
        for name in REQUIRED {
            if !files.contains_key(name) {
                return Err(folder.fail(name, "is not listed in the manifest"));
            }
        }
        let take = |name: &str| files.get(name).cloned();
        let text_of = |name: &str| folder.text(name, take(name).unwrap_or_default());
        let weights = Weights::from_bytes(&take(WEIGHTS).unwrap_or_default(), &dir.join(WEIGHTS))?;
        let normalization: Normalization =
            toml::from_str(&text_of(NORMALIZATION)?).map_err(|e| folder.fail(NORMALIZATION, format!("is not readable: {e}")))?;
        normalization.check().map_err(|reason| folder.fail(NORMALIZATION, reason))?;
        let vehicle = nesam_vehicle_card::from_json(&text_of(VEHICLE)?).map_err(|e| folder.fail(VEHICLE, e.to_string()))?;
        let effects = effects_file::read(&text_of(EFFECTS)?).map_err(|reason| folder.fail(EFFECTS, reason))?;
        let baselines_json = take(BASELINES).map(|bytes| folder.text(BASELINES, bytes)).transpose()?;
        let reference_json = take(REFERENCE).map(|bytes| folder.text(REFERENCE, bytes)).transpose()?.map(Arc::from);
        let reference_drives = take(REFERENCE_DRIVES).map(Arc::from);
        let soil_filter_json = take(SOIL_FILTER).map(|bytes| folder.text(SOIL_FILTER, bytes)).transpose()?;
        let rollout_noise_json = take(ROLLOUT_NOISE).map(|bytes| folder.text(ROLLOUT_NOISE, bytes)).transpose()?;
        Ok(Self {
            name: manifest.name,
            hash,
            form: manifest.model,
            vehicle: vehicle.with_effects(&begun(&effects)),
            effects,
            parameters: trained_parameters(&weights, manifest.model),
            normalization,
            weights,
            baselines_json,
            reference_json,
            reference_drives,
            soil_filter_json,
            rollout_noise_json,
            provenance: manifest.provenance,
        })
    }

    /// This bundle with further effects on its vehicle, each from its onset on; a plain [`Effect`] acts always.
    pub fn with_effects<E: Copy + Into<ScheduledEffect>>(&self, effects: &[E]) -> Self {
        let effects: Vec<ScheduledEffect> = effects.iter().map(|e| (*e).into()).collect();
        let mut patched = self.clone();
        patched.vehicle = self.vehicle.with_effects(&begun(&effects));
        patched.effects.extend(effects);
        patched
    }

    /// Checks that the vehicle can have the bundle's effects; `dir` is where the bundle is.
    ///
    /// # Errors
    /// `ModelError::Bundle` naming the effects that it cannot have ([`Vehicle::check_effects`]).
    pub(crate) fn check_effects(&self, dir: &Path) -> Result<(), ModelError> {
        self.vehicle.check_effects(&self.effects, self.normalization.dt_s).map_err(|reason| Folder(dir).fail(EFFECTS, reason))
    }

    /// How the vehicle that the network knows rides: without effects, on the soil that its prior began with.
    pub fn usual_ride(&self) -> UsualRide {
        let scales = &self.normalization;
        let soil = Soil::from_array(soil_coordinates::from_raw(&scales.default_soil_raw));
        UsualRide::of(&self.vehicle, scales.dt_s, scales.substeps, &soil)
    }

    /// The bundle with its network silenced: nothing is said of sinkage and of the next state, the soil prior stays.
    pub fn silenced(&self) -> Self {
        let mut silent = self.clone();
        for name in HEADS {
            if let Some(values) = silent.weights.values_mut(name) {
                values.fill(0.0);
            }
        }
        silent
    }

    /// Soil where there is no map or no semantics, order of `SOIL_NAMES`.
    pub fn default_soil(&self) -> [f64; SOIL_DIM] {
        self.normalization.default_soil()
    }

    /// The bundle with another soil where a map tells of none.
    pub fn on_soil(&self, soil: &[f64; SOIL_DIM]) -> Self {
        let mut on_soil = self.clone();
        on_soil.normalization.set_default_soil(soil);
        on_soil
    }

    /// Whether the network says anything of sinkage or of the next state.
    pub fn speaks(&self) -> bool {
        self.weights.iter().any(|(name, array)| HEADS.contains(&name) && array.values.iter().any(|v| *v != 0.0))
    }

    /// Whether the bundle is of this vehicle: that of its name, commanded in the same way.
    pub fn is_of(&self, vehicle: &Vehicle) -> bool {
        self.vehicle.name == vehicle.name && self.vehicle.second == vehicle.second
    }

    /// Puts the bundle's effects on another vehicle. What was measured of the bundle's own vehicle does not hold for one that the bundle is not of, and is
    /// dropped: fitted baselines, the reference of diagnoses, the settings of the soil filter, the covariance of errors and the ground that stands in for unseen one.
    pub fn move_to(&mut self, vehicle: &Vehicle) {
        if !self.is_of(vehicle) {
            self.baselines_json = None;
            self.reference_json = None;
            self.reference_drives = None;
            self.soil_filter_json = None;
            self.rollout_noise_json = None;
            self.normalization.stand_in = None;
        }
        self.vehicle = vehicle.with_effects(&begun(&self.effects));
    }

    /// Writes the bundle into a folder (created if absent; files of an older bundle there are replaced) and sets [`ModelBundle::hash`].
    ///
    /// # Errors
    /// `ModelError::Bundle` naming the file that could not be written, or effects that the vehicle cannot have.
    pub fn save(&mut self, dir: &Path) -> Result<PathBuf, ModelError> {
        let folder = Folder(dir);
        self.check_effects(dir)?;
        std::fs::create_dir_all(dir).map_err(|e| folder.fail("", format!("cannot be created: {e}")))?;
        let normalization = toml::to_string(&self.normalization).expect("plain numbers serialise; this is a bug");
        let mut files: Vec<(&str, Vec<u8>)> = vec![
            (WEIGHTS, self.weights.to_bytes()),
            (VEHICLE, nesam_vehicle_card::to_json(&self.vehicle).into_bytes()),
            (NORMALIZATION, normalization.into_bytes()),
            (EFFECTS, effects_file::write(&self.effects).into_bytes()),
        ];
        if let Some(json) = &self.baselines_json {
            files.push((BASELINES, json.clone().into_bytes()));
        }
        if let Some(json) = &self.reference_json {
            files.push((REFERENCE, json.as_bytes().to_vec()));
        }
        if let Some(drives) = &self.reference_drives {
            files.push((REFERENCE_DRIVES, drives.to_vec()));
        }
        if let Some(json) = &self.soil_filter_json {
            files.push((SOIL_FILTER, json.clone().into_bytes()));
        }
        if let Some(json) = &self.rollout_noise_json {
            files.push((ROLLOUT_NOISE, json.clone().into_bytes()));
        }
        for (name, bytes) in &files {
            folder.write(name, bytes)?;
        }
        let manifest = Manifest {
            format: FORMAT.into(),
            name: self.name.clone(),
            model: self.form,
            provenance: self.provenance.clone(),
            files: files.iter().map(|(name, bytes)| ((*name).to_string(), sha256_hex(bytes))).collect(),
        };
        let text = toml::to_string(&manifest).expect("a manifest serialises; this is a bug");
        folder.write(MANIFEST, text.as_bytes())?;
        self.hash = sha256_hex(text.as_bytes());
        Ok(dir.to_path_buf())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: nothing that was measured with one vehicle is taken for another. Method: the shipped bundle of the car, put on its own card and on the card of
    /// the shipped robot.
    #[test]
    fn regress_what_was_measured_does_not_move_to_another_vehicle() {
        let shipped = |name: &str| {
            let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/bundles").join(name);
            ModelBundle::load(&dir).expect("a shipped bundle")
        };
        let measured = |bundle: &ModelBundle| {
            let texts = [&bundle.baselines_json, &bundle.soil_filter_json, &bundle.rollout_noise_json].map(|text| text.is_some());
            let of_drives = [bundle.reference_json.is_some(), bundle.reference_drives.is_some(), bundle.normalization.stand_in.is_some()];
            (texts, of_drives)
        };
        let (mut car, robot) = (shipped("hmmwv-nominal"), shipped("clearpath-husky"));
        let own = car.vehicle.clone();
        car.move_to(&own);
        assert_eq!(measured(&car), ([true; 3], [true; 3]), "its own vehicle changes nothing");
        let mut otherwise = own.clone();
        otherwise.second = robot.vehicle.second;
        for another in [&robot.vehicle, &otherwise] {
            let mut moved = car.clone();
            moved.move_to(another);
            assert!(!car.is_of(another) && moved.is_of(another));
            assert_eq!(measured(&moved), ([false; 3], [false; 3]));
        }
    }
}
