//! States, commands and packed arrays.

use bytes::Bytes;
use nesam_engine::EngineError;
use nesam_physics::{Control, VehicleState};
use nesam_proto::v1 as pb;

/// A packed array of little-endian f32.
///
/// # Errors
/// `Invalid` naming `field` when the length is not 4 `count` bytes.
pub fn decode_f32(field: &str, packed: &[u8], count: usize) -> Result<Vec<f32>, EngineError> {
    if packed.len() != 4 * count {
        let reason = format!("has {} bytes, {count} packed f32 take {}", packed.len(), 4 * count);
        return Err(EngineError::invalid(field, reason));
    }
    Ok(packed.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect())
}

/// Packs an array as little-endian f32.
pub fn encode_f32(values: &[f32]) -> Bytes {
    let mut packed = vec![0; 4 * values.len()];
    for (bytes, value) in packed.chunks_exact_mut(4).zip(values) {
        bytes.copy_from_slice(&value.to_le_bytes());
    }
    packed.into()
}

fn vector(path: &str, part: &str, message: Option<pb::Vector3>) -> Result<[f64; 3], EngineError> {
    message.map(|v| [v.x, v.y, v.z]).ok_or_else(|| EngineError::invalid(format!("{path}.{part}"), "is missing"))
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
    Control { speed_m_s: message.speed_m_s, second: message.second }
}

/// A command as message.
pub fn control_message(control: &Control<f64>) -> pb::Control {
    pb::Control { speed_m_s: control.speed_m_s, second: control.second }
}
