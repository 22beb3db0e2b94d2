//! The JSON of `nesam evaluate` (`nesam.evaluate/1`).
//!
//! The keys of the contract come first; everything after `models` extends it: horizon curves, slices, paired comparisons, and what
//! the numbers were made from.

use serde::Serialize;
use serde::ser::{SerializeMap, Serializer};

use crate::dimension::DIMENSION_KEYS;
use crate::errors::PATH_FLOOR_M;
use crate::evaluate::{HorizonCurve, ModelScore};
use crate::models::ModelName;
use crate::score::{ErrorTree, paired_difference, values};
use crate::slices::Slice;
use crate::{Resamples, Truth};

/// What a report was computed from. Every analysis command writes it, so that a number can be traced.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Provenance {
    /// Version of nesam.
    pub version: String,
    /// Command line as typed.
    pub command: String,
    /// Name of the bundle.
    pub bundle: String,
    /// Hash of the bundle's manifest.
    pub bundle_hash: String,
    /// Hash over the samples and index files that were read.
    pub data_hash: String,
    /// Hash over the maps under the drives; empty without maps.
    pub maps_hash: String,
}

/// Inputs of the JSON and HTML reports.
#[derive(Debug)]
pub struct Evaluation<'a> {
    /// Name of the set.
    pub set: &'a str,
    /// `train`, `test` or `all`.
    pub split: &'a str,
    /// Steps K.
    pub horizon_steps: usize,
    /// Steps of history offered to the models.
    pub history_steps: usize,
    /// Step, s.
    pub dt_s: f64,
    /// Number of windows.
    pub windows: usize,
    /// Number of drives.
    pub trajectories: usize,
    /// Median true path of the windows, m.
    pub path_m_median: f64,
    /// What errors are measured against.
    pub truth: Truth,
    /// `commands` or `wheels`.
    pub inputs: &'a str,
    /// Seed of the bootstrap.
    pub seed: u64,
    /// Bootstrap draws.
    pub resamples: &'a Resamples,
    /// Scores in the order of the tables.
    pub models: &'a [ModelScore],
    /// Slices of the windows.
    pub slices: &'a [Slice],
    /// What the numbers were made from.
    pub provenance: &'a Provenance,
}

#[derive(Serialize)]
struct Document<'a> {
    schema: &'static str,
    set: &'a str,
    split: &'a str,
    horizon_steps: usize,
    dt_s: f64,
    windows: usize,
    path_m_median: f64,
    /// Null where a model was not scored.
    models: ByName<Option<ModelJson<'a>>>,
    /// What a window must have driven to count for `final_over_path_median`, and how many windows did not.
    path_floor_m: f64,
    windows_below_path_floor: usize,
    trajectories: usize,
    history_steps: usize,
    truth: &'static str,
    inputs: &'a str,
    bootstrap: Bootstrap,
    comparisons: Vec<Comparison>,
    slices: ByName<SliceJson>,
    provenance: &'a Provenance,
}

#[derive(Serialize)]
struct Bootstrap {
    by: &'static str,
    resamples: usize,
    seed: u64,
}

#[derive(Serialize)]
struct ModelJson<'a> {
    #[serde(flatten)]
    summary: &'a crate::ErrorSummary,
    parameters: usize,
    not_finite_windows: usize,
    by_step: ByName<Option<&'a Vec<f64>>>,
}

/// `model` minus `against` on the same windows: negative = `model` is better.
#[derive(Serialize)]
struct Comparison {
    model: &'static str,
    against: &'static str,
    difference: ErrorTree<f64>,
    ci95: ErrorTree<[f64; 2]>,
}

#[derive(Serialize)]
struct SliceJson {
    windows: usize,
    models: ByName<ErrorTree<f64>>,
}

/// A JSON object that keeps the order in which it was built.
struct ByName<T>(Vec<(String, T)>);

impl<T: Serialize> Serialize for ByName<T> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(self.0.len()))?;
        for (key, value) in &self.0 {
            map.serialize_entry(key, value)?;
        }
        map.end()
    }
}

impl Evaluation<'_> {
    /// The JSON document, pretty-printed, with a trailing newline. Every model of the contract has its key; that of a model that was not scored (not asked for, or
    /// not there) is null.
    pub fn to_json(&self) -> String {
        let scored = self.models.iter().map(|m| (m.name.to_string(), Some(model_json(m))));
        let left_out = ModelName::ALL.into_iter().filter(|name| !name.is_switch() && self.models.iter().all(|m| m.name != *name));
        let models = scored.chain(left_out.map(|name| (name.to_string(), None))).collect();
        let slices = self.slices.iter().map(|s| (s.name.clone(), self.slice_json(s))).collect();
        let document = Document {
            schema: "nesam.evaluate/1",
            set: self.set,
            split: self.split,
            horizon_steps: self.horizon_steps,
            dt_s: self.dt_s,
            windows: self.windows,
            path_m_median: self.path_m_median,
            models: ByName(models),
            path_floor_m: PATH_FLOOR_M,
            windows_below_path_floor: self.windows_below_path_floor(),
            trajectories: self.trajectories,
            history_steps: self.history_steps,
            truth: self.truth.as_str(),
            inputs: self.inputs,
            bootstrap: Bootstrap { by: "trajectory", resamples: self.resamples.count(), seed: self.seed },
            comparisons: self.comparisons(),
            slices: ByName(slices),
            provenance: self.provenance,
        };
        serde_json::to_string_pretty(&document).expect("finite numbers and text always serialise; this is a bug") + "\n"
    }

    /// Number of windows whose path is too short for a relative error.
    pub(crate) fn windows_below_path_floor(&self) -> usize {
        self.models.first().map_or(0, |model| model.errors.below_path_floor())
    }

    fn comparisons(&self) -> Vec<Comparison> {
        let Some((first, others)) = self.models.split_first() else { return Vec::new() };
        others
            .iter()
            .map(|other| {
                let (difference, ci95) = paired_difference(&first.errors, &other.errors, self.resamples);
                Comparison { model: first.name.as_str(), against: other.name.as_str(), difference, ci95 }
            })
            .collect()
    }

    fn slice_json(&self, slice: &Slice) -> SliceJson {
        let of = |m: &ModelScore| (m.name.to_string(), values(&m.errors.filter(|w| slice.member[w])));
        SliceJson { windows: slice.windows(), models: ByName(self.models.iter().map(of).collect()) }
    }
}

fn model_json(model: &ModelScore) -> ModelJson<'_> {
    let keys = DIMENSION_KEYS.iter().copied().chain(["position_m"]);
    let by_step = keys.zip(&model.curves).map(|(key, c)| (key.to_string(), c.as_ref().map(|c: &HorizonCurve| &c.mean)));
    ModelJson {
        summary: &model.summary,
        parameters: model.parameters,
        not_finite_windows: model.errors.not_finite(),
        by_step: ByName(by_step.collect()),
    }
}
