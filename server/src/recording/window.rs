//! What one session measured in a recording, and on which map.

use std::collections::BTreeMap;
use std::sync::Arc;

use nesam_engine::{Command, Limits, Measurement, Reply};
use nesam_proto::v1 as pb;
use nesam_terrain::WorldMap;
use prost::Message as _;

use super::command::{HeldMaps, of_entries};
use super::error::RecordingError;
use super::reader::Recording;
use super::topic::Topic;

/// The measurements of a session within a window of the vehicle's clock.
#[derive(Clone, Debug)]
pub struct RecordedWindow {
    /// The map that the session drove on, as it was last; `None` without one.
    pub map: Option<Arc<WorldMap>>,
    /// Accepted measurements, by start of the vehicle's software, then by stamp.
    pub measurements: Vec<Measurement>,
}

/// Reads a recording to its end and keeps what a session has accepted with stamps from `from_ns` to `to_ns`.
///
/// Sessions that were imported into the recorded run are known by their name, their map by the name that they came with.
///
/// # Errors
/// `RecordingError::Unusable` for a command that cannot be read or a session that is not in the recording, and the errors of
/// [`Recording::next_command`].
pub fn window(recording: &mut Recording, session: &str, from_ns: i64, to_ns: i64) -> Result<RecordedWindow, RecordingError> {
    let (run, limits) = (recording.header().run.clone(), Limits::from(&recording.header().limits));
    let mut maps = HeldMaps::default();
    // Map of each session that was there.
    let mut map_of: BTreeMap<String, Option<String>> = BTreeMap::new();
    // Starts of the vehicle in the order in which they were seen.
    let mut starts: Vec<(Option<u64>, Vec<Measurement>)> = Vec::new();
    while let Some(recorded) = recording.next_command()? {
        let unreadable =
            |reason: String| RecordingError::unusable(run.as_ref(), format!("command {} cannot be read: {reason}", recorded.index));
        let command = of_entries(&recorded.asked, &limits, &maps).map_err(unreadable)?;
        let (topic, answer) = &recorded.answer;
        match &command {
            Command::PutMap { .. } | Command::DeleteMap { .. } if *topic != Topic::Refused => maps.follow(&command, &Ok(Reply::Done)),
            Command::Open(open) if *topic == Topic::Session => {
                map_of.insert(named(&open.session, &open.vehicle).into(), (!open.map.is_empty()).then(|| open.map.clone()));
            }
            Command::Import { image, session: name } if *topic == Topic::Session => {
                map_of.insert(named(name, &image.session).into(), image.map.as_ref().map(|(id, _)| id.clone()));
            }
            Command::Fork { session, copy } if *topic == Topic::Session => {
                map_of.insert(copy.clone(), map_of.get(session).cloned().flatten());
            }
            Command::Measure { session: of, measurement, .. } if of == session && (from_ns..=to_ns).contains(&measurement.stamp_ns) => {
                // A place is given to what was accepted; a duplicate has that of the newest one and is told by its outcome.
                let accepted = pb::MeasurementAnswer::decode(answer.as_slice())
                    .is_ok_and(|answer| answer.place > 0 && !matches!(answer.outcome, Some(pb::measurement_answer::Outcome::Duplicate(_))));
                if accepted {
                    match starts.iter_mut().find(|(boot, _)| *boot == measurement.boot) {
                        Some((_, of_start)) => of_start.push(*measurement),
                        None => starts.push((measurement.boot, vec![*measurement])),
                    }
                }
            }
            _ => {}
        }
    }
    let Some(map_id) = map_of.remove(session) else {
        return Err(RecordingError::unusable(run.as_ref(), format!("session `{session}` is not in it")));
    };
    for (_, of_start) in &mut starts {
        of_start.sort_by_key(|m| m.stamp_ns);
    }
    let map = map_id.and_then(|id| maps.get(&id));
    Ok(RecordedWindow { map, measurements: starts.into_iter().flat_map(|(_, of_start)| of_start).collect() })
}

fn named<'a>(name: &'a str, otherwise: &'a str) -> &'a str {
    if name.is_empty() { otherwise } else { name }
}
