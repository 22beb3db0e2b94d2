//! A gyro that shows turns too large or too small.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Gyro scale (catalogue no. 35): ω measured = (1 + s) ω, all three axes.
    struct GyroScale = "gyro_scale" in Sensor {
        /// s, -.
        relative: ("-", [-0.3, 0.3], 0.04, Size),
    }
    |effect, terms| terms.sensor.gyro_scale += effect.relative
}
