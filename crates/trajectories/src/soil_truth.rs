//! True soil of a simulated world: for evaluation only.

use std::path::Path;

use nesam_physics::{SOIL_DIM, Soil};
use nesam_terrain::{GridGeometry, SOIL_KEYS, read_gray8};
use serde_json::Value;

use crate::error::TrajectoryError;
use crate::json::JsonFile;

/// True soil of one region.
#[derive(Clone, Debug, PartialEq)]
pub struct RegionSoil {
    /// Region id, the gray value of the region image.
    pub id: usize,
    /// Semantic class.
    pub class: String,
    /// Soil, SI and rad.
    pub soil: Soil<f64>,
}

/// True soil of a world by region.
#[derive(Clone, Debug, PartialEq)]
pub struct SoilTruth {
    /// Regions in file order.
    pub regions: Vec<RegionSoil>,
}

impl SoilTruth {
    /// The soil of a region id.
    pub fn soil(&self, region: usize) -> Option<&RegionSoil> {
        self.regions.iter().find(|r| r.id == region)
    }

    /// Region ids of every cell of a world, row-major with the south row first (`gt_region.png`).
    ///
    /// # Errors
    /// `TrajectoryError::World` naming the file and the row when the image is missing, damaged or of another size.
    pub fn read_regions(world_dir: &Path, geometry: &GridGeometry) -> Result<Vec<u8>, TrajectoryError> {
        Ok(read_gray8(&world_dir.join("gt_region.png"), geometry.width, geometry.height)?)
    }
}

/// Reads `gt_soil.json` of a world folder; the friction angle is converted from degrees.
///
/// # Errors
/// `TrajectoryError` naming the file and the key that is missing or of the wrong type.
pub fn read_ground_truth_soil(world_dir: &Path) -> Result<SoilTruth, TrajectoryError> {
    let file = JsonFile::read(&world_dir.join("gt_soil.json"))?;
    let listed = file.get("params").and_then(Value::as_array).ok_or_else(|| file.wrong("params", "missing"))?;
    let place = |name: &str| listed.iter().position(|p| p.as_str() == Some(name));
    let mut order = [0; SOIL_DIM];
    for (to, name) in order.iter_mut().zip(SOIL_KEYS) {
        *to = place(name).ok_or_else(|| file.wrong("params", format!("does not list `{name}`")))?;
    }
    let regions = file.get("regions").and_then(Value::as_array).ok_or_else(|| file.wrong("regions", "missing"))?;
    let region = |(i, entry): (usize, &Value)| {
        let key = |name: &str| format!("regions[{i}].{name}");
        let get = |name: &str| entry.get(name).ok_or_else(|| file.wrong(&key(name), "missing"));
        let id = get("id")?.as_u64().ok_or_else(|| file.wrong(&key("id"), "expected a region id"))?;
        let class = get("cls")?.as_str().ok_or_else(|| file.wrong(&key("cls"), "expected a class name"))?;
        let values: [f64; SOIL_DIM] = file.array(&key("soil"), get("soil")?)?;
        let mut soil = Soil::from_array(order.map(|at| values[at]));
        soil.phi = soil.phi.to_radians();
        Ok(RegionSoil { id: id as usize, class: class.into(), soil })
    };
    Ok(SoilTruth { regions: regions.iter().enumerate().map(region).collect::<Result<_, TrajectoryError>>()? })
}
