//! A clock that runs fast or slow.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Clock drift (catalogue no. 40): t of the log = (1 + ε) t, so a step of the log lasts Δt / (1 + ε). Velocities are true, distances per step are not.
    struct ClockDrift = "clock_drift" in Sensor {
        /// ε, -.
        relative: ("-", [-0.3, 0.3], 0.03, Size),
    }
    |effect, terms| terms.sensor.clock_drift += effect.relative
}
