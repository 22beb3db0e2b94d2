//! Speed commands that arrive late.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Speed delay (catalogue no. 12): u_eff(t) = u(t - d) for the speed command; see [`SteeringDelay`](super::SteeringDelay) for its reach.
    struct SpeedDelay = "speed_delay" in Actuator {
        /// d, s.
        seconds: ("s", [0.0, 0.6], 0.2, Size),
    }
    |effect, terms| terms.actuator.delay_s[0] += effect.seconds
}
