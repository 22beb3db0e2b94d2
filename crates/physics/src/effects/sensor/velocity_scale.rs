//! A velocity sensor that shows too much or too little.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Velocity scale (catalogue no. 36): v measured = (1 + k) v. Positions tell otherwise.
    struct VelocityScale = "velocity_scale" in Sensor {
        /// k, -.
        relative: ("-", [-0.3, 0.3], 0.04, Size),
    }
    |effect, terms| terms.sensor.velocity_scale += effect.relative
}
