//! Small messages from plain arrays.

use half::f16;
use nesam_proto::v1;

use crate::error::ClientError;

/// A state message from the twelve numbers x y z roll pitch yaw vx vy vz wx wy wz.
pub fn state_message(state: [f64; 12]) -> v1::VehicleState {
    let vector = |i: usize| Some(v1::Vector3 { x: state[i], y: state[i + 1], z: state[i + 2] });
    v1::VehicleState { position_m: vector(0), attitude_rad: vector(3), velocity_m_s: vector(6), angular_velocity_rad_s: vector(9) }
}

/// The twelve numbers of a state message; `None` when a part is missing.
pub fn state_array(message: &v1::VehicleState) -> Option<[f64; 12]> {
    let (p, a, v, w) = (message.position_m?, message.attitude_rad?, message.velocity_m_s?, message.angular_velocity_rad_s?);
    Some([p.x, p.y, p.z, a.x, a.y, a.z, v.x, v.y, v.z, w.x, w.y, w.z])
}

/// A measurement: session (over Zenoh it may be empty), stamp of the vehicle's clock, state, and the command `[speed_m_s, second]` applied from then on.
pub fn measurement(session: &str, stamp_ns: i64, state: [f64; 12], command: [f64; 2]) -> v1::Measurement {
    v1::Measurement {
        session_id: session.into(),
        sequence: 0,
        stamp_ns,
        state: Some(state_message(state)),
        command: Some(v1::Control { speed_m_s: command[0], second: command[1] }),
        wheels: None,
        boot_id: 0,
        run: 0,
    }
}

/// Name of the outcome of a measurement, in capitals as in the protocol's documentation.
pub fn outcome_label(answer: &v1::MeasurementAnswer) -> &'static str {
    use v1::measurement_answer::Outcome;
    match answer.outcome {
        Some(Outcome::Applied(_)) => "APPLIED",
        Some(Outcome::Buffered(_)) => "BUFFERED",
        Some(Outcome::Duplicate(_)) => "DUPLICATE",
        Some(Outcome::TooOld(_)) => "TOO_OLD",
        Some(Outcome::NotFinite(_)) => "NOT_FINITE",
        Some(Outcome::Gated(_)) => "GATED",
        Some(Outcome::Gap(_)) => "GAP",
        Some(Outcome::Future(_)) => "FUTURE",
        Some(Outcome::ClockJump(_)) => "CLOCK_JUMP",
        Some(Outcome::Restarted(_)) => "RESTARTED",
        Some(Outcome::Rejected(_)) => "REJECTED",
        None => "UNKNOWN",
    }
}

/// Unpacks `count` little-endian numbers.
pub(crate) fn unpack(field: &str, packed: &[u8], count: usize, precision: v1::Precision) -> Result<Vec<f32>, ClientError> {
    let width = if precision == v1::Precision::F16 { 2 } else { 4 };
    let expected = count.saturating_mul(width);
    if packed.len() != expected {
        return Err(ClientError::protocol(format!("`{field}` has {} bytes, {expected} were expected", packed.len())));
    }
    Ok(match precision {
        v1::Precision::F16 => packed.chunks_exact(2).map(|b| f16::from_le_bytes([b[0], b[1]]).to_f32()).collect(),
        _ => nesam_proto::packed::unpack(packed),
    })
}
