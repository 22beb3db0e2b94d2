//! Mohr-Coulomb strength and Janosi-Hanamoto mobilisation.

use crate::scalar::Real;
use crate::soil::Soil;

/// Shear strength, Pa: τ_max = c + σ tan φ (Mohr-Coulomb).
#[inline(always)]
pub fn mohr_coulomb<T: Real>(normal_stress_pa: T, tan_phi: T, soil: &Soil<T>) -> T {
    soil.c + normal_stress_pa * tan_phi
}

/// Mobilised share of the strength per metre of shear displacement, (1 - e^{-j/K}) / j (Janosi & Hanamoto 1961), j > 0.
#[inline(always)]
pub fn shear_fraction<T: Real>(displacement_m: T, soil: &Soil<T>) -> T {
    (T::lit(1.0) - (-(displacement_m / soil.k_shear)).exp()) / displacement_m
}
