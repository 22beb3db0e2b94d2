//! The end of the demo: drives of a vehicle that does not move as predicted, and what the diagnosis makes of them.

use nesam_discovery::report::Report;
use nesam_discovery::{Options, Scoring, Verdict, diagnose};
use nesam_evaluation::DEFAULT_RESAMPLES;
use nesam_evaluation::report::Short;
use nesam_model::{HISTORY, ModelBundle, Predictor};
use serde_json::{Value, json};

use super::planner::HORIZON;
use crate::args::{DataArgs, SplitArg};
use crate::failure::Failure;
use crate::output::{self, say};
use crate::sources::{Drives, predictor_for, read_drives};

/// Folder of the sets with a vehicle that was changed.
const FOLDER: &str = "effect_open/";

/// Diagnoses the sets of changed vehicles that the data root has and prints what was found; `[]` where there are none or the bundle cannot tell.
/// Hands every report to `show`.
pub fn close_the_loop(bundle: &ModelBundle, played: &Drives, data: &DataArgs, show: &dyn Fn(Value)) -> Result<Vec<Value>, Failure> {
    let sets: Vec<String> = played.root.sets().into_iter().filter(|s| s.starts_with(FOLDER)).collect();
    if sets.is_empty() || bundle.reference_json.is_none() {
        return Ok(Vec::new());
    }
    say!("\ndoes the model lack an effect? each drive predicted with what the other drives of its set taught");
    let predictor = predictor_for(bundle.clone(), &played.root, data.dt)?;
    let root = Some(played.root.path().to_path_buf());
    let every = DataArgs { data: root, split: SplitArg::All, trajectories: None, ..data.clone() };
    sets.into_iter().map(|set| of_set(&predictor, DataArgs { set: Some(set), ..every.clone() }, show)).collect()
}

fn of_set(predictor: &Predictor, data: DataArgs, show: &dyn Fn(Value)) -> Result<Value, Failure> {
    let drives = read_drives(&data, false)?;
    let scoring = Scoring { horizon: HORIZON, history: HISTORY, resamples: DEFAULT_RESAMPLES, seed: 1 };
    let options = Options::of(scoring);
    // Too few drives, for instance: the demo has shown the rest and says why.
    let found = match diagnose(predictor, &drives.drives, &drives.maps, &options, &|_, _, _| {}) {
        Ok(found) => found,
        Err(error) => {
            say!("  {:<25} not diagnosed: {error}", drives.set);
            return Ok(json!({ "set": drives.set, "verdict": null, "reason": error.to_string() }));
        }
    };
    say!("  {:<25} {}: {}", drives.set, found.verdict.as_str(), found.reason);
    let provenance = output::provenance(Some(predictor.bundle()), &drives);
    let dt_s = predictor.bundle().normalization.dt_s;
    let against = options.against;
    let report = Report {
        set: &drives.set,
        diagnosis: &found,
        bundle: None,
        free_form_bundle: None,
        provenance: &provenance,
        dt_s,
        against,
        doubts: &[],
        notes: &[],
    };
    show(serde_json::from_str(&report.to_json()).unwrap_or_default());
    let position: Vec<Option<f64>> = found.scores.iter().flat_map(|s| s.scores.iter().map(|m| m.summary.tree.position_m.mean)).collect();
    if found.verdict == Verdict::Explained {
        for e in &found.estimates {
            let interval = e.ci95.map_or(String::new(), |[low, high]| format!(" [{}, {}]", Short(low), Short(high)));
            say!("  {:<25} {} = {}{interval} {}", "", e.name, Short(e.value), e.unit);
        }
        let metres: Vec<String> = position.iter().map(|p| p.map_or("–".into(), |p| format!("{p:.3}"))).collect();
        say!("  {:<25} position error before → best soil alone → with the effect: {} m", "", metres.join(" → "));
    }
    Ok(json!({ "set": drives.set, "verdict": found.verdict.as_str(), "reason": found.reason, "position_m": position }))
}
