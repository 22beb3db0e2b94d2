//! Whether the channels of a segment agree with one another: displacement with velocity, change of attitude with angular velocity. No force, soil or
//! command enters, so only sensors can make these differ.

use nesam_physics::vec3::Tilt;
use nesam_physics::{VehicleState, wrap_angle};

use crate::channels::{PATH_AT, Row, TURN_AT};

/// Adds Δp - ∫ R v dt (heading frame of the first sample, m) and Δη - ∫ E ω dt (rad) over consecutive samples, by the trapezoidal rule.
pub fn add_consistency(states: &[VehicleState<f64>], dt_s: f64, row: &mut Row) {
    let [Some(first), Some(last)] = [states.first(), states.last()] else { return };
    let mut path = [0, 1, 2].map(|i| last.position_m[i] - first.position_m[i]);
    let mut turn = [0, 1, 2].map(|i| wrap_angle(last.attitude_rad[i] - first.attitude_rad[i]));
    for (k, state) in states.iter().enumerate() {
        let weight = if k == 0 || k + 1 == states.len() { 0.5 * dt_s } else { dt_s };
        let [roll, pitch, yaw] = state.attitude_rad;
        let tilt = Tilt::new(roll, pitch);
        let v = tilt.to_heading(state.velocity_m_s);
        let (sin, cos) = yaw.sin_cos();
        let world = [cos * v[0] - sin * v[1], sin * v[0] + cos * v[1], v[2]];
        let rates = tilt.attitude_rates(state.angular_velocity_rad_s);
        for i in 0..3 {
            path[i] -= weight * world[i];
            turn[i] -= weight * rates[i];
        }
    }
    let (sin, cos) = first.attitude_rad[2].sin_cos();
    row[PATH_AT..PATH_AT + 3].copy_from_slice(&[cos * path[0] + sin * path[1], cos * path[1] - sin * path[0], path[2]]);
    row[TURN_AT..TURN_AT + 3].copy_from_slice(&turn);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_a_gyro_bias_shows_as_its_integral_and_a_velocity_scale_as_its_path() {
        let (dt, rate, speed) = (0.1, 0.3, 2.0);
        let at = |k: usize| {
            let t = k as f64 * dt;
            // A circle: x' = v cos ψ, y' = v sin ψ.
            let yaw: f64 = rate * t;
            VehicleState {
                position_m: [speed / rate * yaw.sin(), speed / rate * (1.0 - yaw.cos()), 0.0],
                attitude_rad: [0.0, 0.0, yaw],
                velocity_m_s: [speed * 1.02, 0.0, 0.0],
                angular_velocity_rad_s: [0.0, 0.0, rate + 0.01],
            }
        };
        let states: Vec<_> = (0..9).map(at).collect();
        let mut row = [0.0; crate::channels::CHANNELS];
        add_consistency(&states, dt, &mut row);
        assert!((row[TURN_AT + 2] + 0.01 * 0.8).abs() < 1e-12, "{row:?}");
        let chord = speed / rate * (rate * 0.8f64).sin();
        assert!((row[PATH_AT] + 0.02 * chord).abs() < 2e-4, "{row:?}");
    }
}
