//! An antenna that is not where the card says.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Lever arm (catalogue no. 38): p measured = p + R ℓ and v measured = v + ω × ℓ. Kinematic only, where a shifted centre of mass changes forces.
    struct LeverArm = "lever_arm" in Sensor {
        /// ℓ ahead, m.
        x_m: ("m", [-2.0, 2.0], 0.3, Size),
        /// ℓ to the left, m.
        y_m: ("m", [-1.5, 1.5], 0.15, Size).odd(),
    }
    |effect, terms| {
        terms.sensor.lever_arm_m[0] += effect.x_m;
        terms.sensor.lever_arm_m[1] += effect.y_m
    }
}
