//! A gyro that shows a turn at rest.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Gyro bias (catalogue no. 34): ω_z measured = ω_z + b. The measured yaw comes from elsewhere and stays.
    struct GyroBias = "gyro_bias" in Sensor {
        /// b, rad/s.
        rad_s: ("rad/s", [-0.2, 0.2], 0.01, Size).odd(),
    }
    |effect, terms| terms.sensor.gyro_bias_rad_s += effect.rad_s
}
