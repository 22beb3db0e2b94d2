//! A steering that turns the wheels more or less than the card says.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Steering ratio (catalogue no. 15): δ ← (1 + k) δ, behind the actuator and before a [`SteeringOffset`](super::SteeringOffset). Beyond the ends of the
    /// steering table the wheels go on with its slope there. Of a skid-steer vehicle the turning of the rims.
    struct SteeringRatio = "steering_ratio" in Actuator {
        /// k, -.
        relative: ("-", [-0.5, 0.5], 0.08, Size),
    }
    |effect, terms| terms.actuator.steering_ratio += effect.relative
}
