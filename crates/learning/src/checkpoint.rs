//! What an interrupted training run leaves in its folder, and takes from it again.

use std::collections::HashMap;
use std::path::Path;

use nesam_model::bundle::sha256_hex;
use nesam_model::{ModelError, Weights};
use serde::{Deserialize, Serialize};

use crate::adam::Adam;
use crate::origin::{self, Origin};
use crate::trainer::{EpochReport, TrainingError};

/// Steps since the last line of the curve.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Unreported {
    /// Finite losses.
    pub losses: Vec<f64>,
    pub steps: usize,
    /// Time of the steps, over all the runs that took them.
    pub seconds: f64,
}

impl Unreported {
    /// Mean loss, NaN where none was finite, and seconds per step.
    pub fn means(&self) -> (f32, f64) {
        let sum = self.losses.iter().map(|loss| *loss as f32).sum::<f32>();
        (sum / self.losses.len() as f32, self.seconds / self.steps as f64)
    }
}

/// What an interrupted run needs.
pub struct Checkpoint {
    /// Optimiser steps taken.
    pub(crate) step: usize,
    /// Score of the best weights; infinite where none was validated.
    pub(crate) best_score: f64,
    pub(crate) best: Weights,
    pub(crate) latest: Weights,
    /// Running mean.
    pub(crate) average: Weights,
    pub(crate) adam: Adam,
    /// A line for each validation.
    pub(crate) curve: Vec<EpochReport>,
    pub(crate) unreported: Unreported,
}

impl Checkpoint {
    /// That of a run which begins with these weights.
    pub(crate) fn new(weights: &Weights) -> Self {
        Self {
            step: 0,
            best_score: f64::INFINITY,
            best: weights.clone(),
            latest: weights.clone(),
            average: weights.clone(),
            adam: Adam::default(),
            curve: Vec::new(),
            unreported: Unreported::default(),
        }
    }

    /// Writes it into a folder, with what the run was begun with.
    pub(crate) fn save(&self, folder: &Path, begun_with: &Origin) -> Result<(), TrainingError> {
        let fail = |path: &Path, e: std::io::Error| TrainingError::Checkpoint { path: path.to_path_buf(), reason: e.to_string() };
        std::fs::create_dir_all(folder).map_err(|e| fail(folder, e))?;
        let mut moments = Weights::default();
        self.adam.save(&mut moments);
        let arrays = [
            ("best.safetensors", self.best.to_bytes()),
            ("latest.safetensors", self.latest.to_bytes()),
            ("average.safetensors", self.average.to_bytes()),
            ("adam.safetensors", moments.to_bytes()),
        ];
        let hashes: HashMap<&str, String> = arrays.iter().map(|(name, bytes)| (*name, sha256_hex(bytes))).collect();
        let state = serde_json::json!({
            "step": self.step,
            "best_score": self.best_score,
            "curve": self.curve,
            "unreported": self.unreported,
            "hashes": hashes,
            origin::KEY: begun_with,
        });
        // The state is renamed first: of a run that is killed in between, `load` finds the arrays of that state under either name.
        let files: Vec<(&str, Vec<u8>)> = std::iter::once(("state.json", state.to_string().into_bytes())).chain(arrays).collect();
        for (name, bytes) in &files {
            let path = folder.join(format!("{name}.new"));
            std::fs::write(&path, bytes).map_err(|e| fail(&path, e))?;
        }
        for (name, _) in &files {
            let path = folder.join(name);
            std::fs::rename(folder.join(format!("{name}.new")), &path).map_err(|e| fail(&path, e))?;
        }
        Ok(())
    }

    /// That of a folder, if one is there, for a run which began with these weights. A run that was killed while it saved leaves files under two names; they get
    /// the right ones.
    ///
    /// # Errors
    /// `TrainingError::Checkpoint` or `Model` for files that cannot be read, are of different steps, or belong to a network with other arrays.
    pub fn load(folder: &Path, weights: &Weights) -> Result<Option<Self>, TrainingError> {
        let state_path = folder.join("state.json");
        if !state_path.exists() {
            return Ok(None);
        }
        let fail = |path: &Path, reason: String| TrainingError::Checkpoint { path: path.to_path_buf(), reason };
        let bytes = std::fs::read(&state_path).map_err(|e| fail(&state_path, e.to_string()))?;
        let state: serde_json::Value = serde_json::from_slice(&bytes).map_err(|e| fail(&state_path, e.to_string()))?;
        let arrays = |name: &str| -> Result<Weights, TrainingError> {
            let (path, unnamed) = (folder.join(name), folder.join(format!("{name}.new")));
            let hash = state["hashes"][name].as_str();
            let of_state = |path: &Path| std::fs::read(path).ok().filter(|bytes| hash.is_none_or(|hash| hash == sha256_hex(bytes)));
            if of_state(&path).is_none() && of_state(&unnamed).is_some() {
                std::fs::rename(&unnamed, &path).map_err(|e| fail(&path, e.to_string()))?;
            }
            let lost = "is missing or of another step than state.json; start without --resume";
            let bytes = of_state(&path).ok_or_else(|| fail(&path, lost.into()))?;
            Ok(Weights::from_bytes(&bytes, &path)?)
        };
        let missing = |key: &str| fail(&state_path, format!("`{key}` is missing"));
        let checkpoint = Self {
            step: state["step"].as_u64().ok_or_else(|| missing("step"))? as usize,
            best_score: state["best_score"].as_f64().unwrap_or(f64::INFINITY),
            curve: serde_json::from_value(state["curve"].clone()).map_err(|e| fail(&state_path, e.to_string()))?,
            // A checkpoint that says none was validated when it was written.
            unreported: serde_json::from_value::<Option<Unreported>>(state["unreported"].clone())
                .map_err(|e| fail(&state_path, e.to_string()))?
                .unwrap_or_default(),
            best: arrays("best.safetensors")?,
            latest: arrays("latest.safetensors")?,
            average: arrays("average.safetensors")?,
            adam: Adam::load(&arrays("adam.safetensors")?),
        };
        match checkpoint.mismatch(weights) {
            Some((file, reason)) => Err(fail(&folder.join(file), format!("{reason}; start without --resume"))),
            None => Ok(Some(checkpoint)),
        }
    }

    /// Why a run that began with these weights cannot go on, and with which file.
    fn mismatch(&self, weights: &Weights) -> Option<(&'static str, String)> {
        let other_arrays = |found: &Weights| {
            let differs =
                weights.iter().find_map(|(name, array)| found.get(name, &array.shape).err()).map(|error: ModelError| error.to_string());
            differs
                .or_else(|| (found.iter().count() > weights.iter().count()).then(|| "it has arrays that the network does not have".into()))
        };
        let of_weights = [("best.safetensors", &self.best), ("latest.safetensors", &self.latest), ("average.safetensors", &self.average)];
        let of_weights = of_weights.into_iter().find_map(|(file, found)| Some((file, other_arrays(found)?)));
        let of_adam = || self.adam.mismatch(weights, self.step).map(|reason| ("adam.safetensors", reason));
        let of_curve = || {
            let steps = self.curve.iter().map(|line| line.step).chain([self.step]);
            let sound = steps.is_sorted() && self.unreported.steps <= self.step;
            (!sound).then(|| ("state.json", "its steps are not in order".into()))
        };
        of_weights.or_else(of_adam).or_else(of_curve)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn weights(value: f32) -> Weights {
        let mut weights = Weights::default();
        weights.insert("w", &[1], vec![value]);
        weights
    }

    fn checkpoint(step: usize, line: EpochReport) -> Checkpoint {
        let mut moments = Weights::default();
        moments.insert("adam.first.w", &[1], vec![0.5]);
        moments.insert("adam.second.w", &[1], vec![0.25]);
        moments.insert("adam.steps", &[1], vec![step as f32]);
        let unreported = Unreported { losses: vec![0.5], steps: 2, seconds: 0.25 };
        Checkpoint { step, adam: Adam::load(&moments), curve: vec![line], unreported, ..Checkpoint::new(&weights(step as f32)) }
    }

    fn load(folder: &Path) -> Result<Checkpoint, TrainingError> {
        Checkpoint::load(folder, &weights(0.0)).map(|found| found.expect("it was saved"))
    }

    const LINE: EpochReport = EpochReport { step: 2, loss: f32::NAN, validation: [0.5, f64::NAN, 0.0, 0.0, 0.0], diverged: 3, step_s: 0.1 };

    #[test]
    fn regress_a_checkpoint_with_numbers_that_are_none_can_be_read() {
        let folder = tempfile::tempdir().unwrap();
        checkpoint(2, LINE).save(folder.path(), &Origin::new()).unwrap();
        let found = load(folder.path()).unwrap();
        assert_eq!((found.step, found.best_score, found.best.clone()), (2, f64::INFINITY, found.latest));
        assert_eq!(found.unreported, checkpoint(2, LINE).unreported);
        let line = found.curve[0];
        assert!(line.loss.is_nan() && line.validation[0] == 0.5 && line.validation[1].is_nan() && line.diverged == 3, "{line:?}");
    }

    #[test]
    fn property_a_run_killed_while_it_saved_goes_on_and_mixed_files_are_refused() {
        let [folder, later] = [2, 4].map(|step| {
            let folder = tempfile::tempdir().unwrap();
            checkpoint(step, LINE).save(folder.path(), &Origin::new()).unwrap();
            folder
        });
        let take = |from: &str, to: &str| std::fs::copy(later.path().join(from), folder.path().join(to)).unwrap();
        take("best.safetensors", "best.safetensors");
        let error = load(folder.path()).err().expect("files of two steps").to_string();
        assert!(error.contains("best.safetensors") && error.contains("another step"), "{error}");
        // Two of five have their names.
        take("state.json", "state.json");
        for name in ["latest", "average", "adam"] {
            take(&format!("{name}.safetensors"), &format!("{name}.safetensors.new"));
        }
        for _ in 0..2 {
            let found = load(folder.path()).unwrap();
            assert_eq!((found.step, found.latest), (4, checkpoint(4, LINE).latest));
        }
    }

    /// Goal: no file of another network or step is trained on. Method: one file at a time is another; of which it is said.
    #[test]
    fn property_files_of_another_network_are_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let refused = |file: &str, other: &Weights| {
            checkpoint(2, LINE).save(folder.path(), &Origin::new()).unwrap();
            let state = folder.path().join("state.json");
            // Without its hashes nothing but what is in the files tells that they do not belong together.
            let mut read: serde_json::Value = serde_json::from_slice(&std::fs::read(&state).unwrap()).unwrap();
            read["hashes"] = serde_json::Value::Null;
            std::fs::write(&state, read.to_string()).unwrap();
            load(folder.path()).expect("nothing was changed yet");
            std::fs::write(folder.path().join(file), other.to_bytes()).unwrap();
            let error = load(folder.path()).err().unwrap_or_else(|| panic!("{file} was taken")).to_string();
            assert!(error.contains(file) && error.contains("without --resume"), "{error}");
            error
        };
        let arrays = |arrays: &[(&str, &[f32])]| {
            let mut other = Weights::default();
            arrays.iter().for_each(|(name, values)| other.insert(*name, &[values.len()], values.to_vec()));
            other
        };
        assert!(refused("latest.safetensors", &arrays(&[("w", &[1.0, 2.0])])).contains("[2], expected [1]"));
        assert!(refused("best.safetensors", &arrays(&[])).contains("`w` is missing"));
        assert!(refused("average.safetensors", &arrays(&[("v", &[1.0]), ("w", &[1.0])])).contains("does not have"));
        let moments = |first: &[f32], second: &[(&str, &[f32])], steps: &[f32]| {
            let all: Vec<_> = [("adam.first.w", first), ("adam.steps", steps)].into_iter().chain(second.iter().copied()).collect();
            refused("adam.safetensors", &arrays(&all))
        };
        let second: (&str, &[f32]) = ("adam.second.w", &[0.0]);
        assert!(moments(&[0.0], &[second], &[3.0]).contains("of step 3, state.json of step 2"));
        assert!(moments(&[0.0], &[second], &[]).contains("of step 0"));
        assert!(moments(&[0.0], &[], &[2.0]).contains("one of two moments is missing"));
        assert!(moments(&[0.0, 0.0], &[second], &[2.0]).contains("2 moments of `w`, the network 1"));
        let late = EpochReport { step: 3, ..LINE };
        checkpoint(2, late).save(folder.path(), &Origin::new()).unwrap();
        assert!(load(folder.path()).err().expect("a line of a later step").to_string().contains("not in order"));
    }
}
