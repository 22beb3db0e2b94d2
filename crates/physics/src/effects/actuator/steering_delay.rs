//! Steering commands that arrive late.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Steering delay (catalogue no. 13): u_eff(t) = u(t - d) for the second command, exact for commands held over a step and any fraction of it.
    ///
    /// The last twelve commands are kept; what comes later, with the card's dead time, is refused ([`Vehicle::check_effects`](crate::vehicle::Vehicle::check_effects)).
    struct SteeringDelay = "steering_delay" in Actuator {
        /// d, s.
        seconds: ("s", [0.0, 0.6], 0.15, Size),
    }
    |effect, terms| terms.actuator.delay_s[1] += effect.seconds
}
