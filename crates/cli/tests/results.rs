//! Goal: results go where they are asked for, never into a bundle, and an option that a command cannot follow is refused before the work. Method: the real binary
//! on the committed sample; exit codes, files and the words of the messages are the contract.
#![allow(clippy::unwrap_used)]

mod common;

use std::path::Path;

use common::{bundle, nesam, refused, sample, stderr, stdout};
use serde_json::Value;

fn done(args: &[&str], folder: &Path) -> String {
    let output = nesam(args, folder);
    assert_eq!(output.status.code(), Some(0), "{args:?}: {}", stderr(&output));
    stdout(&output)
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
    let root = sample().display().to_string();
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

/// Names of what is in a folder.
fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> = std::fs::read_dir(folder).unwrap().flatten().map(|e| e.file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// Goal: who says what to write gets that and no folder besides, and who is refused gets nothing. Method: each result alone, all of them by default and with `--out`; refusals
/// after the results were placed; a file in the place of the folder.
#[test]
fn service_no_folder_is_made_that_no_result_needs() {
    let here = tempfile::tempdir().unwrap();
    let (root, bundle) = (sample().display().to_string(), bundle("hmmwv-nominal"));
    let evaluate =
        |more: &[&'static str]| [&["evaluate", "--data", &root, "--set", "nominal/", "--models", "constant_velocity"][..], more].concat();
    let missing = ["evaluate", "--data", &root, "--set", "nominal", "--models", "tal_elev", "--baselines", "."];
    refused(&missing, here.path(), &["tal_elev"]);
    refused(&evaluate(&["--horizon", "5000"]), here.path(), &["5000 steps"]);
    assert!(names(here.path()).is_empty(), "{:?}", names(here.path()));
    done(&evaluate(&["--json", "a.json"]), here.path());
    done(&evaluate(&["--html", "a.html"]), here.path());
    let adapt = ["adapt", "--data", &root, "--set", "./nominal", "--bundle", &bundle, "--trajectories", "n0005", "--json", "b.json"];
    done(&adapt, here.path());
    assert_eq!(names(here.path()), ["a.html", "a.json", "b.json"]);
    done(&evaluate(&["--json", "a.json", "--out", "c"]), here.path());
    assert_eq!(names(&here.path().join("c")), ["evaluate.html"]);
    done(&evaluate(&[]), here.path());
    assert_eq!(names(&here.path().join("nesam-out/evaluate-nominal")), ["evaluate.html", "evaluate.json"]);
    std::fs::remove_dir_all(here.path().join("nesam-out")).unwrap();
    std::fs::write(here.path().join("nesam-out"), "").unwrap();
    refused(&evaluate(&[]), here.path(), &["cannot make the folder nesam-out/evaluate-nominal", "nesam-out is not a folder", "--out"]);
    done(&evaluate(&["--json", "a.json", "--html", "a.html"]), here.path());
}

/// Goal: `--json -` is a document that a program reads from a pipe, with nothing else in it. Method: commands that print tables beside it.
#[test]
fn service_a_document_on_standard_output_is_alone_there() {
    let here = tempfile::tempdir().unwrap();
    let (root, bundle) = (sample().display().to_string(), bundle("hmmwv-nominal"));
    for (args, schema) in [
        (&["evaluate", "--data", &root, "--set", "nominal", "--models", "constant_velocity", "--json", "-"][..], "nesam.evaluate/1"),
        (&["predict", "--data", &root, "--set", "nominal", "--bundle", &bundle, "--horizon", "2", "--json=-"], "nesam.predict/1"),
        (&["check", &root, "--json", "-"], "nesam.check/1"),
        (&["inspect", &bundle, "--json", "-"], "nesam.inspect/1"),
    ] {
        let document: Value = serde_json::from_str(&done(args, here.path())).unwrap();
        assert_eq!(document["schema"], schema);
    }
    assert!(names(here.path()).is_empty(), "{:?}", names(here.path()));
}

/// Goal: a prediction is written as the other commands write theirs, and as before. Method: each option alone and together.
#[test]
fn service_a_prediction_goes_where_it_is_asked_for() {
    let here = tempfile::tempdir().unwrap();
    let (root, bundle) = (sample().display().to_string(), bundle("hmmwv-nominal"));
    let predict = |more: &[&str]| {
        done(&[&["predict", "--data", &root, "--set", "nominal", "--bundle", &bundle, "--horizon", "2"][..], more].concat(), here.path())
    };
    let read = |name: &str| std::fs::read_to_string(here.path().join(name)).unwrap();
    let is_json = |text: &str| serde_json::from_str::<Value>(text).is_ok_and(|document| document["schema"] == "nesam.predict/1");
    assert!(is_json(&predict(&[])));
    assert_eq!(predict(&["--json", "a.json", "--html", "a.html"]), "", "no further answer");
    assert!(is_json(&read("a.json")) && read("a.html").contains("<svg"));
    assert!(predict(&["--json", "b.json", "--format", "csv"]).starts_with("k,t_s,"));
    assert_eq!(predict(&["--json", "c.json", "--out", "c.csv", "--format", "csv"]), "");
    assert!(is_json(&read("b.json")) && is_json(&read("c.json")) && read("c.csv").starts_with("k,t_s,"));
    assert_eq!(predict(&["--out", "d.json"]), "");
    assert!(is_json(&read("d.json")));
    let twice = ["predict", "--data", &root, "--set", "nominal", "--json", "e", "--out", "e"];
    refused(&twice, here.path(), &["e is named twice"]);
}

/// Goal: what a check finds can be read by a program, sound or not. Method: a root and a folder that is none.
#[test]
fn service_a_check_is_told_in_json() {
    let here = tempfile::tempdir().unwrap();
    let root = sample().display().to_string();
    refused(&["check", &root, "none", "--json", "c.json"], here.path(), &["the check found errors: 1"]);
    let found: Value = serde_json::from_slice(&std::fs::read(here.path().join("c.json")).unwrap()).unwrap();
    assert!(found["errors"] == 1 && found["checked"][0]["kind"] == "data root", "{found}");
    let of_root = &found["checked"][0];
    assert!(of_root["errors"].as_array().unwrap().is_empty() && !of_root["notes"].as_array().unwrap().is_empty(), "{of_root}");
    assert_eq!(found["checked"][1]["errors"][0], "does not exist");
}

#[test]
fn service_an_option_that_a_command_cannot_follow_is_refused() {
    let here = tempfile::tempdir().unwrap();
    let (root, bundle) = (sample().display().to_string(), bundle("hmmwv-nominal"));
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
    let (root, bundle) = (sample().display().to_string(), bundle("hmmwv-nominal"));
    let (log, card) = (format!("{root}/../../../docs/example/run.csv"), format!("{root}/vehicle_hmmwv.json"));
    done(&["import", &log, "--to", "mine", "--set", "first", "--vehicle", &card], here.path());
    let evaluate = ["evaluate", "--data", "mine", "--bundle", &bundle, "--inputs", "wheels", "--models"];
    refused(&[&evaluate[..], &["nesam"]].concat(), here.path(), &["drive run has no measured wheel speeds", "--inputs commands"]);
    done(&[&evaluate[..], &["constant_velocity"]].concat(), here.path());
}

/// Goal: `--fit-on` opens no other drive for what it finds. Method: drives of the plant with a steering offset, once with two further ones and once without, in folders of
/// other names; the same command writes the same bytes, and the bundle names what it has.
#[test]
fn service_a_patched_bundle_is_made_of_the_fitted_drives_alone() {
    let bundle = bundle("hmmwv-nominal");
    let root = sample().display().to_string();
    let patched = |drives: &str, data: &str, out: &str| {
        let here = tempfile::tempdir().unwrap();
        let write = ["plant", "write", "--data", &root, "--out", data, "--set", "hidden", "--worlds", "w01,w05", "--drives", drives];
        done(&[&write[..], &["--effect", "steering_offset=0.12"]].concat(), here.path());
        let fit_on = ["--fit-on", "p0001,p0002", "--no-controls", "--out", out];
        done(&[&["diagnose", "--data", data, "--set", "hidden", "--bundle", &bundle][..], &fit_on].concat(), here.path());
        let mut files: Vec<(String, Vec<u8>)> = std::fs::read_dir(here.path().join(out).join("bundle"))
            .unwrap()
            .flatten()
            .map(|e| (e.file_name().to_string_lossy().into_owned(), std::fs::read(e.path()).unwrap()))
            .collect();
        files.sort();
        (here, files)
    };
    let ((here, alone), (_, among_others)) = (patched("2", "root", "found"), patched("4", "elsewhere/root", "some/where else"));
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
    let bundle = bundle("hmmwv-nominal");
    let root = sample().display().to_string();
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
        assert_eq!(among_others["after"] != among_others["before"], claims > 0, "after has what is claimed and nothing else");
        assert_ne!(among_others["learned_per_held_out_drive"][0]["effects"], serde_json::json!([]), "the effect was tried, proven or not");
        let reason = among_others["reason"].as_str().unwrap();
        assert_eq!(alone["effects"].as_array().unwrap().len(), claims, "{reason}");
        assert_eq!(reason.contains("the other drives"), claims > 0, "{reason}");
    }
}

#[test]
fn service_a_diagnosis_that_finds_nothing_names_what_stands_out_most() {
    let here = tempfile::tempdir().unwrap();
    let (root, bundle) = (sample().display().to_string(), bundle("hmmwv-nominal"));
    let args = ["diagnose", "--data", &root, "--set", "effect_open/null_open", "--bundle", &bundle, "--no-controls"];
    let said = done(&args, here.path());
    let line = said.lines().find(|l| l.starts_with("the most that stands out: z = ")).unwrap_or_else(|| panic!("{said}"));
    assert!(line.split_once(" in ").is_some_and(|(_, what)| !what.trim().is_empty()), "{line}");
}
