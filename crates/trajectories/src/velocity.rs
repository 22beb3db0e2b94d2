//! Velocities that were not measured, estimated from the past alone, or in hindsight.

use nesam_physics::{VehicleState, wrap_angle};

use crate::trajectory::MeasuredChannels;

/// Time constant of the smoothing, s.
///
/// Chosen on the training windows of a skid-steer robot whose lidar poses repeat for one or two samples and jump by centimetres: against
/// central differences over 0.8 s the error is least (0.17 m/s forward) between 0.25 and 0.4 s; the shorter one lags less.
const SMOOTHING_S: f64 = 0.25;

/// Shortest time over which a difference is taken, s: a step at 20 Hz, the rate of that robot's log, less 1 ms for jitter. Steps that are not shorter are taken
/// one by one.
const SPAN_S: f64 = 0.049;

/// A position that moves faster than this many times the largest speed of the vehicle has jumped, and is not a motion. Two, because a
/// pose that was repeated once in a log of 20 Hz or less moves twice as far in the next step.
const JUMP_FACTOR: f64 = 2.0;

/// R_WB^T v: a World vector in Body, for R_WB = Rz(yaw) Ry(pitch) Rx(roll).
pub fn to_body([roll, pitch, yaw]: [f64; 3], v: [f64; 3]) -> [f64; 3] {
    let ((sr, cr), (sp, cp), (sy, cy)) = (roll.sin_cos(), pitch.sin_cos(), yaw.sin_cos());
    let x = cy * v[0] + sy * v[1];
    let y = -sy * v[0] + cy * v[1];
    let forward = cp * x - sp * v[2];
    let up = sp * x + cp * v[2];
    [forward, cr * y + sr * up, -sr * y + cr * up]
}

/// Backward differences of a channel, smoothed; sample 0 is `first`, since nothing is known of the past there.
///
/// `rate(from, k)` is the rate between two samples; one above `limit` is left out. The estimate at k uses samples up to k only. In a log faster than 20 Hz a
/// difference spans 50 ms or more and ends where the value changes: poses come slower than such a log, which repeats them. A value that stays for as long as the
/// smoothing remembers stands still.
fn smoothed(time_s: &[f64], values: &[[f64; 3]], first: [f64; 3], limit: f64, rate: impl Fn(usize, usize) -> [f64; 3]) -> Vec<[f64; 3]> {
    let (mut estimate, mut from) = (first, 0);
    let mut all = Vec::with_capacity(time_s.len());
    for k in 0..time_s.len() {
        let (step, span) = (time_s[k] - time_s[k.saturating_sub(1)], time_s[k] - time_s[from]);
        let passed_over = step < SPAN_S && (span < SPAN_S || (values[k] == values[k - 1] && span < SMOOTHING_S));
        if !passed_over {
            let (weight, rate) = (span / (SMOOTHING_S + span), rate(from, k));
            if rate.iter().map(|r| r * r).sum::<f64>().sqrt() <= limit {
                for i in 0..3 {
                    estimate[i] += weight * (rate[i] - estimate[i]);
                }
            }
            from = k;
        }
        all.push(estimate);
    }
    all
}

/// Body velocity from positions and attitudes, m/s; `largest_m_s` is the largest speed of the vehicle.
pub(crate) fn from_positions(
    time_s: &[f64],
    position_m: &[[f64; 3]],
    attitude_rad: &[[f64; 3]],
    first_m_s: [f64; 3],
    largest_m_s: f64,
) -> Vec<[f64; 3]> {
    smoothed(time_s, position_m, first_m_s, JUMP_FACTOR * largest_m_s, |from, k| {
        let span = time_s[k] - time_s[from];
        let rate = core::array::from_fn(|i| (position_m[k][i] - position_m[from][i]) / span);
        to_body(attitude_rad[k], rate)
    })
}

/// Body angular velocity of an attitude and its rates, rad/s: w = [r' - y' sin p, p' cos r + y' cos p sin r, -p' sin r + y' cos p cos r].
fn turning([roll, pitch, _]: [f64; 3], [roll_rate, pitch_rate, yaw_rate]: [f64; 3]) -> [f64; 3] {
    let ((sr, cr), (sp, cp)) = (roll.sin_cos(), pitch.sin_cos());
    [roll_rate - yaw_rate * sp, pitch_rate * cr + yaw_rate * cp * sr, -pitch_rate * sr + yaw_rate * cp * cr]
}

/// Body angular velocity from attitudes, rad/s.
pub(crate) fn from_attitudes(time_s: &[f64], attitude_rad: &[[f64; 3]], first_rad_s: [f64; 3]) -> Vec<[f64; 3]> {
    smoothed(time_s, attitude_rad, first_rad_s, f64::INFINITY, |from, k| {
        let span = time_s[k] - time_s[from];
        turning(attitude_rad[k], core::array::from_fn(|i| wrap_angle(attitude_rad[k][i] - attitude_rad[from][i]) / span))
    })
}

/// Samples on each side of a sample whose rate is told in hindsight: 0.6 s of a drive at 10 Hz (chosen, about the 0.8 s above).
const HINDSIGHT: usize = 3;

/// Rates of a channel of equal steps by a parabola through the seven samples around each, at the ends of a drive through the first or last seven. Uses what
/// follows a sample, so nothing that predicts may see it; it does not lag. `difference(i, m)` is the value at i less that at m.
fn in_hindsight(samples: usize, dt_s: f64, difference: impl Fn(usize, usize) -> f64) -> Vec<f64> {
    let reach = HINDSIGHT.min(samples.saturating_sub(1) / 2);
    if reach == 0 {
        return vec![0.0; samples];
    }
    let rate = |k: usize| {
        let middle = k.clamp(reach, samples - 1 - reach);
        let [mut s0, mut s2, mut s4, mut y0, mut y1, mut y2] = [0.0; 6];
        for i in middle - reach..=middle + reach {
            let (t, y) = (i as f64 - middle as f64, difference(i, middle));
            (s0, s2, s4) = (s0 + 1.0, s2 + t * t, s4 + t.powi(4));
            (y0, y1, y2) = (y0 + y, y1 + t * y, y2 + t * t * y);
        }
        let bend = (s0 * y2 - s2 * y0) / (s0 * s4 - s2 * s2);
        (y1 / s2 + 2.0 * bend * (k as f64 - middle as f64)) / dt_s
    };
    (0..samples).map(rate).collect()
}

/// Replaces what is not measured of the velocities of a drive by estimates in hindsight, Body, m/s and rad/s.
pub(crate) fn replace_in_hindsight(states: &mut [VehicleState<f64>], measured: &MeasuredChannels, dt_s: f64) {
    let poses: Vec<([f64; 3], [f64; 3])> = states.iter().map(|s| (s.position_m, s.attitude_rad)).collect();
    let rates = |of: &dyn Fn(usize, usize, usize) -> f64| -> [Vec<f64>; 3] {
        core::array::from_fn(|axis| in_hindsight(poses.len(), dt_s, |i, m| of(axis, i, m)))
    };
    let world = rates(&|axis, i, m| poses[i].0[axis] - poses[m].0[axis]);
    let turns = rates(&|axis, i, m| wrap_angle(poses[i].1[axis] - poses[m].1[axis]));
    for (k, state) in states.iter_mut().enumerate() {
        let at = |of: &[Vec<f64>; 3]| core::array::from_fn(|axis| of[axis][k]);
        if !measured.linear_velocity {
            state.velocity_m_s = to_body(state.attitude_rad, at(&world));
        }
        let angular = turning(state.attitude_rad, at(&turns));
        for axis in (0..3).filter(|axis| !measured.angular_velocity[*axis]) {
            state.angular_velocity_rad_s[axis] = angular[axis];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_steady_circle_is_recovered() {
        // Goal: a body on a circle (1.5 m/s, 0.4 rad/s) is seen as forward speed and yaw rate. After 3 s (12 time constants, 2e-5
        // of the start) only the chord error remains: half a step of heading, 0.01 rad at 20 Hz.
        let time: Vec<f64> = (0..60).map(|k| 0.05 * f64::from(k)).collect();
        let (speed, rate) = (1.5, 0.4);
        let yaw = |t: f64| wrap_angle(2.9 + rate * t);
        let position: Vec<[f64; 3]> =
            time.iter().map(|t| [speed / rate * (2.9 + rate * t).sin(), -speed / rate * (2.9 + rate * t).cos(), 0.3]).collect();
        let attitude: Vec<[f64; 3]> = time.iter().map(|t| [0.0, 0.0, yaw(*t)]).collect();
        let v = from_positions(&time, &position, &attitude, [0.0; 3], 3.0)[59];
        assert!((v[0] - speed).abs() < 2e-3 && v[1].abs() < 0.02 && v[2].abs() < 1e-9, "{v:?}");
        let w = from_attitudes(&time, &attitude, [0.0; 3])[59];
        assert!((w[2] - rate).abs() < 1e-4 && w[0].abs() < 1e-9, "{w:?}");
    }

    #[test]
    fn analytic_hindsight_does_not_lag() {
        // Goal: a body that speeds up on a circle of 5 m is seen without lag, at its ends too, and what is measured is left alone.
        // 1 + 0.8 t m/s for 2 s; a parabola through 0.6 s of the circle is off by a cm/s inside and by some at the ends.
        let (radius, dt) = (5.0, 0.1);
        let speed = |t: f64| 1.0 + 0.8 * t;
        let yaw = |t: f64| (t + 0.4 * t * t) / radius;
        let mut states: Vec<VehicleState<f64>> = (0..21)
            .map(|k| {
                let t = dt * f64::from(k);
                let mut state = VehicleState::from_array([0.0; 12]);
                state.position_m = [radius * yaw(t).sin(), -radius * yaw(t).cos(), 0.0];
                state.attitude_rad[2] = yaw(t);
                state.angular_velocity_rad_s = [7.0; 3];
                state
            })
            .collect();
        let measured =
            MeasuredChannels { linear_velocity: false, angular_velocity: [false, true, false], ..MeasuredChannels::POSE_AND_TWIST };
        replace_in_hindsight(&mut states, &measured, dt);
        for (k, state) in states.iter().enumerate() {
            let (t, bound) = (dt * k as f64, if (3..18).contains(&k) { 0.02 } else { 0.06 });
            assert!((state.velocity_m_s[0] - speed(t)).abs() < bound && state.velocity_m_s[1].abs() < bound, "{k}: {state:?}");
            assert!((state.angular_velocity_rad_s[2] - speed(t) / radius).abs() < 1e-9 && state.angular_velocity_rad_s[1] == 7.0);
        }
    }

    #[test]
    fn property_future_does_not_matter() {
        let time: Vec<f64> = (0..20).map(|k| 0.05 * f64::from(k)).collect();
        let position: Vec<[f64; 3]> = time.iter().map(|t| [t * t, (3.0 * t).sin(), 0.1 * t]).collect();
        let attitude: Vec<[f64; 3]> = time.iter().map(|t| [0.1 * t, -0.05 * t, t.sin()]).collect();
        let whole = from_positions(&time, &position, &attitude, [0.2, 0.0, 0.0], 5.0);
        let part = from_positions(&time[..8], &position[..8], &attitude[..8], [0.2, 0.0, 0.0], 5.0);
        assert_eq!(&whole[..8], &part[..]);
    }

    /// Poses at 10 Hz of a motion along x and a turn to the left, held in a log at `log_hz` for 10 s.
    fn held(log_hz: u32, speed: f64, yaw_rate: f64) -> (Vec<f64>, Vec<[f64; 3]>, Vec<[f64; 3]>) {
        let (step, repeats) = (1.0 / f64::from(log_hz), log_hz / 10);
        let pose_s = |k: u32| 0.1 * f64::from(k / repeats);
        let all = 0..10 * log_hz;
        (
            all.clone().map(|k| step * f64::from(k)).collect(),
            all.clone().map(|k| [speed * pose_s(k), 0.0, 0.3]).collect(),
            all.map(|k| [0.0, 0.0, wrap_angle(yaw_rate * pose_s(k))]).collect(),
        )
    }

    #[test]
    fn analytic_poses_that_a_faster_log_repeats_give_the_speed() {
        // Poses at 10 Hz held at 50 to 200 Hz: what is estimated is the motion, neither the steps nor the pauses between them. After 5 s (20 time
        // constants) nothing of the start is left.
        for log_hz in [50, 100, 200] {
            let (time, position, attitude) = held(log_hz, 1.0, 0.4);
            let half = time.len() / 2;
            let v = from_positions(&time, &position, &vec![[0.0; 3]; time.len()], [0.0; 3], 3.0);
            assert!(v[half..].iter().all(|v| (v[0] - 1.0).abs() < 0.05 && v[1] == 0.0), "{log_hz} Hz: {:?}", v[time.len() - 1]);
            let w = from_attitudes(&time, &attitude, [0.0; 3]);
            assert!(w[half..].iter().all(|w| (w[2] - 0.4).abs() < 0.02), "{log_hz} Hz: {:?}", w[time.len() - 1]);
            // A vehicle that stands is not taken for one whose pose is late.
            let (time, position, attitude) = held(log_hz, 0.0, 0.0);
            let still = from_positions(&time, &position, &attitude, [1.0, 0.0, 0.0], 3.0);
            assert!(still[half..].iter().all(|v| v[0].abs() < 1e-3), "{log_hz} Hz: {:?}", still[half]);
        }
    }

    #[test]
    fn property_logs_of_20_hz_and_less_are_taken_step_by_step() {
        // What the smoothing was chosen for, repeated poses included: the plain recursion over all steps, to the last bit.
        for step in [0.05, 0.1] {
            let time: Vec<f64> = (0..60).map(|k| step * f64::from(k)).collect();
            let position: Vec<[f64; 3]> = (0..60).map(|k| [0.07 * f64::from(k / 2), (0.1 * f64::from(k)).sin(), 0.0]).collect();
            let estimate = from_positions(&time, &position, &[[0.0; 3]; 60], [0.2, 0.0, 0.0], 3.0);
            let mut expected = [0.2, 0.0, 0.0];
            for k in 1..60 {
                let span = time[k] - time[k - 1];
                let rate = to_body([0.0; 3], core::array::from_fn(|i| (position[k][i] - position[k - 1][i]) / span));
                (0..3).for_each(|i| expected[i] += span / (SMOOTHING_S + span) * (rate[i] - expected[i]));
                assert_eq!(estimate[k], expected, "{k}");
            }
        }
    }

    #[test]
    fn analytic_jumps_are_left_out() {
        // A robot of at most 1 m/s stands still while its pose jumps by 1 m and back: nothing has moved.
        let time: Vec<f64> = (0..20).map(|k| 0.05 * f64::from(k)).collect();
        let position: Vec<[f64; 3]> = (0..20).map(|k| [if k == 9 { 1.0 } else { 0.0 }, 0.0, 0.0]).collect();
        let still = from_positions(&time, &position, &[[0.0; 3]; 20], [0.0; 3], 1.0);
        assert!(still.iter().all(|v| *v == [0.0; 3]));
    }

    #[test]
    fn analytic_nose_down_forward_motion() {
        // Driving down a slope of 0.2 rad: the World velocity points down, in Body it is straight ahead.
        let body = to_body([0.0, 0.2, 0.7], [0.2f64.cos() * 0.7f64.cos(), 0.2f64.cos() * 0.7f64.sin(), -(0.2f64.sin())]);
        assert!((body[0] - 1.0).abs() < 1e-12 && body[1].abs() < 1e-12 && body[2].abs() < 1e-12, "{body:?}");
    }
}
