//! The soil that a rollout meets: the prior with one correction for all, or another one from place to place and from sample to sample.

use core::fmt::Debug;
use std::sync::Arc;

use nesam_physics::{SOIL_DIM, SoilCorrection};
use nesam_terrain::WorldMap;

/// Soil along a rollout. A [`SoilCorrection`] is the simplest one; what was learned may differ by the look of the ground or by place, and a what-if
/// study gives every sample its own soil.
pub trait SoilField: Debug + Send + Sync {
    /// Soil θ (SI, order of `SOIL_NAMES`) that sample `sample` meets at `position_m` (x, y in World), where the prior says `prior`. Must be finite, positive
    /// and inside `SOIL_BOUNDS`.
    fn soil(&self, sample: usize, position_m: [f64; 2], prior: &[f64; SOIL_DIM]) -> [f64; SOIL_DIM];
}

impl SoilField for SoilCorrection {
    fn soil(&self, _sample: usize, _position_m: [f64; 2], prior: &[f64; SOIL_DIM]) -> [f64; SOIL_DIM] {
        self.apply(prior)
    }
}

/// A correction for each class of ground that the map tells apart: what a soil filter with classes has learned.
#[derive(Clone, Debug)]
pub struct SoilByClass {
    map: Option<Arc<WorldMap>>,
    corrections: Vec<SoilCorrection>,
}

impl SoilByClass {
    /// `corrections[0]` holds where no class is known, `corrections[i + 1]` on class i of the map; classes beyond the list are as the first. An empty list is
    /// no correction.
    pub fn new(map: Option<&Arc<WorldMap>>, corrections: Vec<SoilCorrection>) -> Self {
        Self { map: map.filter(|_| corrections.len() > 1).cloned(), corrections }
    }

    /// Class of the ground as the soil filter counts: 0 = not known, i + 1 = class i of the map.
    pub fn class_at(map: Option<&WorldMap>, position_m: [f64; 2]) -> usize {
        map.and_then(|map| map.soil_class_index(position_m[0], position_m[1])).map_or(0, |index| index + 1)
    }
}

impl SoilField for SoilByClass {
    fn soil(&self, _sample: usize, position_m: [f64; 2], prior: &[f64; SOIL_DIM]) -> [f64; SOIL_DIM] {
        let class = Self::class_at(self.map.as_deref(), position_m);
        let correction = self.corrections.get(class).or_else(|| self.corrections.first());
        correction.copied().unwrap_or_default().apply(prior)
    }
}
