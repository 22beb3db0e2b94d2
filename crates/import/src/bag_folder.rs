//! A ROS 2 bag as `ros2 bag record` leaves it: a folder with `metadata.yaml` and the parts of the recording.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use crate::error::ImportError;
use crate::part::Notes;

/// What to do with a bag in another storage, or whose files or messages the recorder compressed.
pub const CONVERT: &str = "only bags in MCAP files are read, with or without compressed chunks, and no compressed files. Convert it: write `output_bags: [{uri: converted, storage_id: mcap, all: true}]` \
     into a file out.yaml, run `ros2 bag convert -i BAG -o out.yaml`, and import the folder `converted`";

/// File that makes a folder a bag.
const METADATA: &str = "metadata.yaml";

/// The MCAP files of a bag: the file itself, or the parts of a folder in the order of its metadata, those that it does not name after them by name.
///
/// # Errors
/// `ImportError::Log` when a folder is no bag or has no part in MCAP.
pub(crate) fn parts(path: &Path) -> Result<(Vec<PathBuf>, Notes), ImportError> {
    if !path.is_dir() {
        return Ok((vec![path.to_path_buf()], Notes::new()));
    }
    let entries = std::fs::read_dir(path).map_err(|source| ImportError::file(path, source))?;
    let mut present: Vec<String> = entries.flatten().map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
    present.sort_by_key(|name| numbered(name));
    let is_part = |name: &str| name.to_ascii_lowercase().ends_with(".mcap");
    let metadata = path.join(METADATA);
    let listed = match std::fs::read_to_string(&metadata) {
        Ok(text) => listed(&text),
        Err(_) if present.iter().any(|name| is_part(name)) => Vec::new(),
        Err(_) => return Err(ImportError::log(path, format!("is a folder and no bag: it has neither {METADATA} nor MCAP files"))),
    };
    let mut notes = Notes::new();
    for name in listed.iter().filter(|name| is_part(name) && !present.contains(name)) {
        notes.push(format!("{name}, a part of the bag by its {METADATA}, is not there: what it recorded is missing"));
    }
    let further = present.iter().filter(|name| !listed.contains(name));
    let names = listed.iter().filter(|name| present.contains(name)).chain(further).filter(|name| is_part(name));
    let files: Vec<PathBuf> = names.map(|name| path.join(name)).collect();
    if files.is_empty() {
        let holds: BTreeSet<&str> = listed.iter().chain(&present).map(String::as_str).filter(|name| *name != METADATA).collect();
        let holds = holds.into_iter().collect::<Vec<_>>().join(", ");
        return Err(ImportError::log(path, format!("has no part in MCAP (it has {holds}); {CONVERT}")));
    }
    Ok((files, notes))
}

/// A name such that the tenth part comes after the second one: what stands before the number at its end, and the number.
fn numbered(name: &str) -> (String, u64, String) {
    let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
    let before = stem.trim_end_matches(|c: char| c.is_ascii_digit());
    (before.into(), stem[before.len()..].parse().unwrap_or(0), name.into())
}

/// File names under `relative_file_paths` of a bag's metadata; the names of its folder are left out.
fn listed(metadata: &str) -> Vec<String> {
    let after = metadata.lines().skip_while(|line| line.trim() != "relative_file_paths:").skip(1);
    let entries = after.map_while(|line| line.trim().strip_prefix("- "));
    let plain = entries.map(|entry| entry.trim().trim_matches(['"', '\'']));
    plain.map(|entry| entry.rsplit('/').next().unwrap_or(entry).to_string()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_parts_come_in_the_order_of_the_metadata() {
        let folder = tempfile::tempdir().expect("a folder");
        let bag = folder.path().join("run");
        std::fs::create_dir(&bag).expect("made");
        let put = |name: &str, text: &str| std::fs::write(bag.join(name), text).expect("written");
        for name in ["run_0.mcap", "run_2.mcap", "run_10.mcap", "late.mcap", "notes.txt"] {
            put(name, "");
        }
        let metadata = "rosbag2_bagfile_information:\n  version: 5\n  relative_file_paths:\n    - run_0.mcap\n    - \"run_2.mcap\"\n    - run/run_10.mcap\n    - run_11.mcap\n  files:\n    - path: run_0.mcap\n";
        put(METADATA, metadata);
        let (files, notes) = parts(&bag).expect("a bag");
        let names: Vec<_> = files.iter().filter_map(|file| file.file_name()).map(|name| name.to_string_lossy().into_owned()).collect();
        assert_eq!(names, ["run_0.mcap", "run_2.mcap", "run_10.mcap", "late.mcap"]);
        assert!(notes.len() == 1 && notes[0].starts_with("run_11.mcap"), "{notes:?}");
        std::fs::remove_file(bag.join(METADATA)).expect("removed");
        // Without metadata they come by their numbers.
        let names: Vec<_> =
            parts(&bag).expect("a bag").0.iter().filter_map(|file| Some(file.file_name()?.to_string_lossy().into_owned())).collect();
        assert_eq!(names, ["late.mcap", "run_0.mcap", "run_2.mcap", "run_10.mcap"], "a bag that was cut off");
        assert_eq!(parts(&bag.join("run_0.mcap")).expect("a file").0, [bag.join("run_0.mcap")]);
    }

    #[test]
    fn regress_folders_that_hold_no_mcap_say_what_to_do() {
        let folder = tempfile::tempdir().expect("a folder");
        let told = || parts(folder.path()).expect_err("no bag in MCAP").to_string();
        assert!(told().contains("neither metadata.yaml nor MCAP files"), "{}", told());
        std::fs::write(folder.path().join(METADATA), "  relative_file_paths:\n    - run_0.db3\n").expect("written");
        assert!(told().contains("run_0.db3") && told().contains("ros2 bag convert -i"), "{}", told());
        std::fs::write(folder.path().join("run_0.mcap.zstd"), "").expect("written");
        assert!(told().contains("run_0.mcap.zstd") && told().contains("no compressed files"), "{}", told());
    }
}
