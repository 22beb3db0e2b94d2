//! Baseline `constant_velocity`: the measured body twist goes on unchanged.

use nesam_physics::VehicleState;

use crate::dimension::Pose;

type Vector = [f64; 3];
type Matrix = [[f64; 3]; 3];

/// Poses after steps 1…`horizon` under the twist of `start`, held constant in Body.
///
/// The motion is the exact screw on SE(3): per step R ← R exp(ω× dt) and p ← p + R V(ω dt) v dt, with V the left Jacobian of SO(3)
/// (Murray, Li and Sastry 1994, Eq. 2.36). No command, no map, no fit.
pub fn constant_velocity(start: &VehicleState<f64>, horizon: usize, dt_s: f64) -> Vec<Pose> {
    let step = start.angular_velocity_rad_s.map(|w| w * dt_s);
    let (turn, jacobian) = exponential(step);
    let travel = times(&jacobian, &start.velocity_m_s.map(|v| v * dt_s));
    let mut rotation = rotation_from_rpy(start.attitude_rad);
    let mut position = start.position_m;
    (0..horizon)
        .map(|_| {
            let moved = times(&rotation, &travel);
            position = std::array::from_fn(|i| position[i] + moved[i]);
            rotation = product(&rotation, &turn);
            let [roll, pitch, yaw] = rpy_from_rotation(&rotation);
            [position[0], position[1], position[2], roll, pitch, yaw]
        })
        .collect()
}

/// exp(φ×) and its left Jacobian V(φ); series below 1e-6 rad where the closed form loses digits.
fn exponential(phi: Vector) -> (Matrix, Matrix) {
    let angle2 = phi.iter().map(|v| v * v).sum::<f64>();
    let angle = angle2.sqrt();
    let (a, b, c) = if angle < 1e-6 {
        (1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0, 1.0 / 6.0)
    } else {
        (angle.sin() / angle, (1.0 - angle.cos()) / angle2, (angle - angle.sin()) / (angle2 * angle))
    };
    let skew = [[0.0, -phi[2], phi[1]], [phi[2], 0.0, -phi[0]], [-phi[1], phi[0], 0.0]];
    let squared = product(&skew, &skew);
    let combine = |first: f64, second: f64| -> Matrix {
        std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j)) + first * skew[i][j] + second * squared[i][j]))
    };
    (combine(a, b), combine(b, c))
}

/// R_WB = Rz(yaw) Ry(pitch) Rx(roll).
fn rotation_from_rpy([roll, pitch, yaw]: Vector) -> Matrix {
    let ((sr, cr), (sp, cp), (sy, cy)) = (roll.sin_cos(), pitch.sin_cos(), yaw.sin_cos());
    [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
}

fn rpy_from_rotation(r: &Matrix) -> Vector {
    [r[2][1].atan2(r[2][2]), (-r[2][0]).clamp(-1.0, 1.0).asin(), r[1][0].atan2(r[0][0])]
}

fn product(a: &Matrix, b: &Matrix) -> Matrix {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..3).map(|k| a[i][k] * b[k][j]).sum()))
}

fn times(a: &Matrix, v: &Vector) -> Vector {
    std::array::from_fn(|i| (0..3).map(|k| a[i][k] * v[k]).sum())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(yaw: f64, velocity: Vector, omega: Vector) -> VehicleState<f64> {
        VehicleState { position_m: [1.0, 2.0, 3.0], attitude_rad: [0.0, 0.0, yaw], velocity_m_s: velocity, angular_velocity_rad_s: omega }
    }

    #[test]
    fn analytic_quarter_circle_ends_on_the_circle() {
        let omega = std::f64::consts::FRAC_PI_2 / 3.2;
        let speed = 2.0;
        let poses = constant_velocity(&state(0.0, [speed, 0.0, 0.0], [0.0, 0.0, omega]), 32, 0.1);
        let radius = speed / omega;
        let end = poses[31];
        assert!((end[0] - (1.0 + radius)).abs() < 1e-9 && (end[1] - (2.0 + radius)).abs() < 1e-9, "{end:?}");
        assert!((end[5] - std::f64::consts::FRAC_PI_2).abs() < 1e-9);
        assert!((end[2] - 3.0).abs() < 1e-12);
    }

    #[test]
    fn analytic_no_rotation_is_a_straight_line_in_the_heading() {
        let poses = constant_velocity(&state(std::f64::consts::FRAC_PI_2, [1.5, 0.0, -0.2], [0.0; 3]), 10, 0.1);
        assert!((poses[9][0] - 1.0).abs() < 1e-12 && (poses[9][1] - 3.5).abs() < 1e-12 && (poses[9][2] - 2.8).abs() < 1e-12);
    }

    #[test]
    fn property_attitude_round_trip() {
        for rpy in [[0.1, -0.2, 3.0], [-1.0, 0.9, -2.9], [0.0, 0.0, 0.0]] {
            let back = rpy_from_rotation(&rotation_from_rpy(rpy));
            assert!((0..3).all(|i| (back[i] - rpy[i]).abs() < 1e-12), "{rpy:?} {back:?}");
        }
    }
}
