//! What a training run began with, kept with its checkpoints: another run does not go on from them.

use std::collections::BTreeMap;
use std::path::Path;

use nesam_model::bundle::sha256_hex;
use serde_json::Value;

use crate::trainer::{TrainingError, TrainingPlan};

/// Settings and inputs of a run by name, as they are told in an error; large ones by the first digits of their SHA-256.
pub type Origin = BTreeMap<String, String>;

/// Name of the number of steps in all: what has come so far may end there.
const STEPS: &str = "--epochs times --batches";
/// Key of the state of a checkpoint.
pub(crate) const KEY: &str = "begun_with";

/// An input by the first digits of its hash.
pub(crate) fn digest(content: &str) -> String {
    sha256_hex(content.as_bytes())[..12].into()
}

/// All that a run with this plan hangs on; the options of the command line that say so name it.
pub(crate) fn of_plan(plan: &TrainingPlan) -> Origin {
    let settings = [
        (STEPS, plan.steps.to_string()),
        ("--batches", plan.epoch.to_string()),
        ("--batch-size", plan.batch.to_string()),
        ("--lr", plan.rate.to_string()),
        ("--horizon", plan.horizon.to_string()),
        ("--seed", plan.seed.to_string()),
        ("--device", plan.device.to_string()),
        ("--threads", plan.shards.to_string()),
        ("--dropout", plan.dropout.to_string()),
        ("--decay", plan.decay.to_string()),
        ("--model", plan.objective.variant.as_str().into()),
        ("--sustained", plan.objective.sustained.to_string()),
        ("--soil-prior", plan.objective.soil_prior.to_string()),
    ];
    settings.into_iter().map(|(name, value)| (name.to_string(), value)).chain(plan.origin.clone()).collect()
}

/// Refuses to go on from a checkpoint that was begun with something else; none is none. A plan may have fewer steps than were taken: it ends there.
///
/// # Errors
/// `TrainingError::Foreign` naming what differs, or that the checkpoint does not say what it was begun with; `TrainingError::Checkpoint` where its state cannot be read.
pub(crate) fn check(plan: &TrainingPlan) -> Result<(), TrainingError> {
    let path = plan.folder.join("state.json");
    if !path.exists() {
        return Ok(());
    }
    let unreadable = |reason: String| TrainingError::Checkpoint { path: path.clone(), reason };
    let bytes = std::fs::read(&path).map_err(|e| unreadable(e.to_string()))?;
    let state: Value = serde_json::from_slice(&bytes).map_err(|e| unreadable(e.to_string()))?;
    let ended = state["step"].as_u64().is_some_and(|step| step as usize >= plan.steps);
    let Ok(begun) = serde_json::from_value::<Origin>(state[KEY].clone()) else {
        let reason = "does not say what it was begun with, as those of older versions; go on with the version that wrote it, or begin anew in another folder";
        return Err(foreign(&path, reason));
    };
    let differs = differences(&begun, &of_plan(plan), ended);
    if differs.is_empty() {
        return Ok(());
    }
    let reason =
        format!("was begun with other settings: {}; give the command that began it, or begin anew in another folder", differs.join("; "));
    Err(foreign(&path, &reason))
}

fn foreign(path: &Path, reason: &str) -> TrainingError {
    TrainingError::Foreign { path: path.into(), reason: reason.into() }
}

/// What a run was begun with and is not to go on with, one phrase each.
fn differences(begun: &Origin, now: &Origin, ended: bool) -> Vec<String> {
    let names = begun.keys().chain(now.keys().filter(|name| !begun.contains_key(*name)));
    let told = |value: Option<&String>| value.map_or("nothing", String::as_str).to_string();
    let differing = names.filter(|name| !(ended && *name == STEPS) && begun.get(*name) != now.get(*name));
    differing.map(|name| format!("{name} {}, now {}", told(begun.get(name)), told(now.get(name)))).collect()
}
