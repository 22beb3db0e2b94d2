//! Effects on the soil and its constitutive law: what the six parameters and the contact coefficients lack.

mod elastic_recovery;
mod front_bulldozing;
mod grousers;
mod multi_pass;
mod side_bulldozing;
mod slip_sinkage;
mod soil_crust;
mod soil_drift;
mod theta_m_shift;

pub use elastic_recovery::ElasticRecovery;
pub use front_bulldozing::FrontBulldozing;
pub use grousers::Grousers;
pub use multi_pass::MultiPass;
pub use side_bulldozing::SideBulldozing;
pub use slip_sinkage::SlipSinkage;
pub use soil_crust::SoilCrust;
pub use soil_drift::SoilDrift;
pub use theta_m_shift::ThetaMShift;

use crate::effects::PLACES_MAX;
use crate::scalar::Real;
use crate::soil::{SOIL_BOUNDS, SOIL_DIM, Soil};

/// Adds a share of bulldozing: the resistance is linear in the unit weight, so shares with weights of their own act as their sum at the mean weight.
fn add_bulldozing([sum, mean_n_m3]: &mut [f64; 2], share: f64, unit_weight_n_m3: f64) {
    let total = *sum + share;
    if total != 0.0 {
        *mean_n_m3 = if *sum == 0.0 { unit_weight_n_m3 } else { (*mean_n_m3 * *sum + unit_weight_n_m3 * share) / total };
    }
    *sum = total;
}

/// What effects change of soil and contact; all zero by default.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SoilTerms {
    /// Relative growth of sinkage per slip, -.
    pub slip_sinkage: f64,
    /// Relative growth of the sinkage moduli under the rear wheels, -.
    pub hardening: f64,
    /// Added to the recovery λ of the exit angle, -.
    pub recovery: f64,
    /// Added to c_1 of the angle of maximum stress, -.
    pub theta_m_shift: f64,
    /// Height of the grousers, m.
    pub grouser_height_m: f64,
    /// Share of front bulldozing that acts, and unit weight of the soil, N/m³.
    pub front_bulldozing: [f64; 2],
    /// Share of side bulldozing that acts, and unit weight of the soil, N/m³.
    pub side_bulldozing: [f64; 2],
    /// Logarithm of the modulus below a crust over that of the crust, and thickness of the crust, m, of each crust.
    pub crust: [[f64; 2]; PLACES_MAX],
    /// Logarithm of the factor on moduli, cohesion and friction angle at the end of a drift, and its begin and end, s since the start of the log, of each drift.
    pub drift: [[f64; 3]; PLACES_MAX],
}

impl SoilTerms {
    /// Whether the contact of a wheel follows another law than the six parameters say, coefficients of [`WheelGeometry`](crate::terramechanics::WheelGeometry)
    /// aside.
    pub fn acts_on_wheels(&self) -> bool {
        let sizes = [self.slip_sinkage, self.hardening, self.grouser_height_m, self.front_bulldozing[0], self.side_bulldozing[0]];
        sizes.iter().any(|size| *size != 0.0) || self.has_crust()
    }

    /// The soil at an instant of a drift, s since the start of the log; without an instant, at its end. Clipped to the admissible bounds where it drifts.
    #[inline(always)]
    pub fn drifted<T: Real>(&self, soil: [T; SOIL_DIM], time_s: Option<f64>) -> [T; SOIL_DIM] {
        if self.drift.iter().all(|drift| drift[0] == 0.0) {
            return soil;
        }
        let of = |[ln_factor, begin_s, end_s]: [f64; 3]| {
            let share = time_s.map_or(1.0, |t| ((t - begin_s) / (end_s - begin_s).max(1e-3)).clamp(0.0, 1.0));
            ln_factor * share
        };
        let factor = T::lit(self.drift.map(of).iter().sum::<f64>().exp());
        let drifts = |i: usize| matches!(i, 0 | 1 | 3 | 4);
        core::array::from_fn(|i| {
            let moved = if drifts(i) { soil[i] * factor } else { soil[i] };
            moved.max(T::lit(SOIL_BOUNDS[i].0)).min(T::lit(SOIL_BOUNDS[i].1))
        })
    }

    /// Whether the soil has a crust.
    pub fn has_crust(&self) -> bool {
        self.crust.iter().any(|crust| crust[0] != 0.0)
    }

    /// Soil under one wheel of width b that rolls by this share where another one has rolled.
    pub fn under_wheel<T: Real>(&self, soil: &Soil<T>, in_rut: T, width_m: f64) -> Soil<T> {
        let mut soil = *soil;
        if self.hardening != 0.0 {
            let factor = (T::lit(1.0) + T::lit(self.hardening) * in_rut).max(T::lit(0.01));
            (soil.k_phi, soil.k_c) = (soil.k_phi * factor, soil.k_c * factor);
        }
        if self.grouser_height_m != 0.0 {
            let share = self.grouser_height_m / width_m;
            soil.c = soil.c * T::lit(1.0 + 2.0 * share);
            soil.phi = (soil.phi.tan() * T::lit(1.0 + 0.64 * share * (width_m / self.grouser_height_m).atan())).atan();
        }
        soil
    }

    /// Soil under its crusts as its mean down to a sinkage, m: for each, the moduli times f + (1 - f) (z_h / z)^n, 1 as long as z ≤ z_h.
    pub fn under_crust<T: Real>(&self, soil: &Soil<T>, sinkage_m: T) -> Soil<T> {
        self.crust.iter().filter(|crust| crust[0] != 0.0).fold(*soil, |soil, &[ln_factor, thickness_m]| {
            let (factor, thickness) = (T::lit(ln_factor.exp()), T::lit(thickness_m.max(1e-4)));
            let share = (thickness / sinkage_m.max(thickness)).powf(soil.n);
            let modulus = factor + (T::lit(1.0) - factor) * share;
            Soil { k_phi: soil.k_phi * modulus, k_c: soil.k_c * modulus, ..soil }
        })
    }
}
