//! Repeats a recording and says what came out differently.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use nesam_model::{ModelBundle, Predictor};
use nesam_server::recording::{Ending, KindCount, Recording, RecordingError, RecordingHeader, ReplayReport, replay};
use serde_json::{Value, json};

use super::ReplayArgs;
use crate::failure::{Failure, OrFail};
use crate::interrupt;
use crate::output::{self, note, say};
use crate::sources::load_recorded_bundle;

/// Time between two lines of progress.
const SAY_EVERY: Duration = Duration::from_secs(10);

/// Runs the command on recordings: all of them, whatever comes out of one.
pub fn run(args: &ReplayArgs) -> Result<(), Failure> {
    interrupt::exit_on_ctrl_c("the replay was not finished");
    let recordings = Recording::open_all(&args.recording).or_input()?;
    let several = recordings.len() > 1;
    let (mut documents, mut wrong) = (Vec::new(), Vec::new());
    for recording in recordings {
        let run = recording.header().run.clone();
        let failed = match replay_one(args, recording) {
            Ok((document, failed)) => {
                documents.push(document);
                failed
            }
            Err(failure) if several => Some(failure.to_string()),
            Err(failure) => return Err(failure),
        };
        wrong.extend(failed.map(|reason| if several { format!("{run}: {reason}") } else { reason }));
    }
    if let Some(file) = &args.json {
        output::write_file(file, to_json(documents, several, wrong.is_empty()).as_bytes())?;
    }
    if wrong.is_empty() { Ok(()) } else { Err(Failure::Failed(wrong.join("; "))) }
}

/// Replays one recording and prints what came out; gives that as JSON, and what is wrong.
fn replay_one(args: &ReplayArgs, mut recording: Recording) -> Result<(Value, Option<String>), Failure> {
    let (header, files) = (recording.header().clone(), recording.files());
    let bundle = Arc::new(load_recorded_bundle(args.bundle.bundle.as_deref(), &header)?);
    let predictor = Arc::new(Predictor::new(Arc::clone(&bundle)).or_input()?.in_precision(header.precision));
    let started = Instant::now();
    let mut said = started;
    let mut progress = |commands: u64| {
        if said.elapsed() >= SAY_EVERY {
            said = Instant::now();
            note!("commands replayed: {commands} after {:.0} s", started.elapsed().as_secs_f64());
        }
    };
    let report = replay(&mut recording, predictor, args.force, &mut progress).map_err(|error| {
        let other_bundle = matches!(error, RecordingError::Bundle { .. });
        let hint = if other_bundle { "; give its bundle with --bundle DIR, or --force" } else { "" };
        Failure::Input(format!("{error}{hint}"))
    })?;
    print(&header, &report);
    let wrong = wrong(&report);
    Ok((document(&header, &bundle, &report, &files, wrong.is_none()), wrong))
}

/// Why a replay proves nothing, or the opposite of what it should; `None` where all is well.
fn wrong(report: &ReplayReport) -> Option<String> {
    let total = report.total();
    if total.different > 0 {
        return Some(format!("{} of {} answers differ", total.different, total.commands - total.not_executed));
    }
    if !report.all_equal() {
        return Some("the recording is damaged".into());
    }
    // A server that was asked nothing leaves a recording without an answer, which is whole.
    let whole = matches!(report.ending, Some(Ending::Finished { dropped_commands: 0, .. }));
    (total.equal == 0 && !whole).then(|| "no answer was compared: what is left of the recording holds none".into())
}

fn print(header: &RecordingHeader, report: &ReplayReport) {
    let precision = header.precision.as_str();
    say!("{}: {} with bundle {} in {precision} on {}, {:.1} s", header.run, header.program, header.bundle, header.machine, report.span_s);
    say!("{:<14}{:>12}{:>12}{:>12}{:>14}", "command", "recorded", "equal", "different", "not executed");
    let row = |name: &str, count: &KindCount| {
        say!("{name:<14}{:>12}{:>12}{:>12}{:>14}", count.commands, count.equal, count.different, count.not_executed);
    };
    for (kind, count) in &report.kinds {
        row(kind, count);
    }
    row("all", &report.total());
    if let Some(first) = &report.first_difference {
        let session = if first.session.is_empty() { String::new() } else { format!(", session {}", first.session) };
        say!("\nfirst difference: command {} ({}{session}) at {:.3} s, {}", first.command, first.kind, first.time_s, first.message);
        say!("  {}: recorded {}, now {}", first.field.field, first.field.recorded, first.field.replayed);
        for (what, here, there) in here_and_there(header).into_iter().filter(|(_, here, there)| here != there) {
            say!("  note: the {what} is {here}, recorded with {there}; last bits may differ for that alone");
        }
    }
    match &report.ending {
        Some(Ending::Finished { dropped_commands: 0, .. }) | None => {}
        Some(Ending::Finished { reason, dropped_commands }) => {
            say!("note: the recording ends because: {reason}; {dropped_commands} commands are not in it");
        }
        Some(Ending::CutOff) => say!("note: the recording was not finished (server killed, or file cut off); replayed as far as it goes"),
        Some(Ending::Damaged { reason }) => say!("note: the recording is damaged: {reason}; replayed as far as it goes"),
        Some(Ending::Missing { commands, first }) => {
            say!("note: {commands} commands from {first} on are missing, the disk could not follow; replayed until there");
        }
    }
}

/// What decides over last bits: (what, here, in the recording).
fn here_and_there(header: &RecordingHeader) -> [(&'static str, String, String); 2] {
    [
        ("program", RecordingHeader::this_program(), header.program.clone()),
        ("machine", RecordingHeader::this_machine(), header.machine.clone()),
    ]
}

/// One recording as it is; several under `runs`.
fn to_json(mut documents: Vec<Value>, several: bool, all_equal: bool) -> String {
    let document = match documents.pop() {
        Some(only) if !several => only,
        last => {
            documents.extend(last);
            json!({"schema": "nesam.replays/1", "all_equal": all_equal, "runs": documents})
        }
    };
    output::json_text(&document)
}

fn document(header: &RecordingHeader, bundle: &ModelBundle, report: &ReplayReport, files: &[PathBuf], all_equal: bool) -> Value {
    json!({
        "schema": "nesam.replay/1",
        "run": header.run,
        "files": files,
        "all_equal": all_equal,
        "total": report.total(),
        "kinds": report.kinds,
        "first_difference": report.first_difference,
        "ending": report.ending,
        "span_s": report.span_s,
        "recorded": {
            "program": header.program, "machine": header.machine, "precision": header.precision.as_str(),
            "bundle": header.bundle, "bundle_hash": header.bundle_hash,
        },
        "replayed": {
            "program": RecordingHeader::this_program(), "machine": RecordingHeader::this_machine(),
            "bundle": bundle.name, "bundle_hash": bundle.hash,
        },
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_a_replay_that_compares_nothing_is_no_proof() {
        // Goal: a recording that was cut off before its first answer passes no gate. Method: reports with each ending, with and without answers.
        let report = |equal: u64, different: u64, ending: Ending| {
            let count = KindCount { commands: equal + different, equal, different, not_executed: 0 };
            let kinds = [("measure".to_string(), count)].into();
            ReplayReport { kinds, first_difference: None, span_s: 0.0, ending: Some(ending) }
        };
        let finished = |dropped_commands| Ending::Finished { reason: "the server stopped".into(), dropped_commands };
        assert_eq!(wrong(&report(0, 0, finished(0))), None, "nothing was asked");
        assert_eq!(wrong(&report(3, 0, Ending::CutOff)), None, "as far as it goes");
        for ending in [Ending::CutOff, finished(2), Ending::Missing { commands: 2, first: 0 }] {
            let told = wrong(&report(0, 0, ending.clone())).unwrap();
            assert!(told.contains("no answer was compared"), "{ending:?}: {told}");
        }
        assert_eq!(wrong(&report(2, 1, Ending::CutOff)).unwrap(), "1 of 3 answers differ");
        assert_eq!(wrong(&report(2, 0, Ending::Damaged { reason: "a checksum".into() })).unwrap(), "the recording is damaged");
    }
}
