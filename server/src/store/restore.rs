//! Sessions and maps of a store back into an engine.

use std::collections::{BTreeMap, BTreeSet};

use nesam_engine::{Command, EngineError, EngineHandle, Reply, SessionImage};
use nesam_proto::v1 as pb;
use nesam_terrain::WorldMap;
use prost::Message as _;

use super::map_bytes::map_of;
use super::{Contents, StoreError, StoredSession, StoredSoil};
use crate::clock::unix_ns;
use crate::convert::{SoilTeller, session_image};

/// Which content of a map a store holds. A newer version may have the same content.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StoredMap {
    /// Version.
    pub version: u64,
    /// Hash of the content.
    pub hash: String,
}

impl StoredMap {
    /// That of a map.
    pub fn of(map: &WorldMap) -> Self {
        Self { version: map.version(), hash: map.hash().into() }
    }
}

/// What came back.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Restored {
    /// Measurements that each session had accepted.
    pub accepted: BTreeMap<String, u64>,
    /// Each map.
    pub maps: BTreeMap<String, StoredMap>,
    /// Sessions that cannot go on. They stay in the store as they are.
    pub set_aside: BTreeSet<String>,
    /// Keys of evidence of the soil that has faded.
    pub faded: Vec<String>,
}

/// Puts everything into an engine that holds nothing yet; evidence of the soil where that is kept for this server (`soil_of`). A session that cannot go on is set aside: the
/// vehicles of the others do not wait for it.
///
/// # Errors
/// `StoreError::Content` naming the session or map that another server would take, with another bundle or more room; also a map that is damaged.
pub(crate) fn restore(contents: &Contents, engine: &EngineHandle, soil_of: Option<&SoilTeller>) -> Result<Restored, StoreError> {
    let mut restored = Restored::default();
    for (id, bytes) in &contents.maps {
        let refused = |reason: String| StoreError::Content { what: format!("map `{id}`"), reason };
        let map = map_of(bytes, engine.limits()).map_err(refused)?;
        engine.make_ready(&map);
        restored.maps.insert(id.clone(), StoredMap::of(&map));
        engine.call(Command::PutMap { map: map.into(), base: None }).map_err(|error| refused(error.to_string()))?;
    }
    for session in &contents.sessions {
        let name = session.name.clone();
        match import(session, &restored.maps, engine) {
            Ok(accepted) => drop(restored.accepted.insert(name, accepted)),
            Err(error) if is_of_another_server(&error) => {
                let reason = format!(
                    "{error}; start the server with the bundle and the limits that the store was written with, or with another store"
                );
                return Err(StoreError::Content { what: format!("session `{name}`"), reason });
            }
            Err(error) => {
                let (bytes, reason) = (session.image.len(), error.to_string());
                tracing::error!(
                    session = name,
                    bytes,
                    reason,
                    "a session of the store cannot go on and is set aside; its bytes stay in the store and are tried again at the next start, until one of its name \
                     is opened: then they go to the table `set_aside`"
                );
                restored.set_aside.insert(name);
            }
        }
    }
    for (row, of) in contents.soil.iter().zip(soil_of.into_iter().cycle()) {
        if recall(row, of, engine) == Some(0) {
            restored.faded.push(row.key.clone());
        }
    }
    Ok(restored)
}

/// Whether the session is sound as far as is known, and this server the wrong one.
fn is_of_another_server(error: &EngineError) -> bool {
    use EngineError::{Exhausted, ForeignImage, Overloaded, Stopped};
    matches!(error, ForeignImage { .. } | Exhausted { .. } | Overloaded { .. } | Stopped)
}

/// A stored session as it goes on where its vehicle is now: the time without a server counts as silence.
///
/// # Errors
/// `EngineError` for bytes that are no session of this version.
pub(crate) fn resumed(stored: &StoredSession) -> Result<SessionImage, EngineError> {
    let mut image = session_image(&stored.image)?;
    let down_ns = unix_ns().saturating_sub(stored.saved_unix_ns).max(0);
    for age_ns in [&mut image.newest_age_ns, &mut image.step_age_ns].into_iter().flatten() {
        *age_ns = age_ns.saturating_add(down_ns);
    }
    Ok(image)
}

/// Evidence of the soil as old as it is now; how many cells the engine has taken. `None`: it is not for this engine, which has another bundle, cells of another
/// size, or no soil map.
fn recall(stored: &StoredSoil, of: &SoilTeller, engine: &EngineHandle) -> Option<usize> {
    let message = pb::FleetSoilShares::decode(stored.share.as_slice()).ok()?;
    let mut shares = of.hear(&message).ok().filter(|shares| !shares.is_empty())?;
    let since_s = unix_ns().saturating_sub(stored.saved_unix_ns).max(0) as f64 * 1e-9;
    shares.iter_mut().flat_map(|share| &mut share.cells).for_each(|cell| cell.age_s += since_s);
    match engine.call(Command::HearFleetSoil { cell_m: message.cell_m, shares }) {
        Ok(Reply::FleetSoilHeard(cells)) => Some(cells),
        _ => None,
    }
}

fn import(stored: &StoredSession, maps: &BTreeMap<String, StoredMap>, engine: &EngineHandle) -> Result<u64, EngineError> {
    let mut image = resumed(stored)?;
    // The map may have been patched since the session was saved; it drives on what is held.
    if let Some((id, hash)) = &mut image.map
        && let Some(held) = maps.get(id)
    {
        hash.clone_from(&held.hash);
    }
    let accepted = image.accepted;
    engine.call(Command::Import { image: Box::new(image), session: stored.name.clone() })?;
    Ok(accepted)
}
