//! Sessions, provenance and soil.

use nesam_engine::EngineError;
use nesam_engine::{ForecastCheck, OpenSession, Provenance, SessionView, SoilEstimate};
use nesam_physics::{SOIL_DIM, SecondCommand, SoilCoordinates, Vehicle};
use nesam_proto::v1 as pb;

use super::{alarm_message, control_message, effect_messages, measurement, unsigned_zero, vehicle_state_message};

/// A session to open.
///
/// # Errors
/// `Invalid` naming the field of the initial measurement at fault, its session where it is of another one.
pub fn open_session(message: &pb::OpenSessionRequest) -> Result<OpenSession, EngineError> {
    let session = if message.session_id.is_empty() { &message.vehicle_id } else { &message.session_id };
    if let Some(initial) = message.initial.as_ref().filter(|initial| !initial.session_id.is_empty() && initial.session_id != *session) {
        let reason = format!("is `{}`, the session to open is `{session}`", initial.session_id);
        return Err(EngineError::invalid("initial.session_id", reason));
    }
    let below = |error| match error {
        EngineError::Invalid { field, reason } => EngineError::Invalid { field: format!("initial.{field}"), reason },
        other => other,
    };
    Ok(OpenSession {
        session: message.session_id.clone(),
        vehicle: message.vehicle_id.clone(),
        vehicle_card: message.vehicle_card.clone(),
        map: message.map_id.clone(),
        initial: message.initial.as_ref().map(measurement).transpose().map_err(below)?,
    })
}

/// A session as message.
pub fn session_view(view: &SessionView, vehicle: &Vehicle) -> pb::Session {
    pb::Session {
        session_id: view.session.clone(),
        vehicle_id: view.vehicle.clone(),
        provenance: Some(provenance(&view.provenance)),
        vehicle: Some(vehicle_card(vehicle)),
        history_steps: view.history_steps as u32,
        last_stamp_ns: view.last_stamp_ns,
        last_sequence: view.last_sequence,
        boot_id: view.boot,
        accepted: view.accepted,
        durable_place: 0,
        run: 0,
        vehicle_alive: None,
        state: view.newest.as_ref().map(|step| vehicle_state_message(&step.state)),
        command: view.newest.as_ref().map(|step| control_message(&step.control)),
        soil_correction: Some(soil_correction(&view.soil)),
        effects: effect_messages(&view.effects),
        effects_source: view.effects.source.clone(),
        alarm: view.alarm.as_ref().map(|alarm| alarm_message(&view.session, &view.vehicle, alarm)),
        forecasts: forecast_check(&view.soil.forecasts),
    }
}

/// How predictions came true; `None` before the first comparison.
fn forecast_check(check: &ForecastCheck) -> Option<pb::ForecastCheck> {
    let (error_rms_m, expected_rms_m) = check.error_rms_m().zip(check.expected_rms_m())?;
    Some(pb::ForecastCheck {
        checked: check.checked(),
        error_rms_m: error_rms_m.to_vec(),
        expected_rms_m: expected_rms_m.to_vec(),
        scale: check.scale(),
        height_scale: check.height_scale(),
    })
}

fn vehicle_card(vehicle: &Vehicle) -> pb::VehicleCard {
    let second = match vehicle.second {
        SecondCommand::SteeringNormalised => pb::SecondCommand::SteeringNormalised,
        SecondCommand::RoadWheelAngleRad => pb::SecondCommand::RoadWheelAngleRad,
        SecondCommand::YawRateRadS => pb::SecondCommand::YawRateRadS,
    };
    let [[speed_min_m_s, speed_max_m_s], [second_min, second_max]] = vehicle.command_range;
    let road_wheel_angle_max_rad = match (&vehicle.steering, vehicle.second) {
        (Some(table), _) => {
            let last = |angles: &[f64]| angles.last().copied().unwrap_or(0.0);
            0.5 * (last(&table.front_left_rad) + last(&table.front_right_rad))
        }
        (None, SecondCommand::RoadWheelAngleRad) => second_max,
        (None, _) => 0.0,
    };
    pb::VehicleCard {
        name: vehicle.name.clone(),
        second: second.into(),
        speed_min_m_s,
        speed_max_m_s,
        second_min,
        second_max,
        wheelbase_m: vehicle.wheelbase_m,
        road_wheel_angle_max_rad,
    }
}

/// Provenance as message.
pub fn provenance(provenance: &Provenance) -> pb::Provenance {
    let (map_id, map_version, map_hash) = provenance.map.clone().unwrap_or_default();
    pb::Provenance {
        history_epoch: provenance.history_epoch,
        soil_epoch: provenance.soil_epoch,
        map_id,
        map_version,
        map_hash,
        bundle_name: provenance.bundle_name.clone(),
        bundle_hash: provenance.bundle_hash.clone(),
    }
}

/// Six soil numbers as message.
pub fn soil_vector(values: &[f64; SOIL_DIM]) -> pb::SoilVector {
    let [k_phi, k_c, n, c_pa, phi_rad, k_shear_m] = *values;
    pb::SoilVector { k_phi, k_c, n, c_pa, phi_rad, k_shear_m }
}

/// The same read.
pub fn soil_of(message: &pb::SoilVector) -> [f64; SOIL_DIM] {
    let pb::SoilVector { k_phi, k_c, n, c_pa, phi_rad, k_shear_m } = *message;
    [k_phi, k_c, n, c_pa, phi_rad, k_shear_m].map(unsigned_zero)
}

/// What is known of the soil as message.
pub fn soil_correction(soil: &SoilEstimate) -> pb::SoilCorrection {
    let SoilEstimate { state: soil, covariance, .. } = soil;
    let coordinates = match soil.correction.coordinates {
        SoilCoordinates::Physical => pb::SoilCoordinates::Physical,
        SoilCoordinates::Logarithmic => pb::SoilCoordinates::Logarithmic,
    };
    pb::SoilCorrection {
        coordinates: coordinates.into(),
        delta: Some(soil_vector(&soil.correction.delta)),
        variance: soil.variance.as_ref().map(soil_vector),
        learned: soil.learned.to_vec(),
        covariance: covariance.as_flattened().to_vec(),
    }
}

/// A soil estimate as message, with where its session stands.
pub fn soil_estimate(session: &str, soil: &SoilEstimate, standing: &Provenance) -> pb::SoilEstimate {
    pb::SoilEstimate {
        session_id: session.into(),
        soil_epoch: soil.state.epoch,
        stamp_ns: soil.state.stamp_ns,
        correction: Some(soil_correction(soil)),
        history_epoch: standing.history_epoch,
        map_version: standing.map_version(),
        bundle_hash: standing.bundle_hash.clone(),
    }
}
