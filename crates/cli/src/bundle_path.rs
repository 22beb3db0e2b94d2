//! Where the shipped bundle and the shipped sample of drives are.

use std::path::{Path, PathBuf};

use nesam_model::ModelBundle;
use nesam_model::bundle::MANIFEST;

use crate::failure::Failure;
use crate::output::or_here;

/// Finds the bundle to use: `--bundle`, else the last by name in `deploy/bundles`, searched upward from the executable and then from the
/// current folder.
pub fn bundle_dir(given: Option<&Path>) -> Result<PathBuf, Failure> {
    match given {
        Some(dir) if dir.join(MANIFEST).is_file() => Ok(dir.to_path_buf()),
        Some(dir) if dir.join("bundle").join(MANIFEST).is_file() => Err(Failure::input(format!(
            "{} is not a bundle: it has no {MANIFEST}; did you mean {}?",
            dir.display(),
            dir.join("bundle").display()
        ))),
        Some(dir) if dir.exists() => Err(Failure::input(format!(
            "{} is not a bundle: it has no {MANIFEST}; give a folder such as deploy/bundles/<name>",
            dir.display()
        ))),
        Some(dir) => Err(Failure::input(format!("bundle {} does not exist", dir.display()))),
        None => default_bundle().ok_or_else(|| {
            Failure::input("no bundle in deploy/bundles above the executable or the current folder; give one with --bundle DIR")
        }),
    }
}

/// The shipped bundle, if there is one.
pub fn default_bundle() -> Option<PathBuf> {
    upward("deploy/bundles").into_iter().find_map(|folder| last_by_name(&folder))
}

/// The shipped bundle that was trained for a vehicle, by the name on its card.
pub fn bundle_of_vehicle(name: &str) -> Option<PathBuf> {
    let of = |dir: &PathBuf| nesam_vehicle_card::from_json(&std::fs::read_to_string(dir.join("vehicle.json")).ok()?).ok();
    upward("deploy/bundles").iter().flat_map(|folder| bundles_in(folder)).find(|dir| of(dir).is_some_and(|v| v.name == name))
}

/// The shipped bundle of this hash.
pub fn bundle_of_hash(hash: &str) -> Option<PathBuf> {
    upward("deploy/bundles").iter().flat_map(|folder| bundles_in(folder)).find(|dir| ModelBundle::hash_of(dir).as_deref() == Some(hash))
}

/// Folders of shipped baseline bundles.
pub fn baseline_bundles() -> Vec<PathBuf> {
    upward("deploy/baselines").first().map(|folder| bundles_in(folder)).unwrap_or_default()
}

/// The shipped sample of drives, if there is one.
pub fn sample_root() -> Option<PathBuf> {
    upward("tests/data/chrono_sample").into_iter().next()
}

/// Whether `dir` lies in a bundle (or is one), where no command may write.
pub fn inside_bundle(dir: &Path) -> bool {
    let dir = or_here(dir);
    let absolute = std::path::absolute(dir).unwrap_or_else(|_| dir.to_path_buf());
    absolute.ancestors().any(|a| a.join(MANIFEST).is_file())
}

/// Existing folders `relative` in the ancestors of the executable, then of the current folder.
fn upward(relative: &str) -> Vec<PathBuf> {
    let starts = [std::env::current_exe().ok(), std::env::current_dir().ok()];
    let mut found: Vec<PathBuf> = Vec::new();
    for start in starts.iter().flatten() {
        for ancestor in start.ancestors() {
            let candidate = ancestor.join(relative);
            if candidate.is_dir() && !found.contains(&candidate) {
                found.push(candidate);
            }
        }
    }
    found
}

fn last_by_name(folder: &Path) -> Option<PathBuf> {
    bundles_in(folder).pop()
}

/// Bundles in a folder, sorted by name; none when it cannot be read.
pub fn bundles_in(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let mut bundles: Vec<PathBuf> = entries.flatten().map(|e| e.path()).filter(|p| p.join(MANIFEST).is_file()).collect();
    bundles.sort();
    bundles
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: who gives the folder of a diagnosis for the bundle in it is told which one was meant. Method: such a folder, and an empty one.
    #[test]
    fn regress_a_folder_with_a_bundle_in_it_is_no_bundle_and_says_so() {
        let here = tempfile::tempdir().unwrap();
        let refused = || bundle_dir(Some(here.path())).unwrap_err().to_string();
        assert!(refused().contains("not a bundle") && !refused().contains("did you mean"));
        let inner = here.path().join("bundle");
        std::fs::create_dir(&inner).unwrap();
        std::fs::write(inner.join(MANIFEST), "").unwrap();
        assert!(refused().contains(&format!("did you mean {}?", inner.display())), "{}", refused());
    }

    /// Goal: of several bundles the last by name is the shipped one, whenever they were made. Method: two, the later name made first.
    #[test]
    fn regress_the_last_by_name_is_taken() {
        let here = tempfile::tempdir().unwrap();
        for name in ["b", "a"] {
            std::fs::create_dir(here.path().join(name)).unwrap();
            std::fs::write(here.path().join(name).join(MANIFEST), "").unwrap();
        }
        assert_eq!(last_by_name(here.path()), Some(here.path().join("b")));
    }
}
