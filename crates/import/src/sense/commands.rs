//! Whether the vehicle does what is commanded.

use nesam_physics::{SecondCommand, Vehicle};
use nesam_trajectories::Trajectory;

use super::relation::{ANGLES, COMMANDED_SPEEDS, Relation};
use super::{Doubt, SPEED_M_S, YAW_RATE_RAD_S, forward_m_s, measures_velocity};

/// Slopes between a command and what came of it that are let pass: a vehicle lags and slips.
const FOLLOWS: [f64; 2] = [0.5, 1.6];
/// Road-wheel angle that says something of a stretch, rad (chosen: beyond offsets of steering).
pub(super) const ANGLE_RAD: f64 = 0.05;

/// Speed against its command. A velocity that is not measured is the way from position to position: its estimate begins with the
/// wheels. That way is only told by a heading that holds.
pub(super) fn speed(drives: &[Trajectory], heading_holds: bool) -> Option<Doubt> {
    let pairs = Relation::of(drives, SPEED_M_S, |drive, k, world| {
        let state = &drive.states[k];
        let estimated = !measures_velocity(drive);
        let forward_m_s = if estimated { forward_m_s(drive, k, world) } else { state.velocity_m_s[0] };
        (heading_holds || !estimated).then_some([drive.controls[k].speed_m_s, forward_m_s])
    });
    pairs.judge("speed", "the speed command", FOLLOWS, "the opposite sign", COMMANDED_SPEEDS)
}

/// Turning against the second command.
pub(super) fn turning(drives: &[Trajectory], vehicle: &Vehicle) -> Option<Doubt> {
    let reach = vehicle.steering.as_ref().and_then(|table| table.front_left_rad.last()).copied().unwrap_or(0.4);
    // A skid-steer vehicle may turn at a tenth of the rate that is asked for; only a wrong unit makes less.
    let (floor, least) = if vehicle.second == SecondCommand::YawRateRadS { (YAW_RATE_RAD_S, 0.05) } else { (ANGLE_RAD, 0.3) };
    let pairs = Relation::of(drives, floor, |drive, k, _| {
        let command = drive.controls[k].second;
        match vehicle.second {
            SecondCommand::YawRateRadS => Some([command, drive.states[k].angular_velocity_rad_s[2]]),
            SecondCommand::RoadWheelAngleRad => Some([command, turned_rad(drive, vehicle, k)?]),
            SecondCommand::SteeringNormalised => Some([command * reach, turned_rad(drive, vehicle, k)?]),
        }
    });
    pairs.judge("turning", "the steering command", [least, 2.5], "the opposite sign: steering to the left is positive", ANGLES)
}

/// Road-wheel angle at which a vehicle that slips nowhere turns as a sample says, rad, positive left; `None` where it hardly moves.
pub(super) fn turned_rad(drive: &Trajectory, vehicle: &Vehicle, k: usize) -> Option<f64> {
    let state = &drive.states[k];
    let (forward_m_s, yaw_rate_rad_s) = (state.velocity_m_s[0], state.angular_velocity_rad_s[2]);
    (forward_m_s.abs() > SPEED_M_S).then(|| (yaw_rate_rad_s / forward_m_s * vehicle.wheelbase_m).atan())
}
