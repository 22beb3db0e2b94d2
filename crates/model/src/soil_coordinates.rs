//! Unbounded coordinates of the soil vector.
//!
//! Network and optimiser work on raw numbers; a sigmoid between the admissible bounds, in the logarithm for the scale-like parameters,
//! makes every raw number an admissible soil, so no clip is needed inside the prior.

pub use nesam_physics::SOIL_LOGARITHMIC as LOGARITHMIC;
use nesam_physics::{SOIL_BOUNDS, SOIL_DIM};

/// Bounds of parameter `i` in the coordinate that the sigmoid runs over.
pub fn span(i: usize) -> (f64, f64) {
    let (low, high) = SOIL_BOUNDS[i];
    if LOGARITHMIC[i] { (low.ln(), high.ln()) } else { (low, high) }
}

/// θ of raw coordinates.
pub fn from_raw(raw: &[f32; SOIL_DIM]) -> [f64; SOIL_DIM] {
    core::array::from_fn(|i| {
        let (low, high) = span(i);
        let value = low + (high - low) / (1.0 + (-f64::from(raw[i])).exp());
        if LOGARITHMIC[i] { value.exp() } else { value }
    })
}

/// Raw coordinates of a θ strictly inside the bounds.
pub fn to_raw(theta: &[f64; SOIL_DIM]) -> [f32; SOIL_DIM] {
    core::array::from_fn(|i| {
        let (low, high) = span(i);
        let value = if LOGARITHMIC[i] { theta[i].ln() } else { theta[i] };
        let share = ((value - low) / (high - low)).clamp(1e-4, 1.0 - 1e-4);
        (share / (1.0 - share)).ln() as f32
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_coordinates_round_trip() {
        let theta = [1.5e6, 5.0e3, 0.7, 2.0e3, 0.5, 0.02];
        let back = from_raw(&to_raw(&theta));
        for i in 0..SOIL_DIM {
            assert!((back[i] / theta[i] - 1.0).abs() < 1e-5, "{i}: {} {}", back[i], theta[i]);
        }
    }
}
