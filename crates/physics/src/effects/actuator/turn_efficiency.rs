//! A skid-steer base that turns less than its rims.

use crate::effects::Scaling::Factor;
use crate::effects::act::effect;

effect! {
    /// Turn efficiency (beyond the given catalogue, ADR 0073): the yaw rate per turning of the rims of a skid-steer base, by which the rims are told from the motion
    /// where a prediction begins and nobody measured them, is `factor` times that of the card. Nothing once the rims are known, and nothing on a car.
    struct TurnEfficiency = "turn_efficiency" in Actuator {
        /// Factor on the efficiency of the card, -.
        factor: ("-", [0.05, 3.0], 0.5, Factor),
    }
    |effect, terms| terms.actuator.turn_efficiency = (1.0 + terms.actuator.turn_efficiency) * effect.factor - 1.0
}
