//! Whether measured road-wheel angles fit the steering command and the turning of the vehicle.

use nesam_physics::Vehicle;
use nesam_physics::driveline::{road_wheel_angles, steering_command_of};
use nesam_trajectories::Trajectory;

use super::Doubt;
use super::commands::{ANGLE_RAD, turned_rad};
use super::relation::{ANGLES, Relation};

/// Angles per commanded angle that are let pass: a steering lags, and may have an offset or another ratio.
const FOLLOWS: [f64; 2] = [0.5, 2.0];
/// Angles per angle that the motion tells that are let pass: on soft ground a vehicle slides straight on.
const TURNS: [f64; 2] = [0.4, 3.3];

/// The measured angles of the front wheels, of one where the other holds. Command and motion must both disagree: where one alone does, it is in question itself.
pub(super) fn angles(drives: &[Trajectory], vehicle: &Vehicle) -> Option<Doubt> {
    let [left, right] = [(0, " of FL"), (1, " of FR")].map(|(i, of)| judge(drives, vehicle, of, |angles| angles[i]));
    match (left, right) {
        (Some(left), Some(_)) => judge(drives, vehicle, "", |[left, right]| 0.5 * (left + right)).or(Some(left)),
        (left, right) => left.or(right),
    }
}

/// What is read of the angles of the front wheels (left, right) against the same of those that are commanded, and against the motion.
fn judge(drives: &[Trajectory], vehicle: &Vehicle, of: &str, read: impl Fn([f64; 2]) -> f64) -> Option<Doubt> {
    let measured = |drive: &Trajectory, k: usize| Some(read(drive.road_wheel_angle_rad.as_ref()?[k]));
    let doubt = |relation: Relation, against: &str, pass: [f64; 2]| {
        relation.judge(&format!("road-wheel angle{of}"), against, pass, "the opposite sign: angles to the left are positive", ANGLES)
    };
    let turned = Relation::of(drives, ANGLE_RAD, |drive, k, _| Some([turned_rad(drive, vehicle, k)?, measured(drive, k)?]));
    let by_motion = doubt(turned, "the turning of the vehicle", TURNS)?;
    if steering_command_of(vehicle, 0.0).is_none() {
        return Some(by_motion);
    }
    let commanded = Relation::of(drives, ANGLE_RAD, |drive, k, _| {
        let [left, right, ..] = road_wheel_angles(vehicle, drive.controls[k].second);
        Some([read([left, right]), measured(drive, k)?])
    });
    doubt(commanded, "the steering command", FOLLOWS)
}
