//! Whether velocities, rates and tilt fit poses.

use nesam_trajectories::Trajectory;

use super::relation::{ANGLES, Relation, SPEEDS, UNRELATED_ADVICE};
use super::{Doubt, SPEED_M_S, YAW_RATE_RAD_S, angle_rate_rad_s, doubt, forward_m_s, left_m_s, measures_velocity};

/// Slopes between two measurements of the same that are let pass.
const SAME: [f64; 2] = [0.7, 1.4];
/// The same for rates of roll and pitch, shaken by the suspension: only gross disagreement counts there.
const SHAKEN: [f64; 2] = [0.3, 3.0];
/// Rate of roll or pitch that says something of a stretch, rad/s (chosen: beyond the bias of gyros).
const TILT_RATE_RAD_S: f64 = 0.05;
/// Sideways speed whose sign says something, m/s: it is small (chosen).
const SIDEWAYS_M_S: f64 = 0.1;
/// Slope of the ground whose sign says something, - (chosen: beyond the squat of a suspension).
const SLOPE: f64 = 0.05;
/// Roll or pitch beyond this in a twentieth of all samples is no driving, rad.
const TILT_MAX_RAD: f64 = 1.2;

/// Vehicles do not drive on their sides.
pub(super) fn tilt(drives: &[Trajectory]) -> Option<Doubt> {
    let all: usize = drives.iter().map(|d| d.states.len()).sum();
    let steep = |s: &nesam_physics::VehicleState<f64>| s.attitude_rad[0].abs().max(s.attitude_rad[1].abs()) > TILT_MAX_RAD;
    let count = drives.iter().flat_map(|d| &d.states).filter(|s| steep(s)).count();
    (all > 0 && count * 20 > all).then(|| {
        let what = format!("roll or pitch is beyond {TILT_MAX_RAD} rad in {count} of {all} samples");
        doubt(what, "the file seems to have degrees instead of radians")
    })
}

/// Forward velocities that are measured against positions; whether they vary with these is asked where the positions hold.
pub(super) fn velocity(drives: &[Trajectory], positions_hold: bool) -> Option<Doubt> {
    let forward = Relation::of(drives, SPEED_M_S, |drive, k, world| {
        measures_velocity(drive).then(|| [forward_m_s(drive, k, world), drive.states[k].velocity_m_s[0]])
    });
    forward.judge("forward velocity", "positions", SAME, "x of the body pointing to the rear", SPEEDS).or_else(|| {
        let correlation = forward.unrelated().filter(|_| positions_hold)?;
        Some(doubt(format!("forward velocity does not follow positions (correlation {correlation:.2})"), UNRELATED_ADVICE))
    })
}

/// Sideways velocities against positions: they are small, and only their sign can be told.
pub(super) fn sideways(drives: &[Trajectory]) -> Option<Doubt> {
    let left = Relation::of(drives, SIDEWAYS_M_S, |drive, k, world| {
        measures_velocity(drive).then(|| [left_m_s(drive, k, world), drive.states[k].velocity_m_s[1]])
    });
    let (count, of) = left.reversed(SIDEWAYS_M_S)?;
    let what = format!("sideways velocity has the opposite sign of what positions say in {count} of {of} seconds");
    Some(doubt(what, "y of the body must point to the left; import with `--frame ned-frd` or negate it"))
}

/// Measured rates against measured attitudes.
pub(super) fn rates(drives: &[Trajectory]) -> Vec<Doubt> {
    let checks = [("roll", SHAKEN, TILT_RATE_RAD_S), ("pitch", SHAKEN, TILT_RATE_RAD_S), ("yaw", SAME, YAW_RATE_RAD_S)];
    let judge = |(axis, (name, pass, floor)): (usize, (&str, [f64; 2], f64))| {
        let pairs = Relation::of(drives, floor, |drive, k, _| {
            let told = drive.states[k].angular_velocity_rad_s[axis];
            let both = drive.measured.angular_velocity[axis] && drive.measured.attitude[axis];
            both.then(|| [angle_rate_rad_s(drive, k, axis), told])
        });
        pairs.judge(&format!("{name} rate"), &format!("the change of {name}"), pass, "the opposite sign", ANGLES)
    };
    checks.into_iter().enumerate().filter_map(judge).collect()
}

/// Nose up means climbing.
pub(super) fn climb(drives: &[Trajectory]) -> Option<Doubt> {
    let slopes = Relation::of(drives, SLOPE, |drive, k, v| {
        let forward = drive.controls[k].speed_m_s > 0.0 && v[0].hypot(v[1]) > SPEED_M_S;
        forward.then(|| [-drive.states[k].attitude_rad[1].tan(), v[2] / v[0].hypot(v[1])])
    });
    let (count, of) = slopes.reversed(SLOPE)?;
    Some(doubt(
        format!("the vehicle climbs while its nose points down, or the other way round, in {count} of {of} seconds on slopes"),
        "pitch > 0 must be nose down (x forward, y left, z up); negate it, or import with `--frame ned-frd`",
    ))
}
