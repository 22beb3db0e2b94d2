//! The real binary as tests of the command line run it, alone or as a server, and what is shipped.
#![allow(dead_code, reason = "every test program takes its part of it")]

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::OnceLock;

pub const BINARY: &str = env!("CARGO_BIN_EXE_nesam");

pub fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().unwrap()
}

/// The committed sample of drives.
pub fn sample() -> PathBuf {
    repository().join("tests/data/chrono_sample")
}

/// A shipped bundle.
pub fn bundle(name: &str) -> String {
    repository().join("deploy/bundles").join(name).display().to_string()
}

/// Copies a folder with all that is in it.
pub fn copy_folder(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap().flatten() {
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy_folder(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).unwrap();
        }
    }
}

/// A bundle of two training steps: its errors mean nothing, everything else is real.
pub fn tiny_bundle() -> &'static Path {
    static BUNDLE: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    let (_, bundle) = BUNDLE.get_or_init(|| {
        let dir = tempfile::tempdir().unwrap();
        let root = sample().display().to_string();
        let tiny = ["--epochs", "1", "--batches", "2", "--encoder-steps", "3", "--batch-size", "4", "--out", "made"];
        let trained = nesam(&[&["train", "--data", &root, "--set", "nominal"], &tiny[..]].concat(), dir.path());
        assert_eq!(trained.status.code(), Some(0), "{}", stderr(&trained));
        let bundle = dir.path().join("made/bundle");
        (dir, bundle)
    });
    bundle
}

/// The binary with these arguments, in a folder.
pub fn command(args: &[&str], folder: &Path) -> Command {
    let mut command = Command::new(BINARY);
    command.args(args).current_dir(folder);
    command
}

/// Runs it to its end.
pub fn nesam(args: &[&str], folder: &Path) -> Output {
    command(args, folder).output().expect("the binary runs")
}

pub fn stdout(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

pub fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

/// Both of them.
pub fn said(output: &Output) -> String {
    stdout(output) + &stderr(output)
}

/// Runs it and checks exit code 2 and that stderr has every one of `words`.
pub fn refused(args: &[&str], folder: &Path, words: &[&str]) {
    let output = nesam(args, folder);
    let text = stderr(&output);
    assert_eq!(output.status.code(), Some(2), "{args:?}: {text}");
    for word in words {
        assert!(text.contains(word), "{args:?} should say `{word}`: {text}");
    }
    assert!(!text.contains("panicked"), "{text}");
}

/// Sends a signal to a process.
pub fn send(signal: &str, to: &Child) {
    assert!(Command::new("kill").args([signal, &to.id().to_string()]).status().unwrap().success());
}

/// Starts a server without Zenoh in a folder and gives its process and what it said before it was ready.
pub fn start(folder: &Path, options: &[&str]) -> (Child, Vec<String>) {
    start_on(folder, &bundle("hmmwv-nominal"), options)
}

/// The same with another bundle.
pub fn start_on(folder: &Path, bundle: &str, options: &[&str]) -> (Child, Vec<String>) {
    // It hears a terminal close, also where the tests do not (nohup).
    let mut server = Command::new("env")
        .args(["--default-signal=HUP", BINARY, "serve", "--bundle", bundle, "--grpc", "127.0.0.1:0", "--no-zenoh"])
        .args(options)
        .current_dir(folder)
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let lines = BufReader::new(server.stdout.take().unwrap()).lines().map(Result::unwrap);
    let told = lines.take_while(|l| !l.starts_with("ready")).collect();
    (server, told)
}

/// What a server said after a word.
pub fn told<'a>(lines: &'a [String], word: &str) -> Option<&'a str> {
    lines.iter().find_map(|l| l.strip_prefix(word)).map(str::trim)
}
