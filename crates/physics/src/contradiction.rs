//! Whether the channels of measured states agree with one another: displacement with velocity, change of attitude with angular velocity. No force, soil or
//! command enters, so only sensors can make these differ.

use crate::state::{VehicleState, wrap_angle};
use crate::vec3::Tilt;

/// Channels of [`contradiction`].
pub const CONTRADICTIONS: usize = 6;

/// Δp - ∫ R v dt (ahead, left, up in the heading frame of the first state, m), then Δη - ∫ E ω dt (roll, pitch, yaw, rad) over consecutive states,
/// `step_s(k)` from state k to the next, by the trapezoidal rule; at least two states are needed for it to mean something.
pub fn contradiction(states: &[VehicleState<f64>], step_s: impl Fn(usize) -> f64) -> [f64; CONTRADICTIONS] {
    let [Some(first), Some(last)] = [states.first(), states.last()] else { return [0.0; CONTRADICTIONS] };
    let mut path = [0, 1, 2].map(|i| last.position_m[i] - first.position_m[i]);
    let mut turn = [0, 1, 2].map(|i| wrap_angle(last.attitude_rad[i] - first.attitude_rad[i]));
    for (k, state) in states.iter().enumerate() {
        let before_s = if k == 0 { 0.0 } else { step_s(k - 1) };
        let after_s = if k + 1 == states.len() { 0.0 } else { step_s(k) };
        let weight = 0.5 * (before_s + after_s);
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
    [cos * path[0] + sin * path[1], cos * path[1] - sin * path[0], path[2], turn[0], turn[1], turn[2]]
}
