//! The state of the vehicle, its command and the increment of one step.

use crate::scalar::Real;
use crate::vec3::{add, cross, in_world};

/// Dimension of the state vector of the paper (§III-A): position, attitude, linear and angular velocity.
pub const STATE_DIM: usize = 12;

/// Sampling interval of the paper, s.
pub const DT_S: f64 = 0.1;

/// State x of the vehicle (paper §III-A), R^12.
///
/// `position_m` is that of the reference point of the vehicle card in World (x east, y north, z up); `attitude_rad` is roll, pitch,
/// yaw of R_WB = Rz(yaw) Ry(pitch) Rx(roll) with Body FLU (x forward, y left, z up), so pitch > 0 is nose down; both velocities
/// are expressed in Body (REP-103/105: twist in the child frame).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VehicleState<T> {
    /// x, y, z in World, m.
    pub position_m: [T; 3],
    /// Roll, pitch, yaw, rad.
    pub attitude_rad: [T; 3],
    /// Linear velocity of the reference point in Body, m/s.
    pub velocity_m_s: [T; 3],
    /// Angular velocity in Body, rad/s.
    pub angular_velocity_rad_s: [T; 3],
}

/// Farthest that a point of the vehicle lies from its reference point along an axis, m: what is farther was not given in metres.
pub const POINT_MAX_M: f64 = 20.0;

impl<T: Copy> VehicleState<T> {
    /// The state as the twelve numbers of the paper's order: position, attitude, velocity, angular velocity.
    pub fn to_array(&self) -> [T; STATE_DIM] {
        let (p, a, v, w) = (self.position_m, self.attitude_rad, self.velocity_m_s, self.angular_velocity_rad_s);
        [p[0], p[1], p[2], a[0], a[1], a[2], v[0], v[1], v[2], w[0], w[1], w[2]]
    }

    /// Inverse of [`VehicleState::to_array`].
    pub fn from_array(x: [T; STATE_DIM]) -> Self {
        Self {
            position_m: [x[0], x[1], x[2]],
            attitude_rad: [x[3], x[4], x[5]],
            velocity_m_s: [x[6], x[7], x[8]],
            angular_velocity_rad_s: [x[9], x[10], x[11]],
        }
    }

    /// The same state in another scalar.
    pub fn map<U: Copy>(&self, f: impl FnMut(T) -> U) -> VehicleState<U> {
        VehicleState::from_array(self.to_array().map(f))
    }
}

impl<T: Real> VehicleState<T> {
    /// At rest at the origin.
    pub fn zero() -> Self {
        Self::from_array([T::lit(0.0); STATE_DIM])
    }

    /// The state of another point of the same body, which lies at `point_m` in Body: p + R r and v + ω × r.
    pub fn at_point(&self, point_m: [T; 3]) -> Self {
        Self {
            position_m: add(self.position_m, in_world(&self.attitude_rad, point_m)),
            velocity_m_s: add(self.velocity_m_s, cross(self.angular_velocity_rad_s, point_m)),
            ..*self
        }
    }

    /// x + Δx in the order of [`VehicleState::to_array`], the horizontal displacement of the increment turned from the heading frame into World. The yaw is
    /// not wrapped.
    pub fn advanced(&self, increment: &[T; STATE_DIM]) -> [T; STATE_DIM] {
        let x = self.to_array();
        let (sin, cos) = x[5].sin_cos();
        let mut next: [T; STATE_DIM] = core::array::from_fn(|i| x[i] + increment[i]);
        next[0] = x[0] + cos * increment[0] - sin * increment[1];
        next[1] = x[1] + sin * increment[0] + cos * increment[1];
        next
    }
}

/// Command u of one interval: forward speed and steering.
///
/// `second` is what the vehicle card says: normalised steering in [-1, 1], road-wheel angle (rad) or yaw rate (rad/s); positive = left.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Control<T> {
    /// Commanded forward speed, m/s.
    pub speed_m_s: T,
    /// Second command, in the unit of the vehicle card.
    pub second: T,
}

impl<T: Copy> Control<T> {
    /// The same command in another scalar.
    pub fn map<U>(&self, f: impl Fn(T) -> U) -> Control<U> {
        Control { speed_m_s: f(self.speed_m_s), second: f(self.second) }
    }
}

impl Control<f64> {
    /// Both numbers in single precision, as predictions take them: row-major (steps, 2).
    pub fn packed(&self) -> [f32; 2] {
        [self.speed_m_s as f32, self.second as f32]
    }
}

/// Wraps an angle into (-pi, pi].
pub fn wrap_angle(angle_rad: f64) -> f64 {
    let wrapped = angle_rad.rem_euclid(core::f64::consts::TAU);
    if wrapped > core::f64::consts::PI { wrapped - core::f64::consts::TAU } else { wrapped }
}
