//! One drive from its rows of the samples file.

use nesam_physics::driveline::rim_twist;
use nesam_physics::{Control, RimServo, SecondCommand, Vehicle, VehicleState, WHEELS};

use crate::channels::{Channels, Velocity};
use crate::error::TrajectoryError;
use crate::ground_truth::together;
use crate::resample::Grid;
use crate::table::Numbers;
use crate::trajectory::{MeasuredChannels, Trajectory, VelocitySource};
use crate::velocity::{from_attitudes, from_positions, to_body};

/// A drive at the clock of the log.
struct Log {
    time_s: Vec<f64>,
    position: Vec<[f64; 3]>,
    attitude: Vec<[f64; 3]>,
    command: Vec<[f64; 2]>,
    wheel_speed: Option<Vec<[f64; WHEELS]>>,
    road_wheel_angle: Option<Vec<[f64; 2]>>,
}

/// Builds the drive in the given rows: checks every value that is used, completes the velocities, resamples.
pub(crate) fn build(
    channels: &Channels,
    rows: &[usize],
    vehicle: &Vehicle,
    path: &std::path::Path,
    dt_s: f64,
) -> Result<Trajectory, TrajectoryError> {
    let (position, height_measured) = positions(channels, rows)?;
    let (attitude, attitude_measured) = attitudes(channels, rows)?;
    let log = Log {
        time_s: times(channels, rows, path)?,
        position,
        attitude,
        command: together(&channels.command, rows)?,
        wheel_speed: wheel_speeds(channels, rows)?,
        road_wheel_angle: optional(&channels.road_wheel_angle, rows)?,
    };
    let (velocity, source) = velocity(channels, rows, vehicle, &log)?;
    let (angular, angular_measured) = angular_velocity(channels, rows, vehicle, &log)?;
    let grid = Grid::new(&log.time_s, dt_s).map_err(|(at, reason)| TrajectoryError::cell(path, "t", rows[at], reason))?;
    let (position, attitude) = (grid.linear(&log.position), grid.angles(&log.attitude));
    let (velocity, angular) = (grid.linear(&velocity), grid.linear(&angular));
    let states = (0..position.len()).map(|k| VehicleState {
        position_m: position[k],
        attitude_rad: attitude[k],
        velocity_m_s: velocity[k],
        angular_velocity_rad_s: angular[k],
    });
    let controls = grid.averaged(&log.command).into_iter().map(|[speed_m_s, second]| Control { speed_m_s, second });
    let measured = MeasuredChannels {
        position: true,
        height: height_measured,
        attitude: attitude_measured,
        linear_velocity: source != VelocitySource::Positions,
        velocity_source: source,
        angular_velocity: angular_measured,
        wheel_speed: log.wheel_speed.is_some(),
        road_wheel_angle: log.road_wheel_angle.is_some(),
    };
    Ok(Trajectory {
        id: String::new(),
        set: String::new(),
        world: None,
        split: None,
        dt_s,
        states: states.collect(),
        controls: controls.collect(),
        wheel_speed_rad_s: log.wheel_speed.as_deref().map(|w| grid.linear(w)),
        road_wheel_angle_rad: log.road_wheel_angle.as_deref().map(|a| grid.linear(a)),
        measured,
        truth: channels.truth.as_ref().map(|truth| truth.of(rows, &grid)).transpose()?,
        time_s: grid.time_s,
    })
}

/// Time stamps; they must ascend.
fn times(channels: &Channels, rows: &[usize], path: &std::path::Path) -> Result<Vec<f64>, TrajectoryError> {
    let time_s = channels.time.finite(rows)?;
    for (k, pair) in time_s.windows(2).enumerate() {
        if pair[1] <= pair[0] {
            let what = if pair[1] == pair[0] { "time stamp is repeated" } else { "time goes backwards" };
            let reason = format!("{what}: {} s after {} s in row {}", pair[1], pair[0], rows[k]);
            return Err(TrajectoryError::cell(path, "t", rows[k + 1], reason));
        }
    }
    Ok(time_s)
}

/// Positions, and whether heights are measured; zero where they are not.
fn positions(channels: &Channels, rows: &[usize]) -> Result<(Vec<[f64; 3]>, bool), TrajectoryError> {
    let mut positions: Vec<[f64; 3]> = together(&channels.position, rows)?.into_iter().map(|[x, y]| [x, y, 0.0]).collect();
    let height = recorded(channels.height.as_ref(), rows)?;
    for (position, z) in positions.iter_mut().zip(height.iter().flatten()) {
        position[2] = *z;
    }
    Ok((positions, height.is_some()))
}

/// Roll, pitch and yaw, and which of them are measured; zero where they are not.
fn attitudes(channels: &Channels, rows: &[usize]) -> Result<(Vec<[f64; 3]>, [bool; 3]), TrajectoryError> {
    let mut attitudes: Vec<[f64; 3]> = channels.yaw.finite(rows)?.into_iter().map(|yaw| [0.0, 0.0, yaw]).collect();
    let mut measured = [false, false, true];
    for (axis, column) in channels.tilt.iter().enumerate() {
        let Some(angles) = recorded(column.as_ref(), rows)? else { continue };
        measured[axis] = true;
        for (attitude, angle) in attitudes.iter_mut().zip(angles) {
            attitude[axis] = angle;
        }
    }
    Ok((attitudes, measured))
}

/// A channel that may be missing: no column, or one that is null or NaN all along the drive.
fn recorded(column: Option<&Numbers>, rows: &[usize]) -> Result<Option<Vec<f64>>, TrajectoryError> {
    column.filter(|column| !column.is_absent(rows)).map(|column| column.finite(rows)).transpose()
}

/// Channels that may be missing: no columns, or columns that are null or NaN all along the drive.
fn optional<const N: usize>(columns: &Option<[Numbers; N]>, rows: &[usize]) -> Result<Option<Vec<[f64; N]>>, TrajectoryError> {
    match columns {
        Some(columns) if !columns.iter().any(|c| c.is_absent(rows)) => together(columns, rows).map(Some),
        _ => Ok(None),
    }
}

/// Four wheel speeds; a vehicle whose sides are coupled has one per side.
fn wheel_speeds(channels: &Channels, rows: &[usize]) -> Result<Option<Vec<[f64; WHEELS]>>, TrajectoryError> {
    if let Some(wheels) = optional(&channels.wheel_speed, rows)? {
        return Ok(Some(wheels));
    }
    let sides = optional(&channels.side_speed, rows)?;
    Ok(sides.map(|sides| sides.into_iter().map(|[left, right]| [left, right, left, right]).collect()))
}

/// A measured velocity; the third axis of a planar one, which tells nothing of it, is that of `estimated`.
fn recorded_velocity(
    columns: Option<&Velocity>,
    rows: &[usize],
    estimated: impl FnOnce() -> Vec<[f64; 3]>,
) -> Result<Option<Vec<[f64; 3]>>, TrajectoryError> {
    let Some(Velocity { planar, third }) = columns.filter(|v| !v.planar.iter().any(|c| c.is_absent(rows))) else { return Ok(None) };
    let third = recorded(third.as_ref(), rows)?.unwrap_or_else(|| estimated().into_iter().map(|v| v[2]).collect());
    Ok(Some(together(planar, rows)?.into_iter().zip(third).map(|([x, y], z)| [x, y, z]).collect()))
}

/// Body velocity: measured in Body, else measured in World, else estimated from positions. Of a planar one the third axis is estimated.
///
/// The estimate begins with what is known at the first sample: the mean rim speed where wheel speeds are measured, else the commanded
/// speed. The vehicle is as fast as its card or its fastest command says.
fn velocity(channels: &Channels, rows: &[usize], vehicle: &Vehicle, log: &Log) -> Result<(Vec<[f64; 3]>, VelocitySource), TrajectoryError> {
    let commanded = log.command.iter().map(|command| command[0]);
    let largest_m_s = vehicle.command_range[0].into_iter().chain(commanded).fold(0.0, |a: f64, b| a.max(b.abs()));
    let level = vec![[0.0; 3]; rows.len()];
    let estimated = |attitude: &[[f64; 3]]| from_positions(&log.time_s, &log.position, attitude, [0.0; 3], largest_m_s);
    if let Some(body) = recorded_velocity(channels.body_velocity.as_ref(), rows, || estimated(&log.attitude))? {
        return Ok((body, VelocitySource::Body));
    }
    if let Some(world) = recorded_velocity(channels.world_velocity.as_ref(), rows, || estimated(&level))? {
        let body = world.into_iter().zip(&log.attitude).map(|(v, attitude)| to_body(*attitude, v)).collect();
        return Ok((body, VelocitySource::World));
    }
    let rim = log.wheel_speed.as_ref().map(|w| w[0].iter().sum::<f64>() / WHEELS as f64 * vehicle.wheel_radius_m);
    let forward = rim.unwrap_or(log.command[0][0]);
    let estimate = from_positions(&log.time_s, &log.position, &log.attitude, [forward, 0.0, 0.0], largest_m_s);
    Ok((estimate, VelocitySource::Positions))
}

/// Yaw rate of the vehicle per turning of its rims where nobody has fitted it, -. It lies between 0 and the 1 of wheels that do not slide, and half errs least
/// at worst (chosen); a Husky has 0.38.
const TURN_EFFICIENCY_UNKNOWN: f64 = 0.5;

/// Yaw rate at the first sample of a drive without a measured one, rad/s.
///
/// The rims of a skid-steer vehicle tell it, their turning times the `turn_efficiency` of the card; the 1 of a card that was not fitted says nothing of
/// the ground. The command tells nothing: the drive may begin before the vehicle obeys. Without wheel speeds, and for a car, whose wheels slip, it is zero.
fn first_yaw_rate(vehicle: &Vehicle, log: &Log) -> f64 {
    let skid = vehicle.second == SecondCommand::YawRateRadS;
    let Some(wheels) = log.wheel_speed.as_ref().filter(|_| skid) else { return 0.0 };
    let stated = vehicle.limited_rims().turn_efficiency;
    let efficiency = if stated == RimServo::default().turn_efficiency { TURN_EFFICIENCY_UNKNOWN } else { stated };
    efficiency * rim_twist(vehicle, &wheels[0])[1]
}

/// Body angular velocity, axis by axis: measured, else estimated from attitudes.
fn angular_velocity(
    channels: &Channels,
    rows: &[usize],
    vehicle: &Vehicle,
    log: &Log,
) -> Result<(Vec<[f64; 3]>, [bool; 3]), TrajectoryError> {
    let mut rates = from_attitudes(&log.time_s, &log.attitude, [0.0, 0.0, first_yaw_rate(vehicle, log)]);
    let mut measured = [false; 3];
    for (axis, column) in channels.angular_velocity.iter().enumerate() {
        let Some(values) = recorded(column.as_ref(), rows)? else { continue };
        measured[axis] = true;
        for (rate, value) in rates.iter_mut().zip(values) {
            rate[axis] = value;
        }
    }
    Ok((rates, measured))
}
