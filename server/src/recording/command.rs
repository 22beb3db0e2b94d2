//! Commands as messages of a recording and back.

use std::collections::BTreeMap;
use std::sync::Arc;

use nesam_engine::{AppliedEffects, Command, EngineError, Limits, Reply};
use nesam_proto::v1 as pb;
use nesam_terrain::WorldMap;
use prost::Message as _;

use super::topic::Topic;
use crate::convert::{
    MapBuilder, applied_effects, changed_tile, effect_messages, fleet_soil_shares, heard_fleet_soil, image_bytes, measurement,
    measurement_message, open_message, open_session, patched, predict_message, predict_query, session_image, upload,
};

/// A message and its topic.
pub(crate) type Entry = (Topic, Vec<u8>);

/// The maps that the engine holds, so that a patch can be recorded as the tile that it was and not as a whole map.
#[derive(Debug, Default)]
pub(crate) struct HeldMaps(BTreeMap<String, Arc<WorldMap>>);

impl HeldMaps {
    /// A map.
    pub fn get(&self, id: &str) -> Option<Arc<WorldMap>> {
        self.0.get(id).cloned()
    }

    /// Follows what a command has done.
    pub fn follow(&mut self, command: &Command, result: &Result<Reply, EngineError>) {
        match (command, result) {
            (Command::PutMap { map, .. }, Ok(_)) => {
                self.0.insert(map.id().into(), Arc::clone(map));
            }
            (Command::DeleteMap { map }, Ok(_)) => {
                self.0.remove(map);
            }
            _ => {}
        }
    }
}

/// The messages that ask for a command.
pub(crate) fn to_entries(command: &Command, maps: &HeldMaps) -> Vec<Entry> {
    let one = |topic: Topic, data: Vec<u8>| vec![(topic, data)];
    match command {
        Command::Open(open) => one(Topic::Open, open_message(open).encode_to_vec()),
        Command::Get { session } => one(Topic::Get, pb::GetSessionRequest { session_id: session.clone() }.encode_to_vec()),
        Command::List => one(Topic::List, pb::ListSessionsRequest {}.encode_to_vec()),
        Command::Fork { session, copy } => {
            let message = pb::ForkSessionRequest { session_id: session.clone(), new_session_id: copy.clone() };
            one(Topic::Fork, message.encode_to_vec())
        }
        Command::Export { session } => one(Topic::Export, pb::ExportSessionRequest { session_id: session.clone() }.encode_to_vec()),
        Command::Import { image, session } => {
            let message = pb::ImportSessionRequest { image: image_bytes(image).into(), session_id: session.clone() };
            one(Topic::Import, message.encode_to_vec())
        }
        // The engine does not tell of what only it and the server need: they change nothing.
        Command::Snapshot { .. } | Command::TellFleetSoil => Vec::new(),
        Command::HearFleetSoil { cell_m, shares } => {
            one(Topic::FleetSoilShares, fleet_soil_shares("", "", *cell_m, shares).encode_to_vec())
        }
        Command::FleetSoil { map } => one(Topic::FleetSoil, pb::FleetSoilRequest { map_id: map.clone() }.encode_to_vec()),
        Command::Close { session } => one(Topic::Close, pb::CloseSessionRequest { session_id: session.clone() }.encode_to_vec()),
        Command::SetEffects { session, effects } if effects.effects.is_empty() => {
            one(Topic::RevertEffects, pb::RevertEffectsRequest { session_id: session.clone() }.encode_to_vec())
        }
        Command::SetEffects { session, effects } => {
            let (source, messages) = (effects.source.clone(), effect_messages(effects));
            one(Topic::ApplyEffects, pb::ApplyEffectsRequest { session_id: session.clone(), source, effects: messages }.encode_to_vec())
        }
        Command::Expire => one(Topic::Expire, pb::ExpireSessionsRequest {}.encode_to_vec()),
        Command::Measure { session, vehicle, measurement } => {
            let source = vehicle.iter().map(|vehicle| pb::MeasurementSource { vehicle_id: vehicle.clone() }.encode_to_vec());
            let source = source.map(|data| (Topic::MeasurementSource, data));
            let message = measurement_message(session, measurement).encode_to_vec();
            source.chain([(Topic::Measurement, message)]).collect()
        }
        Command::Predict(query) => one(Topic::Predict, predict_message(query).encode_to_vec()),
        Command::PutMap { map, base } => put_entries(map, *base, maps),
        Command::GetMap { map } => one(Topic::MapGet, pb::GetMapRequest { map_id: map.clone() }.encode_to_vec()),
        Command::ListMaps => one(Topic::MapList, pb::ListMapsRequest {}.encode_to_vec()),
        Command::DeleteMap { map } => one(Topic::MapDelete, pb::DeleteMapRequest { map_id: map.clone() }.encode_to_vec()),
    }
}

/// A whole map, or the tile that was patched where the map below it is in the recording already. A patch whose map is not held any more (it will
/// have been refused) is a whole map with its base.
fn put_entries(map: &Arc<WorldMap>, base: Option<u64>, maps: &HeldMaps) -> Vec<Entry> {
    let patch = |tile: Option<pb::MapTile>, base_version: u64| {
        let message = pb::PatchTileRequest { map_id: map.id().into(), base_version, tile };
        (Topic::MapPatch, message.encode_to_vec())
    };
    let below = maps.0.get(map.id()).filter(|held| Some(held.version()) == base && held.version() + 1 == map.version());
    if let (Some(base), Some(tile)) = (base, below.and_then(|held| changed_tile(held, map))) {
        return vec![patch(Some(tile), base)];
    }
    let whole = upload(map).into_iter().map(|message| (Topic::MapUpload, message.encode_to_vec()));
    whole.chain(base.map(|base| patch(None, base))).collect()
}

/// The command that the messages ask for.
///
/// # Errors
/// What is wrong with the messages.
pub(crate) fn of_entries(entries: &[Entry], limits: &Limits, maps: &HeldMaps) -> Result<Command, String> {
    match entries {
        [(Topic::Open, data)] => Ok(Command::Open(open_session(&read(data)?).map_err(|e| e.to_string())?)),
        [(Topic::Get, data)] => Ok(Command::Get { session: read::<pb::GetSessionRequest>(data)?.session_id }),
        [(Topic::List, _)] => Ok(Command::List),
        [(Topic::Fork, data)] => {
            let pb::ForkSessionRequest { session_id, new_session_id } = read(data)?;
            Ok(Command::Fork { session: session_id, copy: new_session_id })
        }
        [(Topic::Export, data)] => Ok(Command::Export { session: read::<pb::ExportSessionRequest>(data)?.session_id }),
        [(Topic::Import, data)] => {
            let pb::ImportSessionRequest { image, session_id } = read(data)?;
            Ok(Command::Import { image: session_image(&image).map_err(|e| e.to_string())?.into(), session: session_id })
        }
        [(Topic::FleetSoil, data)] => Ok(Command::FleetSoil { map: read::<pb::FleetSoilRequest>(data)?.map_id }),
        [(Topic::FleetSoilShares, data)] => {
            let message: pb::FleetSoilShares = read(data)?;
            let shares = heard_fleet_soil(&message, "").map_err(|e| e.to_string())?;
            Ok(Command::HearFleetSoil { cell_m: message.cell_m, shares })
        }
        [(Topic::Close, data)] => Ok(Command::Close { session: read::<pb::CloseSessionRequest>(data)?.session_id }),
        [(Topic::ApplyEffects, data)] => {
            let pb::ApplyEffectsRequest { session_id, source, effects } = read(data)?;
            Ok(Command::SetEffects { session: session_id, effects: applied_effects(&source, &effects) })
        }
        [(Topic::RevertEffects, data)] => {
            let session = read::<pb::RevertEffectsRequest>(data)?.session_id;
            Ok(Command::SetEffects { session, effects: AppliedEffects::default() })
        }
        [(Topic::Expire, _)] => Ok(Command::Expire),
        [(Topic::Measurement, data)] => measure(data, None),
        [(Topic::MeasurementSource, source), (Topic::Measurement, data)] => {
            measure(data, Some(read::<pb::MeasurementSource>(source)?.vehicle_id))
        }
        [(Topic::Predict, data)] => {
            predict_query(&read(data)?, limits).map(|(query, _)| Command::Predict(query)).map_err(|e| e.to_string())
        }
        [(Topic::MapUpload | Topic::MapPatch, _), ..] => put(entries, limits, maps),
        [(Topic::MapGet, data)] => Ok(Command::GetMap { map: read::<pb::GetMapRequest>(data)?.map_id }),
        [(Topic::MapList, _)] => Ok(Command::ListMaps),
        [(Topic::MapDelete, data)] => Ok(Command::DeleteMap { map: read::<pb::DeleteMapRequest>(data)?.map_id }),
        other => {
            let topics: Vec<&str> = other.iter().map(|(topic, _)| topic.name()).collect();
            Err(format!("messages on [{}] are no command", topics.join(", ")))
        }
    }
}

fn read<M: prost::Message + Default>(data: &[u8]) -> Result<M, String> {
    M::decode(data).map_err(|error| error.to_string())
}

fn measure(data: &[u8], vehicle: Option<String>) -> Result<Command, String> {
    let message: pb::Measurement = read(data)?;
    let measurement = measurement(&message).map_err(|e| e.to_string())?;
    Ok(Command::Measure { session: message.session_id, vehicle, measurement })
}

/// A map from its upload, from a patch of the held one, or from an upload with the version below it.
fn put(entries: &[Entry], limits: &Limits, maps: &HeldMaps) -> Result<Command, String> {
    use pb::upload_map_request::Part;
    let (mut builder, mut base) = (None::<MapBuilder>, None);
    for (topic, data) in entries {
        match topic {
            Topic::MapUpload => match (read::<pb::UploadMapRequest>(data)?.part, &mut builder) {
                (Some(Part::Header(header)), None) => builder = Some(MapBuilder::new(&header, limits).map_err(|e| e.to_string())?),
                (Some(Part::Tile(tile)), Some(builder)) => builder.add(&tile).map_err(|e| e.to_string())?,
                _ => return Err("a map is not uploaded as one header and tiles".into()),
            },
            Topic::MapPatch => {
                let message: pb::PatchTileRequest = read(data)?;
                base = Some(message.base_version);
                if let Some(tile) = &message.tile {
                    let held =
                        maps.0.get(&message.map_id).ok_or_else(|| format!("map `{}` is patched before it is there", message.map_id))?;
                    let map = Arc::new(patched(held, tile).map_err(|e| e.to_string())?);
                    return Ok(Command::PutMap { map, base });
                }
            }
            other => return Err(format!("a message on {} is no part of a map", other.name())),
        }
    }
    let map = builder.ok_or("a map has no header")?.finish().map_err(|e| e.to_string())?;
    Ok(Command::PutMap { map: Arc::new(map), base })
}
