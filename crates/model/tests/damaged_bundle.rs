//! Goal: no damage to a bundle is overlooked or stops the program. Method: every file of the shipped bundle is truncated, overwritten and flipped
//! bit by bit, first with the hash that the manifest has for it, then with the hash of the damaged file, as a careless hand would leave it.

use std::fs;
use std::path::{Path, PathBuf};

use nesam_model::ModelBundle;
use nesam_model::bundle::sha256_hex;

/// Truncations and flips tried of each file.
const TRIES: usize = 24;

fn shipped() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/bundles/hmmwv-nominal")
}

/// Names of the files that the manifest of the shipped bundle lists.
fn files() -> Vec<String> {
    let manifest: toml::Table = fs::read_to_string(shipped().join("manifest.toml")).expect("readable").parse().expect("a manifest");
    manifest["files"].as_table().expect("files by name").keys().cloned().collect()
}

/// Copies of one file with something wrong, with words for it.
fn damaged(whole: &[u8]) -> Vec<(String, Vec<u8>)> {
    let at = |i: usize| i * whole.len() / TRIES;
    let truncated = (0..TRIES).map(|i| (format!("cut after {} bytes", at(i)), whole[..at(i)].to_vec()));
    let flipped = (0..TRIES).map(|i| {
        let mut bytes = whole.to_vec();
        bytes[at(i)] ^= 1 << (i % 8);
        (format!("bit {} of byte {} flipped", i % 8, at(i)), bytes)
    });
    let zeros = ("zeros".to_string(), vec![0; whole.len()]);
    let longer = ("a byte too long".to_string(), [whole, &[0xff]].concat());
    truncated.chain(flipped).chain([zeros, longer]).collect()
}

#[test]
fn regress_every_damaged_file_of_a_bundle_is_named() {
    let folder = tempfile::tempdir().expect("a folder");
    for name in files().iter().map(String::as_str).chain(["manifest.toml"]) {
        fs::copy(shipped().join(name), folder.path().join(name)).expect("the shipped bundle is complete");
    }
    ModelBundle::load(folder.path()).expect("the copy is whole");
    let manifest = fs::read_to_string(shipped().join("manifest.toml")).expect("readable");
    for name in &files() {
        let whole = fs::read(shipped().join(name)).expect("readable");
        for (what, bytes) in damaged(&whole) {
            fs::write(folder.path().join(name), &bytes).expect("writable");
            let message = ModelBundle::load(folder.path()).expect_err(&what).to_string();
            assert!(message.contains(name) && message.contains("SHA-256"), "{name}, {what}: {message}");
            // With a manifest that agrees, what is left of the file decides. A flipped bit may give another number, a cut of the comment of a
            // file nothing at all; a cut of an array must be noticed, and nothing may panic.
            fs::write(folder.path().join("manifest.toml"), manifest.replace(&sha256_hex(&whole), &sha256_hex(&bytes))).expect("writable");
            let loaded = ModelBundle::load(folder.path());
            let cut = bytes.len() < whole.len();
            assert!(loaded.is_err() || !cut || name != "weights.safetensors", "{name}, {what}");
            if let Err(error) = loaded {
                assert!(error.to_string().len() > 20, "{name}, {what}: {error}");
            }
            fs::write(folder.path().join("manifest.toml"), &manifest).expect("writable");
        }
        fs::remove_file(folder.path().join(name)).expect("removable");
        let message = ModelBundle::load(folder.path()).expect_err("a missing file").to_string();
        assert!(message.contains(name), "{name}: {message}");
        fs::write(folder.path().join(name), &whole).expect("writable");
    }
    for (what, bytes) in damaged(manifest.as_bytes()) {
        fs::write(folder.path().join("manifest.toml"), &bytes).expect("writable");
        // A damaged comment or name of the provenance is no damage to the model; the hash of the bundle tells.
        match ModelBundle::load(folder.path()) {
            Ok(bundle) => assert_eq!(bundle.hash, sha256_hex(&bytes), "{what}"),
            Err(error) => assert!(error.to_string().len() > 20, "{what}: {error}"),
        }
    }
}

/// Goal: a bundle whose files are whole and whose numbers are none is refused when it is loaded. Method: one line of the shipped `normalization.toml` is
/// written anew, with a manifest that agrees.
#[test]
fn regress_a_bundle_that_no_model_runs_with_is_not_loaded() {
    let folder = tempfile::tempdir().expect("a folder");
    for name in files().iter().map(String::as_str).chain(["manifest.toml"]) {
        fs::copy(shipped().join(name), folder.path().join(name)).expect("the shipped bundle is complete");
    }
    let manifest = fs::read_to_string(shipped().join("manifest.toml")).expect("readable");
    let whole = fs::read_to_string(shipped().join("normalization.toml")).expect("readable");
    let with = |key: &str, value: &str| {
        let line = |line: &str| if line.starts_with(&format!("{key} = ")) { format!("{key} = {value}\n") } else { format!("{line}\n") };
        let changed: String = whole.lines().map(line).collect();
        assert_ne!(changed.trim_end(), whole.trim_end(), "`{key}` is a line of the file");
        let agreeing = manifest.replace(&sha256_hex(whole.as_bytes()), &sha256_hex(changed.as_bytes()));
        fs::write(folder.path().join("normalization.toml"), changed).expect("writable");
        fs::write(folder.path().join("manifest.toml"), agreeing).expect("writable");
        ModelBundle::load(folder.path())
    };
    for (key, value, allowed) in [
        ("substeps", "0", "1 to 64"),
        ("substeps", "1000000000", "1 to 64"),
        ("dt_s", "-0.1", "0.01 to 1 s"),
        ("dt_s", "nan", "0.01 to 1 s"),
        ("elevation_half_range_m", "0.0", "above 0"),
        ("sinkage_log_ratio_max", "nan", "above 0"),
    ] {
        let message = with(key, value).expect_err(key).to_string();
        assert!(message.contains("normalization.toml") && message.contains(&format!("`{key}`")), "{key} = {value}: {message}");
        assert!(message.contains(allowed), "{key} = {value}: {message}");
    }
    with("substeps", "3").expect("a number of sub-steps that is allowed");
}
