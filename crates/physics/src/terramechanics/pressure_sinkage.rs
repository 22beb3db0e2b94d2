//! Bekker pressure-sinkage.

use crate::scalar::Real;
use crate::soil::Soil;

/// Smallest depth at which stresses are evaluated, m; keeps `depth^n` differentiable.
const DEPTH_FLOOR_M: f64 = 1e-7;

/// Normal stress of the Bekker law, Pa: σ = (k_c / b + k_φ) depth^n (Bekker 1969; paper §III-B).
#[inline(always)]
pub fn normal_stress<T: Real>(depth_m: T, width_m: f64, soil: &Soil<T>) -> T {
    let modulus = soil.k_c * T::lit(1.0 / width_m) + soil.k_phi;
    modulus * depth_m.max(T::lit(DEPTH_FLOOR_M)).powf(soil.n)
}

/// Static sinkage of a rigid wheel, m: z = [3 W / ((3 - n) (k_c + b k_φ) √D)]^(2 / (2n + 1)) (Bekker 1969), n < 3.
#[inline(always)]
pub fn bekker_sinkage<T: Real>(load_n: T, radius_m: f64, width_m: f64, soil: &Soil<T>) -> T {
    let stiffness = (T::lit(3.0) - soil.n) * (soil.k_c + soil.k_phi * T::lit(width_m)) * T::lit((2.0 * radius_m).sqrt());
    (T::lit(3.0) * load_n / stiffness).powf(T::lit(2.0) / (T::lit(2.0) * soil.n + T::lit(1.0)))
}
