//! What a vehicle must be, whatever dialect its card is written in.

use nesam_physics::linear::is_positive_definite;
use nesam_physics::{Driveline, RimServo, SecondCommand, SteeringTable, TorqueDrive, Vehicle, WHEELS};

use crate::CardError;

/// Longest dead time of a card, s: with the longest that an effect adds it is what the commands that are kept reach back to at steps of 0.1 s.
const DEAD_TIME_MAX_S: f64 = 0.6;

type Named<'a> = (&'a str, f64);

/// Checks a vehicle without effects.
///
/// # Errors
/// `CardError` naming the key at fault, as the schema of bundles calls it, and the rule that it breaks.
pub fn check(vehicle: &Vehicle) -> Result<(), CardError> {
    match at_fault(vehicle) {
        None => Ok(()),
        Some(fault) => Err(CardError(fault)),
    }
}

/// Whether wheel centres stand in the order FL, FR, RL, RR, x ahead and y to the left, m.
pub fn are_in_order(centre_m: &[[f64; 3]; WHEELS]) -> bool {
    let apart = |a: usize, b: usize, axis: usize| centre_m[a][axis] - centre_m[b][axis];
    apart(0, 2, 0) > 0.0 && apart(1, 3, 0) > 0.0 && apart(0, 1, 1) > 0.0 && apart(2, 3, 1) > 0.0
}

/// Whether a body can have this inertia: symmetric and positive definite.
pub fn is_inertia(matrix: &[[f64; 3]; 3]) -> bool {
    let symmetric = (0..3).all(|i| (0..3).all(|j| (matrix[i][j] - matrix[j][i]).abs() <= 1e-6 * matrix[i][i].abs()));
    symmetric && is_positive_definite(matrix)
}

fn at_fault(v: &Vehicle) -> Option<String> {
    let positive = [
        ("mass_kg", v.mass_kg),
        ("wheel_radius_m", v.wheel_radius_m),
        ("wheel_width_m", v.wheel_width_m),
        ("track_m", v.track_m),
        ("wheelbase_m", v.wheelbase_m),
        ("gravity_m_s2", v.gravity_m_s2),
    ];
    not_positive(positive.into_iter().chain(v.suspension_n_m.map(|rate| ("suspension_n_m", rate))))
        .or_else(|| negative(v.suspension_n_s_m.map(|rate| ("suspension_n_s_m", rate))))
        .or_else(|| negative([("soil_damping_pa_s_m", v.soil_damping_pa_s_m)]))
        .or_else(|| wheels_at_fault(v))
        .or_else(|| (!is_inertia(&v.inertia_kg_m2)).then(|| "`inertia_kg_m2` must be symmetric and positive definite".into()))
        .or_else(|| range_at_fault("speed_range_m_s", v.command_range[0]))
        .or_else(|| range_at_fault("second_range", v.command_range[1]))
        .or_else(|| driveline_at_fault(&v.driveline))
        .or_else(|| steering_at_fault(v.steering.as_ref(), v.second))
}

fn not_positive<'a>(numbers: impl IntoIterator<Item = Named<'a>>) -> Option<String> {
    let (key, value) = numbers.into_iter().find(|(_, value)| !(value.is_finite() && *value > 0.0))?;
    Some(format!("`{key}` is {value}, must be positive"))
}

fn negative<'a>(numbers: impl IntoIterator<Item = Named<'a>>) -> Option<String> {
    let (key, value) = numbers.into_iter().find(|(_, value)| !(value.is_finite() && *value >= 0.0))?;
    Some(format!("`{key}` is {value}, must not be negative"))
}

/// Wheels that are swapped, or a weight that an axle would have to pull up.
fn wheels_at_fault(v: &Vehicle) -> Option<String> {
    let centres = &v.wheel_centre_m;
    if !centres.as_flattened().iter().all(|x| x.is_finite()) || !are_in_order(centres) {
        return Some("`wheel_centre_m` must hold FL, FR, RL, RR in this order with x ahead and y to the left".into());
    }
    let between = centres[..2].iter().all(|c| c[0] > 0.0) && centres[2..].iter().all(|c| c[0] < 0.0);
    (!between).then(|| "`wheel_centre_m` must have the centre of mass, from which it counts, between the axles".into())
}

fn range_at_fault(key: &str, [low, high]: [f64; 2]) -> Option<String> {
    (!(low.is_finite() && high.is_finite() && low < high)).then(|| format!("`{key}` is [{low}, {high}], must ascend"))
}

fn driveline_at_fault(line: &Driveline) -> Option<String> {
    not_positive([
        ("driveline.steering_rate_limit_per_s", line.steering_rate_limit_per_s),
        ("driveline.speed_integral_leak_s", line.speed_integral_leak_s),
        ("driveline.overspeed_limit_m_s", line.overspeed_limit_m_s),
    ])
    .or_else(|| {
        negative([
            ("driveline.steering_lag_s", line.steering_lag_s),
            ("driveline.speed_gain", line.speed_gain),
            ("driveline.speed_integral_gain_per_s", line.speed_integral_gain_per_s),
            ("driveline.speed_integral_limit_m", line.speed_integral_limit_m),
            ("driveline.side_coupling_n_m_s", line.side_coupling_n_m_s),
        ])
    })
    .or_else(|| rims_at_fault(&line.rims))
    .or_else(|| line.torque.as_ref().and_then(torque_at_fault))
}

fn rims_at_fault(rims: &RimServo) -> Option<String> {
    let late = rims.dead_time_s.iter().find(|value| !(0.0..=DEAD_TIME_MAX_S).contains(*value));
    not_positive([
        ("driveline.rims.speed_gain", rims.speed_gain),
        ("driveline.rims.yaw_gain", rims.yaw_gain),
        ("driveline.rims.yaw_limit_rad_s", rims.yaw_limit_rad_s),
        ("driveline.rims.rim_limit_m_s", rims.rim_limit_m_s),
        ("driveline.rims.acceleration_limit", rims.acceleration_limit[0]),
        ("driveline.rims.acceleration_limit", rims.acceleration_limit[1]),
        ("driveline.rims.turn_efficiency", rims.turn_efficiency),
    ])
    .or_else(|| negative([("driveline.rims.speed_lag_s", rims.speed_lag_s), ("driveline.rims.yaw_lag_s", rims.yaw_lag_s)]))
    .or_else(|| late.map(|value| format!("`driveline.rims.dead_time_s` is {value}, must lie between 0 and {DEAD_TIME_MAX_S} s")))
}

/// What is wrong with engine and brakes, if anything.
fn torque_at_fault(t: &TorqueDrive) -> Option<String> {
    let numbers = [t.per_demand_n_m_s_m, t.holding_demand_m_s, t.integral_observer_per_s, t.closed_n_m, t.brake_ratio];
    if numbers.iter().chain(&t.curve).any(|v| !(v.is_finite() && *v >= 0.0)) {
        return Some("`driveline.torque` has a number that is negative or not finite".into());
    }
    let ascending = t.curve_speed_m_s.windows(2).all(|w| w[0] < w[1]) && t.curve_speed_m_s.iter().all(|v| v.is_finite());
    (!ascending).then(|| "`driveline.torque.curve_speed_m_s` must ascend".into())
}

fn steering_at_fault(table: Option<&SteeringTable>, second: SecondCommand) -> Option<String> {
    let Some(t) = table else {
        let needed = second == SecondCommand::SteeringNormalised;
        return needed.then(|| "`steering` is missing, which turns a steering_normalised command into road-wheel angles".into());
    };
    let ascending = t.command.windows(2).all(|w| w[0] < w[1]);
    let same = t.command.len() == t.front_left_rad.len() && t.command.len() == t.front_right_rad.len();
    if t.command.len() < 2 || !ascending || !same {
        return Some("`steering` needs at least two ascending commands with one angle each".into());
    }
    let finite = [&t.command, &t.front_left_rad, &t.front_right_rad].into_iter().flatten().all(|v| v.is_finite());
    (!finite).then(|| "`steering` has a number that is not finite".into())
}
