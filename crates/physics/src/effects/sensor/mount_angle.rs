//! Sensors that are mounted askew.

use crate::effects::Scaling::Size;
use crate::effects::act::effect;

effect! {
    /// Mount angle (catalogue no. 39): R measured = R E and both velocities in the axes of E = Rz Ry Rx, the sensors' axes in Body.
    struct MountAngle = "mount_angle" in Sensor {
        /// Roll of E, rad.
        roll_rad: ("rad", [-0.2, 0.2], 0.01, Size).odd(),
        /// Pitch of E, rad.
        pitch_rad: ("rad", [-0.2, 0.2], 0.015, Size),
        /// Yaw of E, rad.
        yaw_rad: ("rad", [-0.2, 0.2], 0.02, Size).odd(),
    }
    |effect, terms| {
        terms.sensor.mount_rad[0] += effect.roll_rad;
        terms.sensor.mount_rad[1] += effect.pitch_rad;
        terms.sensor.mount_rad[2] += effect.yaw_rad
    }
}
