//! Settings of the map and what each of them does.

use crate::error::FleetSoilError;

/// Most cells of a map: as many as one answer to another server holds.
const CELLS_MAX: usize = 131_072;

/// Settings of a [`crate::FleetSoilMap`]. All defaults are chosen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FleetSoilSettings {
    /// Edge of a cell, m. Larger: fewer cells, and evidence is placed less exactly.
    pub cell_m: f64,
    /// Time after which evidence counts half, s. Shorter: follows rain and traffic, and forgets sooner.
    pub half_life_s: f64,
    /// Distance over which evidence loses the factor e, m. Longer: more ground is covered by what was driven, and its differences are ignored.
    pub reach_m: f64,
    /// Distance between colours over which evidence loses the factor e, levels of 255. Wider: classes mix; narrower: the texture of the image splits them.
    pub colour_reach: f64,
    /// Process noise, as share of the standard deviations of the filter's own prior: ground of one look differs from place to place and from day to day, however much
    /// was measured of it.
    pub process_share: f64,
    /// Cells held at most, brought to this map and heard of others together; beyond, those with the oldest evidence are forgotten.
    pub cells_max: usize,
}

impl Default for FleetSoilSettings {
    fn default() -> Self {
        Self { cell_m: 10.0, half_life_s: 86_400.0, reach_m: 20.0, colour_reach: 32.0, process_share: 0.3, cells_max: 65_536 }
    }
}

impl FleetSoilSettings {
    /// Refuses what no map can work with.
    ///
    /// # Errors
    /// `FleetSoilError::Setting` naming the setting.
    pub fn check(&self) -> Result<(), FleetSoilError> {
        let positive =
            [("cell_m", self.cell_m), ("half_life_s", self.half_life_s), ("reach_m", self.reach_m), ("colour_reach", self.colour_reach)];
        if let Some((setting, value)) = positive.into_iter().find(|(_, v)| !(v.is_finite() && *v > 0.0)) {
            return Err(FleetSoilError::Setting { setting, reason: format!("is {value}, it must be positive") });
        }
        if !(self.process_share.is_finite() && self.process_share >= 0.0) {
            return Err(FleetSoilError::Setting {
                setting: "process_share",
                reason: format!("is {}, it must be at least 0", self.process_share),
            });
        }
        if !(1..=CELLS_MAX).contains(&self.cells_max) {
            return Err(FleetSoilError::Setting {
                setting: "cells_max",
                reason: format!("is {}, it must be 1 to {CELLS_MAX}", self.cells_max),
            });
        }
        Ok(())
    }
}
