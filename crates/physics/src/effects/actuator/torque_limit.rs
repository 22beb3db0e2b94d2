//! A drive that cannot pull as the card's does.

use crate::effects::Scaling::Factor;
use crate::effects::act::effect;

effect! {
    /// Torque limit (catalogue no. 11): τ = min(τ, f τ_max). The drive line of a speed-controlled car is known by the rim over-speed that it can hold, so
    /// its limit shrinks to the share f; of a skid-steer vehicle the largest rim speed does.
    struct TorqueLimit = "torque_limit" in Actuator {
        /// Share f of the limit that is left, -.
        fraction: ("-", [0.05, 1.5], 0.4, Factor),
    }
    |effect, terms| terms.actuator.torque_lost = 1.0 - (1.0 - terms.actuator.torque_lost) * effect.fraction
}
