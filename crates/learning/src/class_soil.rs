//! What a map says of the soil under a place: the ranges of its semantic class, in the raw coordinates of the network's soil prior.

use nesam_model::soil_coordinates::to_raw;
use nesam_physics::SOIL_DIM;
use nesam_terrain::{SoilClassRange, WorldMap};

/// Ranges narrower than this, in raw coordinates, are taken to be rounded.
const NARROWEST_SD: f32 = 0.02;

/// Mean and standard deviation of a raw soil that lies anywhere within the ranges of a class with equal chance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClassSoil {
    /// Middle of each range.
    pub mean: [f32; SOIL_DIM],
    /// Standard deviation within each range.
    pub sd: [f32; SOIL_DIM],
}

impl ClassSoil {
    /// Soil of a class.
    pub fn of(class: &SoilClassRange) -> Self {
        let (low, high) = (to_raw(&class.low), to_raw(&class.high));
        Self {
            mean: core::array::from_fn(|i| 0.5 * (low[i] + high[i])),
            sd: core::array::from_fn(|i| ((high[i] - low[i]) / 12f32.sqrt()).max(NARROWEST_SD)),
        }
    }

    /// Soil under World x, y (m); `None` off the map and where it names no class or no range.
    pub fn at(map: &WorldMap, x_m: f64, y_m: f64) -> Option<Self> {
        map.soil_class(x_m, y_m).map(Self::of)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nesam_model::soil_coordinates::from_raw;

    #[test]
    fn analytic_a_class_lies_in_the_middle_of_its_ranges() {
        let low = [2.2e6, 1.0e4, 0.85, 5.0e3, 0.52, 0.008];
        let class = |high| ClassSoil::of(&SoilClassRange { name: "grass".into(), colour: None, low, high });
        let grass = class([5.0e6, 7.0e4, 1.05, 1.1e4, 0.63, 0.018]);
        let middle = from_raw(&grass.mean);
        assert!((0..SOIL_DIM).all(|i| middle[i] > low[i]), "{middle:?}");
        // A logarithmic parameter lies near the geometric mean of its ends, an angle near their mean.
        assert!((middle[0] / (2.2e6f64 * 5.0e6).sqrt() - 1.0).abs() < 0.05, "{middle:?}");
        assert!((middle[4] / 0.575 - 1.0).abs() < 0.05, "{middle:?}");
        assert!((grass.sd[0] * 12f32.sqrt() / (to_raw(&[5.0e6; 6])[0] - to_raw(&[2.2e6; 6])[0]) - 1.0).abs() < 1e-5);
        // A class that is stated by one number each is not held to its last digit.
        assert_eq!(class(low).sd, [NARROWEST_SD; SOIL_DIM]);
    }
}
