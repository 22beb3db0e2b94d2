//! A steering that gives way to side forces.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Steering compliance (catalogue no. 17): δ ← δ - C F_y with the side force on the front axle F_y = M (l_r / L) v_x ω_z of steady cornering.
    ///
    /// It grows with speed and turn, where a wrong ratio does not. Neglects the aligning moment of the contact itself and side forces on a slope.
    struct SteeringCompliance = "steering_compliance" in Actuator {
        /// C, rad/N.
        rad_n: ("rad/N", [-2e-5, 4e-5], 5e-6, Size),
    }
    |effect, terms| terms.actuator.steering_compliance_rad_n += effect.rad_n
}
