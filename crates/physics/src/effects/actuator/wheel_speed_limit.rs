//! A skid-steer drive whose wheels turn only so fast.

use crate::effects::Scaling::Limit;
use crate::effects::act::effect;

effect! {
    /// Limit of the wheel speeds (beyond the given catalogue, ADR 0073): no rim of a skid-steer base is faster than v_max; beyond it both sides shrink by the same
    /// share, so that the path keeps its curvature. Slower commands are untouched. Nothing on a car.
    struct WheelSpeedLimit = "wheel_speed_limit" in Actuator {
        /// v_max, m/s.
        m_s: ("m/s", [0.05, 20.0], 1.0, Limit),
    }
    |effect, terms| terms.actuator.rim_limit_inverse_s_m = terms.actuator.rim_limit_inverse_s_m.max(1.0 / effect.m_s)
}
