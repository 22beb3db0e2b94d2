//! Goal: results go where they are asked for, never into a bundle, and an option that a command cannot follow is refused before the work. Method: the real binary
//! on the committed sample; exit codes, files and the words of the messages are the contract.
#![allow(clippy::unwrap_used)]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use serde_json::Value;

fn sample() -> String {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/chrono_sample").display().to_string()
}

fn bundle() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/bundles/hmmwv-nominal")
}

fn nesam(args: &[&str], folder: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_nesam")).args(args).current_dir(folder).output().expect("the binary runs")
}

fn done(args: &[&str], folder: &Path) -> String {
    let output = nesam(args, folder);
    assert_eq!(output.status.code(), Some(0), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Runs and checks exit code 2 and that stderr has every one of `words`.
fn refused(args: &[&str], folder: &Path, words: &[&str]) {
    let output = nesam(args, folder);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{args:?}: {text}");
    for word in words {
        assert!(text.contains(word), "{args:?} should say `{word}`: {text}");
    }
}

/// A folder that only has a manifest is a bundle to whoever writes.
fn folder_with_a_bundle() -> tempfile::TempDir {
    let here = tempfile::tempdir().unwrap();
    std::fs::create_dir(here.path().join("kept")).unwrap();
    std::fs::write(here.path().join("kept/manifest.toml"), "").unwrap();
    here
}

#[test]
fn service_a_place_that_cannot_take_results_is_refused_before_the_work() {
    let here = folder_with_a_bundle();
    let root = sample();
    std::fs::write(here.path().join("file"), "").unwrap();
    let evaluate = |more: &[&'static str]| {
        [&["evaluate", "--data", &root, "--set", "nominal", "--models", "constant_velocity", "--out", "out"][..], more].concat()
    };
    for (option, name) in [("--json", "a.json"), ("--html", "a.html"), ("--markdown", "a.md"), ("--predictions", "a.parquet")] {
        let inside = format!("kept/{name}");
        refused(&[&evaluate(&[option])[..], &[inside.as_str()]].concat(), here.path(), &[&inside, "lies in a bundle"]);
        assert!(!here.path().join(&inside).exists());
    }
    refused(&evaluate(&["--predictions", "file/p.parquet"]), here.path(), &["file is not a folder"]);
    refused(&evaluate(&["--predictions", "kept"]), here.path(), &["kept is a folder"]);
    refused(&["train", "--data", &root, "--set", "nominal", "--out", "kept/new"], here.path(), &["--out kept/new lies in a bundle"]);
    // Folders are made, and no draft stays.
    done(&evaluate(&["--predictions", "new/folder/p.parquet"]), here.path());
    let there: Vec<String> =
        std::fs::read_dir(here.path().join("new/folder")).unwrap().flatten().map(|e| e.file_name().into_string().unwrap()).collect();
    assert_eq!(there, ["p.parquet"]);
}

/// Goal: who says where everything goes needs no folder besides. Method: `nesam-out` is a file, so that no folder of that name can be made.
#[test]
fn service_no_folder_is_made_where_every_result_has_a_place() {
    let here = tempfile::tempdir().unwrap();
    let root = sample();
    std::fs::write(here.path().join("nesam-out"), "").unwrap();
    let args = ["evaluate", "--data", &root, "--set", "nominal", "--models", "constant_velocity", "--json", "a.json"];
    refused(&args, here.path(), &["cannot make the folder nesam-out/evaluate-nominal", "--out"]);
    done(&[&args[..], &["--html", "a.html"]].concat(), here.path());
    assert!(here.path().join("a.json").exists() && here.path().join("a.html").exists());
}

#[test]
fn service_an_option_that_a_command_cannot_follow_is_refused() {
    let here = tempfile::tempdir().unwrap();
    let (root, bundle) = (sample(), bundle().display().to_string());
    let of = |command: &'static str, more: &[&'static str]| {
        [&[command, "--data", &root, "--set", "nominal", "--bundle", &bundle][..], more].concat()
    };
    for command in ["adapt", "diagnose", "predict"] {
        refused(&of(command, &["--inputs", "wheels"]), here.path(), &["--inputs wheels: ", "under commands"]);
        refused(&of(command, &["--inputs", "tracks"]), here.path(), &["--inputs"]);
    }
    done(&of("predict", &["--inputs", "commands", "--horizon", "3"]), here.path());
    refused(&of("evaluate", &["--coverage", "--inputs", "wheels"]), here.path(), &["--inputs wheels"]);
    refused(&["train", "--data", &root, "--set", "nominal", "--split", "test"], here.path(), &["--split test", "train split alone"]);
}

/// The log of the book has no channels of wheels.
#[test]
fn service_wheels_that_a_set_does_not_measure_are_wrong_input() {
    let here = tempfile::tempdir().unwrap();
    let (root, bundle) = (sample(), bundle().display().to_string());
    let (log, card) = (format!("{root}/../../../docs/example/run.csv"), format!("{root}/vehicle_hmmwv.json"));
    done(&["import", &log, "--to", "mine", "--set", "first", "--vehicle", &card], here.path());
    let evaluate = ["evaluate", "--data", "mine", "--bundle", &bundle, "--inputs", "wheels", "--models"];
    refused(&[&evaluate[..], &["nesam"]].concat(), here.path(), &["drive run has no measured wheel speeds", "--inputs commands"]);
    done(&[&evaluate[..], &["constant_velocity"]].concat(), here.path());
}

/// Goal: `--fit-on` opens no other drive for what it finds. Method: drives of the plant with a steering offset, once with two further ones and once without; the
/// same command writes the same bytes, and the bundle names what it has.
#[test]
fn service_a_patched_bundle_is_made_of_the_fitted_drives_alone() {
    let bundle = bundle().display().to_string();
    let root = sample();
    let patched = |drives: &str| {
        let here = tempfile::tempdir().unwrap();
        let write = ["plant", "write", "--data", &root, "--out", "root", "--set", "hidden", "--worlds", "w01,w05", "--drives", drives];
        done(&[&write[..], &["--effect", "steering_offset=0.12"]].concat(), here.path());
        let fit_on = ["--fit-on", "p0001,p0002", "--no-controls", "--out", "found"];
        done(&[&["diagnose", "--data", "root", "--set", "hidden", "--bundle", &bundle][..], &fit_on].concat(), here.path());
        let mut files: Vec<(String, Vec<u8>)> = std::fs::read_dir(here.path().join("found/bundle"))
            .unwrap()
            .flatten()
            .map(|e| (e.file_name().to_string_lossy().into_owned(), std::fs::read(e.path()).unwrap()))
            .collect();
        files.sort();
        (here, files)
    };
    let ((here, alone), (_, among_others)) = (patched("2"), patched("4"));
    for ((name, bytes), (_, same)) in alone.iter().zip(&among_others) {
        assert_eq!(String::from_utf8_lossy(bytes), String::from_utf8_lossy(same), "{name}");
    }
    assert_eq!(alone.len(), among_others.len());
    // Nothing was held out: the errors are there, without numbers.
    let report: Value = serde_json::from_slice(&std::fs::read(here.path().join("found/diagnose.json")).unwrap()).unwrap();
    for stage in ["before", "soil_only", "after"] {
        assert_eq!(report[stage]["windows"], 0, "{}", report[stage]);
        assert!(report[stage]["position_m"].is_object() && report[stage]["position_m"]["mean"].is_null());
    }
    let inspected = done(&["inspect", "found/bundle", "--json", "i.json"], here.path());
    assert!(inspected.contains("steering_offset") && inspected.contains("second 0.1"), "{inspected}");
    let summary: Value = serde_json::from_slice(&std::fs::read(here.path().join("i.json")).unwrap()).unwrap();
    let effect = &summary["effects"][0];
    assert_eq!((effect["id"].as_str(), effect["parameters"][0]["name"].as_str()), (Some("steering_offset"), Some("second")));
}

/// Goal: what is claimed with `--fit-on` does not hang on the other drives, whether it proves itself or not. Method: three drives of the plant with a steering offset that is
/// plain in the steering and too small to show in predictions, and with a larger one, judged alone and among others; the same comes out, and what the others say is told.
#[test]
fn service_drives_that_are_not_fitted_change_no_claim() {
    let bundle = bundle().display().to_string();
    let root = sample();
    let found = |effect: &str, drives: &str| {
        let here = tempfile::tempdir().unwrap();
        let write = ["plant", "write", "--data", &root, "--out", "root", "--set", "hidden", "--worlds", "w01,w05", "--drives", drives];
        done(&[&write[..], &["--effect", effect]].concat(), here.path());
        let fit_on = ["--fit-on", "p0001,p0002,p0003", "--no-controls", "--out", "found"];
        done(&[&["diagnose", "--data", "root", "--set", "hidden", "--bundle", &bundle][..], &fit_on].concat(), here.path());
        let report = std::fs::read(here.path().join("found/diagnose.json")).unwrap();
        serde_json::from_slice::<Value>(&report).unwrap()
    };
    for (effect, claims) in [("steering_offset=0.03", 0), ("steering_offset=0.08", 1)] {
        let (alone, among_others) = (found(effect, "3"), found(effect, "5"));
        assert_eq!(alone["effects"], among_others["effects"]);
        assert_eq!(alone["verdict"], among_others["verdict"]);
        assert!(alone["after"]["position_m"]["mean"].is_null() && among_others["after"]["position_m"]["mean"].is_number());
        assert_ne!(among_others["after"], among_others["before"], "the effect was tried, proven or not");
        let reason = among_others["reason"].as_str().unwrap();
        assert_eq!(alone["effects"].as_array().unwrap().len(), claims, "{reason}");
        assert_eq!(reason.contains("the other drives"), claims > 0, "{reason}");
    }
}

#[test]
fn service_a_diagnosis_that_finds_nothing_names_what_stands_out_most() {
    let here = tempfile::tempdir().unwrap();
    let (root, bundle) = (sample(), bundle().display().to_string());
    let args = ["diagnose", "--data", &root, "--set", "effect_open/null_open", "--bundle", &bundle, "--no-controls"];
    let said = done(&args, here.path());
    let line = said.lines().find(|l| l.starts_with("the most that stands out: z = ")).unwrap_or_else(|| panic!("{said}"));
    assert!(line.split_once(" in ").is_some_and(|(_, what)| !what.trim().is_empty()), "{line}");
}
