//! The encoded terrain of several maps.

use std::sync::Arc;

use nesam_terrain::WorldMap;

use super::TerrainTokens;
use super::store::NODES_MAX;

/// Maps whose terrain is kept where nobody asks for more: as many as a service takes by default.
const MAPS_MAX: usize = 64;
/// Nodes of all maps together (0.5 kB each): those of sixteen maps that are full (chosen).
const NODES_TOTAL_MAX: usize = 16 * NODES_MAX;

/// The terrain of the maps that were used last.
#[derive(Debug)]
pub struct TokensOfMaps {
    /// In the order of their last use.
    held: Vec<Arc<TerrainTokens>>,
    maps_max: usize,
}

impl Default for TokensOfMaps {
    fn default() -> Self {
        Self { held: Vec::new(), maps_max: MAPS_MAX }
    }
}

impl TokensOfMaps {
    /// Keeps the terrain of so many maps, and of no fewer than before.
    pub fn keep(&mut self, maps: usize) {
        self.maps_max = self.maps_max.max(maps);
    }

    /// The terrain of a map, if somebody has used it.
    pub fn get(&self, map: &WorldMap) -> Option<&Arc<TerrainTokens>> {
        self.held.iter().find(|tokens| tokens.map().hash() == map.hash())
    }

    /// The terrain of a map that is used now. Older versions of the map go, and what was used least recently where there is too much.
    pub fn used(&mut self, map: &Arc<WorldMap>) -> Arc<TerrainTokens> {
        let tokens = match self.held.iter().position(|tokens| tokens.map().hash() == map.hash()) {
            Some(at) => self.held.remove(at),
            None => Arc::new(TerrainTokens::new(map.clone())),
        };
        self.held.retain(|other| other.map().id() != map.id() || other.map().version() >= map.version());
        let mut nodes: usize = self.held.iter().map(|other| other.nodes()).sum::<usize>() + tokens.nodes();
        while !self.held.is_empty() && (self.held.len() >= self.maps_max || nodes > NODES_TOTAL_MAX) {
            nodes = nodes.saturating_sub(self.held.remove(0).nodes());
        }
        self.held.push(tokens.clone());
        tokens
    }
}

#[cfg(test)]
mod tests {
    use nesam_terrain::GridGeometry;

    use super::*;

    fn map(id: &str, version: u64, height_m: f32) -> Arc<WorldMap> {
        let geometry = GridGeometry { origin_m: [0.0; 2], resolution_m: 1.0, width: 2, height: 2 };
        Arc::new(WorldMap::from_layers(id, version, geometry, vec![height_m; 4], None).expect("a valid map"))
    }

    /// Found from outside: with 17 maps in turns every query encoded its terrain anew, and a map that was patched sixteen times put out another that was in use.
    #[test]
    fn regress_maps_in_use_stay() {
        let mut terrain = TokensOfMaps::default();
        let maps: Vec<Arc<WorldMap>> = (0..MAPS_MAX).map(|i| map(&format!("map-{i}"), 1, i as f32)).collect();
        let first: Vec<Arc<TerrainTokens>> = maps.iter().map(|map| terrain.used(map)).collect();
        assert!(maps.iter().zip(&first).all(|(map, tokens)| Arc::ptr_eq(tokens, &terrain.used(map))), "as many as are kept, in turns");
        // Versions of another map put out one map alone, the least recently used.
        terrain.used(&maps[0]);
        let patched = |version: u64| map("patched", version, 100.0 + version as f32);
        for version in 1..40 {
            terrain.used(&patched(version));
        }
        assert!(terrain.get(&maps[1]).is_none() && terrain.get(&patched(38)).is_none() && terrain.get(&patched(39)).is_some());
        assert!(maps.iter().filter(|map| map.id() != "map-1").all(|map| terrain.get(map).is_some()));
        terrain.keep(MAPS_MAX + 1);
        terrain.used(&maps[1]);
        assert!(maps.iter().all(|map| terrain.get(map).is_some()), "there is room for one more");
    }
}
