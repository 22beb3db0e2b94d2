//! Whose session is whose, as the engine tells it: kept beside the engine so that a foreign request is refused before it enters the queue.

use std::collections::BTreeMap;
use std::sync::{Arc, RwLock};

use nesam_engine::Event;

/// Vehicle of each open session. Clones share it.
#[derive(Clone, Debug, Default)]
pub struct Directory(Arc<RwLock<BTreeMap<String, Arc<str>>>>);

impl Directory {
    /// Hears the engine, on its thread: a session is known here before whoever opened it hears so.
    pub fn note(&self, event: &Event) {
        let Ok(mut sessions) = self.0.write() else { return };
        match event {
            Event::SessionOpened { session, vehicle } => drop(sessions.insert(session.clone(), vehicle.as_str().into())),
            Event::SessionClosed { session, .. } => drop(sessions.remove(session)),
            _ => {}
        }
    }

    /// Number of open sessions.
    pub fn count(&self) -> usize {
        self.0.read().map_or(0, |sessions| sessions.len())
    }

    /// Vehicle of an open session.
    pub fn vehicle(&self, session: &str) -> Option<Arc<str>> {
        self.0.read().ok()?.get(session).cloned()
    }

    /// Whether a session is open and of another vehicle than this one, which is told nothing of it.
    pub fn is_foreign(&self, session: &str, vehicle: &str) -> bool {
        self.0.read().is_ok_and(|sessions| sessions.get(session).is_some_and(|owner| **owner != *vehicle))
    }
}
