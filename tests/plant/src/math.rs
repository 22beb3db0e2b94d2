//! Three-vectors, rotations and a small solver; nothing of this is shared with the model.

/// A vector in World or Body.
pub(crate) type Vec3 = [f64; 3];

pub(crate) fn add(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

pub(crate) fn sub(a: Vec3, b: Vec3) -> Vec3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

pub(crate) fn scale(a: Vec3, k: f64) -> Vec3 {
    [a[0] * k, a[1] * k, a[2] * k]
}

pub(crate) fn dot(a: Vec3, b: Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(crate) fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

pub(crate) fn norm(a: Vec3) -> f64 {
    dot(a, a).sqrt()
}

/// A rotation from Body to World as a matrix of rows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Rotation(pub [Vec3; 3]);

impl Rotation {
    /// Rz(yaw) Ry(pitch) Rx(roll).
    pub(crate) fn from_attitude([roll, pitch, yaw]: Vec3) -> Self {
        let ((sr, cr), (sp, cp), (sy, cy)) = (roll.sin_cos(), pitch.sin_cos(), yaw.sin_cos());
        Self([
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ])
    }

    /// Roll, pitch, yaw.
    pub(crate) fn attitude(&self) -> Vec3 {
        let m = &self.0;
        [m[2][1].atan2(m[2][2]), (-m[2][0]).clamp(-1.0, 1.0).asin(), m[1][0].atan2(m[0][0])]
    }

    /// Body vector in World.
    pub(crate) fn to_world(self, v: Vec3) -> Vec3 {
        [dot(self.0[0], v), dot(self.0[1], v), dot(self.0[2], v)]
    }

    /// World vector in Body.
    pub(crate) fn to_body(self, v: Vec3) -> Vec3 {
        let m = &self.0;
        std::array::from_fn(|i| m[0][i] * v[0] + m[1][i] * v[1] + m[2][i] * v[2])
    }

    /// After turning at a constant rate (Body, rad/s) for `dt_s`: Rodrigues' formula, rows made orthonormal again.
    pub(crate) fn turned(self, rate: Vec3, dt_s: f64) -> Self {
        let angle = norm(rate) * dt_s;
        if angle < 1e-12 {
            return self;
        }
        let axis = scale(rate, dt_s / angle);
        let (sin, cos) = angle.sin_cos();
        let columns: [Vec3; 3] = std::array::from_fn(|i| {
            let unit: Vec3 = std::array::from_fn(|j| f64::from(u8::from(i == j)));
            let turned = add(add(scale(unit, cos), scale(cross(axis, unit), sin)), scale(axis, dot(axis, unit) * (1.0 - cos)));
            self.to_world(turned)
        });
        let x = scale(columns[0], 1.0 / norm(columns[0]));
        let y = sub(columns[1], scale(x, dot(x, columns[1])));
        let y = scale(y, 1.0 / norm(y));
        let z = cross(x, y);
        Self([[x[0], y[0], z[0]], [x[1], y[1], z[1]], [x[2], y[2], z[2]]])
    }
}

/// Solves A x = b for a positive definite 3 x 3 matrix by Cramer's rule.
pub(crate) fn solve(a: &[Vec3; 3], b: Vec3) -> Vec3 {
    let det = |c: [Vec3; 3]| dot(c[0], cross(c[1], c[2]));
    let whole = det(*a);
    std::array::from_fn(|column| {
        let mut replaced = *a;
        for row in 0..3 {
            replaced[row][column] = b[row];
        }
        det(replaced) / whole
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_attitude_round_trip_and_small_turns_add_up() {
        let attitude = [0.1, -0.2, 2.5];
        let back = Rotation::from_attitude(attitude).attitude();
        assert!((0..3).all(|i| (back[i] - attitude[i]).abs() < 1e-12));
        let mut turned = Rotation::from_attitude([0.0; 3]);
        for _ in 0..1000 {
            turned = turned.turned([0.0, 0.0, 0.5], 0.002);
        }
        assert!((turned.attitude()[2] - 1.0).abs() < 1e-9);
        // Nose down is pitch > 0: the forward axis then points below the horizon.
        assert!(Rotation::from_attitude([0.0, 0.1, 0.0]).to_world([1.0, 0.0, 0.0])[2] < 0.0);
    }

    #[test]
    fn analytic_solver() {
        let x = solve(&[[4.0, 1.0, 0.0], [1.0, 3.0, -1.0], [0.0, -1.0, 2.0]], [6.0, 4.0, 4.0]);
        let b = [4.0 * x[0] + x[1], x[0] + 3.0 * x[1] - x[2], -x[1] + 2.0 * x[2]];
        assert!((b[0] - 6.0).abs() < 1e-12 && (b[1] - 4.0).abs() < 1e-12 && (b[2] - 4.0).abs() < 1e-12);
    }
}
