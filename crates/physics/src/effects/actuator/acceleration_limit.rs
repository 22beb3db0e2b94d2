//! A skid-steer drive whose speed is led to a command only so fast.

use crate::effects::Scaling::Limit;
use crate::effects::act::effect;

effect! {
    /// Acceleration limit (beyond the given catalogue, ADR 0072): the mean rim speed of a skid-steer base is led to its command by at most a_max, before its
    /// lags, as controllers of differential drives do. Slower changes are untouched. Nothing on a car.
    struct AccelerationLimit = "acceleration_limit" in Actuator {
        /// a_max, m/s².
        m_s2: ("m/s²", [0.05, 50.0], 3.0, Limit),
    }
    |effect, terms| terms.actuator.acceleration_limit_inverse[0] = terms.actuator.acceleration_limit_inverse[0].max(1.0 / effect.m_s2)
}
