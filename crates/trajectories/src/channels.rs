//! The columns of a samples file that a drive is made of.

use nesam_physics::{SecondCommand, WHEELS};

use crate::error::TrajectoryError;
use crate::ground_truth::TruthColumns;
use crate::table::{Numbers, Table};

/// Suffixes of the wheels in column names, in the order of every array.
pub(crate) const WHEEL_SUFFIXES: [&str; WHEELS] = ["fl", "fr", "rl", "rr"];

/// Columns by meaning; what a vehicle does not measure is `None`. Columns are read whole, values are checked per drive.
pub(crate) struct Channels {
    pub(crate) time: Numbers,
    pub(crate) position: [Numbers; 2],
    pub(crate) height: Option<Numbers>,
    /// Roll and pitch.
    pub(crate) tilt: [Option<Numbers>; 2],
    pub(crate) yaw: Numbers,
    pub(crate) body_velocity: Option<Velocity>,
    pub(crate) world_velocity: Option<Velocity>,
    pub(crate) angular_velocity: [Option<Numbers>; 3],
    pub(crate) command: [Numbers; 2],
    pub(crate) wheel_speed: Option<[Numbers; WHEELS]>,
    pub(crate) side_speed: Option<[Numbers; 2]>,
    pub(crate) road_wheel_angle: Option<[Numbers; 2]>,
    pub(crate) truth: Option<TruthColumns>,
}

/// A velocity; a planar one says nothing of the third axis.
pub(crate) struct Velocity {
    pub(crate) planar: [Numbers; 2],
    pub(crate) third: Option<Numbers>,
}

impl Channels {
    /// Reads the columns; horizontal position, yaw, time and the commands must be there, `gt_` columns only where ground truth is asked for.
    pub(crate) fn read(table: &Table, second: SecondCommand, ground_truth: bool) -> Result<Self, TrajectoryError> {
        let one = |name: &str| if table.has(name) { table.numbers(name).map(Some) } else { Ok(None) };
        let velocity = |planar: [&str; 2], third: &str| -> Result<Option<Velocity>, TrajectoryError> {
            let Some(planar) = group(table, planar)? else { return Ok(None) };
            Ok(Some(Velocity { planar, third: one(third)? }))
        };
        Ok(Self {
            time: table.numbers("t")?,
            position: all(table, ["x", "y"])?,
            height: one("z")?,
            tilt: [one("roll")?, one("pitch")?],
            yaw: table.numbers("yaw")?,
            body_velocity: velocity(["vbx", "vby"], "vbz")?,
            world_velocity: velocity(["vx", "vy"], "vz")?,
            angular_velocity: [one("wx")?, one("wy")?, one("wz")?],
            command: [table.numbers("cmd_speed")?, second_command(table, second)?],
            wheel_speed: group(table, ["om_fl", "om_fr", "om_rl", "om_rr"])?,
            side_speed: group(table, ["om_l", "om_r"])?,
            road_wheel_angle: group(table, ["steer_fl", "steer_fr"])?,
            truth: if ground_truth { Some(TruthColumns::read(table)?) } else { None },
        })
    }
}

/// Columns that must all be there.
pub(crate) fn all<const N: usize>(table: &Table, names: [&str; N]) -> Result<[Numbers; N], TrajectoryError> {
    let columns = names.iter().map(|name| table.numbers(name)).collect::<Result<Vec<_>, _>>()?;
    Ok(columns.try_into().unwrap_or_else(|_| unreachable!("as many columns as names; this is a bug")))
}

/// Columns that are there together or not used at all.
fn group<const N: usize>(table: &Table, names: [&str; N]) -> Result<Option<[Numbers; N]>, TrajectoryError> {
    if names.iter().all(|name| table.has(name)) { all(table, names).map(Some) } else { Ok(None) }
}

/// The second command: names that data roots use for its column, and what it means.
pub(crate) fn names_of(second: SecondCommand) -> (&'static [&'static str], &'static str) {
    match second {
        SecondCommand::SteeringNormalised => (&["cmd_steer"], "normalised steering"),
        SecondCommand::RoadWheelAngleRad => (&["cmd_road_wheel_angle", "cmd_steer_angle", "cmd_steer"], "a road-wheel angle"),
        SecondCommand::YawRateRadS => (&["cmd_yaw_rate"], "a yaw rate"),
    }
}

/// The column of the second command under one of its names.
fn second_command(table: &Table, second: SecondCommand) -> Result<Numbers, TrajectoryError> {
    let (names, meaning) = names_of(second);
    match names.iter().find(|name| table.has(name)) {
        Some(name) => table.numbers(name),
        None => {
            let reason = format!("missing; the vehicle card says that the second command is {meaning}");
            Err(TrajectoryError::column(table.path(), names[0], reason))
        }
    }
}

/// What the second command means where the name of its column alone says it, and that column; `cmd_steer` may be either kind of steering.
pub(crate) fn implied_second(table: &Table) -> Option<(SecondCommand, &'static str)> {
    let of = |second| names_of(second).0.iter().filter(|name| **name != "cmd_steer").map(move |name| (*name, second));
    let mut there = of(SecondCommand::YawRateRadS).chain(of(SecondCommand::RoadWheelAngleRad)).filter(|(name, _)| table.has(name));
    let (name, second) = there.next()?;
    there.all(|(_, other)| other == second).then_some((second, name))
}
