//! Goal: a log of one's own becomes a set that every command reads, and what is odd in it is told. Method: the real binary on the example of the book.
#![allow(clippy::unwrap_used)]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().unwrap()
}

fn nesam(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_nesam")).args(args).current_dir(folder).output().expect("the binary runs")
}

/// Imports the example with further arguments; exit code and all that was said.
fn import(folder: &Path, set: &str, more: &[&str]) -> (Option<i32>, String) {
    let (log, card) = (repository().join("docs/example/run.csv"), repository().join("tests/data/chrono_sample/vehicle_hmmwv.json"));
    let (log, card) = (log.to_string_lossy().into_owned(), card.to_string_lossy().into_owned());
    let args = [&["import", &log, "--to", "root", "--set", set, "--vehicle", &card][..], more].concat();
    let output = nesam(folder, &args);
    (output.status.code(), format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr)))
}

#[test]
fn service_an_imported_log_is_a_set() {
    let folder = tempfile::tempdir().unwrap();
    let (code, said) = import(folder.path(), "mine/first", &["--split", "test"]);
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("run: 11.9 s, 120 samples, 10.0 Hz") && !said.contains("doubt"), "{said}");
    let check = nesam(folder.path(), &["check", "root"]);
    let said = String::from_utf8_lossy(&check.stdout).into_owned();
    assert!(check.status.success() && said.contains("set mine/first: 1 drives, 120 samples") && said.contains("sound"), "{said}");
    let (code, said) = import(folder.path(), "mine/first", &[]);
    assert!(code == Some(2) && said.contains("exists; choose another --set"), "{said}");
}

#[test]
fn service_wrong_conventions_raise_doubts_and_wrong_mappings_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    for (i, (column, doubt)) in [
        ("yaw=-yaw", "yaw rate against the change of yaw"),
        ("vbx=vbx:km/h", "m/s that were divided by 3.6"),
        ("cmd_steer=-cmd_steer", "steering to the left is positive"),
        ("pitch=-pitch", "nose points down"),
        ("wz=wz:deg/s", "radians that were taken for degrees"),
    ]
    .into_iter()
    .enumerate()
    {
        let (code, said) = import(folder.path(), &format!("set{i}"), &["--column", column]);
        assert!(code == Some(0) && said.contains("doubt:") && said.contains(doubt), "{column} should raise `{doubt}`: {said}");
    }
    for (column, word) in [
        ("yaw=heading", "has no column `heading` (for `yaw`); it has t, x, y"),
        ("yaw=yaw:m", "allowed are rad, deg"),
        ("up=z", "no target `up`"),
    ] {
        let (code, said) = import(folder.path(), "refused", &["--column", column]);
        assert!(code == Some(2) && said.contains(word), "{column} should say `{word}`: {said}");
    }
    assert!(!folder.path().join("root/refused").exists(), "what was refused leaves nothing behind");
}
