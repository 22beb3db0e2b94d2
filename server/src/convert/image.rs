//! Exported sessions: bytes with a version and a checksum.

use nesam_engine::{
    BufferTest, EngineError, FilterSnapshot, ForecastCheck, JointSnapshot, Measurement, OpenForecast, SessionImage, SoilEstimate,
    SoilState, StepGrid, TrackImage, WheelMeasurement,
};
use nesam_model::HistoryStep;
use nesam_physics::{Control, SOIL_DIM, STATE_DIM, SoilCoordinates, SoilCorrection, VehicleState};
use nesam_proto::v1 as pb;
use prost::Message as _;
use sha2::{Digest as _, Sha256};

use super::alarm::{from_watch_image, watch_image};
use super::{applied_effects, effect_messages, soil_correction};

/// Version of the format. What is added to `SessionContent` keeps it as long as an older service may go on without it and a newer one begins anew where it is
/// absent, so that sessions move both ways while a fleet is upgraded; anything else needs another one.
const VERSION: u32 = 3;

fn refused(reason: impl Into<String>) -> EngineError {
    EngineError::invalid("image", reason)
}

/// The bytes of a session.
pub fn image_bytes(image: &SessionImage) -> Vec<u8> {
    let content = content(image).encode_to_vec();
    let checksum = Sha256::digest(&content).to_vec();
    pb::SessionImage { version: VERSION, checksum: checksum.into(), content: content.into() }.encode_to_vec()
}

/// The session in such bytes.
///
/// # Errors
/// `ForeignImage` of another version, `Invalid` naming `image`: empty, no export, damaged, or not of the shape of a session.
pub fn session_image(bytes: &[u8]) -> Result<SessionImage, EngineError> {
    if bytes.is_empty() {
        return Err(refused("is empty; give what an export has answered"));
    }
    let no_export = |error: prost::DecodeError| refused(format!("is no exported session: {error}"));
    let outer = pb::SessionImage::decode(bytes).map_err(no_export)?;
    if outer.version != VERSION {
        let reason = format!(
            "is of version {} of the format, this service reads version {VERSION}; export it again from a service of this version",
            outer.version
        );
        return Err(EngineError::ForeignImage { reason });
    }
    if *Sha256::digest(&outer.content) != *outer.checksum {
        return Err(refused("is damaged: its checksum does not fit; export it again"));
    }
    from_content(&pb::SessionContent::decode(outer.content).map_err(no_export)?)
}

fn content(image: &SessionImage) -> pb::SessionContent {
    let (map_id, map_hash) = image.map.clone().unwrap_or_default();
    let (forecasts_checked, forecasts) = image.soil.forecasts.parts();
    pb::SessionContent {
        session_id: image.session.clone(),
        vehicle_id: image.vehicle.clone(),
        bundle_hash: image.bundle_hash.clone(),
        filter_settings: image.filter_settings.clone(),
        map_id,
        map_hash,
        live: Some(track(&image.live)),
        settled: Some(track(&image.settled)),
        open: image.open.iter().map(measured).collect(),
        recent_stamp_ns: image.recent.iter().map(|(stamp_ns, _)| *stamp_ns).collect(),
        recent_sequence: image.recent.iter().map(|(_, number)| number.unwrap_or(0)).collect(),
        last_sequence: image.last_sequence,
        accepted_first: image.numbers.iter().map(|(first, _)| *first).collect(),
        accepted_last: image.numbers.iter().map(|(_, last)| *last).collect(),
        boot_id: image.boot,
        ended_boots: image.ended_boots.iter().map(|(boot, _)| *boot).collect(),
        ended_last_sequence: image.ended_boots.iter().map(|(_, last)| last.unwrap_or(0)).collect(),
        final_ns: image.final_ns,
        newest_age_ns: image.newest_age_ns.map(|age| age.max(0) as u64),
        step_age_ns: image.step_age_ns.map(|age| age.max(0) as u64),
        history_epoch: image.history_epoch,
        filter_steps: image.filter_steps.iter().map(step).collect(),
        filter_first: image.filter_first as u32,
        filter_stamps_ns: image.filter_stamps_ns.clone(),
        filter: Some(pb::FilterImage {
            mean: image.filter.state.mean.clone(),
            covariance: image.filter.state.covariance.clone(),
            noise_scale: image.filter.noise_scale,
            trust_log_odds: image.filter.trust_log_odds,
            trust_corrections: image.filter.trust_corrections.clone(),
            plain_mean: image.filter.plain.mean.clone(),
            plain_covariance: image.filter.plain.covariance.clone(),
            ground_class: image.filter.ground_class as u32,
        }),
        soil_epoch: image.soil.state.epoch,
        soil_stamp_ns: image.soil.state.stamp_ns,
        soil: Some(soil_correction(&image.soil)),
        soil_noise_scale: image.soil.noise_scale,
        accepted: image.accepted,
        last_buffer: image.soil.state.last_buffer.map(|last| pb::BufferImage {
            judged: last.judged,
            nis: last.nis,
            dof: last.dof as u32,
            rejected: last.rejected,
        }),
        effects: effect_messages(&image.effects),
        effects_source: image.effects.source.clone(),
        watch: image.watch.as_ref().map(watch_image),
        forecasts_checked,
        forecasts: forecasts.to_vec(),
        forecast: image.forecast.as_ref().map(|forecast| pb::ForecastImage {
            steps: forecast.steps.iter().map(step).collect(),
            corrections: forecast.corrections.iter().flat_map(|c| c.delta).collect(),
            noise_scale: forecast.noise_scale,
        }),
        asks_fleet: image.asks_fleet,
        brings_nothing: image.brings_nothing,
    }
}

fn step(step: &HistoryStep) -> pb::StepImage {
    pb::StepImage { state: step.state.to_array().to_vec(), command: vec![step.control.speed_m_s, step.control.second] }
}

fn measured(m: &Measurement) -> pb::MeasurementImage {
    pb::MeasurementImage {
        stamp_ns: m.stamp_ns,
        sequence: m.sequence.unwrap_or(0),
        boot_id: m.boot.unwrap_or(0),
        step: Some(step(&HistoryStep { state: m.state, control: m.command })),
        wheel_speed_rad_s: m.wheels.speed_rad_s.map(Vec::from).unwrap_or_default(),
        road_wheel_angle_rad: m.wheels.road_wheel_angle_rad.map(Vec::from).unwrap_or_default(),
    }
}

fn track(track: &TrackImage) -> pb::TrackImage {
    let grid = |grid: StepGrid| vec![grid.step_ns, grid.last_ns, grid.seen_ns, grid.next_ns];
    pb::TrackImage {
        grid_ns: track.grid.map(grid).unwrap_or_default(),
        before: track.before.as_ref().map(measured),
        history: track.history.iter().map(step).collect(),
    }
}

fn from_content(content: &pb::SessionContent) -> Result<SessionImage, EngineError> {
    let filter = content.filter.as_ref().ok_or_else(|| refused("has no filter"))?;
    if content.recent_stamp_ns.len() != content.recent_sequence.len() {
        return Err(refused("has stamps without numbers"));
    }
    if content.accepted_first.len() != content.accepted_last.len() {
        return Err(refused("has numbers without an end"));
    }
    let soil = from_soil(content)?;
    let numbers = content.recent_sequence.iter().map(|number| numbered(*number));
    // An older service wrote none.
    let ended_last = content.ended_last_sequence.iter().map(|number| numbered(*number)).chain(std::iter::repeat(None));
    let age = |age: u64| i64::try_from(age).unwrap_or(i64::MAX);
    // As an older service wrote it, steps have no stamps: the next buffer begins anew.
    let stamped = !content.filter_stamps_ns.is_empty();
    let filter_steps = content.filter_steps.iter().filter(|_| stamped).map(from_step).collect::<Result<_, _>>()?;
    Ok(SessionImage {
        session: content.session_id.clone(),
        vehicle: content.vehicle_id.clone(),
        bundle_hash: content.bundle_hash.clone(),
        filter_settings: content.filter_settings.clone(),
        map: (!content.map_id.is_empty()).then(|| (content.map_id.clone(), content.map_hash.clone())),
        live: from_track(content.live.as_ref())?,
        settled: from_track(content.settled.as_ref())?,
        open: content.open.iter().map(from_measured).collect::<Result<_, _>>()?,
        recent: content.recent_stamp_ns.iter().copied().zip(numbers).collect(),
        last_sequence: content.last_sequence,
        numbers: content.accepted_first.iter().copied().zip(content.accepted_last.iter().copied()).collect(),
        boot: content.boot_id,
        ended_boots: content.ended_boots.iter().copied().zip(ended_last).collect(),
        final_ns: content.final_ns,
        newest_age_ns: content.newest_age_ns.map(age),
        step_age_ns: content.step_age_ns.map(age),
        history_epoch: content.history_epoch,
        accepted: content.accepted,
        filter_steps,
        filter_first: if stamped { content.filter_first as usize } else { 0 },
        filter_stamps_ns: content.filter_stamps_ns.clone(),
        filter: FilterSnapshot {
            state: JointSnapshot { mean: filter.mean.clone(), covariance: filter.covariance.clone() },
            plain: JointSnapshot { mean: filter.plain_mean.clone(), covariance: filter.plain_covariance.clone() },
            noise_scale: filter.noise_scale,
            trust_log_odds: filter.trust_log_odds,
            trust_corrections: filter.trust_corrections.clone(),
            ground_class: filter.ground_class as usize,
        },
        forecast: content.forecast.as_ref().map(|forecast| from_forecast(forecast, soil.state.correction.coordinates)).transpose()?,
        soil,
        effects: applied_effects(&content.effects_source, &content.effects),
        watch: content.watch.as_ref().map(from_watch_image).transpose()?,
        asks_fleet: content.asks_fleet,
        brings_nothing: content.brings_nothing,
    })
}

fn from_soil(content: &pb::SessionContent) -> Result<SoilEstimate, EngineError> {
    let soil = content.soil.as_ref().ok_or_else(|| refused("has no soil"))?;
    let vector = |v: &pb::SoilVector| [v.k_phi, v.k_c, v.n, v.c_pa, v.phi_rad, v.k_shear_m];
    let coordinates = match soil.coordinates() {
        pb::SoilCoordinates::Physical => SoilCoordinates::Physical,
        pb::SoilCoordinates::Logarithmic => SoilCoordinates::Logarithmic,
        pb::SoilCoordinates::Unspecified => return Err(refused("has a soil without coordinates")),
    };
    let delta = soil.delta.as_ref().map(vector).ok_or_else(|| refused("has no soil"))?;
    let state = SoilState {
        epoch: content.soil_epoch,
        stamp_ns: content.soil_stamp_ns,
        correction: SoilCorrection { coordinates, delta },
        variance: soil.variance.as_ref().map(vector),
        learned: array(&soil.learned)?,
        last_buffer: content.last_buffer.map(|last| BufferTest {
            judged: last.judged,
            nis: last.nis,
            dof: last.dof as usize,
            rejected: last.rejected,
        }),
    };
    let forecasts = match content.forecasts.as_slice() {
        [] => ForecastCheck::default(),
        values => ForecastCheck::restored(content.forecasts_checked, values)
            .ok_or_else(|| refused("has numbers that no check of forecasts can have"))?,
    };
    Ok(SoilEstimate { state, covariance: matrix(&soil.covariance)?, noise_scale: content.soil_noise_scale, forecasts })
}

fn from_forecast(forecast: &pb::ForecastImage, coordinates: SoilCoordinates) -> Result<OpenForecast, EngineError> {
    let (corrections, rest) = forecast.corrections.as_chunks::<SOIL_DIM>();
    if !rest.is_empty() {
        return Err(refused(format!("has corrections of {} numbers, not sixes", forecast.corrections.len())));
    }
    Ok(OpenForecast {
        steps: forecast.steps.iter().map(from_step).collect::<Result<_, _>>()?,
        corrections: corrections.iter().map(|delta| SoilCorrection { coordinates, delta: *delta }).collect(),
        noise_scale: forecast.noise_scale,
    })
}

fn from_track(track: Option<&pb::TrackImage>) -> Result<TrackImage, EngineError> {
    let track = track.ok_or_else(|| refused("has no history"))?;
    let grid = match track.grid_ns.as_slice() {
        [] => None,
        values => {
            let [step_ns, last_ns, seen_ns, next_ns] = array(values)?;
            Some(StepGrid { step_ns, last_ns, seen_ns, next_ns })
        }
    };
    Ok(TrackImage {
        grid,
        before: track.before.as_ref().map(from_measured).transpose()?,
        history: track.history.iter().map(from_step).collect::<Result<_, _>>()?,
    })
}

fn from_step(step: &pb::StepImage) -> Result<HistoryStep, EngineError> {
    let [speed_m_s, second] = array(&step.command)?;
    let state: [f64; STATE_DIM] = array(&step.state)?;
    Ok(HistoryStep { state: VehicleState::from_array(state), control: Control { speed_m_s, second } })
}

fn from_measured(m: &pb::MeasurementImage) -> Result<Measurement, EngineError> {
    let HistoryStep { state, control } = from_step(m.step.as_ref().ok_or_else(|| refused("has a measurement without state"))?)?;
    let wheels = WheelMeasurement {
        speed_rad_s: (!m.wheel_speed_rad_s.is_empty()).then(|| array(&m.wheel_speed_rad_s)).transpose()?,
        road_wheel_angle_rad: (!m.road_wheel_angle_rad.is_empty()).then(|| array(&m.road_wheel_angle_rad)).transpose()?,
    };
    Ok(Measurement { sequence: numbered(m.sequence), boot: numbered(m.boot_id), stamp_ns: m.stamp_ns, state, command: control, wheels })
}

/// 0 = none.
fn numbered(number: u64) -> Option<u64> {
    (number != 0).then_some(number)
}

fn array<T: Copy, const N: usize>(values: &[T]) -> Result<[T; N], EngineError> {
    values.try_into().map_err(|_| refused(format!("has {} numbers where {N} belong", values.len())))
}

fn matrix(values: &[f64]) -> Result<[[f64; SOIL_DIM]; SOIL_DIM], EngineError> {
    let flat: [f64; SOIL_DIM * SOIL_DIM] = array(values)?;
    Ok(core::array::from_fn(|r| core::array::from_fn(|c| flat[SOIL_DIM * r + c])))
}
