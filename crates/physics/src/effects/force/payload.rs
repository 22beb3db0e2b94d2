//! A mass that rides along: total mass, centre of mass and inertia change, the springs do not.

use crate::effects::{Act, EffectTerms, Layer, Quantity, Scaling};

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

impl Act for Payload {
    const ID: &'static str = "payload";
    const LAYER: Layer = Layer::Force;
    const QUANTITIES: &'static [Quantity] = &[
        Quantity::new("mass_kg", "kg", [-500.0, 2000.0], 400.0, Scaling::Size),
        Quantity::new("x_m", "m", [-3.0, 3.0], -0.6, Scaling::Held),
        Quantity::new("y_m", "m", [-1.5, 1.5], 0.2, Scaling::Held).odd(),
        Quantity::new("z_m", "m", [-2.0, 2.0], 0.6, Scaling::Held),
    ];

    fn values(&self) -> Vec<f64> {
        let [x, y, z] = self.at_m;
        vec![self.mass_kg, x, y, z]
    }

    fn from_values(values: &[f64]) -> Option<Self> {
        let &[mass_kg, x, y, z] = values else { return None };
        Some(Self { mass_kg, at_m: [x, y, z] })
    }

    fn add_to(&self, terms: &mut EffectTerms) {
        let force = &mut terms.force;
        let total = force.added_mass_kg + self.mass_kg;
        if total != 0.0 {
            for (at, own) in force.added_at_m.iter_mut().zip(self.at_m) {
                *at = (*at * force.added_mass_kg + own * self.mass_kg) / total;
            }
        }
        force.added_mass_kg = total;
    }
}
