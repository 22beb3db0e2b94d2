//! Mohr-Coulomb strength and Janosi-Hanamoto mobilisation.

use crate::scalar::Real;
use crate::soil::Soil;

/// Shear strength, Pa: τ_max = c + σ tan φ (Mohr-Coulomb).
#[inline(always)]
pub fn mohr_coulomb<T: Real>(normal_stress_pa: T, tan_phi: T, soil: &Soil<T>) -> T {
    soil.c + normal_stress_pa * tan_phi
}

/// Mobilised share of the strength, 1 - e^{-j/K} (Janosi & Hanamoto 1961); `per_modulus` is 1 / K, 1/m.
#[inline(always)]
pub fn mobilised_share<T: Real>(displacement_m: T, per_modulus: T) -> T {
    T::lit(1.0) - (-(displacement_m * per_modulus)).exp()
}
