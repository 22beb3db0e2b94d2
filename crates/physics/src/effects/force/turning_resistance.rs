//! Resistance of a skid-steer base to turning.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Turning resistance (beyond the given catalogue, ADR 0072): M_z = -C W L / 4 · v / √(v² + (0.07 m/s)²), v = ω_z L / 2, for the weight W and the length L
    /// between the axles, beside the moment by which the contacts resist; below zero they resist too much. C is a share of the coefficient of lateral resistance
    /// (Wong, Theory of Ground Vehicles, the moment of turning resistance of a tracked vehicle under even pressure). Nothing on a car.
    struct TurningResistance = "turning_resistance" in Force {
        /// C, -.
        coefficient: ("-", [-0.8, 0.8], 0.1, Size),
    }
    |effect, terms| terms.force.turning_resistance += effect.coefficient
}
