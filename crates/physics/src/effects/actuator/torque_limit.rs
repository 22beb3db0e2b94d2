//! A drive that cannot pull as the card's does.

use crate::effects::Scaling::Factor;
use crate::effects::act::effect;

effect! {
    /// Torque limit (catalogue no. 11): τ = min(τ, f τ_max). An engine whose torque is linear in the pedal gives the share f of every torque. A drive line that
    /// is known by the rim over-speed that it can hold has its limit shrink to the share f, a skid-steer vehicle its largest rim speed.
    struct TorqueLimit = "torque_limit" in Actuator {
        /// Share f of the limit that is left, -.
        fraction: ("-", [0.05, 1.5], 0.4, Factor),
    }
    |effect, terms| terms.actuator.torque_lost = 1.0 - (1.0 - terms.actuator.torque_lost) * effect.fraction
}
