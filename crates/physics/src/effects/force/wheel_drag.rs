//! Friction at one wheel: a dragging brake, a bad bearing.

use crate::effects::{Act, EffectTerms, Layer, Quantity, Scaling};
use crate::vehicle::WHEELS;

/// Wheel drag (catalogue no. 10): F_i = −(τ / r) tanh(v_i / 0.07 m/s) along the wheel's heading, at the contact.
///
/// The rims of a speed-controlled vehicle follow the ground here, so the friction torque appears as the force it takes away from the tread. What the
/// coupling of a limited-slip axle passes over is taken from the partner's tread instead, and a
/// speed controller makes up for the sum, so that the vehicle turns rather than slows (`step.rs`, [`Vehicle::drag_made_up_n_m`]).
///
/// [`Vehicle::drag_made_up_n_m`]: crate::Vehicle::drag_made_up_n_m
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WheelDrag {
    /// Wheel: 0 = front left, 1 = front right, 2 = rear left, 3 = rear right.
    pub wheel: usize,
    /// Friction torque, N m.
    pub torque_n_m: f64,
}

impl Act for WheelDrag {
    const ID: &'static str = "wheel_drag";
    const LAYER: Layer = Layer::Force;
    const QUANTITIES: &'static [Quantity] = &[
        Quantity::new("wheel", "index", [-0.5, WHEELS as f64 - 0.5], 2.0, Scaling::Held),
        Quantity::new("torque_nm", "N m", [-200.0, 4000.0], 600.0, Scaling::Size),
    ];

    fn values(&self) -> Vec<f64> {
        vec![self.wheel as f64, self.torque_n_m]
    }

    fn from_values(values: &[f64]) -> Option<Self> {
        let &[wheel, torque_n_m] = values else { return None };
        Some(Self { wheel: wheel as usize, torque_n_m })
    }

    fn add_to(&self, terms: &mut EffectTerms) {
        terms.force.wheel_drag_n_m[self.wheel.min(WHEELS - 1)] += self.torque_n_m;
    }
}
