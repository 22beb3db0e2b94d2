//! Answers as messages of a recording.

use std::collections::BTreeMap;

use nesam_engine::{Command, EngineError, Executed, Reply, SessionView};
use nesam_physics::Vehicle;
use nesam_proto::v1 as pb;
use prost::Message as _;

use super::command::Entry;
use super::topic::Topic;
use crate::call::Timing;
use crate::convert::{
    OutputSelection, code, description, fleet_soil_map, image_bytes, measurement_answer, measurement_message, predict_error, predict_reply,
    session_view, soil_estimate,
};

/// The answer to a command. It is the same whenever the command is executed again at the same instant, but for `timing`.
pub(crate) fn to_entry(command: &Command, result: &Result<Reply, EngineError>, vehicle: &Vehicle, timing: Timing) -> Entry {
    if let Command::Measure { session, measurement, .. } = command {
        let measured = match result {
            Ok(Reply::Measured(answer)) => Ok((**answer).clone()),
            Ok(_) => Err(EngineError::Internal { reason: "a measurement was answered with another reply".into() }),
            Err(error) => Err(error.clone()),
        };
        let answer = measurement_answer(&measurement_message(session, measurement), session, measured);
        return (Topic::MeasurementAnswer, answer.encode_to_vec());
    }
    match result {
        Ok(reply) => reply_entry(command, reply, vehicle, timing),
        Err(error) if matches!(command, Command::Predict(_)) => (Topic::PredictionError, predict_error(0, error).encode_to_vec()),
        Err(error) => {
            let refusal = pb::Refusal { code: code(error).into(), field: error.field().into(), message: error.to_string() };
            (Topic::Refused, refusal.encode_to_vec())
        }
    }
}

fn reply_entry(command: &Command, reply: &Reply, vehicle: &Vehicle, timing: Timing) -> Entry {
    let session = |view: &SessionView| session_view(view, vehicle);
    match reply {
        Reply::Session(view) => (Topic::Session, session(view).encode_to_vec()),
        Reply::Sessions(views) => {
            (Topic::Sessions, pb::ListSessionsReply { sessions: views.iter().map(session).collect() }.encode_to_vec())
        }
        Reply::Expired(sessions) => (Topic::Expired, pb::ExpireSessionsReply { session_ids: sessions.clone() }.encode_to_vec()),
        // The command was answered above; another one that is answered so is told apart by its outcome.
        Reply::Measured(answer) => {
            (Topic::MeasurementAnswer, measurement_answer(&pb::Measurement::default(), "", Ok((**answer).clone())).encode_to_vec())
        }
        Reply::Image(image) => (Topic::Exported, pb::ExportSessionReply { image: image_bytes(image).into() }.encode_to_vec()),
        Reply::FleetSoil(cell_m, cells) => (Topic::FleetSoilMap, fleet_soil_map(*cell_m, cells).encode_to_vec()),
        Reply::FleetSoilHeard(cells) => (Topic::FleetSoilHeard, pb::FleetSoilHeard { cells: *cells as u64 }.encode_to_vec()),
        Reply::Predicted(prediction) => {
            (Topic::Prediction, predict_reply(0, prediction, OutputSelection::EVERYTHING, timing).encode_to_vec())
        }
        Reply::Map(map) => (Topic::Map, description(map).encode_to_vec()),
        Reply::Maps(maps) => (Topic::Maps, pb::ListMapsReply { maps: maps.iter().map(|map| description(map)).collect() }.encode_to_vec()),
        Reply::Done if matches!(command, Command::DeleteMap { .. }) => (Topic::MapDeleted, pb::DeleteMapReply {}.encode_to_vec()),
        Reply::Done | Reply::Snapshot(_) | Reply::FleetShares(..) => (Topic::Closed, pb::CloseSessionReply {}.encode_to_vec()),
    }
}

/// Whether the recorded answer says that the command was not executed, or given up: its asker had gone, its deadline had passed, or too many came before it.
pub(crate) fn not_executed((topic, data): &Entry) -> bool {
    let skipped = [tonic::Code::Cancelled, tonic::Code::DeadlineExceeded, tonic::Code::ResourceExhausted].map(i32::from);
    *topic == Topic::PredictionError && pb::PredictError::decode(data.as_slice()).is_ok_and(|error| skipped.contains(&error.code))
}

/// The answer without what the machine's load decides.
pub(crate) fn without_timing((topic, data): &Entry) -> Vec<u8> {
    match (topic, pb::PredictReply::decode(data.as_slice())) {
        (Topic::Prediction, Ok(reply)) => pb::PredictReply { queue_s: 0.0, compute_s: 0.0, ..reply }.encode_to_vec(),
        _ => data.clone(),
    }
}

/// Soil estimates for viewers: the last known epoch of each session.
#[derive(Debug, Default)]
pub(crate) struct SoilEpochs(BTreeMap<String, u64>);

impl SoilEpochs {
    /// The estimate that a command has changed.
    pub fn changed(&mut self, executed: &Executed) -> Option<Entry> {
        match (&executed.command, &executed.result) {
            (Command::Measure { session, .. }, Ok(Reply::Measured(answer))) => {
                let epoch = answer.soil.state.epoch;
                let known = self.0.insert(session.clone(), epoch).unwrap_or(0);
                (epoch != known).then(|| (Topic::Soil, soil_estimate(session, &answer.soil, &answer.provenance).encode_to_vec()))
            }
            (Command::Fork { .. } | Command::Import { .. }, Ok(Reply::Session(view))) => {
                self.0.insert(view.session.clone(), view.provenance.soil_epoch);
                None
            }
            (Command::Close { session }, Ok(_)) => {
                self.0.remove(session);
                None
            }
            (Command::Expire, Ok(Reply::Expired(sessions))) => {
                self.0.retain(|session, _| !sessions.contains(session));
                None
            }
            _ => None,
        }
    }
}
