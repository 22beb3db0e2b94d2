//! What stands in for ground that no map shows, measured once a network is trained.
//!
//! A network that has seen colours in every drive makes of a map without them what it makes of grey paint, which no drive had. In the mean over the drives that
//! trained it colours add something to the context and give a soil: this is the least surprising thing to see where nothing is seen.

use std::collections::HashMap;
use std::sync::Arc;

use nesam_model::dims::HIDDEN;
use nesam_model::soil_coordinates::{LOGARITHMIC, from_raw};
use nesam_model::{ModelBundle, ModelError, Predictor, StandIn, TerrainToken};
use nesam_physics::SOIL_DIM;
use nesam_terrain::{Pose2, WorldMap};
use nesam_trajectories::{DataRoot, Trajectory};
use rayon::prelude::*;

use crate::drives::Drive;
use crate::recipe::load_drives;
use crate::trainer::TrainingError;

/// Samples from one pose to the next: a vehicle at 3 m/s is 6 m further on.
const EVERY: usize = 20;

/// Means along the drives that trained a bundle; `None` unless every one of them has a map with colours, as a network that was trained without some has seen what
/// it is to lack them.
///
/// # Errors
/// As [`Predictor::new`].
pub fn measure(bundle: &ModelBundle, drives: &[&Drive]) -> Result<Option<StandIn>, ModelError> {
    let Some(maps) = drives.iter().map(|d| d.map.as_ref().filter(|map| map.has_semantics())).collect::<Option<Vec<_>>>() else {
        return Ok(None);
    };
    let bare: HashMap<&str, Arc<WorldMap>> = maps
        .iter()
        .map(|map| (map.hash(), *map))
        .collect::<HashMap<_, _>>()
        .into_iter()
        .map(|(hash, map)| (hash, Arc::new(map.without_colours())))
        .collect();
    let mut plain = bundle.clone();
    plain.normalization.stand_in = None;
    let predictor = Predictor::new(Arc::new(plain))?.exactly();
    let along = |(drive, map): (&&Drive, &&Arc<WorldMap>)| {
        let poses: Vec<Pose2> = (0..drive.states.len()).step_by(EVERY).map(|i| drive.pose(i)).collect();
        let [seen, unseen] = [*map, &bare[map.hash()]].map(|map| predictor.terrain_tokens(Some(map), &poses));
        seen.iter().zip(&unseen).map(|(seen, unseen)| Sums::of(seen, unseen)).fold(Sums::NONE, Sums::plus)
    };
    let by_drive: Vec<Sums> = drives.par_iter().zip(&maps).map(along).collect();
    let sums = by_drive.into_iter().fold(Sums::NONE, Sums::plus);
    Ok((sums.poses > 0.0).then(|| sums.stand_in()))
}

/// The same along drives of a data root.
///
/// # Errors
/// `TrainingError` when a map cannot be read, or as [`measure`].
pub fn measure_on(bundle: &ModelBundle, root: &DataRoot, training: &[Trajectory]) -> Result<Option<StandIn>, TrainingError> {
    let drives = load_drives(root, training)?;
    Ok(measure(bundle, &drives.iter().collect::<Vec<_>>())?)
}

/// Sums over poses.
struct Sums {
    poses: f64,
    /// Context with colours, and what it has over that without.
    ground: [f64; HIDDEN],
    colours: [f64; HIDDEN],
    /// Soil prior, raw, and in the coordinates of a standard deviation with its square.
    soil_raw: [f64; SOIL_DIM],
    soil: [f64; SOIL_DIM],
    squares: [f64; SOIL_DIM],
}

impl Sums {
    const NONE: Self = Self {
        poses: 0.0,
        ground: [0.0; HIDDEN],
        colours: [0.0; HIDDEN],
        soil_raw: [0.0; SOIL_DIM],
        soil: [0.0; SOIL_DIM],
        squares: [0.0; SOIL_DIM],
    };

    /// One pose on a map with and without its colours.
    fn of(seen: &TerrainToken, unseen: &TerrainToken) -> Self {
        let raw: [f32; SOIL_DIM] = core::array::from_fn(|i| seen[HIDDEN + i]);
        let theta = from_raw(&raw);
        let soil: [f64; SOIL_DIM] = core::array::from_fn(|i| if LOGARITHMIC[i] { theta[i].ln() } else { theta[i] });
        Self {
            poses: 1.0,
            ground: core::array::from_fn(|i| f64::from(seen[i])),
            colours: core::array::from_fn(|i| f64::from(seen[i]) - f64::from(unseen[i])),
            soil_raw: raw.map(f64::from),
            soil,
            squares: soil.map(|v| v * v),
        }
    }

    fn plus(self, other: Self) -> Self {
        Self {
            poses: self.poses + other.poses,
            ground: added(self.ground, other.ground),
            colours: added(self.colours, other.colours),
            soil_raw: added(self.soil_raw, other.soil_raw),
            soil: added(self.soil, other.soil),
            squares: added(self.squares, other.squares),
        }
    }

    fn stand_in(&self) -> StandIn {
        let mean = |sum: f64| sum / self.poses;
        StandIn {
            colours: self.colours.map(|sum| mean(sum) as f32).to_vec(),
            ground: self.ground.map(|sum| mean(sum) as f32).to_vec(),
            soil_raw: self.soil_raw.map(|sum| mean(sum) as f32),
            soil_sd: core::array::from_fn(|i| (mean(self.squares[i]) - mean(self.soil[i]).powi(2)).max(0.0).sqrt()),
        }
    }
}

fn added<const N: usize>(a: [f64; N], b: [f64; N]) -> [f64; N] {
    core::array::from_fn(|i| a[i] + b[i])
}
