//! Whether the channels of a segment agree with one another: displacement with velocity, change of attitude with angular velocity. No force, soil or
//! command enters, so only sensors can make these differ.

use nesam_physics::{VehicleState, contradiction};

use crate::channels::{PATH_AT, Row};

/// Adds Δp - ∫ R v dt (heading frame of the first sample, m) and Δη - ∫ E ω dt (rad) over consecutive samples, by the trapezoidal rule.
pub fn add_consistency(states: &[VehicleState<f64>], dt_s: f64, row: &mut Row) {
    let found = contradiction(states, dt_s);
    row[PATH_AT..PATH_AT + found.len()].copy_from_slice(&found);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channels::TURN_AT;

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
