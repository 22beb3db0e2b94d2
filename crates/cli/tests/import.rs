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

fn example() -> PathBuf {
    repository().join("docs/example/run.csv")
}

fn card() -> PathBuf {
    repository().join("tests/data/chrono_sample/vehicle_hmmwv.json")
}

/// Imports the example with further arguments; exit code and all that was said.
fn import(folder: &Path, set: &str, more: &[&str]) -> (Option<i32>, String) {
    import_of(folder, &example(), &card(), set, more)
}

/// The same with another log and card.
fn import_of(folder: &Path, log: &Path, card: &Path, set: &str, more: &[&str]) -> (Option<i32>, String) {
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

#[test]
fn service_time_stamps_in_nanoseconds_are_refused_without_their_unit() {
    let folder = tempfile::tempdir().unwrap();
    let text = std::fs::read_to_string(example()).unwrap();
    let in_ns = |line: &str| match line.split_once(',') {
        Some((t, rest)) if t != "t" => format!("{:.0},{rest}\n", 1e9 * (1.7e9 + t.parse::<f64>().unwrap())),
        _ => format!("{line}\n"),
    };
    let log = folder.path().join("log.csv");
    std::fs::write(&log, text.lines().map(in_ns).collect::<String>()).unwrap();
    let (code, said) = import_of(folder.path(), &log, &card(), "mine/first", &[]);
    assert!(code == Some(2) && said.contains("--column t=COLUMN:ns"), "{said}");
    assert!(!folder.path().join("root").exists(), "what was refused leaves nothing behind");
    let (code, said) = import_of(folder.path(), &log, &card(), "mine/first", &["--column", "t=t:ns"]);
    assert!(code == Some(0) && said.contains("120 samples, 10.0 Hz"), "{said}");
}

#[test]
fn service_a_card_that_does_not_fit_is_not_kept_and_a_second_one_does_not_count() {
    let folder = tempfile::tempdir().unwrap();
    let of_another = repository().join("deploy/bundles/clearpath-husky/vehicle.json");
    let (code, said) = import_of(folder.path(), &example(), &of_another, "first", &[]);
    assert!(code == Some(2) && said.contains("cmd_yaw_rate"), "{said}");
    assert!(!folder.path().join("root").exists(), "what was refused leaves nothing behind");
    let (code, said) = import(folder.path(), "first", &[]);
    assert!(code == Some(0) && !said.contains("counts"), "{said}");
    let (code, said) = import_of(folder.path(), &example(), &of_another, "second", &[]);
    assert!(code == Some(0) && said.contains("vehicle_hmmwv.json counts, the card of the data root"), "{said}");
}
