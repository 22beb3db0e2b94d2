//! Whether the channels of measured states agree with one another: displacement with velocity, change of attitude with angular velocity. No force, soil or
//! command enters, so only sensors can make these differ, and a blow that is over between two samples.

use crate::state::{VehicleState, wrap_angle};
use crate::vec3::Tilt;

/// Channels of [`contradiction`].
pub const CONTRADICTIONS: usize = 6;

/// Δp - ∫ R v dt (ahead, left, up in the heading frame of the first state, m), then Δη - ∫ E ω dt (roll, pitch, yaw, rad) over consecutive states,
/// `step_s(k)` from state k to the next, by the trapezoidal rule; at least two states are needed for it to mean something.
pub fn contradiction(states: &[VehicleState<f64>], step_s: impl Fn(usize) -> f64) -> [f64; CONTRADICTIONS] {
    let [Some(first), Some(last)] = [states.first(), states.last()] else { return [0.0; CONTRADICTIONS] };
    let heading_rad = first.attitude_rad[2];
    let way = ahead_left([0, 1, 2].map(|i| last.position_m[i] - first.position_m[i]), heading_rad);
    let turn = [0, 1, 2].map(|i| wrap_angle(last.attitude_rad[i] - first.attitude_rad[i]));
    let mut left = [way[0], way[1], way[2], turn[0], turn[1], turn[2]];
    for (k, state) in states.iter().enumerate() {
        let before_s = if k == 0 { 0.0 } else { step_s(k - 1) };
        let after_s = if k + 1 == states.len() { 0.0 } else { step_s(k) };
        let rates = rates(state, heading_rad);
        (0..CONTRADICTIONS).for_each(|c| left[c] -= 0.5 * (before_s + after_s) * rates[c]);
    }
    left
}

/// How far each channel of [`contradiction`] may be off between two samples without either showing it, m and rad: half of the change of its rate over that
/// step, the largest of all steps. A rate that goes over at once somewhere within the step is integrated wrongly by as much.
pub fn unseen(states: &[VehicleState<f64>], step_s: impl Fn(usize) -> f64) -> [f64; CONTRADICTIONS] {
    let heading_rad = states.first().map_or(0.0, |first| first.attitude_rad[2]);
    let mut largest: [f64; CONTRADICTIONS] = [0.0; CONTRADICTIONS];
    for (k, pair) in states.windows(2).enumerate() {
        let [from, to] = [&pair[0], &pair[1]].map(|state| rates(state, heading_rad));
        (0..CONTRADICTIONS).for_each(|c| largest[c] = largest[c].max(0.5 * step_s(k) * (to[c] - from[c]).abs()));
    }
    largest
}

/// Velocity ahead, left and up of a heading, m/s, and rates of roll, pitch and yaw, rad/s.
fn rates(state: &VehicleState<f64>, heading_rad: f64) -> [f64; CONTRADICTIONS] {
    let [roll, pitch, yaw] = state.attitude_rad;
    let tilt = Tilt::new(roll, pitch);
    let velocity = ahead_left(tilt.to_heading(state.velocity_m_s), heading_rad - yaw);
    let turning = tilt.attitude_rates(state.angular_velocity_rad_s);
    [velocity[0], velocity[1], velocity[2], turning[0], turning[1], turning[2]]
}

/// A vector in axes that are turned about the vertical by an angle.
fn ahead_left(vector: [f64; 3], angle_rad: f64) -> [f64; 3] {
    let (sin, cos) = angle_rad.sin_cos();
    [cos * vector[0] + sin * vector[1], cos * vector[1] - sin * vector[0], vector[2]]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A turn of 0.4 rad/s at 2 m/s that begins at a heading, 0.1 s apart.
    fn turn(heading_rad: f64) -> Vec<VehicleState<f64>> {
        (0..=10)
            .map(|k| {
                let turned = 0.04 * k as f64;
                let yaw = heading_rad + turned;
                VehicleState {
                    position_m: [5.0 * (yaw.sin() - heading_rad.sin()), 5.0 * (heading_rad.cos() - yaw.cos()), 0.0],
                    attitude_rad: [0.0, 0.0, wrap_angle(yaw)],
                    velocity_m_s: [2.0, 0.0, 0.0],
                    angular_velocity_rad_s: [0.0, 0.0, 0.4],
                }
            })
            .collect()
    }

    #[test]
    fn analytic_a_turn_agrees_with_itself_in_any_heading() {
        for heading_rad in [0.0, 2.0, -3.1] {
            let states = turn(heading_rad);
            assert!(contradiction(&states, |_| 0.1).iter().all(|v| v.abs() < 3e-4), "{:?}", contradiction(&states, |_| 0.1));
            // The direction of 2 m/s turns by 0.04 rad in each step.
            let found = unseen(&states, |_| 0.1);
            assert!(found[0] < 0.002 && (0.0036..0.0041).contains(&found[1]) && found[2..].iter().all(|v| v.abs() < 1e-12), "{found:?}");
        }
    }

    #[test]
    fn analytic_a_blow_between_samples_is_within_what_is_unseen() {
        // Pitching stops at once from 1.2 rad/s, 0.02 s before the sixth sample.
        let states: Vec<VehicleState<f64>> = (0..=10)
            .map(|k| VehicleState {
                attitude_rad: [0.0, 1.2 * (0.1 * k as f64).min(0.48), 0.0],
                angular_velocity_rad_s: [0.0, if k < 5 { 1.2 } else { 0.0 }, 0.0],
                ..VehicleState::zero()
            })
            .collect();
        let off = contradiction(&states, |_| 0.1)[4];
        // 0.48 s at 1.2 rad/s against 0.45 s of the trapezoidal rule.
        assert!((off - 1.2 * 0.03).abs() < 1e-12, "{off}");
        assert!((unseen(&states, |_| 0.1)[4] - 0.06).abs() < 1e-12);
    }
}
