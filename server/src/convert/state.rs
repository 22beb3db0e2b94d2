//! States and commands.

use nesam_engine::EngineError;
use nesam_physics::{Control, VehicleState};
use nesam_proto::v1 as pb;

/// Zero without a sign, everything else as it is: a message leaves a number out that equals 0, so that a recording would lose the sign, and what depends on it.
pub(crate) fn unsigned_zero(value: f64) -> f64 {
    value + 0.0
}

fn vector(path: &str, part: &str, message: Option<pb::Vector3>) -> Result<[f64; 3], EngineError> {
    message.map(|v| [v.x, v.y, v.z].map(unsigned_zero)).ok_or_else(|| EngineError::invalid(format!("{path}.{part}"), "is missing"))
}

/// A state whose four parts must be present; values are checked by the engine.
///
/// # Errors
/// `Invalid` naming the missing part below `path`.
pub fn vehicle_state(path: &str, message: &pb::VehicleState) -> Result<VehicleState<f64>, EngineError> {
    Ok(VehicleState {
        position_m: vector(path, "position_m", message.position_m)?,
        attitude_rad: vector(path, "attitude_rad", message.attitude_rad)?,
        velocity_m_s: vector(path, "velocity_m_s", message.velocity_m_s)?,
        angular_velocity_rad_s: vector(path, "angular_velocity_rad_s", message.angular_velocity_rad_s)?,
    })
}

/// A state as message.
pub fn vehicle_state_message(state: &VehicleState<f64>) -> pb::VehicleState {
    let vector = |[x, y, z]: [f64; 3]| Some(pb::Vector3 { x, y, z });
    pb::VehicleState {
        position_m: vector(state.position_m),
        attitude_rad: vector(state.attitude_rad),
        velocity_m_s: vector(state.velocity_m_s),
        angular_velocity_rad_s: vector(state.angular_velocity_rad_s),
    }
}

/// A command.
pub fn control(message: &pb::Control) -> Control<f64> {
    Control { speed_m_s: unsigned_zero(message.speed_m_s), second: unsigned_zero(message.second) }
}

/// A command as message.
pub fn control_message(control: &Control<f64>) -> pb::Control {
    pb::Control { speed_m_s: control.speed_m_s, second: control.second }
}
