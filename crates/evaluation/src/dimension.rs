//! The six dimensions that are scored, and poses as six numbers.

use nesam_physics::{VehicleState, wrap_angle};

/// Number of scored dimensions.
pub const POSE_DIM: usize = 6;

/// Keys of the scored dimensions in JSON, in the order of every pose array: x, y, z, roll, pitch, yaw.
pub const DIMENSION_KEYS: [&str; POSE_DIM] = ["x_m", "y_m", "z_m", "roll_deg", "pitch_deg", "yaw_deg"];

/// A pose: x, y, z in m and roll, pitch, yaw in rad, World.
pub type Pose = [f64; POSE_DIM];

/// The pose part of a state.
pub fn pose_of(state: &VehicleState<f64>) -> Pose {
    let (p, a) = (state.position_m, state.attitude_rad);
    [p[0], p[1], p[2], a[0], a[1], a[2]]
}

/// Absolute error per dimension in the units of [`DIMENSION_KEYS`]: metres, and degrees of the wrapped difference.
pub fn absolute_error(predicted: &Pose, measured: &Pose) -> [f64; POSE_DIM] {
    std::array::from_fn(|d| {
        let difference = predicted[d] - measured[d];
        if d < 3 { difference.abs() } else { wrap_angle(difference).to_degrees().abs() }
    })
}

/// Horizontal distance between two poses, m.
pub fn horizontal_distance(a: &Pose, b: &Pose) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_angle_errors_are_wrapped_to_the_short_way() {
        let a = [1.0, 2.0, 3.0, 0.0, 0.0, 179.0_f64.to_radians()];
        let b = [4.0, -2.0, 3.5, 0.1, -0.1, -179.0_f64.to_radians()];
        let e = absolute_error(&a, &b);
        assert_eq!(&e[..3], &[3.0, 4.0, 0.5]);
        assert!((e[3] - 0.1_f64.to_degrees()).abs() < 1e-12 && (e[4] - e[3]).abs() < 1e-12);
        assert!((e[5] - 2.0).abs() < 1e-9, "358 degrees apart is 2 degrees, got {}", e[5]);
        assert_eq!(horizontal_distance(&a, &b), 5.0);
    }
}
