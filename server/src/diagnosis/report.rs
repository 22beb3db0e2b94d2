//! The report of `nesam diagnose` (schema `nesam.diagnose/1`) as message.

use std::collections::BTreeMap;
use std::path::Path;

use nesam_engine::UNCERTAIN_MAX;
use nesam_model::ModelBundle;
use nesam_model::named_effect;
use nesam_proto::v1 as pb;
use serde_json::Value;

use super::folder::REPORT;

/// Largest report that is read, bytes; those of five pieces have some tens of thousands.
const BYTES_MAX: u64 = 8 << 20;
/// Half width of a 95 % interval, standard deviations.
const HALF_WIDTH: f64 = 1.96;

/// Reads the report in the folder of a diagnosis: the message, and the document for the live page.
///
/// # Errors
/// What is wrong with the file.
pub(super) fn read(folder: &Path, diagnosis_id: String, notes: Vec<String>) -> Result<pb::DiagnosisReport, String> {
    let file = folder.join(REPORT);
    let bytes = std::fs::metadata(&file).map_err(|error| format!("left no report: {error}"))?.len();
    if bytes > BYTES_MAX {
        return Err(format!("left a report of {bytes} bytes, at most {BYTES_MAX} are read"));
    }
    let json = std::fs::read_to_string(&file).map_err(|error| format!("left a report that cannot be read: {error}"))?;
    let document: Value = serde_json::from_str(&json).map_err(|error| format!("left a report that is no JSON: {error}"))?;
    let verdict = verdict(&document).ok_or("left a report without a verdict")?;
    let bundle = document["bundle"].as_str().unwrap_or_default().to_string();
    Ok(pb::DiagnosisReport {
        diagnosis_id,
        verdict: verdict.into(),
        reason: document["reason"].as_str().unwrap_or_default().into(),
        effects: effects(&document),
        json,
        folder: folder.display().to_string(),
        bundle_hash: bundle_hash(&bundle),
        bundle,
        notes,
    })
}

/// Whether a server takes what lies in the folder of a diagnosis as its report.
#[must_use]
pub fn knows_report(folder: &Path) -> bool {
    read(folder, String::new(), Vec::new()).is_ok()
}

/// Hash of a bundle; empty without one.
fn bundle_hash(bundle: &str) -> String {
    if bundle.is_empty() {
        return String::new();
    }
    ModelBundle::hash_of(Path::new(bundle)).unwrap_or_default()
}

fn verdict(document: &Value) -> Option<pb::DiagnosisVerdict> {
    match document["verdict"].as_str()? {
        "none" => Some(pb::DiagnosisVerdict::None),
        "explained" => Some(pb::DiagnosisVerdict::Explained),
        "ambiguous" => Some(pb::DiagnosisVerdict::Ambiguous),
        "unexplained" => Some(pb::DiagnosisVerdict::Unexplained),
        _ => None,
    }
}

/// The claimed effects that a session takes: those of the catalogue, with as many standard deviations as it allows.
fn effects(document: &Value) -> Vec<pb::Effect> {
    let mut effects: Vec<pb::Effect> = document["effects"].as_array().into_iter().flatten().filter_map(effect).collect();
    let uncertain = effects.iter_mut().flat_map(|effect| &mut effect.parameters).filter(|parameter| parameter.sd > 0.0);
    uncertain.skip(UNCERTAIN_MAX).for_each(|parameter| parameter.sd = 0.0);
    effects
}

/// One of them; `None` for one that was written as formulas, which the catalogue does not have.
fn effect(claimed: &Value) -> Option<pb::Effect> {
    let id = claimed["id"].as_str()?;
    let parameters = claimed["parameters"].as_array()?.iter().map(parameter).collect::<Option<Vec<_>>>()?;
    let values: BTreeMap<String, f64> = parameters.iter().map(|parameter| (parameter.name.clone(), parameter.value)).collect();
    let of_catalogue = named_effect(id, &values).is_ok();
    of_catalogue.then(|| pb::Effect { id: id.into(), parameters })
}

fn parameter(claimed: &Value) -> Option<pb::EffectParameter> {
    let (name, value) = (claimed["name"].as_str()?, claimed["value"].as_f64()?);
    // The upper end of an interval may be cut off where the parameter ends, and either may lie further out where an onset is possible. A choice, such as the wheel, has none.
    let end = |i: usize| claimed["ci95"][i].as_f64().unwrap_or(value);
    Some(pb::EffectParameter { name: name.into(), value, sd: ((value - end(0)).max(end(1) - value) / HALF_WIDTH).max(0.0) })
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn read_document(document: &Value) -> Result<pb::DiagnosisReport, String> {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join(REPORT), document.to_string()).unwrap();
        read(folder.path(), "d".into(), vec!["remark".into()])
    }

    /// Goal: what the report claims is what a session takes. Method: a claim with an interval, a choice, one that the catalogue does not have.
    #[test]
    fn analytic_claimed_effects_are_ready_to_be_applied() {
        let report = read_document(&json!({
            "verdict": "explained",
            "reason": "because",
            "effects": [
                {"id": "steering_offset", "parameters": [{"name": "second", "value": 0.05, "ci95": [0.0304, 0.06]}]},
                {"id": "push", "parameters": [{"name": "f", "value": 1.0, "ci95": null}]},
                {"id": "wheel_drag", "parameters": [{"name": "wheel", "value": 1.0, "ci95": null}, {"name": "torque_nm", "value": 900.0, "ci95": [802.0, 998.0]}]},
            ],
            "bundle": null,
        }))
        .unwrap();
        assert_eq!((report.verdict(), report.reason.as_str()), (pb::DiagnosisVerdict::Explained, "because"));
        assert_eq!((report.bundle.as_str(), report.bundle_hash.as_str(), report.notes.len()), ("", "", 1));
        let ids: Vec<&str> = report.effects.iter().map(|effect| effect.id.as_str()).collect();
        assert_eq!(ids, ["steering_offset", "wheel_drag"]);
        let sds: Vec<f64> = report.effects.iter().flat_map(|effect| &effect.parameters).map(|parameter| parameter.sd).collect();
        // (0.05 - 0.0304) / 1.96 and (900 - 802) / 1.96, up to rounding.
        for (sd, expected) in sds.iter().zip([0.01, 0.0, 50.0]) {
            assert!((sd - expected).abs() < 1e-9 * expected.max(1.0), "{sds:?}");
        }
        assert_eq!(sds.len(), 3);
    }

    /// Nine parameters with an interval: a session takes eight, and the ninth is taken as exact.
    #[test]
    fn property_no_more_standard_deviations_than_a_session_takes() {
        let offset = json!({"id": "steering_offset", "parameters": [{"name": "second", "value": 0.05, "ci95": [0.04, 0.06]}]});
        let report = read_document(&json!({"verdict": "ambiguous", "effects": vec![offset; 9]})).unwrap();
        let exact: Vec<bool> = report.effects.iter().flat_map(|effect| &effect.parameters).map(|parameter| parameter.sd == 0.0).collect();
        assert_eq!(exact, [false, false, false, false, false, false, false, false, true]);
    }

    #[test]
    fn regress_what_is_no_report_is_refused() {
        for document in [json!({}), json!({"verdict": "perhaps"}), json!([1, 2]), json!("text")] {
            assert!(read_document(&document).is_err_and(|reason| reason.contains("verdict")), "{document}");
        }
        let empty = tempfile::tempdir().unwrap();
        assert!(read(empty.path(), "d".into(), Vec::new()).is_err_and(|reason| reason.contains("left no report")));
    }
}
