//! A drive that follows its speed command slowly.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Speed lag (catalogue no. 12): τ u̇_eff = u - u_eff on the speed command, before the drive of the card.
    struct SpeedLag = "speed_lag" in Actuator {
        /// τ, s.
        seconds: ("s", [0.0, 2.0], 0.3, Size),
    }
    |effect, terms| terms.actuator.lag_s[0] += effect.seconds
}
