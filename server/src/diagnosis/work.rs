//! One diagnosis, from its process to its report.

use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use nesam_proto::v1 as pb;
use nesam_proto::v1::diagnosis_event::Event;
use tokio::io::{AsyncBufReadExt as _, AsyncRead, BufReader};
use tokio::process::Command;
use tokio::sync::mpsc;
use tonic::{Code, Status};

use super::folder::Folder;
use super::line::Line;
use super::{Work, refused, report};
use crate::clock::unix_ns;
use crate::recording::FLUSH_EVERY;

/// After this everything that was recorded before is in the file: twice the interval at which a recording is flushed.
const WRITTEN_AFTER: Duration = FLUSH_EVERY.saturating_mul(2);
/// Remarks of the command that are kept.
const NOTES_MAX: usize = 16;
/// Characters of the command's reason that are told: a status has to fit into headers.
const REASON_CHARS_MAX: usize = 1000;

/// Where the events of a diagnosis go.
pub(crate) type Told = mpsc::Sender<Result<pb::DiagnosisEvent, Status>>;

/// What the command said beside its progress.
#[derive(Debug, Default)]
struct Said {
    notes: Vec<String>,
    /// Why it failed, all lines of it.
    error: Option<String>,
    /// The last line that is none of these: of a process that broke down there is no more.
    last: String,
}

impl Work {
    /// Runs it and tells what happens, the report last. Dropping the future kills the process and removes what it wrote.
    ///
    /// # Errors
    /// FAILED_PRECONDITION with the command's reason where the input is at fault, INTERNAL where the work is.
    pub async fn run(self, told: &Told) -> Result<(), Status> {
        let Self { diagnoses, asked, source, .. } = &self;
        let (session, directory) = (asked.session_id.as_str(), &diagnoses.directory);
        let made = {
            let (directory, session) = (directory.clone(), session.to_string());
            beside(move || Folder::make(&directory, unix_ns(), &session)).await?
        };
        let folder = made.map_err(|error| {
            let reason = format!("{} cannot be written: {error}", directory.display());
            refused(Code::FailedPrecondition, "diagnosis.directory", reason)
        })?;
        let (from_stamp_ns, to_stamp_ns) = (asked.from_stamp_ns, asked.to_stamp_ns);
        let started = pb::DiagnosisStarted { diagnosis_id: folder.name(), recording: source.run.clone(), from_stamp_ns, to_stamp_ns };
        tell(told, Event::Started(started)).await;
        tracing::info!(session, diagnosis = folder.name(), recording = source.run, "diagnosis started");
        if source.live {
            tokio::time::sleep(WRITTEN_AFTER).await;
        }
        let program = diagnoses.program()?;
        let mut child = self.command(&program, folder.path()).spawn().map_err(|error| {
            let reason = format!("nesam diagnose: {} does not start: {error}; `diagnosis.executable` names the program", program.display());
            Status::internal(reason)
        })?;
        let said = match child.stderr.take() {
            Some(stderr) => listen(stderr, told).await,
            None => Said::default(),
        };
        let status = child.wait().await.map_err(|error| Status::internal(format!("nesam diagnose: {error}")))?;
        if !status.success() {
            return Err(said.failure(status.code(), &status.to_string()));
        }
        let read = {
            let (path, name) = (folder.path().to_path_buf(), folder.name());
            beside(move || report::read(&path, name, said.notes)).await?
        };
        let report = read.map_err(|reason| Status::internal(format!("nesam diagnose {reason}")))?;
        let verdict = report.verdict().as_str_name();
        tracing::info!(session, diagnosis = folder.name(), verdict, effects = report.effects.len(), "diagnosis finished");
        let kept_max = diagnoses.config.kept_max;
        beside(move || folder.keep(kept_max)).await?;
        diagnoses.live.reports.look_again();
        tell(told, Event::Report(report)).await;
        Ok(())
    }

    /// The command that makes the diagnosis and leaves everything in `folder`.
    fn command(&self, program: &Path, folder: &Path) -> Command {
        let (config, asked) = (&self.diagnoses.config, &self.asked);
        let mut command = Command::new(program);
        command.arg("diagnose").arg("--recording").args(&self.source.files).arg(format!("--session={}", asked.session_id));
        if !config.bundle.as_os_str().is_empty() {
            command.arg("--bundle").arg(&config.bundle);
        }
        if let Some(from_ns) = asked.from_stamp_ns {
            command.arg(format!("--from-ns={from_ns}"));
        }
        if let Some(to_ns) = asked.to_stamp_ns {
            command.arg(format!("--to-ns={to_ns}"));
        }
        if let Some(seed) = asked.seed {
            command.arg(format!("--seed={seed}"));
        }
        command.arg(match asked.reference() {
            pb::DiagnosisReference::Physics => "--reference=physics",
            pb::DiagnosisReference::Bundle | pb::DiagnosisReference::Unspecified => "--reference=bundle",
        });
        if asked.without_controls {
            command.arg("--no-controls");
        }
        command.arg("--out").arg(folder);
        command.env("RAYON_NUM_THREADS", config.threads.to_string());
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::piped()).kill_on_drop(true);
        command
    }
}

/// What work on files gives, on a thread that may wait for the disk.
///
/// # Errors
/// INTERNAL when it panicked.
async fn beside<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, Status> {
    tokio::task::spawn_blocking(work)
        .await
        .map_err(|_| Status::internal("files of the diagnosis: the work on them panicked; this is a bug"))
}

impl Said {
    /// Takes a line; gives the progress where it tells some.
    fn hear(&mut self, line: &str) -> Option<pb::DiagnosisProgress> {
        if let Some(error) = &mut self.error {
            // The reason goes on over several lines.
            error.push('\n');
            error.push_str(line);
            return None;
        }
        match Line::of(line) {
            Line::Progress { stage, done, total } => return Some(pb::DiagnosisProgress { stage: stage.into(), done, total }),
            Line::Note(note) if self.notes.len() < NOTES_MAX => self.notes.push(note.into()),
            Line::Error(error) => self.error = Some(error.into()),
            Line::Other(text) if !text.trim().is_empty() => self.last = text.into(),
            _ => {}
        }
        None
    }

    /// Why the process failed. Exit code 2 means that the input is at fault.
    fn failure(self, code: Option<i32>, status: &str) -> Status {
        let short = |text: &str| text.chars().take(REASON_CHARS_MAX).collect::<String>();
        match (self.error, code) {
            (Some(reason), Some(2)) => Status::failed_precondition(short(&reason)),
            (Some(reason), _) => Status::internal(format!("nesam diagnose: {}", short(&reason))),
            (None, _) => Status::internal(format!("nesam diagnose ended with {status}; its last words: {}", short(&self.last))),
        }
    }
}

/// Hears the command until it closes its standard error. Whoever does not read in time misses progress, nothing else.
async fn listen(stderr: impl AsyncRead + Unpin, told: &Told) -> Said {
    let mut said = Said::default();
    let mut lines = BufReader::new(stderr).lines();
    while let Ok(Some(line)) = lines.next_line().await {
        if let Some(progress) = said.hear(&line) {
            let _ = told.try_send(Ok(pb::DiagnosisEvent { event: Some(Event::Progress(progress)) }));
        }
    }
    said
}

async fn tell(told: &Told, event: Event) {
    // Nobody there any more: the call is about to end, and with it this.
    let _ = told.send(Ok(pb::DiagnosisEvent { event: Some(event) })).await;
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: progress is passed on, remarks are gathered, and a failure is told in the words of the command with the code that its exit code means. Method:
    /// standard error as the command writes it.
    #[tokio::test]
    async fn analytic_what_the_command_says_is_told() {
        let (told, mut heard) = mpsc::channel(8);
        let text = "note: another bundle\nhypotheses: 1/2 after 10 s\nhypotheses: 2 in 20.0 s\nerror: first line\nsecond: 3 in 1.0 s\n";
        let said = listen(text.as_bytes(), &told).await;
        drop(told);
        let mut progress = Vec::new();
        while let Some(Ok(pb::DiagnosisEvent { event: Some(Event::Progress(one)) })) = heard.recv().await {
            progress.push((one.stage, one.done, one.total));
        }
        assert_eq!(progress, [("hypotheses".to_string(), 1, 2), ("hypotheses".to_string(), 2, 2)]);
        assert_eq!(said.notes, ["another bundle"]);
        let failure = said.failure(Some(2), "exit status: 2");
        assert_eq!((failure.code(), failure.message()), (Code::FailedPrecondition, "first line\nsecond: 3 in 1.0 s"));

        for (text, code, part) in [
            ("error: the disk is full\n", Some(1), "the disk is full"),
            ("thread 'main' panicked at somewhere\n\n", Some(101), "panicked at somewhere"),
            ("hypotheses: 2 in 20.0 s\n", None, "ended with signal: 9"),
        ] {
            let (told, _heard) = mpsc::channel(8);
            let failure = listen(text.as_bytes(), &told).await.failure(code, "signal: 9");
            assert!(failure.code() == Code::Internal && failure.message().contains(part), "{text:?}: {failure:?}");
        }
        // A reason that no header holds is cut.
        let (told, _heard) = mpsc::channel(8);
        let long = format!("error: {}\n", "é".repeat(5000));
        assert_eq!(listen(long.as_bytes(), &told).await.failure(Some(2), "").message().chars().count(), REASON_CHARS_MAX);
    }
}
