//! A steering that follows its command slowly.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Steering lag (catalogue no. 13): τ u̇_eff = u - u_eff on the second command, in series with the actuator of the card, whose own lag stays.
    /// Two lags in series answer late by the sum of their time constants.
    struct SteeringLag = "steering_lag" in Actuator {
        /// τ, s.
        seconds: ("s", [0.0, 1.0], 0.15, Size),
    }
    |effect, terms| terms.actuator.lag_s[1] += effect.seconds
}
