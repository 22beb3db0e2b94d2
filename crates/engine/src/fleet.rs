//! The soil map of the fleet inside the engine: what sessions bring to it and begin from.

use std::collections::BTreeMap;

use nesam_adaptation::FilterConfig;
use nesam_fleet_soil::{
    CellEvidence, CellKey, Colour, EvidenceParts, FleetPrior, FleetSoilError, FleetSoilMap, FleetSoilSettings, Increment,
};
use nesam_terrain::WorldMap;

use crate::clock::seconds;

/// Half an edge of the square that colours are averaged over at most, cells of the world map.
const COLOUR_HALF_MAX: f64 = 32.0;

/// What one buffer of a session brought, and where.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Brought {
    /// Position in the middle of the buffer, World, m.
    pub position_m: [f64; 2],
    pub increment: Increment,
}

/// The evidence of a cell as the outside sees it.
#[derive(Clone, Debug, PartialEq)]
pub struct FleetCell {
    /// Map, colour and cell.
    pub key: CellKey,
    /// Evidence as of its last increment.
    pub evidence: CellEvidence,
    /// Time since that, s.
    pub age_s: f64,
}

/// What was brought to one service's soil map of the fleet.
#[derive(Clone, Debug, PartialEq)]
pub struct FleetShare {
    /// Name of the service in its present life; empty = this one.
    pub service: String,
    /// The cells.
    pub cells: Vec<FleetCell>,
}

/// The map, and what the ground looks like on the world maps in use.
#[derive(Clone, Debug)]
pub(crate) struct Fleet {
    map: FleetSoilMap,
    /// Hash and colours of the newest version of each world map; 3 bytes for each cell.
    colours: BTreeMap<String, (String, Vec<Colour>)>,
}

impl Fleet {
    pub fn new(settings: FleetSoilSettings) -> Result<Self, FleetSoilError> {
        FleetSoilMap::new(settings).map(|map| Self { map, colours: BTreeMap::new() })
    }

    /// What a vehicle that begins here starts from; `None` without evidence.
    pub fn prior(&mut self, world: &WorldMap, position_m: [f64; 2], config: &FilterConfig, now_ns: u64) -> Option<FleetPrior> {
        let key = self.key(world, position_m);
        self.map.prior(&key, position_m, &config.prior_sd, seconds(now_ns as i64))
    }

    /// Adds what a session brought; gives all that is known of the cell that it changed, and what was brought here of it.
    pub fn add(&mut self, world: &WorldMap, brought: &Brought, now_ns: u64) -> Option<[FleetCell; 2]> {
        let key = self.key(world, brought.position_m);
        self.map.add(key.clone(), &brought.increment, seconds(now_ns as i64));
        let (all, own) = (self.map.cell(&key)?, *self.map.own_cell(&key)?);
        Some([all, own].map(|evidence| aged(&key, &evidence, now_ns)))
    }

    /// The cells of a map, in the order of colour and place; of all maps when no name is given.
    pub fn cells(&self, map: &str, now_ns: u64) -> Vec<FleetCell> {
        let of_map = self.map.cells().into_iter().filter(|(key, _)| map.is_empty() || key.map == map);
        of_map.map(|(key, evidence)| aged(key, &evidence, now_ns)).collect()
    }

    /// What was brought here, and to each service that was heard of.
    pub fn shares(&self, now_ns: u64) -> Vec<FleetShare> {
        let share = |(service, cells): (Option<&str>, &BTreeMap<CellKey, CellEvidence>)| FleetShare {
            service: service.unwrap_or_default().into(),
            cells: cells.iter().map(|(key, evidence)| aged(key, evidence, now_ns)).collect(),
        };
        self.map.by_map().map(share).collect()
    }

    /// Takes what another service tells and gives the number of cells that were news. What is said to be brought here is not: nobody else knows it better.
    pub fn hear(&mut self, shares: &[FleetShare], now_ns: u64) -> usize {
        let told = shares.iter().filter(|share| !share.service.is_empty());
        let cells = told.flat_map(|share| share.cells.iter().map(move |cell| (share.service.as_str(), cell)));
        cells
            .filter(|(service, cell)| {
                let stamp_s = seconds(now_ns as i64) - cell.age_s.max(0.0);
                let evidence = CellEvidence::from_parts(&EvidenceParts { stamp_s, ..cell.evidence.parts() });
                evidence.is_ok_and(|evidence| self.map.hear(service, cell.key.clone(), &evidence, seconds(now_ns as i64)))
            })
            .count()
    }

    /// Forgets what the ground of a world map that is gone looks like; what was learned of it stays.
    pub fn forget_colours(&mut self, world: &str) {
        self.colours.remove(world);
    }

    /// Edge of a cell, m.
    pub fn cell_m(&self) -> f64 {
        self.map.settings().cell_m
    }

    fn key(&mut self, world: &WorldMap, position_m: [f64; 2]) -> CellKey {
        CellKey::at(world.id(), self.colour(world, position_m), position_m, self.cell_m())
    }

    /// Mean colour of the square of 2 m around a position, as the texture of a class is finer than that; black off the map and without a semantic layer.
    fn colour(&mut self, world: &WorldMap, [x_m, y_m]: [f64; 2]) -> Colour {
        if self.colours.get(world.id()).is_none_or(|(hash, _)| hash != world.hash()) {
            self.colours.insert(world.id().into(), (world.hash().into(), world.semantic_rgb().unwrap_or_default()));
        }
        let geometry = world.geometry();
        let Some((_, colours)) = self.colours.get(world.id()).filter(|_| geometry.contains(x_m, y_m)) else { return [0; 3] };
        let [column, row] = geometry.to_grid(x_m, y_m).map(|v| v.round().max(0.0) as usize);
        let half = (1.0 / geometry.resolution_m).clamp(0.0, COLOUR_HALF_MAX) as usize;
        let (rows, columns) = (row.saturating_sub(half)..=row + half, column.saturating_sub(half)..(column + half + 1).min(geometry.width));
        let square = rows.flat_map(|row| colours.get(row * geometry.width + columns.start..row * geometry.width + columns.end)).flatten();
        let (sum, count) =
            square.fold(([0_u64; 3], 0_u64), |(sum, count), c| (core::array::from_fn(|i| sum[i] + u64::from(c[i])), count + 1));
        sum.map(|level| (level / count.max(1)) as u8)
    }
}

/// A cell as the outside sees it.
fn aged(key: &CellKey, evidence: &CellEvidence, now_ns: u64) -> FleetCell {
    FleetCell { key: key.clone(), evidence: *evidence, age_s: seconds(now_ns as i64) - evidence.stamp_s() }
}

#[cfg(test)]
mod tests {
    use nesam_terrain::GridGeometry;

    use super::*;

    #[test]
    fn property_colours_of_a_deleted_map_are_forgotten() {
        let mut fleet = Fleet::new(FleetSoilSettings::default()).unwrap();
        let geometry = GridGeometry { origin_m: [0.0; 2], resolution_m: 1.0, width: 4, height: 4 };
        for id in ["gone", "held"] {
            let world = WorldMap::from_layers(id, 1, geometry, vec![0.0; 16], Some(vec![[90, 100, 110]; 16])).unwrap();
            assert_eq!(fleet.colour(&world, [1.5, 1.5]), [90, 100, 110]);
        }
        fleet.forget_colours("gone");
        assert_eq!(fleet.colours.keys().collect::<Vec<_>>(), ["held"]);
    }
}
