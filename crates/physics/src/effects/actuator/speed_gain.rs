//! A drive that holds another speed than it is told.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Speed gain (catalogue no. 18): the drive tracks (1 + k) times the commanded speed (a wrong calibration of speedometer or throttle).
    struct SpeedGain = "speed_gain" in Actuator {
        /// k, -.
        relative: ("-", [-0.6, 1.5], 0.05, Size),
    }
    |effect, terms| terms.actuator.speed_gain += effect.relative
}
