//! Whether recorded drives make sense: units, signs and frames are told from each other by what they must agree on.
//!
//! A log that reads without an error can still say metres where it means feet, or count yaw like a compass. Every check here compares two channels that
//! measure the same motion, or a command with what came of it, over all drives of a set; a doubt says which convention explains the numbers. The
//! limits are wide (chosen): slip, lag and noise of a sound log stay inside, a wrong unit or sign does not. A check counts stretches of a second, and
//! doubts what most of them say: one drive with a bad pose is none, and of few seconds nothing is said.

mod belong;
mod card;
mod commands;
mod heading;
mod heights;
mod late;
mod motion;
mod point;
mod positions;
mod quaternion;
mod recorded;
mod relation;
mod road_wheels;
#[cfg(test)]
mod tests;
mod wheels;

use std::ops::Range;

use nesam_physics::{Vehicle, WHEELS, wrap_angle};
use nesam_trajectories::{Trajectory, VelocitySource};

pub use card::card_doubts;
pub use recorded::recorded_doubts;

/// Samples of a stretch: a second at 10 Hz (chosen: longer than poses freeze in sound logs, shorter than most motions last).
const STRETCH: usize = 10;
/// Speed that says something of a stretch, m/s (chosen: beyond what noise of positions makes in a second).
const SPEED_M_S: f64 = 0.3;
/// Yaw rate that says something of a stretch, rad/s (chosen: beyond noise of attitudes and bias of gyros).
const YAW_RATE_RAD_S: f64 = 0.1;

/// Something that does not fit together.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Doubt {
    /// What disagrees, with the figure.
    pub what: String,
    /// What to do.
    pub advice: String,
}

fn doubt(what: String, advice: impl Into<String>) -> Doubt {
    Doubt { what, advice: advice.into() }
}

/// What does not fit together in these drives of one vehicle, causes first. Nothing is said of what they hardly exercise, nor of what a wrong heading explains.
pub fn doubts(drives: &[Trajectory], vehicle: &Vehicle) -> Vec<Doubt> {
    let positions_m = drives.iter().flat_map(|drive| &drive.states).map(|state| state.position_m);
    disagreements(drives, vehicle).into_iter().chain(positions::far_from_origin(positions_m)).collect()
}

fn disagreements(drives: &[Trajectory], vehicle: &Vehicle) -> Vec<Doubt> {
    // Whatever else is odd follows from attitudes that are none.
    if let Some(order) = quaternion::order(drives) {
        return vec![order];
    }
    let jumps = positions::jumps(drives, vehicle);
    // Of positions that jump back and forth all the time, nothing follows.
    let torn = jumps.as_ref().is_some_and(|jumps| jumps.often && jumps.back_and_forth);
    let attitude: Vec<Doubt> = motion::tilt(drives).into_iter().chain(heading::heading(drives).filter(|_| !torn)).collect();
    let heights = if jumps.is_none() { heights::heights(drives, vehicle) } else { None };
    // A path in another unit is all jumps, and told by the velocities.
    let (jumps, unit) =
        jumps.map_or((None, None), |found| if found.often && !torn { (None, Some(found.doubt)) } else { (Some(found.doubt), None) });
    let positions: Vec<Doubt> = positions::frozen(drives, vehicle).into_iter().chain(jumps).collect();
    let (attitude_holds, positions_hold) = (attitude.is_empty(), positions.is_empty());
    let rates = motion::rates(drives);
    let turns = heading::turns(drives).filter(|_| attitude_holds && !torn && rates.is_empty());
    let mut found = [attitude, positions, turns.into_iter().collect()].concat();
    if attitude_holds && !torn {
        found.extend(motion::velocity(drives, positions_hold));
        let rims = wheels::speeds(drives, vehicle);
        if rims.is_empty() && rates.is_empty() {
            found.extend(wheels::sides(drives, vehicle));
        }
        found.extend(rims);
    }
    found.extend(rates);
    found.extend(motion::climb(drives).filter(|_| !torn && heights.is_none()));
    found.extend(commands::speed(drives, attitude_holds && !torn));
    found.extend(commands::turning(drives, vehicle));
    found.extend(road_wheels::angles(drives, vehicle));
    if found.is_empty() {
        found.extend(unit);
    }
    // Positions that are late move sideways in turns, otherwise than the velocities do.
    let late = if found.is_empty() { late::late(drives, vehicle) } else { Vec::new() };
    if late.is_empty() && attitude_holds && !torn {
        found.extend(motion::sideways(drives));
    }
    found.extend(late);
    if found.is_empty() {
        found.extend(belong::belong(drives, vehicle));
        found.extend(point::moves_sideways(drives, vehicle));
    }
    // Nothing else is judged by them.
    found.extend(heights);
    found
}

/// Stretches of the samples of a drive that lie between two others.
fn stretches(drive: &Trajectory) -> impl Iterator<Item = Range<usize>> {
    let end = drive.states.len().saturating_sub(1);
    (1..end).step_by(STRETCH).map(move |begin| begin..end.min(begin + STRETCH)).filter(|stretch| stretch.len() >= STRETCH / 2)
}

/// Velocity over ground from the positions around a sample, World, m/s.
fn ground_velocity_m_s(drive: &Trajectory, k: usize) -> [f64; 3] {
    let (a, b) = (drive.states[k - 1].position_m, drive.states[k + 1].position_m);
    core::array::from_fn(|i| (b[i] - a[i]) / (2.0 * drive.dt_s))
}

/// Speed over ground along the heading, m/s, of a ground velocity. Heights do not count: they may be in another unit.
fn forward_m_s(drive: &Trajectory, k: usize, [x, y, _]: [f64; 3]) -> f64 {
    let (sin, cos) = drive.states[k].attitude_rad[2].sin_cos();
    x * cos + y * sin
}

/// The same to the left of the heading, m/s.
fn left_m_s(drive: &Trajectory, k: usize, [x, y, _]: [f64; 3]) -> f64 {
    let (sin, cos) = drive.states[k].attitude_rad[2].sin_cos();
    y * cos - x * sin
}

/// Rate of roll, pitch or yaw from the attitudes around a sample, rad/s.
fn angle_rate_rad_s(drive: &Trajectory, k: usize, axis: usize) -> f64 {
    wrap_angle(drive.states[k + 1].attitude_rad[axis] - drive.states[k - 1].attitude_rad[axis]) / (2.0 * drive.dt_s)
}

/// Whether velocities are measured, and not what positions make of them.
fn measures_velocity(drive: &Trajectory) -> bool {
    drive.measured.velocity_source != VelocitySource::Positions
}

/// Mean rim speed, m/s.
fn rim_speed_m_s(drive: &Trajectory, vehicle: &Vehicle, k: usize) -> Option<f64> {
    let wheels = drive.wheel_speed_rad_s.as_ref()?[k];
    Some(wheels.iter().sum::<f64>() / WHEELS as f64 * vehicle.wheel_radius_m)
}
