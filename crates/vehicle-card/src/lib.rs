//! The one schema of vehicle cards, as bundles carry it.
//!
//! Data sheets come in several dialects, which `nesam-trajectories` reads; all become a [`Vehicle`], and this crate writes and reads that
//! vehicle as JSON with units in the names.
#![forbid(unsafe_code)]

mod rules;

pub use rules::{are_in_order, check, is_inertia};

use nesam_physics::terramechanics::ContactLaw;
use nesam_physics::{Driveline, RimServo, SecondCommand, SteeringTable, TORQUE_KNOTS, TorqueDrive, Vehicle, WHEELS};
use serde::{Deserialize, Serialize};

/// Format tag of the card.
pub const FORMAT: &str = "nesam.vehicle/1";

/// A card that cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("vehicle card: {0}")]
pub struct CardError(String);

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Card {
    format: String,
    name: String,
    mass_kg: f64,
    inertia_kg_m2: [[f64; 3]; 3],
    inertia_estimated: bool,
    wheel_centre_m: [[f64; 3]; WHEELS],
    wheel_radius_m: f64,
    wheel_width_m: f64,
    suspension_n_m: [f64; WHEELS],
    suspension_n_s_m: [f64; WHEELS],
    second: Second,
    speed_range_m_s: [f64; 2],
    second_range: [f64; 2],
    #[serde(default, skip_serializing_if = "Option::is_none")]
    steering: Option<Table>,
    track_m: f64,
    wheelbase_m: f64,
    driveline: Line,
    gravity_m_s2: f64,
    #[serde(default, with = "Law", skip_serializing_if = "is_classical")]
    contact_law: ContactLaw,
    #[serde(default, skip_serializing_if = "is_zero")]
    soil_damping_pa_s_m: f64,
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Second {
    SteeringNormalised,
    RoadWheelAngleRad,
    YawRateRadS,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    command: Vec<f64>,
    front_left_rad: Vec<f64>,
    front_right_rad: Vec<f64>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    steering_lag_s: f64,
    steering_rate_limit_per_s: f64,
    speed_gain: f64,
    speed_integral_gain_per_s: f64,
    speed_integral_leak_s: f64,
    speed_integral_limit_m: f64,
    overspeed_limit_m_s: f64,
    #[serde(default, with = "Rims", skip_serializing_if = "is_identity")]
    rims: RimServo,
    #[serde(default, skip_serializing_if = "is_zero")]
    side_coupling_n_m_s: f64,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    torque: Option<Torque>,
}

/// Engine and brakes.
#[derive(Clone, Copy, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Torque {
    per_demand_n_m_s_m: f64,
    holding_demand_m_s: f64,
    #[serde(default, skip_serializing_if = "is_zero")]
    integral_observer_per_s: f64,
    closed_n_m: f64,
    brake_ratio: f64,
    curve_speed_m_s: [f64; TORQUE_KNOTS],
    curve: [f64; TORQUE_KNOTS],
}

impl From<TorqueDrive> for Torque {
    fn from(t: TorqueDrive) -> Self {
        let TorqueDrive {
            per_demand_n_m_s_m,
            holding_demand_m_s,
            integral_observer_per_s,
            closed_n_m,
            brake_ratio,
            curve_speed_m_s,
            curve,
        } = t;
        Self { per_demand_n_m_s_m, holding_demand_m_s, integral_observer_per_s, closed_n_m, brake_ratio, curve_speed_m_s, curve }
    }
}

impl From<Torque> for TorqueDrive {
    fn from(t: Torque) -> Self {
        let Torque { per_demand_n_m_s_m, holding_demand_m_s, integral_observer_per_s, closed_n_m, brake_ratio, curve_speed_m_s, curve } = t;
        Self { per_demand_n_m_s_m, holding_demand_m_s, integral_observer_per_s, closed_n_m, brake_ratio, curve_speed_m_s, curve }
    }
}

/// Servo of the rims of a skid-steer vehicle.
#[derive(Serialize, Deserialize)]
#[serde(remote = "RimServo", deny_unknown_fields)]
struct Rims {
    speed_gain: f64,
    yaw_gain: f64,
    yaw_limit_rad_s: f64,
    rim_limit_m_s: f64,
    speed_lag_s: f64,
    yaw_lag_s: f64,
    #[serde(default, skip_serializing_if = "are_zero")]
    dead_time_s: [f64; 2],
    #[serde(default = "no_limits", skip_serializing_if = "are_no_limits")]
    acceleration_limit: [f64; 2],
    turn_efficiency: f64,
}

fn no_limits() -> [f64; 2] {
    RimServo::default().acceleration_limit
}

/// Commands that arrive at once are left out, so that cards written before dead times were known keep their bytes.
fn are_zero(pair: &[f64; 2]) -> bool {
    *pair == [0.0; 2]
}

/// Limits that nothing reaches are left out, so that cards written before these were known keep their bytes.
fn are_no_limits(limits: &[f64; 2]) -> bool {
    *limits == no_limits()
}

/// How the soil acts on the wheels.
#[derive(Serialize, Deserialize)]
#[serde(remote = "ContactLaw", rename_all = "snake_case")]
enum Law {
    WongReece,
    SoilContactModel,
}

/// The law of the paper is left out, so that cards written before there was another keep their bytes.
#[allow(clippy::trivially_copy_pass_by_ref)]
fn is_classical(law: &ContactLaw) -> bool {
    *law == ContactLaw::WongReece
}

/// A base that does what it is told is left out, so that the cards of cars know nothing of it.
fn is_identity(rims: &RimServo) -> bool {
    *rims == RimServo::default()
}

/// An open differential and soil without damping are left out, so that cards written before these were known keep their bytes.
#[allow(clippy::trivially_copy_pass_by_ref)]
fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

/// The vehicle as a card.
pub fn to_json(vehicle: &Vehicle) -> String {
    let v = vehicle.clone();
    let card = Card {
        format: FORMAT.into(),
        name: v.name,
        mass_kg: v.mass_kg,
        inertia_kg_m2: v.inertia_kg_m2,
        inertia_estimated: v.inertia_estimated,
        wheel_centre_m: v.wheel_centre_m,
        wheel_radius_m: v.wheel_radius_m,
        wheel_width_m: v.wheel_width_m,
        suspension_n_m: v.suspension_n_m,
        suspension_n_s_m: v.suspension_n_s_m,
        second: match v.second {
            SecondCommand::SteeringNormalised => Second::SteeringNormalised,
            SecondCommand::RoadWheelAngleRad => Second::RoadWheelAngleRad,
            SecondCommand::YawRateRadS => Second::YawRateRadS,
        },
        speed_range_m_s: v.command_range[0],
        second_range: v.command_range[1],
        steering: v.steering.map(|t| Table { command: t.command, front_left_rad: t.front_left_rad, front_right_rad: t.front_right_rad }),
        track_m: v.track_m,
        wheelbase_m: v.wheelbase_m,
        driveline: Line {
            steering_lag_s: v.driveline.steering_lag_s,
            steering_rate_limit_per_s: v.driveline.steering_rate_limit_per_s,
            speed_gain: v.driveline.speed_gain,
            speed_integral_gain_per_s: v.driveline.speed_integral_gain_per_s,
            speed_integral_leak_s: v.driveline.speed_integral_leak_s,
            speed_integral_limit_m: v.driveline.speed_integral_limit_m,
            overspeed_limit_m_s: v.driveline.overspeed_limit_m_s,
            rims: v.driveline.rims,
            side_coupling_n_m_s: v.driveline.side_coupling_n_m_s,
            torque: v.driveline.torque.map(Torque::from),
        },
        gravity_m_s2: v.gravity_m_s2,
        contact_law: v.contact_law,
        soil_damping_pa_s_m: v.soil_damping_pa_s_m,
    };
    serde_json::to_string_pretty(&card).expect("plain numbers serialise; this is a bug")
}

/// The vehicle of a card.
///
/// # Errors
/// `CardError` naming the key at fault: unknown or missing keys, another format, what [`check`] refuses.
pub fn from_json(text: &str) -> Result<Vehicle, CardError> {
    let c: Card = serde_json::from_str(text).map_err(|e| CardError(e.to_string()))?;
    if c.format != FORMAT {
        return Err(CardError(format!("format is `{}`, expected `{FORMAT}`", c.format)));
    }
    let vehicle = Vehicle {
        name: c.name,
        mass_kg: c.mass_kg,
        inertia_kg_m2: c.inertia_kg_m2,
        inertia_estimated: c.inertia_estimated,
        wheel_centre_m: c.wheel_centre_m,
        wheel_radius_m: c.wheel_radius_m,
        wheel_width_m: c.wheel_width_m,
        suspension_n_m: c.suspension_n_m,
        suspension_n_s_m: c.suspension_n_s_m,
        second: match c.second {
            Second::SteeringNormalised => SecondCommand::SteeringNormalised,
            Second::RoadWheelAngleRad => SecondCommand::RoadWheelAngleRad,
            Second::YawRateRadS => SecondCommand::YawRateRadS,
        },
        command_range: [c.speed_range_m_s, c.second_range],
        steering: c.steering.map(|t| SteeringTable {
            command: t.command,
            front_left_rad: t.front_left_rad,
            front_right_rad: t.front_right_rad,
        }),
        track_m: c.track_m,
        wheelbase_m: c.wheelbase_m,
        driveline: Driveline {
            steering_lag_s: c.driveline.steering_lag_s,
            steering_rate_limit_per_s: c.driveline.steering_rate_limit_per_s,
            speed_gain: c.driveline.speed_gain,
            speed_integral_gain_per_s: c.driveline.speed_integral_gain_per_s,
            speed_integral_leak_s: c.driveline.speed_integral_leak_s,
            speed_integral_limit_m: c.driveline.speed_integral_limit_m,
            overspeed_limit_m_s: c.driveline.overspeed_limit_m_s,
            rims: c.driveline.rims,
            side_coupling_n_m_s: c.driveline.side_coupling_n_m_s,
            torque: c.driveline.torque.map(TorqueDrive::from),
        },
        gravity_m_s2: c.gravity_m_s2,
        contact_law: c.contact_law,
        soil_damping_pa_s_m: c.soil_damping_pa_s_m,
        effects: Default::default(),
    };
    check(&vehicle)?;
    Ok(vehicle)
}
