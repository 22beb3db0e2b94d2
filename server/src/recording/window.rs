//! What one session measured in a recording, and on which map.

use std::collections::BTreeMap;
use std::sync::Arc;

use nesam_engine::{AppliedEffect, Command, Measurement, Reply};
use nesam_proto::v1 as pb;
use nesam_terrain::WorldMap;
use prost::Message as _;

use super::command::{HeldMaps, of_entries};
use super::error::RecordingError;
use super::reader::Recording;
use super::topic::Topic;
use crate::convert::applied_effects;

/// The measurements of a session within a window of the vehicle's clock.
#[derive(Clone, Debug)]
pub struct RecordedWindow {
    /// The map that the session drove on; `None` without one.
    pub map: Option<Arc<WorldMap>>,
    /// Effects that the session predicts with at the end of the recording, applied over those of its bundle.
    pub applied: Vec<AppliedEffect>,
    /// Accepted measurements, in the order of the openings of the session and the starts and clocks of the vehicle, then by stamp.
    pub measurements: Vec<Measurement>,
}

/// Measurements of one clock: from an opening of the session, a start of the vehicle or a setting of its clock to the next.
struct Line {
    map: Option<String>,
    boot: Option<u64>,
    measurements: Vec<Measurement>,
}

/// Reads a recording to its end and keeps what a session has accepted with stamps from `from_ns` to `to_ns`. Where sessions of this name drove on several maps one
/// after the other, it is what was measured on the last of them that has something in the window.
///
/// Sessions that were imported into the recorded run are known by their name, their map by the name that they came with.
///
/// # Errors
/// `RecordingError::Unusable` for a command that cannot be read, `NoSession` for a session that is not in the recording, and the errors of
/// [`Recording::next_command`].
pub fn window(recording: &mut Recording, session: &str, from_ns: i64, to_ns: i64) -> Result<RecordedWindow, RecordingError> {
    let (run, limits) = (recording.header().run.clone(), recording.header().limits.clone());
    let within = |measurement: &Measurement| (from_ns..=to_ns).contains(&measurement.stamp_ns);
    let mut maps = HeldMaps::default();
    // Map of each session that was there.
    let mut map_of: BTreeMap<String, Option<String>> = BTreeMap::new();
    let mut lines: Vec<Line> = Vec::new();
    let mut applied = Vec::new();
    while let Some(recorded) = recording.next_command()? {
        let unreadable =
            |reason: String| RecordingError::unusable(run.as_ref(), format!("command {} cannot be read: {reason}", recorded.index));
        let command = of_entries(&recorded.asked, &limits, &maps).map_err(unreadable)?;
        let (topic, answer) = &recorded.answer;
        let told = (*topic == Topic::Session).then(|| pb::Session::decode(&answer[..]).ok()).flatten();
        if let Some(told) = told.filter(|told| told.session_id == session) {
            applied = applied_effects("", &told.effects).effects;
        }
        // Name, map and first measurement of a session that begins.
        let begun = match &command {
            Command::PutMap { .. } | Command::DeleteMap { .. } if *topic != Topic::Refused => {
                maps.follow(&command, &Ok(Reply::Done));
                None
            }
            Command::Open(open) if *topic == Topic::Session => {
                Some((named(&open.session, &open.vehicle), (!open.map.is_empty()).then(|| open.map.clone()), open.initial))
            }
            Command::Import { image, session: name } if *topic == Topic::Session => {
                Some((named(name, &image.session), image.map.as_ref().map(|(id, _)| id.clone()), None))
            }
            Command::Fork { session, copy } if *topic == Topic::Session => {
                Some((copy.as_str(), map_of.get(session).cloned().flatten(), None))
            }
            Command::Measure { session: of, measurement, .. } if of == session => {
                if let Some(renewed) = accepted(answer) {
                    let other_boot = |line: &Line| line.boot.zip(measurement.boot).is_some_and(|(before, now)| before != now);
                    if renewed || lines.last().is_none_or(other_boot) {
                        let map = map_of.get(session).cloned().flatten();
                        lines.push(Line { map, boot: measurement.boot, measurements: Vec::new() });
                    }
                    if let Some(line) = lines.last_mut() {
                        line.boot = measurement.boot.or(line.boot);
                        line.measurements.extend(Some(*measurement).filter(within));
                    }
                }
                None
            }
            _ => None,
        };
        if let Some((name, map, initial)) = begun {
            if name == session {
                let boot = initial.and_then(|measurement| measurement.boot);
                lines.push(Line { map: map.clone(), boot, measurements: initial.into_iter().filter(within).collect() });
            }
            map_of.insert(name.into(), map);
        }
    }
    let Some(last_map) = map_of.remove(session) else {
        return Err(RecordingError::NoSession { run, session: session.into() });
    };
    let map_id = lines.iter().rfind(|line| !line.measurements.is_empty()).map_or(last_map, |line| line.map.clone());
    lines.retain(|line| line.map == map_id);
    for line in &mut lines {
        line.measurements.sort_by_key(|m| m.stamp_ns);
    }
    let map = map_id.and_then(|id| maps.get(&id));
    Ok(RecordedWindow { map, applied, measurements: lines.into_iter().flat_map(|line| line.measurements).collect() })
}

/// Of the answer to an accepted measurement: whether another clock begins with it.
fn accepted(answer: &[u8]) -> Option<bool> {
    use pb::measurement_answer::Outcome;
    // A place is given to what was accepted; a duplicate has that of the newest one and is told by its outcome.
    let answer = pb::MeasurementAnswer::decode(answer).ok().filter(|answer| answer.place > 0)?;
    match answer.outcome {
        Some(Outcome::Duplicate(_)) => None,
        outcome => Some(matches!(outcome, Some(Outcome::Restarted(_) | Outcome::ClockJump(_)))),
    }
}

fn named<'a>(name: &'a str, otherwise: &'a str) -> &'a str {
    if name.is_empty() { otherwise } else { name }
}
