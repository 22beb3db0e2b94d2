//! Whether attitudes come from quaternions in another order.

use nesam_physics::vec3::attitude_of_quaternion;
use nesam_trajectories::Trajectory;

use super::{Doubt, doubt};

/// Roll and pitch of a vehicle that drives, rad (chosen).
const LEVEL_RAD: f64 = 0.7;
/// Share of the samples that the other order must make level (chosen).
const MOST: f64 = 0.95;

/// Attitudes that no vehicle has, of quaternions w, x, y, z that were taken for x, y, z, w.
pub(super) fn order(drives: &[Trajectory]) -> Option<Doubt> {
    let all: usize = drives.iter().map(|drive| drive.states.len()).sum();
    let level = |[roll, pitch, _]: [f64; 3]| roll.abs().max(pitch.abs()) < LEVEL_RAD;
    let count = |is: &dyn Fn([f64; 3]) -> bool| drives.iter().flat_map(|drive| &drive.states).filter(|s| is(s.attitude_rad)).count() as f64;
    let as_read = count(&level);
    let other = count(&|attitude| {
        let [w, x, y, z] = quaternion(attitude);
        attitude_of_quaternion([x, y, z, w]).is_some_and(level)
    });
    if as_read > 0.5 * all as f64 || other < MOST * all as f64 || all == 0 {
        return None;
    }
    let what = format!(
        "roll or pitch is beyond {LEVEL_RAD} rad in {:.0} of {all} samples, and level with the quaternion in another order",
        all as f64 - as_read
    );
    Some(doubt(
        what,
        "the columns `qx`, `qy`, `qz`, `qw` seem to hold w, x, y, z: import with `--column qw=qx --column qx=qy --column qy=qz --column qz=qw`",
    ))
}

/// Unit quaternion x, y, z, w of roll, pitch and yaw (R = Rz Ry Rx).
fn quaternion(attitude_rad: [f64; 3]) -> [f64; 4] {
    let [(sr, cr), (sp, cp), (sy, cy)] = attitude_rad.map(|angle| (0.5 * angle).sin_cos());
    [sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy, cr * cp * cy + sr * sp * sy]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_quaternions_of_angles_are_read_again() {
        for attitude in [[0.1, -0.2, 3.0], [-2.0, 1.2, -0.5]] {
            let read = attitude_of_quaternion(quaternion(attitude)).unwrap();
            assert!(read.iter().zip(attitude).all(|(a, b)| (a - b).abs() < 1e-12), "{read:?}");
        }
    }
}
