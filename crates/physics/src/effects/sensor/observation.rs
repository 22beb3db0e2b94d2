//! True states to measured states and back.

use super::SensorTerms;
use crate::scalar::Real;
use crate::state::VehicleState;
use crate::vec3::{Tilt, Vec3, add, cross, dot, in_world, scale};

impl SensorTerms {
    /// Whether a measured state is another one than the true state. The clock is not part of a state.
    #[inline]
    pub fn alters_states(&self) -> bool {
        Self { clock_drift: 0.0, ..*self } != Self::default()
    }

    /// The state as the sensors measure it: p' = p(t - d) + R ℓ, v' = (1 + k) Eᵀ (v + ω × ℓ), ω' = (1 + s) Eᵀ ω + b e_z, R' = R E with the
    /// heading of t - d.
    ///
    /// Place and heading of t - d are taken along the arc of the present velocities, which errs by the change of velocity within d;
    /// [`SensorTerms::to_true_along`] does not.
    #[inline(always)]
    pub fn to_measured<T: Real>(&self, state: &VehicleState<T>) -> VehicleState<T> {
        if self.alters_states() { self.measured(state) } else { *state }
    }

    /// The true state behind a measured one: inverse of [`SensorTerms::to_measured`].
    #[inline(always)]
    pub fn to_true<T: Real>(&self, state: &VehicleState<T>) -> VehicleState<T> {
        if self.alters_states() { self.corrected(state) } else { *state }
    }

    /// The true states behind a series of measured ones, `dt_s` apart: [`SensorTerms::to_true`] with the turn and the way within a latency d summed from the
    /// velocities that were measured then, ∫ from t - d to t, linear from sample to sample. Where the series does not reach, or is not finite, the last sample on the way there counts.
    pub fn to_true_along(&self, measured: &[VehicleState<f64>], dt_s: f64) -> Vec<VehicleState<f64>> {
        let (pose, position) = (self.pose_latency_s / dt_s, (self.position_latency_s + self.pose_latency_s) / dt_s);
        if pose == 0.0 && position == 0.0 {
            return measured.iter().map(|state| self.to_true(state)).collect();
        }
        let prompt = Self { position_latency_s: 0.0, pose_latency_s: 0.0, ..*self };
        let mut truth: Vec<_> = measured.iter().map(|state| prompt.to_true(state)).collect();
        let seen_arm: Vec<_> = truth.iter().map(|state| self.arm(&state.attitude_rad)).collect();
        let rates: Vec<_> = truth.iter().map(|state| [turn_rate(state)]).collect();
        for (k, state) in truth.iter_mut().enumerate() {
            state.attitude_rad[2] += dt_s * summed_before(&rates, k, pose)[0];
        }
        let velocities: Vec<_> = truth.iter().map(|state| in_world(&state.attitude_rad, state.velocity_m_s)).collect();
        for (k, state) in truth.iter_mut().enumerate() {
            let (moved, arm) = (summed_before(&velocities, k, position), self.arm(&state.attitude_rad));
            for axis in 0..3 {
                state.position_m[axis] += dt_s * moved[axis] + seen_arm[k][axis] - arm[axis];
            }
        }
        truth
    }

    #[cold]
    #[inline(never)]
    fn measured<T: Real>(&self, state: &VehicleState<T>) -> VehicleState<T> {
        let lever = self.lever_arm_m.map(T::lit);
        let (v, w) = (state.velocity_m_s, state.angular_velocity_rad_s);
        let moved = self.travelled(state);
        let arm = self.arm(&state.attitude_rad);
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
        let arm = self.arm(&truth.attitude_rad);
        let moved = self.travelled(&truth);
        for axis in 0..3 {
            truth.position_m[axis] = truth.position_m[axis] + moved[axis] - arm[axis];
        }
        truth
    }

    /// R ℓ: from the reference point to the place that is measured, World, m.
    fn arm<T: Real>(&self, attitude: &Vec3<T>) -> Vec3<T> {
        in_world(attitude, self.lever_arm_m.map(T::lit))
    }

    /// Way in World within the latency, m: chord of the arc that ends at the true state.
    fn travelled<T: Real>(&self, truth: &VehicleState<T>) -> Vec3<T> {
        let latency = T::lit(self.position_latency_s + self.pose_latency_s);
        let [roll, pitch, yaw] = truth.attitude_rad;
        let middle = yaw - truth.angular_velocity_rad_s[2] * latency * T::lit(0.5);
        scale(in_world(&[roll, pitch, middle], truth.velocity_m_s), latency)
    }

    /// Turn of the heading within the latency of the pose, rad.
    fn turned_since<T: Real>(&self, truth: &VehicleState<T>) -> T {
        T::lit(self.pose_latency_s) * turn_rate(truth)
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

/// Rate of the heading, rad/s: ψ' = (ω_y sin φ + ω_z cos φ) / cos θ.
fn turn_rate<T: Real>(truth: &VehicleState<T>) -> T {
    let ([roll, pitch, _], w) = (truth.attitude_rad, truth.angular_velocity_rad_s);
    let ((sin, cos), (_, level)) = (roll.sin_cos(), pitch.sin_cos());
    (w[1] * sin + w[2] * cos) / level
}

/// Integral of a series that is linear from sample to sample, over the `steps` before sample `k` (those after it where negative, with a minus), in units of a
/// step. Beyond the ends, and over what is not finite, the last value on the way there holds.
fn summed_before<const N: usize>(series: &[[f64; N]], k: usize, steps: f64) -> [f64; N] {
    let mut sum = [0.0; N];
    let (mut at, mut here, mut left) = (k, series[k], steps.abs());
    while left > 0.0 {
        let share = left.min(1.0);
        let next = if steps > 0.0 { at.checked_sub(1) } else { Some(at + 1) };
        let there = next.and_then(|n| series.get(n)).filter(|v| v.iter().all(|v| v.is_finite())).unwrap_or(&here);
        for i in 0..N {
            sum[i] += steps.signum() * share * (here[i] + 0.5 * share * (there[i] - here[i]));
        }
        (at, here, left) = (next.unwrap_or(at), *there, left - share);
    }
    sum
}
