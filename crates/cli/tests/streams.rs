//! Goal: what happens to the work when a stream is full or closed, or somebody presses Ctrl-C. Method: the real binary on the committed sample, with `/dev/full`
//! or a closed pipe in the place of a stream; exit codes, files and the words of the messages are the contract.
#![allow(clippy::unwrap_used)]

mod common;

use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Read};
use std::process::Stdio;
use std::time::Duration;

use common::{bundle, command, sample, send};

/// A device that takes nothing.
fn full() -> File {
    OpenOptions::new().write(true).open("/dev/full").unwrap()
}

/// Lines up to the first that has a word, that line included.
fn lines_until(lines: &mut impl Iterator<Item = std::io::Result<String>>, word: &str) -> Vec<String> {
    let mut read = Vec::new();
    for line in lines {
        read.push(line.unwrap());
        if read.last().is_some_and(|line| line.contains(word)) {
            return read;
        }
    }
    panic!("no line with `{word}`: {read:?}");
}

/// Remarks and progress are lost with the stream that they were for; results are not.
#[test]
fn service_standard_error_that_takes_nothing_costs_no_results() {
    let here = tempfile::tempdir().unwrap();
    let root = sample().display().to_string();
    let files = ["--json", "e.json", "--html", "e.html"];
    let args = [&["evaluate", "--data", &root, "--set", "nominal", "--models", "constant_velocity"][..], &files].concat();
    let mut on_full = command(&args, here.path()).stdout(Stdio::null()).stderr(full()).spawn().unwrap();
    assert_eq!(on_full.wait().unwrap().code(), Some(0), "/dev/full");
    std::fs::remove_file(here.path().join("e.json")).unwrap();
    let mut on_closed = command(&args, here.path()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    drop(on_closed.stderr.take());
    assert_eq!(on_closed.wait().unwrap().code(), Some(0), "a closed pipe");
    assert!(here.path().join("e.json").exists());
    let wrong = command(&["evaluate", "--data", "nowhere"], here.path()).stderr(full()).status().unwrap();
    assert_eq!(wrong.code(), Some(2), "the exit code is told all the same");
}

/// A server logs on standard error; a line that is lost there must not end it, nor the call that logged.
#[test]
fn service_a_server_outlives_a_full_standard_error() {
    let here = tempfile::tempdir().unwrap();
    let bundle = bundle("hmmwv-nominal");
    let args = ["serve", "--bundle", &bundle, "--grpc", "127.0.0.1:0", "--no-http", "--no-zenoh"];
    let mut server = command(&args, here.path()).env("RUST_LOG", "info").stdout(Stdio::piped()).stderr(full()).spawn().unwrap();
    let mut lines = BufReader::new(server.stdout.take().unwrap()).lines();
    let told = lines_until(&mut lines, "ready");
    let grpc = told.iter().find_map(|l| l.strip_prefix("grpc")).expect("the address of grpc");
    std::net::TcpStream::connect(grpc.trim()).expect("somebody listens there");
    send("-TERM", &server);
    assert_eq!(server.wait().unwrap().code(), Some(0));
    assert_eq!(lines.last().unwrap().unwrap(), "stopped");
}

/// A prediction that standard output did not take was not given; a reader that has enough is no failure.
#[test]
fn service_results_that_standard_output_loses_are_a_failure() {
    let here = tempfile::tempdir().unwrap();
    let (root, bundle) = (sample().display().to_string(), bundle("hmmwv-nominal"));
    let args = ["predict", "--data", &root, "--set", "nominal", "--bundle", &bundle, "--horizon", "5"];
    let lost = command(&args, here.path()).stdout(full()).stderr(Stdio::piped()).output().unwrap();
    let said = String::from_utf8_lossy(&lost.stderr).into_owned();
    assert!(lost.status.code() == Some(1) && said.contains("error: cannot write to standard output"), "{said}");
    let mut enough = command(&args, here.path()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    drop(enough.stdout.take());
    assert_eq!(enough.wait().unwrap().code(), Some(0), "a closed pipe");
}

/// Goal: a bench that is interrupted says so. Method: far more queries than the test waits for; the note on the sample comes after Ctrl-C is caught.
#[test]
fn service_an_interrupted_bench_says_that_nothing_was_written() {
    let bundle = bundle("hmmwv-nominal");
    let args = ["bench", "predict", "--bundle", &bundle, "--queries", "1000000", "--json", "never.json"];
    let mut bench = command(&args, &sample()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(bench.stderr.take().unwrap()).lines();
    lines_until(&mut lines, "no --data given");
    // The thread that waits for the signal was started before the note, not necessarily running.
    std::thread::sleep(Duration::from_millis(500));
    send("-INT", &bench);
    lines_until(&mut lines, "interrupted: nothing was written");
    assert_eq!(bench.wait().unwrap().code(), Some(1));
}

/// Goal: the first Ctrl-C ends what comes before the first step, finished encoders are kept, and what is said of --resume is true. Method: Ctrl-C while the drive
/// line is fitted and once both encoders are; then the same command with --resume.
#[test]
fn service_an_interrupted_training_stops_and_keeps_finished_encoders() {
    let here = tempfile::tempdir().unwrap();
    let root = sample().display().to_string();
    let tiny = ["--epochs", "1", "--batches", "20", "--encoder-steps", "3", "--batch-size", "4"];
    let args = [&["train", "--data", &root, "--set", "nominal"][..], &tiny].concat();
    for (after, interrupted) in [("symbolic model alone", "while the vehicle's card was calibrated"), ("semantic encoder:", "interrupted")]
    {
        let mut training = command(&args, here.path()).stderr(Stdio::piped()).spawn().unwrap();
        let mut said = BufReader::new(training.stderr.take().unwrap());
        lines_until(&mut said.by_ref().lines(), after);
        send("-INT", &training);
        let mut rest = String::new();
        said.read_to_string(&mut rest).unwrap();
        assert_eq!(training.wait().unwrap().code(), Some(1), "{rest}");
        assert!(rest.contains(interrupted) && rest.contains("the same command with --resume"), "{rest}");
        assert!(!rest.contains("NaN"), "{rest}");
    }
    let output = command(&[&args[..], &["--resume"]].concat(), here.path()).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success() && said.contains("encoders taken from"), "{said}");
    assert!(here.path().join("nesam-out/train-nominal/bundle/manifest.toml").exists(), "the folder is named after the set");
}
