//! Soil parameters of the paper (θ ∈ R⁶) and their admissible bounds.

/// Number of soil parameters.
pub const SOIL_DIM: usize = 6;

/// Names in the order of every array, JSON and message: `k_phi, k_c, n, c, phi, k_shear`.
pub const SOIL_NAMES: [&str; SOIL_DIM] = ["k_phi", "k_c", "n", "c", "phi", "k_shear"];

/// Units in the order of [`SOIL_NAMES`].
pub const SOIL_UNITS: [&str; SOIL_DIM] = ["N/m^(n+2)", "N/m^(n+1)", "-", "Pa", "rad", "m"];

/// Soil vector θ (paper §III-B): Bekker pressure-sinkage, Mohr-Coulomb and Janosi-Hanamoto parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Soil<T> {
    /// Frictional modulus of sinkage, N/m^(n+2).
    pub k_phi: T,
    /// Cohesive modulus of sinkage, N/m^(n+1). Enters only as `k_c / b + k_phi` on a vehicle with one wheel width b.
    pub k_c: T,
    /// Sinkage exponent, -.
    pub n: T,
    /// Cohesion, Pa.
    pub c: T,
    /// Angle of internal friction, rad.
    pub phi: T,
    /// Janosi-Hanamoto shear deformation modulus K, m.
    pub k_shear: T,
}

impl<T: Copy> Soil<T> {
    /// In the order of [`SOIL_NAMES`].
    pub fn to_array(&self) -> [T; SOIL_DIM] {
        [self.k_phi, self.k_c, self.n, self.c, self.phi, self.k_shear]
    }

    /// Inverse of [`Soil::to_array`].
    pub fn from_array(a: [T; SOIL_DIM]) -> Self {
        Self { k_phi: a[0], k_c: a[1], n: a[2], c: a[3], phi: a[4], k_shear: a[5] }
    }
}

/// Admissible bounds θ_min, θ_max (paper Alg. 1), wide enough for the published soils of Wong's tables from snow to LETE sand.
pub const SOIL_BOUNDS: [(f64, f64); SOIL_DIM] = [(3.0e4, 1.5e7), (10.0, 2.0e5), (0.1, 1.6), (50.0, 7.0e4), (0.09, 0.75), (0.002, 0.08)];

/// Ground like a floor or a paved road, in the order of [`SOIL_NAMES`]: what a rigid wheel must stand on to hold as a tyre does there (chosen within [`SOIL_BOUNDS`]). The
/// patch that a tyre has from flexing it has here from sinking by some millimetres; it slides at 0.7 of its load after the least shear.
pub const HARD_GROUND: [f64; SOIL_DIM] = [2.0e6, 1.0e3, 0.5, 2.0e4, 0.62, 0.002];
