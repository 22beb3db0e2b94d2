//! The soil map of the fleet inside the engine: what sessions bring to it and begin from.

use std::collections::BTreeMap;

use nesam_adaptation::FilterConfig;
use nesam_fleet_soil::{CellEvidence, CellKey, Colour, FleetPrior, FleetSoilError, FleetSoilMap, FleetSoilSettings, Increment};
use nesam_terrain::WorldMap;

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
        self.map.prior(&key, position_m, &config.prior_sd, now_ns as f64 * 1e-9)
    }

    /// Adds what a session brought and gives the cell that it changed.
    pub fn add(&mut self, world: &WorldMap, brought: &Brought, now_ns: u64) -> Option<FleetCell> {
        let key = self.key(world, brought.position_m);
        self.map.add(key.clone(), &brought.increment, now_ns as f64 * 1e-9);
        self.map.cell(&key).map(|evidence| FleetCell { evidence: *evidence, key, age_s: 0.0 })
    }

    /// The cells of a map, in the order of colour and place; of all maps when no name is given.
    pub fn cells(&self, map: &str, now_ns: u64) -> Vec<FleetCell> {
        let of_map = self.map.cells().filter(|(key, _)| map.is_empty() || key.map == map);
        of_map
            .map(|(key, evidence)| FleetCell { key: key.clone(), evidence: *evidence, age_s: now_ns as f64 * 1e-9 - evidence.stamp_s() })
            .collect()
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
