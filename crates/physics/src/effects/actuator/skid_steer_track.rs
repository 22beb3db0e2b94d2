//! A differential drive with another base than its controller assumes.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Track of a skid-steer vehicle: rims turn at v ∓ ω (B + ΔB) / 2. Nothing on a car.
    struct SkidSteerTrack = "skid_steer_track" in Actuator {
        /// ΔB, m.
        metres: ("m", [-0.5, 1.0], 0.05, Size),
    }
    |effect, terms| terms.actuator.track_m += effect.metres
}
