//! Diagnoses of what was recorded, started by clients.
//!
//! A diagnosis is minutes of work on all that a session measured. It runs as `nesam diagnose --recording` in a process of its own (ADR 0063), so that it can
//! neither stop the service nor take its memory: what it does is heard on its standard error, what it found is read from its JSON. Whoever waits for it holds
//! it: when the call ends, for whatever reason, the process is killed and its folder removed.
//!
//! ```text
//! Start ──► Diagnoses::prepare ──► Work::run ──► nesam diagnose ──► lines of progress, diagnose.json, bundle/
//! ```

mod folder;
mod line;
mod report;
mod work;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use nesam_engine::check_name;
use nesam_proto::v1 as pb;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tonic::{Code, Status};

use crate::config::{Config, DiagnosisConfig};
use crate::convert::{refused, to_status};
use crate::recording::{Recorder, Recording, utc};
use crate::web::Live;

pub use report::knows_report;
pub(crate) use work::Told;

/// Runs before the present one in which a window is looked for.
const RUNS_BEFORE: usize = 3;

/// What a server needs to diagnose.
#[derive(Debug)]
pub(crate) struct Diagnoses {
    config: DiagnosisConfig,
    /// Folder for reports and bundles, from the root on: reports name it.
    directory: PathBuf,
    /// Folder with the recordings of this server.
    recordings: PathBuf,
    recorder: Option<Arc<Recorder>>,
    /// One for each that may run at a time.
    places: Arc<Semaphore>,
    /// Shows reports.
    live: Live,
}

/// Parts of a recording.
#[derive(Debug)]
struct Source {
    /// Name of the run.
    run: String,
    files: Vec<PathBuf>,
    /// Whether it is being written.
    live: bool,
}

/// A diagnosis that may begin.
#[derive(Debug)]
pub(crate) struct Work {
    diagnoses: Arc<Diagnoses>,
    asked: pb::StartDiagnosisRequest,
    source: Source,
    /// Held until it has ended.
    _place: OwnedSemaphorePermit,
}

impl Diagnoses {
    /// Of a server with this configuration.
    pub fn new(config: &Config, recorder: Option<Arc<Recorder>>, live: Live) -> Self {
        let directory = &config.diagnosis.directory;
        Self {
            directory: std::path::absolute(directory).unwrap_or_else(|_| directory.clone()),
            recordings: config.recording.directory.clone(),
            recorder,
            places: Arc::new(Semaphore::new(config.diagnosis.at_once)),
            live,
            config: config.diagnosis.clone(),
        }
    }

    /// The program that is run with the arguments of `nesam diagnose`.
    ///
    /// # Errors
    /// INTERNAL when this program does not know where it is.
    fn program(&self) -> Result<PathBuf, Status> {
        let named = &self.config.executable;
        if !named.as_os_str().is_empty() {
            return Ok(named.clone());
        }
        std::env::current_exe().map_err(|error| {
            Status::internal(format!("nesam diagnose: where this program lies is not known: {error}; `diagnosis.executable` names it"))
        })
    }

    /// Longest duration of one.
    pub fn longest(&self) -> Duration {
        Duration::from_secs_f64(self.config.limit_s)
    }

    /// Looks whether a diagnosis can be made, and takes a place for it.
    ///
    /// # Errors
    /// INVALID_ARGUMENT, NOT_FOUND or FAILED_PRECONDITION naming the field; RESOURCE_EXHAUSTED when as many run as may.
    pub fn prepare(self: &Arc<Self>, asked: pb::StartDiagnosisRequest) -> Result<Work, Status> {
        check_name("session_id", &asked.session_id).map_err(to_status)?;
        if pb::DiagnosisReference::try_from(asked.reference).is_err() {
            return Err(refused(Code::InvalidArgument, "reference", format!("{} is none that this server knows", asked.reference)));
        }
        if asked.from_stamp_ns.zip(asked.to_stamp_ns).is_some_and(|(from, to)| to < from) {
            return Err(refused(Code::InvalidArgument, "to_stamp_ns", "lies before from_stamp_ns"));
        }
        let source = self.source(&asked.recording, asked.from_stamp_ns)?;
        let most = self.config.at_once;
        let place = Arc::clone(&self.places).try_acquire_owned().map_err(|_| {
            let reason = format!("{most} may run at a time, as many as run now; wait for one to end, or raise `diagnosis.at_once`");
            refused(Code::ResourceExhausted, "diagnosis.at_once", reason)
        })?;
        Ok(Work { diagnoses: Arc::clone(self), asked, source, _place: place })
    }

    /// The parts of what this server recorded in its runs before, as far as it may still matter: an alarm lasts over a restart.
    fn before(&self, run: &str) -> Vec<PathBuf> {
        let entries = std::fs::read_dir(&self.recordings).into_iter().flatten().flatten().map(|entry| entry.path());
        let runs: BTreeSet<String> =
            entries.filter_map(|path| run_of(&path).map(String::from)).filter(|other| other.as_str() < run).collect();
        let parts = runs.iter().rev().take(RUNS_BEFORE).map(|run| parts_of(&self.recordings, run));
        // One that ended before it began, or that somebody has cleared in part, keeps nothing from being diagnosed.
        parts.filter(|parts| Recording::open(parts).is_ok()).flatten().collect()
    }

    /// The named recording; an empty name means the one that is being written, and for a window that began at
    /// some stamp those before, if there is not enough in it.
    fn source(&self, named: &str, since: Option<i64>) -> Result<Source, Status> {
        let now = self.recorder.as_ref().map(|recorder| recorder.parts()).unwrap_or_default();
        let run = now.first().and_then(|part| run_of(part));
        if let Some(run) = run.filter(|run| named.is_empty() || named == *run) {
            let ended = self.recorder.as_ref().and_then(|recorder| recorder.ended_unix_ns());
            if let Some(ended_unix_ns) = ended.filter(|_| named.is_empty()) {
                let at = utc(ended_unix_ns.unsigned_abs() / 1_000_000_000);
                let reason = format!(
                    "this server records nothing since {at}: its disk failed or `recording.bytes_max` is reached; name `{run}` to diagnose what was measured \
                     before, or restart the server"
                );
                return Err(refused(Code::FailedPrecondition, "recording", reason));
            }
            let mut files = if named.is_empty() && since.is_some() { self.before(run) } else { Vec::new() };
            files.extend(now.clone());
            return Ok(Source { run: run.into(), files, live: ended.is_none() });
        }
        if named.is_empty() {
            let reason =
                "this server records nothing; start it with `nesam serve --record DIR` (`recording.enabled`), or name an earlier recording";
            return Err(refused(Code::FailedPrecondition, "recording", reason));
        }
        check_name("recording", named).map_err(to_status)?;
        let files = parts_of(&self.recordings, named);
        if files.is_empty() {
            let reason = format!("`{named}` is not in the folder of the recordings of this server (`recording.directory`)");
            return Err(refused(Code::NotFound, "recording", reason));
        }
        Ok(Source { run: named.into(), files, live: false })
    }
}

/// Name of the run that a part belongs to: `<run>.<part>.mcap`.
fn run_of(path: &Path) -> Option<&str> {
    let (run, part) = path.file_name()?.to_str()?.strip_suffix(".mcap")?.rsplit_once('.')?;
    (!part.is_empty() && part.bytes().all(|byte| byte.is_ascii_digit())).then_some(run)
}

/// The parts of a run in a folder; none when there is no such folder.
fn parts_of(folder: &Path, run: &str) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    let mut parts: Vec<PathBuf> = entries.filter(|path| run_of(path) == Some(run)).collect();
    parts.sort();
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: a recording is found by the name of its run alone, whatever else lies beside it. Method: a folder with parts of two runs and strangers.
    #[test]
    fn property_the_parts_of_a_run_are_those_of_its_name() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["a.0002.mcap", "a.0001.mcap", "a.mcap", "a.b.0001.mcap", "ab.0001.mcap", "a.0001.mcap.part", "a.x.mcap", "a..mcap"] {
            std::fs::write(folder.path().join(name), "").unwrap();
        }
        let found = |run: &str| -> Vec<String> {
            parts_of(folder.path(), run).iter().filter_map(|path| Some(path.file_name()?.to_str()?.to_string())).collect()
        };
        assert_eq!(found("a"), ["a.0001.mcap", "a.0002.mcap"]);
        assert_eq!(found("a.b"), ["a.b.0001.mcap"]);
        assert_eq!(found(".."), [""; 0]);
        assert_eq!(parts_of(&folder.path().join("none"), "a"), Vec::<PathBuf>::new());
    }
}
