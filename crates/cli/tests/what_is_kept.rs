//! Goal: no command takes away what somebody has, or spends hours on what cannot be. Method: the real binary on copies of the committed sample, asked for what a
//! tired person asks for; exit codes, the words of the messages, and every byte that was there before.
#![allow(clippy::unwrap_used)]

mod common;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use common::{nesam, refused, sample};

/// The files of a folder with what they hold.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![folder.to_path_buf()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                found.insert(path.clone(), std::fs::read(&path).unwrap());
            }
        }
    }
    found
}

/// A root with the vehicle, one world and one set of the sample.
fn root(folder: &Path) -> PathBuf {
    let root = folder.join("root");
    for part in ["worlds/w01", "nominal"] {
        std::fs::create_dir_all(root.join(part)).unwrap();
        for (file, content) in files(&sample().join(part)) {
            std::fs::write(root.join(part).join(file.file_name().unwrap()), content).unwrap();
        }
    }
    let card = "vehicle_hmmwv.json";
    std::fs::copy(sample().join(card), root.join(card)).unwrap();
    root
}

const DRIVES: [&str; 6] = ["--worlds", "w01", "--drives", "1", "--seconds", "2"];

#[test]
fn service_drives_of_the_plant_join_a_root_and_replace_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let root = root(folder.path());
    let write =
        |out: &str, more: &[&str]| nesam(&[&["plant", "write", "--data", "root", "--out", out][..], &DRIVES, more].concat(), folder.path());
    // Into the root that they are driven in, by another name of it.
    let before = files(&root);
    assert!(write("root/../root/.", &[]).status.success());
    let mut now = files(&root);
    let added: Vec<PathBuf> = now.keys().filter(|path| !before.contains_key(*path)).cloned().collect();
    assert!(added.iter().all(|path| path.starts_with(root.join("plant"))) && !added.is_empty(), "{added:?}");
    now.retain(|path, _| before.contains_key(path));
    assert_eq!(now, before);
    // A set that is there, a world that is another, a card of another vehicle.
    let refused = |args: &[&str], words: &[&str]| {
        let before = files(folder.path());
        refused(&[&["plant", "write", "--data", "root"][..], &DRIVES, args].concat(), folder.path(), words);
        assert_eq!(files(folder.path()), before, "nothing is written");
    };
    refused(&["--out", "root", "--set", "nominal"], &["exists; choose another --set"]);
    std::fs::create_dir_all(folder.path().join("other/worlds/w01")).unwrap();
    std::fs::write(folder.path().join("other/worlds/w01/world.json"), "{}").unwrap();
    refused(&["--out", "other"], &["world.json", "choose another --out"]);
    std::fs::create_dir(folder.path().join("third")).unwrap();
    std::fs::write(folder.path().join("third/vehicle_own.json"), "{}").unwrap();
    refused(&["--out", "third"], &["vehicle_own.json", "choose another --out"]);
    assert!(write("new", &["--set", "a/b"]).status.success() && folder.path().join("new/worlds/w01/elevation.png").is_file());
}

#[test]
fn service_no_output_takes_the_place_of_another_file() {
    let folder = tempfile::tempdir().unwrap();
    let root = root(folder.path());
    let evaluate = ["evaluate", "--data", "root", "--set", "nominal", "--models", "constant_velocity"];
    let twice = ["--json", "e.json", "--html", "./e.json"];
    refused(&[&evaluate[..], &twice].concat(), folder.path(), &["e.json is named twice"]);
    let before = files(&root);
    for file in ["root/nominal/index.json", "root/vehicle_hmmwv.json", "root/worlds/w01/world.json"] {
        refused(&[&evaluate[..], &["--json", file]].concat(), folder.path(), &[file, "part of a data root"]);
    }
    assert_eq!(files(&root), before);
    std::fs::write(folder.path().join("log.csv"), "t,x\n").unwrap();
    let import = ["import", "log.csv", "--to", "mine", "--set", "a", "--html", "log.csv", "--vehicle", "root/vehicle_hmmwv.json"];
    refused(&import, folder.path(), &["log.csv is named twice"]);
    assert_eq!(std::fs::read_to_string(folder.path().join("log.csv")).unwrap(), "t,x\n");
    let before = files(&root);
    refused(&["calibrate", "--data", "root", "--set", "nominal", "--out", "root"], folder.path(), &["two cards", "another folder"]);
    assert_eq!(files(&root), before);
}

/// Two imports into one set at the same time: one makes it, the other is told, and what is there is that of the one.
#[test]
fn service_of_two_imports_into_one_set_one_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let log = |name: &str, samples: usize| {
        let rows = (0..samples).map(|i| format!("{:.1},{:.2},0,0,1,0\n", 0.1 * i as f64, 0.1 * i as f64));
        std::fs::write(folder.path().join(name), "t,x,y,yaw,cmd_speed,cmd_steer\n".to_string() + &rows.collect::<String>()).unwrap();
    };
    log("short.csv", 50);
    log("long.csv", 80);
    let card = sample().join("vehicle_hmmwv.json").display().to_string();
    for round in 0..8 {
        let set = format!("s{round}");
        let begun = ["short.csv", "long.csv"].map(|name| {
            let args = ["import", name, "--flat", "--to", "mine", "--set", &set, "--vehicle", &card];
            Command::new(env!("CARGO_BIN_EXE_nesam"))
                .args(args)
                .current_dir(folder.path())
                .stdout(std::process::Stdio::null())
                .stderr(std::process::Stdio::piped())
                .spawn()
                .unwrap()
        });
        let ended = begun.map(|import| import.wait_with_output().unwrap());
        let succeeded: Vec<bool> = ended.iter().map(|output| output.status.success()).collect();
        let said: Vec<String> = ended.iter().map(|output| String::from_utf8_lossy(&output.stderr).into_owned()).collect();
        assert_eq!(succeeded.iter().filter(|succeeded| **succeeded).count(), 1, "{said:?}");
        assert!(said.iter().any(|said| said.contains("exists; choose another --set")), "{said:?}");
        let index = std::fs::read_to_string(folder.path().join("mine").join(&set).join("index.json")).unwrap();
        assert_eq!(index.contains("short"), succeeded[0], "{index}");
    }
}

#[test]
fn service_what_makes_no_sense_is_refused_before_the_work() {
    let folder = tempfile::tempdir().unwrap();
    root(folder.path());
    let data = ["--data", "root", "--set", "nominal"];
    for (command, args, words) in [
        (&["train"][..], &["--out", "t", "--lr", "nan"][..], &["--lr NaN"][..]),
        (&["train"], &["--out", "t", "--lr", "-1"], &["--lr -1"]),
        (&["train"], &["--out", "t", "--encoder-lr", "inf"], &["--encoder-lr inf"]),
        (&["fleet"], &["--first-s", "nan"], &["--first-s NaN"]),
        (&["fleet"], &["--first-s", "0"], &["--first-s 0"]),
        (&["bench", "predict"], &["--samples", "99999999999"], &["--samples", "262144"]),
        (&["bench", "predict"], &["--queries", "9223372036854775807"], &["--queries", "1000000"]),
        (&["diagnose"], &["--session", "x"], &["--session", "--recording"]),
        (&["diagnose"], &["--from-ns", "5"], &["--from-ns", "--recording"]),
        (&["evaluate"], &["--start-sd", "1,2"], &["--calibrate-coverage"]),
        (&["replay"], &["--degrade", "--every", "0"], &["--every"]),
    ] {
        refused(&[command, &data, args].concat(), folder.path(), words);
    }
}

#[test]
fn service_a_slow_log_is_doubted() {
    let folder = tempfile::tempdir().unwrap();
    let card = sample().join("vehicle_hmmwv.json").display().to_string();
    for (name, hz, doubted) in [("slow", 2.0, true), ("usual", 10.0, false), ("trembling", 9.9, false)] {
        let rows = (0..60).map(|i| format!("{:.3},{:.3},0,0,1,0\n", f64::from(i) / hz, f64::from(i) / hz));
        std::fs::write(
            folder.path().join(format!("{name}.csv")),
            "t,x,y,yaw,cmd_speed,cmd_steer\n".to_string() + &rows.collect::<String>(),
        )
        .unwrap();
        let output = nesam(&["import", &format!("{name}.csv"), "--flat", "--to", "mine", "--set", name, "--vehicle", &card], folder.path());
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        assert!(
            output.status.success() && said.contains("10 Hz or faster") == doubted,
            "{name}: {said}{}",
            String::from_utf8_lossy(&output.stderr)
        );
    }
}

/// Goal: a training takes the place of no other one, and goes on from no other one. Method: folders that hold a bundle, a checkpoint, one that does not say what it was
/// begun with, one that says something else; all is refused before the work.
#[test]
fn service_a_training_takes_the_place_of_no_other() {
    let folder = tempfile::tempdir().unwrap();
    root(folder.path());
    let state = |out: &str, text: &str| {
        std::fs::create_dir_all(folder.path().join(out).join("checkpoint")).unwrap();
        std::fs::write(folder.path().join(out).join("checkpoint/state.json"), text).unwrap();
    };
    state("begun", r#"{"step": 1}"#);
    state("other", r#"{"step": 1, "begun_with": {"--seed": "7", "drives": "of another set"}}"#);
    std::fs::create_dir_all(folder.path().join("made/bundle")).unwrap();
    std::fs::write(folder.path().join("made/bundle/manifest.toml"), "").unwrap();
    let before = files(folder.path());
    for (out, resume, words) in [
        ("made", false, &["--out made holds a bundle and no checkpoint", "choose another --out or remove it"][..]),
        ("made", true, &["--out made holds a bundle and no checkpoint"]),
        ("begun", false, &["--out begun holds the checkpoint of another run", "--resume", "choose another --out"]),
        ("begun", true, &["begun/checkpoint/state.json does not say what it was begun with", "older versions"]),
        ("other", true, &["was begun with other settings", "--seed 7, now 1", "drives of another set, now", "vehicle card nothing, now"]),
    ] {
        let resume = if resume { &["--resume"][..] } else { &[] };
        refused(&[&["train", "--data", "root", "--set", "nominal", "--out", out][..], resume].concat(), folder.path(), words);
    }
    assert_eq!(files(folder.path()), before);
}
