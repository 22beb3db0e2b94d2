//! Doing a recorded run again and comparing every answer.

use std::collections::BTreeMap;
use std::sync::Arc;

use nesam_engine::{Engine, Limits, execute_guarded};
use nesam_model::Predictor;
use nesam_proto::v1 as pb;
use prost::Message as _;
use serde::Serialize;

use super::answer::{not_executed, to_entry, without_timing};
use super::command::{HeldMaps, of_entries};
use super::difference::{FieldDifference, first_difference};
use super::error::RecordingError;
use super::reader::{Ending, RecordedCommand, Recording};
use super::schema::Descriptors;
use super::topic::Topic;
use crate::call::Timing;

/// Commands of one kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct KindCount {
    /// Commands recorded.
    pub commands: u64,
    /// Answers that came out bit for bit.
    pub equal: u64,
    /// Answers that did not.
    pub different: u64,
    /// Predictions that the server did not compute, or not to the end, because the asker had gone or the deadline had passed.
    pub not_executed: u64,
}

/// The first answer that came out differently.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Difference {
    /// Number of the command in the run.
    pub command: u64,
    /// Its kind.
    pub kind: String,
    /// Session that it names; empty where it names none.
    pub session: String,
    /// Time since the start of the engine's clock, s.
    pub time_s: f64,
    /// Type of the answer.
    pub message: String,
    /// Where the answers differ.
    #[serde(flatten)]
    pub field: FieldDifference,
}

/// What a replay found.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ReplayReport {
    /// By kind of command.
    pub kinds: BTreeMap<String, KindCount>,
    /// The first difference.
    pub first_difference: Option<Difference>,
    /// Time that the recorded commands span, s.
    pub span_s: f64,
    /// How the recording ends.
    pub ending: Option<Ending>,
}

impl ReplayReport {
    /// Sums over all kinds.
    pub fn total(&self) -> KindCount {
        self.kinds.values().fold(KindCount::default(), |sum, kind| KindCount {
            commands: sum.commands + kind.commands,
            equal: sum.equal + kind.equal,
            different: sum.different + kind.different,
            not_executed: sum.not_executed + kind.not_executed,
        })
    }

    /// Whether every answer that could be compared came out the same and the bytes of the recording are sound.
    pub fn all_equal(&self) -> bool {
        self.total().different == 0 && !matches!(self.ending, Some(Ending::Damaged { .. }))
    }
}

/// Executes the commands of a recording on a fresh engine. `force` accepts another bundle than the recorded one; `progress` is told the number of
/// commands so far.
///
/// # Errors
/// `RecordingError::Bundle` for another bundle without `force`, `Engine` when no engine can be made of it, the errors of
/// [`Recording::next_command`], `Unusable` for a command that cannot be read.
pub fn replay(
    recording: &mut Recording,
    predictor: Arc<Predictor>,
    force: bool,
    progress: &mut dyn FnMut(u64),
) -> Result<ReplayReport, RecordingError> {
    let shared = Arc::clone(&predictor);
    let bundle = shared.bundle();
    let header = recording.header();
    if header.bundle_hash != bundle.hash && !force {
        return Err(RecordingError::Bundle {
            recorded_name: header.bundle.clone(),
            recorded: header.bundle_hash.clone(),
            given_name: bundle.name.clone(),
            given: bundle.hash.clone(),
        });
    }
    let limits = header.limits.clone();
    let run = header.run.clone();
    let unusable = |reason: String| RecordingError::Engine { bundle: bundle.name.clone(), reason };
    let mut engine = Engine::new(predictor, limits.clone()).map_err(|error| unusable(error.to_string()))?;
    if header.fleet_soil.enabled {
        engine = engine.with_fleet_soil((&header.fleet_soil).into()).map_err(|error| unusable(error.to_string()))?;
    }
    let mut again = Again { engine, limits, maps: HeldMaps::default(), descriptors: Descriptors::of_program() };
    let mut report = ReplayReport { kinds: BTreeMap::new(), first_difference: None, span_s: 0.0, ending: None };
    let mut first_ns = None;
    while let Some(recorded) = recording.next_command()? {
        let since_ns = recorded.now_ns.saturating_sub(*first_ns.get_or_insert(recorded.now_ns));
        report.span_s = since_ns as f64 * 1e-9;
        let (kind, outcome) = again
            .execute(&recorded, &bundle.vehicle)
            .map_err(|reason| RecordingError::unusable(run.as_ref(), format!("command {} cannot be read: {reason}", recorded.index)))?;
        let count = report.kinds.entry(kind.to_string()).or_default();
        count.commands += 1;
        match outcome {
            Outcome::Equal => count.equal += 1,
            Outcome::NotExecuted => count.not_executed += 1,
            Outcome::Different(difference) => {
                count.different += 1;
                report.first_difference = report.first_difference.take().or(Some(difference));
            }
        }
        progress(recorded.index);
    }
    report.ending = recording.ending().cloned();
    Ok(report)
}

/// What became of one command.
enum Outcome {
    Equal,
    Different(Difference),
    NotExecuted,
}

/// The engine that does it again.
struct Again {
    engine: Engine,
    limits: Limits,
    maps: HeldMaps,
    descriptors: Descriptors,
}

impl Again {
    fn execute(&mut self, recorded: &RecordedCommand, vehicle: &nesam_physics::Vehicle) -> Result<(&'static str, Outcome), String> {
        let command = of_entries(&recorded.asked, &self.limits, &self.maps)?;
        let kind = command.label();
        if not_executed(&recorded.answer) {
            self.engine.touch(recorded.now_ns, command.uses());
            return Ok((kind, Outcome::NotExecuted));
        }
        let result = execute_guarded(&mut self.engine, recorded.now_ns, &command);
        self.maps.follow(&command, &result);
        let (topic, replayed) = to_entry(&command, &result, vehicle, Timing::default());
        let (recorded_topic, expected) = (recorded.answer.0, without_timing(&recorded.answer));
        if topic == recorded_topic && expected == replayed {
            return Ok((kind, Outcome::Equal));
        }
        let field = match topic == recorded_topic {
            true => first_difference(&self.descriptors, topic.message(), &expected, &replayed),
            false => Some(FieldDifference {
                field: "answer".into(),
                recorded: said(recorded_topic, &expected),
                replayed: said(topic, &replayed),
            }),
        };
        let unnamed = || FieldDifference { field: "encoding".into(), recorded: "other bytes".into(), replayed: "other bytes".into() };
        Ok((
            kind,
            Outcome::Different(Difference {
                command: recorded.index,
                kind: kind.into(),
                session: session_of(&command).into(),
                time_s: recorded.now_ns as f64 * 1e-9,
                message: recorded_topic.message().into(),
                field: field.unwrap_or_else(unnamed),
            }),
        ))
    }
}

/// An answer of another type in one line: a refusal says why.
fn said(topic: Topic, data: &[u8]) -> String {
    let why = match topic {
        Topic::Refused => pb::Refusal::decode(data).map(|refusal| refusal.message).ok(),
        Topic::PredictionError => pb::PredictError::decode(data).map(|error| error.message).ok(),
        _ => None,
    };
    why.map_or_else(|| topic.message().into(), |why| format!("{}: {why}", topic.message()))
}

/// Session that a command names.
fn session_of(command: &nesam_engine::Command) -> &str {
    use nesam_engine::Command;
    match command {
        Command::Open(open) => {
            if open.session.is_empty() {
                &open.vehicle
            } else {
                &open.session
            }
        }
        Command::Get { session }
        | Command::Fork { session, .. }
        | Command::Export { session }
        | Command::Import { session, .. }
        | Command::Close { session }
        | Command::Measure { session, .. } => session,
        Command::Predict(query) => &query.session,
        _ => "",
    }
}
