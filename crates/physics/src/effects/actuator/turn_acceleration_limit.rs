//! A skid-steer drive whose turning is led to a command only so fast.

use crate::effects::Scaling::Limit;
use crate::effects::act::effect;

effect! {
    /// Acceleration limit of turning (beyond the given catalogue, ADR 0072): the turning of the rims of a skid-steer base, (v_right - v_left) / B, is led to its
    /// command by at most α_max, before its lags, as controllers of differential drives do. Slower changes are untouched. Nothing on a car.
    struct TurnAccelerationLimit = "turn_acceleration_limit" in Actuator {
        /// α_max, rad/s².
        rad_s2: ("rad/s²", [0.05, 50.0], 3.0, Limit),
    }
    |effect, terms| terms.actuator.acceleration_limit_inverse[1] = terms.actuator.acceleration_limit_inverse[1].max(1.0 / effect.rad_s2)
}
