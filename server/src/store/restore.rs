//! Sessions and maps of a store back into an engine.

use std::collections::BTreeMap;

use nesam_engine::{Command, EngineError, EngineHandle, SessionImage};

use super::map_bytes::map_of;
use super::{Contents, StoreError, StoredSession};
use crate::clock::unix_ns;
use crate::convert::session_image;

/// What came back.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Restored {
    /// Measurements that each session had accepted.
    pub accepted: BTreeMap<String, u64>,
    /// Hash of each map.
    pub maps: BTreeMap<String, String>,
}

/// Puts everything into an engine that holds nothing yet.
///
/// # Errors
/// `StoreError::Content` naming the session or map that the engine refuses: of another bundle, damaged, or beyond its limits.
pub(crate) fn restore(contents: &Contents, engine: &EngineHandle) -> Result<Restored, StoreError> {
    let mut restored = Restored::default();
    for (id, bytes) in &contents.maps {
        let refused = |reason: String| StoreError::Content { what: format!("map `{id}`"), reason };
        let map = map_of(bytes, engine.limits()).map_err(refused)?;
        restored.maps.insert(id.clone(), map.hash().into());
        engine.call(Command::PutMap { map: map.into(), base: None }).map_err(|error| refused(error.to_string()))?;
    }
    for session in &contents.sessions {
        let accepted = import(session, &restored.maps, engine).map_err(|error| {
            let reason =
                format!("{error}; start the server with the bundle and the limits that the store was written with, or with another store");
            StoreError::Content { what: format!("session `{}`", session.name), reason }
        })?;
        restored.accepted.insert(session.name.clone(), accepted);
    }
    Ok(restored)
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

fn import(stored: &StoredSession, maps: &BTreeMap<String, String>, engine: &EngineHandle) -> Result<u64, EngineError> {
    let mut image = resumed(stored)?;
    // The map may have been patched since the session was saved; it drives on what is held.
    if let Some((id, hash)) = &mut image.map
        && let Some(held) = maps.get(id)
    {
        hash.clone_from(held);
    }
    let accepted = image.accepted;
    engine.call(Command::Import { image: Box::new(image), session: stored.name.clone() })?;
    Ok(accepted)
}
