//! Limits of everything, and the checks that need nothing else.

use nesam_model::MAX_HORIZON;
use nesam_physics::{Control, STATE_DIM, Vehicle, VehicleState};
use serde::{Deserialize, Serialize};

use crate::error::EngineError;
use crate::measurement::WheelMeasurement;

/// Longest name of a session, a vehicle or a map, bytes.
pub const NAME_LENGTH_MAX: usize = 64;

/// |yaw| of a state, rad: it may be unwrapped.
pub(crate) const YAW_MAX_RAD: f64 = 1e4;

/// Names of the entries of a state, as paths below the state.
const STATE_FIELDS: [&str; STATE_DIM] = [
    "position_m.x",
    "position_m.y",
    "position_m.z",
    "attitude_rad.x",
    "attitude_rad.y",
    "attitude_rad.z",
    "velocity_m_s.x",
    "velocity_m_s.y",
    "velocity_m_s.z",
    "angular_velocity_rad_s.x",
    "angular_velocity_rad_s.y",
    "angular_velocity_rad_s.z",
];

/// What the engine accepts and holds at most: the section `limits` of a configuration, and of a recording's header.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Limits {
    /// Open sessions.
    pub sessions_max: usize,
    /// Open sessions of one vehicle.
    pub sessions_per_vehicle_max: usize,
    /// Candidate sequences N of one prediction.
    pub samples_max: usize,
    /// Steps K of one prediction; never above the positions of the model.
    pub horizon_max: usize,
    /// Product N K of one prediction, the budget of one turn of the engine.
    pub sample_steps_max: usize,
    /// Samples of one prediction with Jacobians; each takes about as long as a hundred without.
    pub jacobian_samples_max: usize,
    /// Samples of one prediction with covariance; each takes a third of a Jacobian's time.
    pub covariance_samples_max: usize,
    /// Samples of one prediction with the terrain encoded at every pose.
    pub exact_samples_max: usize,
    /// What-if soils of one prediction.
    pub soils_max: usize,
    /// Uploaded maps.
    pub maps_max: usize,
    /// Cells of one map.
    pub map_cells_max: usize,
    /// Cells of all maps together.
    pub map_cells_total_max: usize,
    /// Predictions that wait.
    pub waiting_predictions_max: usize,
    /// Predictions of one vehicle that wait.
    pub waiting_predictions_per_vehicle_max: usize,
    /// Other commands that wait.
    pub waiting_commands_max: usize,
    /// Measurements of one vehicle among them.
    pub waiting_measurements_per_vehicle_max: usize,
    /// |position| along each axis, m.
    pub position_max_m: f64,
    /// |velocity| along each axis and of the rim of each wheel, m/s.
    pub speed_max_m_s: f64,
    /// |angular velocity| about each axis, rad/s.
    pub angular_speed_max_rad_s: f64,
    /// How far ahead of the last measurement of a session one may be stamped, s, before as much time has passed on the server too. It decides where it is below
    /// [`clock_ahead_max_s`](Self::clock_ahead_max_s). After a pause that both clocks have seen the history starts again, however long it was.
    pub pause_max_s: f64,
    /// How far behind the newest measurement one may arrive and still be put in its place, s; at most 1. Later ones are refused. Measurements inside this window
    /// count for predictions at once, but the soil filter sees them only when they have left it: the soil is older by as much. 0 = every measurement
    /// behind the newest is refused.
    pub reorder_window_s: f64,
    /// How much further ahead than time has passed a stamp may lie, s, before the clock counts as wrong. Larger: one wrong stamp makes more of the following
    /// ones look late. Smaller: a vehicle that sends its backlog after a pause loses a measurement.
    pub clock_ahead_max_s: f64,
    /// Time after which a session that nobody feeds and nobody asks is closed, s.
    pub session_idle_s: f64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            sessions_max: 1024,
            sessions_per_vehicle_max: 32,
            samples_max: 4096,
            horizon_max: MAX_HORIZON,
            sample_steps_max: 65_536,
            jacobian_samples_max: 8,
            covariance_samples_max: 64,
            exact_samples_max: 16,
            soils_max: 16,
            maps_max: 64,
            map_cells_max: nesam_terrain::MAX_CELLS,
            map_cells_total_max: 4 * nesam_terrain::MAX_CELLS,
            waiting_predictions_max: 64,
            waiting_predictions_per_vehicle_max: 32,
            waiting_commands_max: 4096,
            waiting_measurements_per_vehicle_max: 1024,
            position_max_m: 1e6,
            speed_max_m_s: 100.0,
            angular_speed_max_rad_s: 50.0,
            pause_max_s: 86_400.0,
            reorder_window_s: 0.2,
            clock_ahead_max_s: 10.0,
            session_idle_s: 86_400.0,
        }
    }
}

impl Limits {
    /// The reorder window, ns.
    pub fn reorder_window_ns(&self) -> i64 {
        (self.reorder_window_s.clamp(0.0, 1.0) * 1e9).round() as i64
    }

    /// Largest K: never above the positions of the model.
    pub fn steps_max(&self) -> usize {
        self.horizon_max.min(MAX_HORIZON)
    }

    /// Checks N, K and N K.
    ///
    /// # Errors
    /// `EngineError::Invalid` naming `samples` or `horizon` and the limit.
    pub fn check_shape(&self, samples: usize, horizon: usize) -> Result<(), EngineError> {
        for (field, value, limit) in [("samples", samples, self.samples_max), ("horizon", horizon, self.steps_max())] {
            if value == 0 || value > limit {
                return Err(EngineError::invalid(field, format!("is {value}, allowed are 1 to {limit}")));
            }
        }
        if samples * horizon > self.sample_steps_max {
            let reason = format!("samples x horizon = {samples} x {horizon} is above the limit of {}", self.sample_steps_max);
            return Err(EngineError::invalid("samples", reason));
        }
        Ok(())
    }

    /// Checks the plausibility of a finite state.
    ///
    /// # Errors
    /// `EngineError::Invalid` naming the entry below `path` and its limit.
    pub fn check_state(&self, path: &str, state: &VehicleState<f64>) -> Result<(), EngineError> {
        let angle = core::f64::consts::PI + 1e-6;
        for (i, value) in state.to_array().into_iter().enumerate() {
            let limit = match i {
                0..3 => self.position_max_m,
                3 | 4 => angle,
                5 => YAW_MAX_RAD,
                6..9 => self.speed_max_m_s,
                _ => self.angular_speed_max_rad_s,
            };
            if !value.is_finite() || value.abs() > limit {
                let reason = format!("is {value}, allowed is a finite number of magnitude up to {limit}");
                return Err(EngineError::invalid(format!("{path}.{}", STATE_FIELDS[i]), reason));
            }
        }
        Ok(())
    }

    /// Checks the plausibility of finite measurements of wheels of this radius.
    ///
    /// # Errors
    /// `EngineError::Invalid` naming the entry and its limit.
    pub fn check_wheels(&self, wheels: &WheelMeasurement, wheel_radius_m: f64) -> Result<(), EngineError> {
        let (speeds, angles) = (wheels.speed_rad_s.as_slice().as_flattened(), wheels.road_wheel_angle_rad.as_slice().as_flattened());
        let entries =
            [("speed_rad_s", speeds, self.speed_max_m_s / wheel_radius_m), ("road_wheel_angle_rad", angles, core::f64::consts::FRAC_PI_2)];
        for (name, values, limit) in entries {
            if let Some(i) = values.iter().position(|value| value.abs() > limit) {
                let reason = format!("is {}, allowed is a magnitude up to {limit}", values[i]);
                return Err(EngineError::invalid(format!("wheels.{name}[{i}]"), reason));
            }
        }
        Ok(())
    }
}

/// Path of the first entry below the state that is NaN or infinite.
pub(crate) fn not_finite(state: &VehicleState<f64>) -> Option<&'static str> {
    state.to_array().iter().position(|v| !v.is_finite()).map(|i| STATE_FIELDS[i])
}

/// The entry of a command outside the card's range, with the reason.
pub(crate) fn outside_card(vehicle: &Vehicle, control: &Control<f64>) -> Option<(&'static str, String)> {
    let entries = [("speed_m_s", control.speed_m_s), ("second", control.second)];
    entries.into_iter().enumerate().find(|(axis, (_, value))| !vehicle.admits_on(*axis, *value)).map(|(axis, (name, value))| {
        let [low, high] = vehicle.command_range[axis];
        (name, format!("is {value}, the card of {} admits {low} to {high}", vehicle.name))
    })
}

/// Checks the name of a session, a vehicle or a map: 1 to 64 of `A-Z a-z 0-9 _ . -`, so that it can be part of a key or a path.
///
/// # Errors
/// `EngineError::Invalid` naming `field`.
pub fn check_name(field: &str, name: &str) -> Result<(), EngineError> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || "_.-".contains(c);
    let wrong = match name.chars().find(|c| !allowed(*c)) {
        Some(other) => format!("has {other:?}"),
        None if name.is_empty() || name.len() > NAME_LENGTH_MAX => format!("is {} characters long", name.len()),
        None => return Ok(()),
    };
    Err(EngineError::invalid(field, format!("must be 1 to {NAME_LENGTH_MAX} of A-Z a-z 0-9 _ . - and {wrong}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_shape_limits_hold_at_the_edge() {
        let limits = Limits::default();
        assert!(limits.check_shape(1, 1).is_ok() && limits.check_shape(4096, 16).is_ok() && limits.check_shape(2048, 32).is_ok());
        for (samples, horizon, field) in
            [(0, 1, "samples"), (4097, 1, "samples"), (1, 0, "horizon"), (1, 33, "horizon"), (2049, 32, "samples")]
        {
            assert_eq!(limits.check_shape(samples, horizon).unwrap_err().field(), field, "{samples} x {horizon}");
        }
    }

    #[test]
    fn analytic_names_can_be_part_of_a_key() {
        assert!(check_name("a", "truck_1.x-y").is_ok() && check_name("a", &"x".repeat(64)).is_ok());
        for name in ["", "a/b", "a b", "*", "é", &"x".repeat(65)] {
            assert!(check_name("a", name).is_err(), "{name}");
        }
        for (name, wrong) in [("a/b*", "has '/'"), ("", "is 0 characters long"), ("x".repeat(65).as_str(), "is 65 characters long")] {
            let told = check_name("a", name).unwrap_err().to_string();
            assert!(told.ends_with(wrong), "{told}");
        }
    }
}
