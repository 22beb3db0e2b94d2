//! Corrections of a soil prior: what the soil filter estimates and every prediction applies.

use crate::scalar::Real;
use crate::soil::{SOIL_BOUNDS, SOIL_DIM, Soil};

/// Parameters that vary over decades and are compared by their ratio: k_phi, k_c, c, k_shear; n and phi are compared by their difference.
pub const SOIL_LOGARITHMIC: [bool; SOIL_DIM] = [true, true, false, true, false, true];

/// Coordinates in which a correction Δ is added to a soil prior θ̄.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum SoilCoordinates {
    /// θ = clip(θ̄ + Δ) in physical units, word for word as in the paper (Alg. 1).
    Physical,
    /// θ = clip(θ̄ e^Δ) for the parameters of [`SOIL_LOGARITHMIC`], θ = clip(θ̄ + Δ) for n and phi. One correction then means the same
    /// softer or firmer ground whether the prior under the wheels is mud or gravel, and all six numbers are of order one.
    #[default]
    Logarithmic,
}

impl SoilCoordinates {
    /// Whether parameter `i` is corrected by a factor.
    fn by_factor(self, i: usize) -> bool {
        self == Self::Logarithmic && SOIL_LOGARITHMIC[i]
    }

    /// The corrected soil, clipped to the admissible bounds. A zero correction returns an admissible prior bit for bit.
    #[inline(always)]
    pub fn correct<T: Real>(self, prior: &[f64; SOIL_DIM], delta: &[T; SOIL_DIM]) -> [T; SOIL_DIM] {
        core::array::from_fn(|i| {
            let prior = T::lit(prior[i]);
            let moved = if self.by_factor(i) { prior * delta[i].exp() } else { prior + delta[i] };
            moved.max(T::lit(SOIL_BOUNDS[i].0)).min(T::lit(SOIL_BOUNDS[i].1))
        })
    }

    /// Slope of k_c with its own Δ by which the sum k_c / b + k_φ answers to both Δ in the ratio that it has at the *prior*, where k_φ has become `k_phi`. `None` where
    /// that is the true slope: in physical units the ratio is 1 / b everywhere.
    ///
    /// Of logarithms, the slopes of the sum stand in the ratio of its two parts, which moves as an estimate does, and a filter that linearises each buffer where
    /// it then stands would learn the parts one by one from nothing but its own moves. Slopes of a first estimate keep what cannot be seen unseen (first-estimates
    /// Jacobians: Huang, Mourikis & Roumeliotis 2010). Priors whose ratios differ from place to place still tell.
    pub fn first_slope_of_k_c(self, prior: &Soil<f64>, k_phi: f64) -> Option<f64> {
        (self == Self::Logarithmic).then(|| k_phi * prior.k_c / prior.k_phi)
    }

    /// The correction that leads from a prior to a soil.
    pub fn between(self, prior: &[f64; SOIL_DIM], soil: &[f64; SOIL_DIM]) -> [f64; SOIL_DIM] {
        core::array::from_fn(|i| if self.by_factor(i) { (soil[i] / prior[i]).ln() } else { soil[i] - prior[i] })
    }

    /// ∂θ/∂Δ at a soil inside the bounds: turns a standard deviation of the correction into one in physical units.
    pub fn slope(self, soil: &[f64; SOIL_DIM]) -> [f64; SOIL_DIM] {
        core::array::from_fn(|i| if self.by_factor(i) { soil[i] } else { 1.0 })
    }
}

/// A correction Δθ of the soil prior (paper Alg. 1). It holds wherever the vehicle goes, because it is relative to the prior of the place.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct SoilCorrection {
    /// Coordinates of `delta`.
    pub coordinates: SoilCoordinates,
    /// Δ in the order of `SOIL_NAMES`; zero = the prior as it is.
    pub delta: [f64; SOIL_DIM],
}

impl SoilCorrection {
    /// No correction.
    pub const NONE: Self = Self { coordinates: SoilCoordinates::Logarithmic, delta: [0.0; SOIL_DIM] };

    /// The corrected soil, clipped to the admissible bounds.
    pub fn apply(&self, prior: &[f64; SOIL_DIM]) -> [f64; SOIL_DIM] {
        self.coordinates.correct(prior, &self.delta)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LOAM: [f64; SOIL_DIM] = [1.515e6, 5.27e3, 0.7, 1.72e3, 0.506, 0.025];

    #[test]
    fn regress_no_correction_is_the_prior_bit_for_bit() {
        for coordinates in [SoilCoordinates::Physical, SoilCoordinates::Logarithmic] {
            let none = SoilCorrection { coordinates, delta: [0.0; SOIL_DIM] };
            assert_eq!(none.apply(&LOAM).map(f64::to_bits), LOAM.map(f64::to_bits));
        }
    }

    #[test]
    fn analytic_corrections_lead_where_they_say() {
        let sand = [8.0e5, 1.1e3, 1.05, 900.0, 0.55, 0.015];
        for coordinates in [SoilCoordinates::Physical, SoilCoordinates::Logarithmic] {
            let found = SoilCorrection { coordinates, delta: coordinates.between(&LOAM, &sand) }.apply(&LOAM);
            for i in 0..SOIL_DIM {
                assert!((found[i] / sand[i] - 1.0).abs() < 1e-12, "{coordinates:?} {i}: {} {}", found[i], sand[i]);
            }
        }
    }

    #[test]
    fn property_no_correction_leaves_the_bounds() {
        for size in [-1e3, -3.0, 3.0, 1e3] {
            let theta = SoilCorrection { coordinates: SoilCoordinates::Logarithmic, delta: [size; SOIL_DIM] }.apply(&LOAM);
            assert!((0..SOIL_DIM).all(|i| theta[i] >= SOIL_BOUNDS[i].0 && theta[i] <= SOIL_BOUNDS[i].1), "{theta:?}");
        }
    }
}
