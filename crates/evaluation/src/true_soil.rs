//! The simulator's own soil as a field: what a perfect filter would put in place of the prior; for evaluation only.

use std::path::Path;
use std::sync::Arc;

use nesam_model::SoilField;
use nesam_physics::{SOIL_DIM, SoilCorrection};
use nesam_terrain::{GridGeometry, WorldMap};
use nesam_trajectories::{SoilTruth, TrajectoryError, read_ground_truth_soil};

/// True soil and class of every place of a world.
#[derive(Clone, Debug)]
pub struct TrueSoil {
    geometry: GridGeometry,
    /// Region of each cell, row-major, south row first.
    cells: Vec<u8>,
    /// Soil and class of each region id.
    regions: Vec<Option<([f64; SOIL_DIM], usize)>>,
    /// Classes that occur.
    classes: usize,
}

impl TrueSoil {
    /// Reads `gt_soil.json` and `gt_region.png` of a world.
    ///
    /// # Errors
    /// `TrajectoryError` when one of them is missing or damaged.
    pub fn read(world_dir: &Path, map: &WorldMap) -> Result<Arc<Self>, TrajectoryError> {
        let truth = read_ground_truth_soil(world_dir)?;
        let geometry = *map.geometry();
        let cells = SoilTruth::read_regions(world_dir, &geometry)?;
        let mut names: Vec<&str> = truth.regions.iter().map(|r| r.class.as_str()).collect();
        names.sort_unstable();
        names.dedup();
        let class_of = |name: &str| names.binary_search(&name).unwrap_or(0);
        let regions = (0..=usize::from(u8::MAX))
            .map(|id| truth.soil(id).map(|r| (SoilCorrection::NONE.apply(&r.soil.to_array()), class_of(&r.class))))
            .collect();
        Ok(Arc::new(Self { geometry, cells, regions, classes: names.len() }))
    }

    /// Number of classes.
    pub fn classes(&self) -> usize {
        self.classes
    }

    /// Index of the class at a place; `None` off the map.
    pub fn class_at(&self, position_m: [f64; 2]) -> Option<usize> {
        self.at(position_m).map(|(_, class)| class)
    }

    /// The soil of a place, clipped to the bounds of the physics; `None` off the map.
    pub fn soil_at(&self, position_m: [f64; 2]) -> Option<[f64; SOIL_DIM]> {
        self.at(position_m).map(|(soil, _)| soil)
    }

    fn at(&self, [x_m, y_m]: [f64; 2]) -> Option<([f64; SOIL_DIM], usize)> {
        if !self.geometry.contains(x_m, y_m) {
            return None;
        }
        let [column, row] = self.geometry.to_grid(x_m, y_m).map(|v| v.round().max(0.0) as usize);
        let cell = row.min(self.geometry.height - 1) * self.geometry.width + column.min(self.geometry.width - 1);
        self.regions[usize::from(self.cells[cell])]
    }
}

impl SoilField for TrueSoil {
    /// The true soil under the reference point, clipped to the bounds of the physics; the prior off the map.
    fn soil(&self, _sample: usize, position_m: [f64; 2], prior: &[f64; SOIL_DIM]) -> [f64; SOIL_DIM] {
        self.soil_at(position_m).unwrap_or(*prior)
    }
}
