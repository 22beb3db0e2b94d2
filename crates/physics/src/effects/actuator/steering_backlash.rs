//! Play between steering actuator and road wheels.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Steering backlash (catalogue no. 16): the wheels follow the actuator s at a distance, y ← min(max(y, s - b/2), s + b/2) with the play b.
    /// A reversal of the steering has to cross b first. Of a skid-steer vehicle s is the turning of the rims, which follow their servo so.
    struct SteeringBacklash = "steering_backlash" in Actuator {
        /// Play b from end to end, in the unit of the second command.
        second: ("unit of the second command", [0.0, 0.5], 0.08, Size),
    }
    |effect, terms| terms.actuator.steering_play += effect.second
}
