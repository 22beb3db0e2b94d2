//! True states to measured states and back.

use super::SensorTerms;
use crate::scalar::Real;
use crate::state::VehicleState;
use crate::vec3::{Tilt, Vec3, add, cross, dot, scale};

impl SensorTerms {
    /// Whether a measured state is another one than the true state. The clock is not part of a state.
    #[inline]
    pub fn alters_states(&self) -> bool {
        Self { clock_drift: 0.0, ..*self } != Self::default()
    }

    /// The state as the sensors measure it: p' = p(t - d) + R ℓ, v' = (1 + k) Eᵀ (v + ω × ℓ), ω' = (1 + s) Eᵀ ω + b e_z, R' = R E with the
    /// heading of t - d.
    ///
    /// Place and heading of t - d are taken along the arc of the present velocities, which errs by the change of velocity within d.
    #[inline(always)]
    pub fn to_measured<T: Real>(&self, state: &VehicleState<T>) -> VehicleState<T> {
        if self.alters_states() { self.measured(state) } else { *state }
    }

    /// The true state behind a measured one: inverse of [`SensorTerms::to_measured`].
    #[inline(always)]
    pub fn to_true<T: Real>(&self, state: &VehicleState<T>) -> VehicleState<T> {
        if self.alters_states() { self.corrected(state) } else { *state }
    }

    #[cold]
    #[inline(never)]
    fn measured<T: Real>(&self, state: &VehicleState<T>) -> VehicleState<T> {
        let lever = self.lever_arm_m.map(T::lit);
        let (v, w) = (state.velocity_m_s, state.angular_velocity_rad_s);
        let moved = self.travelled(state);
        let arm = in_world(&state.attitude_rad, lever);
        let mut position = state.position_m;
        for axis in 0..3 {
            position[axis] = position[axis] - moved[axis] + arm[axis];
        }
        let at_sensor = self.turned_back(add(v, cross(w, lever)));
        let mut rate = scale(self.turned_back(w), T::lit(1.0 + self.gyro_scale));
        rate[2] = rate[2] + T::lit(self.gyro_bias_rad_s);
        let mut attitude = state.attitude_rad;
        attitude[2] = attitude[2] - self.turned_since(state);
        VehicleState {
            position_m: position,
            attitude_rad: self.attitude(&attitude, false),
            velocity_m_s: scale(at_sensor, T::lit(1.0 + self.velocity_scale)),
            angular_velocity_rad_s: rate,
        }
    }

    #[cold]
    #[inline(never)]
    fn corrected<T: Real>(&self, state: &VehicleState<T>) -> VehicleState<T> {
        let lever = self.lever_arm_m.map(T::lit);
        let mut rate = state.angular_velocity_rad_s;
        rate[2] = rate[2] - T::lit(self.gyro_bias_rad_s);
        let w = self.turned_on(scale(rate, T::lit(1.0 / (1.0 + self.gyro_scale))));
        let at_sensor = self.turned_on(scale(state.velocity_m_s, T::lit(1.0 / (1.0 + self.velocity_scale))));
        let v = add(at_sensor, scale(cross(w, lever), T::lit(-1.0)));
        let mut truth = VehicleState {
            position_m: state.position_m,
            attitude_rad: self.attitude(&state.attitude_rad, true),
            velocity_m_s: v,
            angular_velocity_rad_s: w,
        };
        truth.attitude_rad[2] = truth.attitude_rad[2] + self.turned_since(&truth);
        let arm = in_world(&truth.attitude_rad, lever);
        let moved = self.travelled(&truth);
        for axis in 0..3 {
            truth.position_m[axis] = truth.position_m[axis] + moved[axis] - arm[axis];
        }
        truth
    }

    /// Way in World within the latency, m: chord of the arc that ends at the true state.
    fn travelled<T: Real>(&self, truth: &VehicleState<T>) -> Vec3<T> {
        let latency = T::lit(self.position_latency_s + self.pose_latency_s);
        let [roll, pitch, yaw] = truth.attitude_rad;
        let middle = yaw - truth.angular_velocity_rad_s[2] * latency * T::lit(0.5);
        scale(in_world(&[roll, pitch, middle], truth.velocity_m_s), latency)
    }

    /// Turn of the heading within the latency of the pose, rad: d ψ' with ψ' = (ω_y sin φ + ω_z cos φ) / cos θ.
    fn turned_since<T: Real>(&self, truth: &VehicleState<T>) -> T {
        let ([roll, pitch, _], w) = (truth.attitude_rad, truth.angular_velocity_rad_s);
        let ((sin, cos), (_, level)) = (roll.sin_cos(), pitch.sin_cos());
        T::lit(self.pose_latency_s) * (w[1] * sin + w[2] * cos) / level
    }

    /// Eᵀ a: a vector of Body in the axes of the sensors.
    fn turned_back<T: Real>(&self, a: Vec3<T>) -> Vec3<T> {
        if self.mount_rad == [0.0; 3] {
            return a;
        }
        let rows = self.mount();
        core::array::from_fn(|c| T::lit(rows[0][c]) * a[0] + T::lit(rows[1][c]) * a[1] + T::lit(rows[2][c]) * a[2])
    }

    /// E a: back into Body.
    fn turned_on<T: Real>(&self, a: Vec3<T>) -> Vec3<T> {
        if self.mount_rad == [0.0; 3] {
            return a;
        }
        self.mount().map(|row| dot(row.map(T::lit), a))
    }

    /// E = Rz Ry Rx of the mount angles, rows.
    fn mount(&self) -> [[f64; 3]; 3] {
        let [roll, pitch, yaw] = self.mount_rad;
        let tilt = Tilt::new(roll, pitch);
        let (sin, cos) = yaw.sin_cos();
        let columns = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]].map(|e| {
            let h = tilt.to_heading(e);
            [cos * h[0] - sin * h[1], sin * h[0] + cos * h[1], h[2]]
        });
        core::array::from_fn(|r| core::array::from_fn(|c| columns[c][r]))
    }

    /// Attitude angles of R E, or of R Eᵀ on the way back, |tilt| < 90°. The yaw turns by the difference, so it is not wrapped anew.
    fn attitude<T: Real>(&self, attitude: &[T; 3], back: bool) -> [T; 3] {
        if self.mount_rad == [0.0; 3] {
            return *attitude;
        }
        let tilt = Tilt::new(attitude[0], attitude[1]);
        let mount = self.mount();
        // Columns of Ry Rx E: the sensor's axes in the heading frame.
        let column = |c: usize| {
            let axis = core::array::from_fn(|r| T::lit(if back { mount[c][r] } else { mount[r][c] }));
            tilt.to_heading(axis)
        };
        let [x, y, z] = [column(0), column(1), column(2)];
        let roll = (y[2] / z[2]).atan();
        let pitch = (-x[2] / (y[2] * y[2] + z[2] * z[2]).sqrt()).atan();
        [roll, pitch, attitude[2] + (x[1] / x[0]).atan()]
    }
}

/// A vector of Body in World.
fn in_world<T: Real>(attitude: &[T; 3], a: Vec3<T>) -> Vec3<T> {
    let h = Tilt::new(attitude[0], attitude[1]).to_heading(a);
    let (sin, cos) = attitude[2].sin_cos();
    [cos * h[0] - sin * h[1], sin * h[0] + cos * h[1], h[2]]
}
