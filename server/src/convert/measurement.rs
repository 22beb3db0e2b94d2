//! Measurements and their answers, the same for gRPC and Zenoh.

use nesam_engine::{EngineError, MeasureAnswer, Measurement, Outcome, Provenance, WheelMeasurement};
use nesam_proto::v1 as pb;

use super::{code, control, soil_correction, vehicle_state};

/// A measurement (its session id is read by the caller).
///
/// # Errors
/// `Invalid` naming the field that is missing or has the wrong length.
pub fn measurement(message: &pb::Measurement) -> Result<Measurement, EngineError> {
    let missing = |field: &str| EngineError::invalid(field, "is missing");
    let state = message.state.as_ref().ok_or_else(|| missing("state"))?;
    let command = message.command.as_ref().ok_or_else(|| missing("command"))?;
    let wheels = message.wheels.as_ref().map(wheel_measurement).transpose()?.unwrap_or_default();
    Ok(Measurement {
        sequence: (message.sequence != 0).then_some(message.sequence),
        boot: (message.boot_id != 0).then_some(message.boot_id),
        stamp_ns: message.stamp_ns,
        state: vehicle_state("state", state)?,
        command: control(command),
        wheels,
    })
}

fn wheel_measurement(message: &pb::WheelMeasurement) -> Result<WheelMeasurement, EngineError> {
    Ok(WheelMeasurement {
        speed_rad_s: optional_array("wheels.speed_rad_s", &message.speed_rad_s)?,
        road_wheel_angle_rad: optional_array("wheels.road_wheel_angle_rad", &message.road_wheel_angle_rad)?,
    })
}

/// Nothing, or exactly N values.
fn optional_array<const N: usize>(field: &str, values: &[f64]) -> Result<Option<[f64; N]>, EngineError> {
    match values {
        [] => Ok(None),
        values => <[f64; N]>::try_from(values)
            .map(Some)
            .map_err(|_| EngineError::invalid(field, format!("has {} values, allowed are 0 or {N}", values.len()))),
    }
}

/// The answer to a measurement.
pub fn measurement_answer(message: &pb::Measurement, session: &str, result: Result<MeasureAnswer, EngineError>) -> pb::MeasurementAnswer {
    let mut answer =
        pb::MeasurementAnswer { session_id: session.into(), sequence: message.sequence, stamp_ns: message.stamp_ns, ..Default::default() };
    match result {
        Ok(measured) => {
            put_standing(&mut answer, &measured.provenance);
            answer.reordered = measured.reordered;
            let known = measured.outcome.accepted() || measured.outcome == Outcome::Duplicate;
            answer.place = if known { measured.accepted } else { 0 };
            answer.soil_correction = Some(soil_correction(&measured.soil));
            answer.outcome = Some(outcome(measured));
        }
        Err(error) => {
            if let Some(standing) = error.standing() {
                put_standing(&mut answer, standing);
            }
            let rejected = pb::Rejected { code: code(&error).into(), field: error.field().into(), message: error.to_string() };
            answer.outcome = Some(pb::measurement_answer::Outcome::Rejected(rejected));
        }
    }
    answer
}

/// Says where the session stands.
fn put_standing(answer: &mut pb::MeasurementAnswer, standing: &Provenance) {
    answer.history_epoch = standing.history_epoch;
    answer.soil_epoch = standing.soil_epoch;
    answer.map_version = standing.map_version();
    answer.bundle_hash.clone_from(&standing.bundle_hash);
}

fn outcome(measured: MeasureAnswer) -> pb::measurement_answer::Outcome {
    use pb::measurement_answer::Outcome as Message;
    match measured.outcome {
        Outcome::Applied => Message::Applied(pb::Applied { history_steps: measured.history_steps as u32 }),
        Outcome::Buffered { next_step_in_s } => Message::Buffered(pb::Buffered { next_step_in_s }),
        Outcome::Duplicate => Message::Duplicate(pb::Duplicate {}),
        Outcome::TooOld { behind_s } => Message::TooOld(pb::TooOld { behind_s }),
        Outcome::NotFinite { field } => Message::NotFinite(pb::NotFinite { field }),
        Outcome::Gated { nis } => Message::Gated(pb::Gated { nis }),
        Outcome::Gap { gap_s } => Message::Gap(pb::Gap { gap_s }),
        Outcome::Future { ahead_s } => Message::Future(pb::Future { ahead_s }),
        Outcome::ClockJump { jump_s } => Message::ClockJump(pb::ClockJump { jump_s }),
        Outcome::Restarted => Message::Restarted(pb::Restarted {}),
    }
}
