//! A constant offset of the steering: a bent linkage, a wrong zero.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Steering offset (catalogue no. 14): δ ← δ + δ_0, behind the actuator, in the unit of the second command.
    struct SteeringOffset = "steering_offset" in Actuator {
        /// Offset, in the unit of the second command, positive left.
        second: ("unit of the second command", [-0.5, 0.5], 0.06, Size).odd(),
    }
    |effect, terms| terms.actuator.steering_offset += effect.second
}
