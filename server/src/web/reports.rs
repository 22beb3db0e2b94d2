//! Diagnoses for the page: reports of `nesam diagnose` (schema `nesam.diagnose/1`) in a folder, and those that the program itself adds.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Instant, SystemTime};

use serde_json::{Value, json};

/// Reports that are shown, the newest first.
const SHOWN_MAX: usize = 24;
/// Largest report that is read, bytes.
const BYTES_MAX: u64 = 8 << 20;
/// Entries of the folder and its folders that are looked at.
const ENTRIES_MAX: usize = 2000;
/// Time between two looks into the folder, s.
const LOOK_EVERY_S: f64 = 5.0;

/// The reports. Clones share them.
#[derive(Clone, Debug, Default)]
pub(crate) struct Reports {
    folders: Vec<PathBuf>,
    added: Arc<Mutex<Added>>,
    looked: Arc<Mutex<Option<(Instant, u64)>>>,
}

/// Reports that the program itself added.
#[derive(Debug, Default)]
struct Added {
    /// All that ever were.
    count: u64,
    /// Those that are shown, the newest first.
    newest: Vec<Value>,
}

impl Reports {
    /// Reports of folders and one level of folders in each, beside those that are added; an empty path is none.
    pub fn new(folders: &[&Path]) -> Self {
        let mut named: Vec<PathBuf> = folders.iter().filter(|folder| !folder.as_os_str().is_empty()).map(|folder| place(folder)).collect();
        named.sort();
        named.dedup();
        Self { folders: named, ..Self::default() }
    }

    /// Looks into the folders at the next time it is asked, not only after a while.
    pub fn look_again(&self) {
        if let Ok(mut looked) = self.looked.lock() {
            *looked = None;
        }
    }

    /// Adds one. What is not a report of a diagnosis is left out.
    pub fn add(&self, report: Value) {
        if let (Some(summary), Ok(mut added)) = (summary(&report, None), self.added.lock()) {
            added.count += 1;
            added.newest.insert(0, summary);
            added.newest.truncate(SHOWN_MAX);
        }
    }

    /// Changes whenever the reports do; looks into the folder every few seconds.
    pub fn version(&self) -> u64 {
        let added = self.added.lock().map_or(0, |added| added.count);
        let Ok(mut looked) = self.looked.lock() else { return added };
        let seen = match *looked {
            Some((at, seen)) if at.elapsed().as_secs_f64() < LOOK_EVERY_S => seen,
            _ => {
                let newest = |files: &[(SystemTime, PathBuf)]| {
                    files.first().and_then(|(at, _)| at.duration_since(SystemTime::UNIX_EPOCH).ok()).map_or(0, |d| d.as_millis() as u64)
                };
                let files = files(&self.folders);
                let seen = newest(&files).wrapping_mul(31).wrapping_add(files.len() as u64);
                *looked = Some((Instant::now(), seen));
                seen
            }
        };
        seen.wrapping_add(added)
    }

    /// What the page shows of each report, the newest first.
    pub fn read(&self) -> Value {
        let mut shown = self.added.lock().map(|added| added.newest.clone()).unwrap_or_default();
        for (_, file) in files(&self.folders) {
            if shown.len() >= SHOWN_MAX {
                break;
            }
            let text = std::fs::read_to_string(&file).unwrap_or_default();
            let report = serde_json::from_str::<Value>(&text).ok();
            shown.extend(report.and_then(|report| summary(&report, Some(&file))));
        }
        Value::Array(shown)
    }
}

/// How many reports of a folder the live page shows.
#[must_use]
pub fn shown_reports(folder: &Path) -> usize {
    Reports::new(&[folder]).read().as_array().map_or(0, Vec::len)
}

/// A folder by a name that is the same however it was given.
fn place(folder: &Path) -> PathBuf {
    folder.canonicalize().or_else(|_| std::path::absolute(folder)).unwrap_or_else(|_| folder.into())
}

/// JSON files of folders and of the folders in them, the newest first.
fn files(folders: &[PathBuf]) -> Vec<(SystemTime, PathBuf)> {
    let entries = |folder: &Path| std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let all = folders
        .iter()
        .flat_map(|folder| entries(folder))
        .flat_map(|path| if path.is_dir() { entries(&path).collect() } else { vec![path] });
    let json = all.take(ENTRIES_MAX).filter(|path| path.extension().is_some_and(|e| e == "json"));
    let dated = json.filter_map(|path| {
        let about = std::fs::metadata(&path).ok().filter(|about| about.is_file() && about.len() <= BYTES_MAX)?;
        Some((about.modified().ok()?, path))
    });
    let mut dated: Vec<_> = dated.collect();
    dated.sort_by(|a, b| b.cmp(a));
    dated
}

/// What is shown of a report.
fn summary(report: &Value, file: Option<&Path>) -> Option<Value> {
    if report["schema"] != "nesam.diagnose/1" {
        return None;
    }
    let errors = |stage: &str| {
        let tree = &report[stage];
        (!tree.is_null()).then(
            || json!({"mae_mean": tree["mae_mean"], "position_m": tree["position_m"]["mean"], "ci95": tree["ci95"]["position_m"]["mean"]}),
        )
    };
    let effect = |e: &Value| json!({"id": e["id"], "weight": e["weight"], "parameters": e["parameters"], "onset_s": e["onset_s"], "onset_possible_s": e["onset_possible_s"], "z": e["evidence"]["z"], "rivals": e["rivals"]});
    Some(json!({
        "set": report["set"],
        "verdict": report["verdict"],
        "reason": report["reason"],
        "effects": report["effects"].as_array().map(|effects| effects.iter().map(effect).collect::<Vec<_>>()),
        "held_out": report["held_out"].as_array().map(Vec::len),
        "before": errors("before"),
        "soil_only": errors("soil_only"),
        "after": errors("after"),
        "improvement_ci95": report["improvement_ci95"]["position_m"]["mean"],
        "bundle": report["bundle"],
        "file": file.map(|file| file.display().to_string()),
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn property_only_diagnoses_are_shown_and_new_ones_change_the_version() {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::create_dir(folder.path().join("run")).expect("a folder");
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect("written");
        write("other.json", r#"{"schema":"nesam.bench/1"}"#);
        write("torn.json", r#"{"schema":"nesam.diag"#);
        write("run/report.json", r#"{"schema":"nesam.diagnose/1","set":"s","verdict":"none","effects":[]}"#);
        let reports = Reports::new(&[folder.path()]);
        let shown = reports.read();
        assert_eq!(shown.as_array().map(Vec::len), Some(1), "{shown}");
        assert_eq!(shown[0]["set"], "s");
        let before = reports.version();
        reports.add(json!({"schema": "nesam.diagnose/1", "set": "t", "verdict": "explained"}));
        reports.add(json!({"schema": "nesam.adapt/1"}));
        assert_eq!(reports.version(), before + 1);
        assert_eq!(reports.read()[0]["set"], "t");
        // More than are shown change the version, too.
        for _ in 0..SHOWN_MAX {
            let before = reports.version();
            reports.add(json!({"schema": "nesam.diagnose/1", "set": "u", "verdict": "none"}));
            assert_eq!(reports.version(), before + 1);
        }
    }
}
