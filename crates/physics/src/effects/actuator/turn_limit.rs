//! A skid-steer drive that turns its rims against each other only so fast.

use crate::effects::Scaling::Limit;
use crate::effects::act::effect;

effect! {
    /// Turn limit (beyond the given catalogue, ADR 0034): the turning of the rims of a skid-steer base, (v_right - v_left) / B, ends at ±ω_max whatever
    /// is commanded; commands below it are untouched. Nothing on a car.
    struct TurnLimit = "turn_limit" in Actuator {
        /// ω_max, rad/s.
        rad_s: ("rad/s", [0.05, 20.0], 0.5, Limit),
    }
    |effect, terms| terms.actuator.turn_limit_inverse_s_rad = terms.actuator.turn_limit_inverse_s_rad.max(1.0 / effect.rad_s)
}
