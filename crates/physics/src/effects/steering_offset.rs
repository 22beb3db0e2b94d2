//! A constant offset of the steering: a bent linkage, a wrong zero.

use super::{EffectTerms, Parameter};

/// Steering offset (catalogue no. 14): δ ← δ + δ_0, at the actuator, in the unit of the second command.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SteeringOffset {
    /// Offset, in the unit of the second command, positive left.
    pub second: f64,
}

impl SteeringOffset {
    pub(super) fn parameters(&self) -> Vec<Parameter> {
        vec![Parameter { name: "second", unit: "unit of the second command", value: self.second, range: [-0.5, 0.5] }]
    }

    pub(super) fn add_to(&self, terms: &mut EffectTerms) {
        terms.steering_offset += self.second;
    }
}
