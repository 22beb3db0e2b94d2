//! Conventions of axes.

use std::f64::consts::FRAC_PI_2;

/// Axes of a log.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum FrameConvention {
    /// World x east, y north, z up; Body x forward, y left, z up (ROS, REP-103). Pitch > 0 is nose down.
    #[default]
    EnuFlu,
    /// World x north, y east, z down; Body x forward, y right, z down (aviation, PX4, ArduPilot). Pitch > 0 is nose up, yaw counts clockwise from north.
    NedFrd,
}

impl FrameConvention {
    /// A vector of World in east, north, up.
    pub(crate) fn world(self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        match self {
            Self::EnuFlu => [x, y, z],
            Self::NedFrd => [y, x, -z],
        }
    }

    /// A vector of Body in forward, left, up; angular velocities too.
    pub(crate) fn body(self, [x, y, z]: [f64; 3]) -> [f64; 3] {
        match self {
            Self::EnuFlu => [x, y, z],
            Self::NedFrd => [x, -y, -z],
        }
    }

    /// Roll, pitch and yaw.
    pub(crate) fn attitude(self, [roll, pitch, yaw]: [f64; 3]) -> [f64; 3] {
        match self {
            Self::EnuFlu => [roll, pitch, yaw],
            Self::NedFrd => [roll, -pitch, wrapped(FRAC_PI_2 - yaw)],
        }
    }

    /// An angle or rate about the axis that points up here: yaw rate, road-wheel angle, steering.
    pub(crate) fn about_up(self, value: f64) -> f64 {
        match self {
            Self::EnuFlu => value,
            Self::NedFrd => -value,
        }
    }
}

/// The angle in (-π, π].
pub(crate) fn wrapped(angle: f64) -> f64 {
    use std::f64::consts::{PI, TAU};
    if angle > -PI && angle <= PI {
        return angle;
    }
    PI - (PI - angle).rem_euclid(TAU)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// R = Rz Ry Rx.
    fn matrix([roll, pitch, yaw]: [f64; 3]) -> [[f64; 3]; 3] {
        let ((sr, cr), (sp, cp), (sy, cy)) = (roll.sin_cos(), pitch.sin_cos(), yaw.sin_cos());
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    }

    #[test]
    fn analytic_ned_attitudes_are_the_same_rotation() {
        let rpy = [0.2, -0.3, 1.1];
        let (ned, enu) = (matrix(rpy), matrix(FrameConvention::NedFrd.attitude(rpy)));
        // Column j of R is Body axis j in World: converted axis by axis.
        for (j, sign) in [1.0, -1.0, -1.0].into_iter().enumerate() {
            let axis = FrameConvention::NedFrd.world([sign * ned[0][j], sign * ned[1][j], sign * ned[2][j]]);
            for i in 0..3 {
                assert!((axis[i] - enu[i][j]).abs() < 1e-12, "{i} {j}: {} {}", axis[i], enu[i][j]);
            }
        }
    }

    #[test]
    fn analytic_angles_are_wrapped() {
        assert!((wrapped(4.0) - (4.0 - std::f64::consts::TAU)).abs() < 1e-12 && wrapped(-std::f64::consts::PI) > 3.0);
    }
}
