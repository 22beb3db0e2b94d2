//! Positions that are older than the rest of a sample.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Position latency (catalogue no. 37): p measured at t = p(t - d); attitude and velocities are of t.
    struct PositionLatency = "position_latency" in Sensor {
        /// d, s.
        seconds: ("s", [-0.2, 0.6], 0.1, Size),
    }
    |effect, terms| terms.sensor.position_latency_s += effect.seconds
}
