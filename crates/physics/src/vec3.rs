//! Three-vectors and rotations over any scalar, kept as plain arrays so that lanes and duals stay in registers.

use crate::scalar::Real;

/// A vector with three components; the frame is in the name of the variable (`v_B`, `f_W`).
pub type Vec3<T> = [T; 3];

/// a + b.
#[inline(always)]
pub fn add<T: Real>(a: Vec3<T>, b: Vec3<T>) -> Vec3<T> {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

/// s a.
#[inline(always)]
pub fn scale<T: Real>(a: Vec3<T>, s: T) -> Vec3<T> {
    [a[0] * s, a[1] * s, a[2] * s]
}

/// a · b.
#[inline(always)]
pub fn dot<T: Real>(a: Vec3<T>, b: Vec3<T>) -> T {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// a × b.
#[inline(always)]
pub fn cross<T: Real>(a: Vec3<T>, b: Vec3<T>) -> Vec3<T> {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

/// a / |a|.
#[inline(always)]
pub fn normalise<T: Real>(a: Vec3<T>) -> Vec3<T> {
    scale(a, T::lit(1.0) / dot(a, a).sqrt())
}

/// Roll, pitch and yaw (R = Rz Ry Rx), rad, of a unit quaternion x, y, z, w; `None` where its length is far from one.
pub fn attitude_of_quaternion([x, y, z, w]: [f64; 4]) -> Option<[f64; 3]> {
    let length = (x * x + y * y + z * z + w * w).sqrt();
    if !(0.5..2.0).contains(&length) {
        return None;
    }
    let [x, y, z, w] = [x, y, z, w].map(|v| v / length);
    let roll = (2.0 * (w * x + y * z)).atan2(1.0 - 2.0 * (x * x + y * y));
    let pitch = (2.0 * (w * y - z * x)).clamp(-1.0, 1.0).asin();
    let yaw = (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z));
    Some([roll, pitch, yaw])
}

/// R_WB v_B: a vector of Body in World, by roll, pitch and yaw, rad.
#[inline(always)]
pub fn in_world<T: Real>([roll, pitch, yaw]: &Vec3<T>, v_b: Vec3<T>) -> Vec3<T> {
    let h = Tilt::new(*roll, *pitch).to_heading(v_b);
    let (sin, cos) = yaw.sin_cos();
    [cos * h[0] - sin * h[1], sin * h[0] + cos * h[1], h[2]]
}

/// R_HB = Ry(pitch) Rx(roll): from Body to the heading frame H (World turned by yaw about z). Rows are the axes of H in Body.
#[derive(Clone, Copy, Debug)]
pub struct Tilt<T> {
    rows: [Vec3<T>; 3],
    /// sin and cos of roll, cos and tan of pitch: what the attitude rates need.
    sin_roll: T,
    cos_roll: T,
    cos_pitch: T,
    tan_pitch: T,
}

impl<T: Real> Tilt<T> {
    /// From roll and pitch, rad.
    #[inline(always)]
    pub fn new(roll_rad: T, pitch_rad: T) -> Self {
        let (sr, cr) = roll_rad.sin_cos();
        let (sp, cp) = pitch_rad.sin_cos();
        let zero = T::lit(0.0);
        Self {
            rows: [[cp, sp * sr, sp * cr], [zero, cr, -sr], [-sp, cp * sr, cp * cr]],
            sin_roll: sr,
            cos_roll: cr,
            cos_pitch: cp,
            tan_pitch: sp / cp,
        }
    }

    /// v_H = R_HB v_B.
    #[inline(always)]
    pub fn to_heading(&self, v_b: Vec3<T>) -> Vec3<T> {
        [dot(self.rows[0], v_b), dot(self.rows[1], v_b), dot(self.rows[2], v_b)]
    }

    /// v_B = R_HBᵀ v_H.
    #[inline(always)]
    pub fn to_body(&self, v_h: Vec3<T>) -> Vec3<T> {
        add(add(scale(self.rows[0], v_h[0]), scale(self.rows[1], v_h[1])), scale(self.rows[2], v_h[2]))
    }

    /// Rates of roll, pitch, yaw from the angular velocity in Body (singular at |pitch| = 90 degrees).
    #[inline(always)]
    pub fn attitude_rates(&self, w_b: Vec3<T>) -> Vec3<T> {
        let turn = self.sin_roll * w_b[1] + self.cos_roll * w_b[2];
        [w_b[0] + self.tan_pitch * turn, self.cos_roll * w_b[1] - self.sin_roll * w_b[2], turn / self.cos_pitch]
    }
}
