//! A server of the real binary, as tests of the command line start it.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

pub const BINARY: &str = env!("CARGO_BIN_EXE_nesam");

pub fn repository() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

/// A shipped bundle.
pub fn bundle(name: &str) -> String {
    repository().join("deploy/bundles").join(name).display().to_string()
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
