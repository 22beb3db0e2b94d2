//! The interaction token ζ = x ‖ u ‖ c (paper §III-B), made invariant to where the vehicle is and where it heads.
//!
//! The paper puts the raw state into the token. Position and yaw in a world frame would break translation and rotation invariance, so the
//! twelve entries are: height of the reference point above the ground under it, roll, pitch, change of yaw since the last token, linear and angular
//! velocity in Body, and the displacement since the last token in the last heading frame.

use nesam_physics::{Real, STATE_DIM, VehicleState, wrap_angle};

use crate::dims::STATE_CONTROL;

/// Means and scales of the state and control part of a token.
#[derive(Clone, Debug, PartialEq)]
pub struct TokenScale {
    /// Subtracted.
    pub mean: [f32; STATE_CONTROL],
    /// Divided by.
    pub scale: [f32; STATE_CONTROL],
}

/// Raw (unscaled) entries of a token: state part, then control.
///
/// `previous` is the state one step earlier; without one, the displacement is that of the current velocity over `dt_s`.
pub fn token_entries(
    state: &VehicleState<f64>,
    previous: Option<&VehicleState<f64>>,
    control: [f64; 2],
    ground_height_m: f64,
    dt_s: f64,
) -> [f32; STATE_CONTROL] {
    entries_of(state, previous, control, ground_height_m, dt_s, wrap_angle).map(|x| x as f32)
}

/// The same in any scalar; `wrap` brings an angle into (-pi, pi].
pub fn entries_of<T: Real>(
    state: &VehicleState<T>,
    previous: Option<&VehicleState<T>>,
    control: [T; 2],
    ground_height_m: T,
    dt_s: f64,
    wrap: impl Fn(T) -> T,
) -> [T; STATE_CONTROL] {
    let dt = T::lit(dt_s);
    let (turned, moved) = match previous {
        Some(p) => {
            let (sin, cos) = p.attitude_rad[2].sin_cos();
            let (dx, dy) = (state.position_m[0] - p.position_m[0], state.position_m[1] - p.position_m[1]);
            (wrap(state.attitude_rad[2] - p.attitude_rad[2]), [cos * dx + sin * dy, cos * dy - sin * dx])
        }
        None => (state.angular_velocity_rad_s[2] * dt, [state.velocity_m_s[0] * dt, state.velocity_m_s[1] * dt]),
    };
    let (a, v, w) = (state.attitude_rad, state.velocity_m_s, state.angular_velocity_rad_s);
    let height = state.position_m[2] - ground_height_m;
    [height, a[0], a[1], turned, v[0], v[1], v[2], w[0], w[1], w[2], moved[0], moved[1], control[0], control[1]]
}

impl TokenScale {
    /// (entries - mean) / scale.
    pub fn apply(&self, entries: [f32; STATE_CONTROL]) -> [f32; STATE_CONTROL] {
        core::array::from_fn(|i| (entries[i] - self.mean[i]) / self.scale[i])
    }
}

const _: () = assert!(STATE_DIM + 2 == STATE_CONTROL);
