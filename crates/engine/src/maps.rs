//! The maps that sessions drive on.

use std::collections::BTreeMap;
use std::sync::Arc;

use nesam_terrain::WorldMap;

use crate::error::EngineError;
use crate::limits::{Limits, check_name};

/// Uploaded maps, the newest version of each.
#[derive(Debug, Default)]
pub struct MapRegistry {
    maps: BTreeMap<String, Arc<WorldMap>>,
}

impl MapRegistry {
    /// The newest version of a map.
    ///
    /// # Errors
    /// `EngineError::UnknownMap`.
    pub fn get(&self, id: &str) -> Result<&Arc<WorldMap>, EngineError> {
        self.maps.get(id).ok_or_else(|| EngineError::UnknownMap { map: id.into() })
    }

    /// All maps, by id.
    pub fn all(&self) -> Vec<Arc<WorldMap>> {
        self.maps.values().cloned().collect()
    }

    /// Number of maps.
    pub fn count(&self) -> usize {
        self.maps.len()
    }

    /// Takes a new map, or a new version of one.
    ///
    /// `base` = version that the new one was made from, for a patched map; the held one must still be that.
    ///
    /// # Errors
    /// `Invalid` for a bad id or version, `MapExists` when the version is not above the held one, `MapChanged` when the base is not held any more,
    /// `UnknownMap` when there is no base, `Exhausted` when a limit on maps or cells is reached.
    pub fn put(&mut self, map: Arc<WorldMap>, base: Option<u64>, limits: &Limits) -> Result<(), EngineError> {
        check_name("map_id", map.id())?;
        if map.version() == 0 {
            return Err(EngineError::invalid("version", "is 0, versions start at 1"));
        }
        let held = self.maps.get(map.id());
        match (base, held) {
            (Some(_), None) => return Err(EngineError::UnknownMap { map: map.id().into() }),
            (Some(base), Some(held)) if held.version() != base => {
                return Err(EngineError::MapChanged { map: map.id().into(), held: held.version(), base });
            }
            (None, Some(held)) if map.version() <= held.version() => {
                return Err(EngineError::MapExists { map: map.id().into(), held: held.version() });
            }
            (None, None) if self.maps.len() >= limits.maps_max => {
                let reason = format!("{} maps are held, the limit; delete one", self.maps.len());
                return Err(EngineError::Exhausted { field: "map_id".into(), reason });
            }
            _ => {}
        }
        let cells = map.geometry().cells();
        let others: usize = self.maps.values().filter(|m| m.id() != map.id()).map(|m| m.geometry().cells()).sum();
        if cells > limits.map_cells_max {
            let reason = format!("the map has {cells} cells, the limit is {}", limits.map_cells_max);
            return Err(EngineError::invalid("width", reason));
        }
        if others + cells > limits.map_cells_total_max {
            let reason = format!("all maps would have {} cells, the limit is {}; delete one", others + cells, limits.map_cells_total_max);
            return Err(EngineError::Exhausted { field: "map_id".into(), reason });
        }
        self.maps.insert(map.id().into(), map);
        Ok(())
    }

    /// Forgets a map.
    ///
    /// # Errors
    /// `EngineError::UnknownMap`.
    pub fn delete(&mut self, id: &str) -> Result<(), EngineError> {
        self.maps.remove(id).map(|_| ()).ok_or_else(|| EngineError::UnknownMap { map: id.into() })
    }
}
