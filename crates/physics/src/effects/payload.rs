//! A mass that rides along: total mass, centre of mass and inertia change, the springs do not.

use super::{EffectTerms, Parameter};

/// Payload as a point mass (catalogue no. 1): M ← M + m; the centre of mass moves to m r / (M + m); I_P ← I_P + m (|r|² 1 − r rᵀ).
///
/// Neglects the payload's own inertia (a 1 m box of 600 kg adds 3 % to the yaw inertia of a 2.5-tonne car).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Payload {
    /// Mass, kg.
    pub mass_kg: f64,
    /// Position relative to the reference point, Body, m.
    pub at_m: [f64; 3],
}

impl Payload {
    pub(super) fn parameters(&self) -> Vec<Parameter> {
        let position = |name, value, reach: f64| Parameter { name, unit: "m", value, range: [-reach, reach] };
        vec![
            Parameter { name: "mass_kg", unit: "kg", value: self.mass_kg, range: [-500.0, 2000.0] },
            position("x_m", self.at_m[0], 3.0),
            position("y_m", self.at_m[1], 1.5),
            position("z_m", self.at_m[2], 2.0),
        ]
    }

    pub(super) fn add_to(&self, terms: &mut EffectTerms) {
        let total = terms.added_mass_kg + self.mass_kg;
        if total != 0.0 {
            for (at, own) in terms.added_at_m.iter_mut().zip(self.at_m) {
                *at = (*at * terms.added_mass_kg + own * self.mass_kg) / total;
            }
        }
        terms.added_mass_kg = total;
    }
}
