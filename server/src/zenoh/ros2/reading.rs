//! What messages of ROS 2 say of a vehicle in the conventions of its card.

use nesam_engine::EngineError;
use nesam_physics::driveline::steering_command_of;
use nesam_physics::vec3::attitude_of_quaternion;
use nesam_physics::{Control, SecondCommand, Vehicle, VehicleState};
use nesam_ros2::messages::{Command, CommandType, Odometry};

/// Least speed with which the yaw rate of a twist is made an angle, m/s: below it noise would be full lock.
const SLOW_M_S: f64 = 0.3;

/// State of the reference point of the card, which lies at `reference_m` in the child frame of the odometry. Child frame is Body, its frame World (REP-103).
///
/// # Errors
/// `Invalid` for an orientation that is none.
pub fn state(odometry: &Odometry, reference_m: [f64; 3]) -> Result<VehicleState<f64>, EngineError> {
    let attitude_rad = attitude_of_quaternion(odometry.orientation).ok_or_else(|| {
        let reason = format!("is {:?}, a quaternion of length 1 is expected", odometry.orientation);
        EngineError::invalid("pose.pose.orientation", reason)
    })?;
    let of_child_frame = VehicleState {
        position_m: odometry.position_m,
        attitude_rad,
        velocity_m_s: odometry.linear_m_s,
        angular_velocity_rad_s: odometry.angular_rad_s,
    };
    Ok(of_child_frame.at_point(reference_m))
}

/// A command as the card has it, and whether it was beyond the card's range, where the vehicle does what it can.
///
/// The yaw rate of a twist is the angle with which a vehicle of this wheelbase turns so at its speed (kinematic bicycle), the speed taken as 0.3 m/s at least,
/// as clients do.
pub fn control(kind: CommandType, vehicle: &Vehicle, command: &Command) -> (Control<f64>, bool) {
    let Command { speed_m_s, turn, .. } = *command;
    let angle_rad = match kind.is_steered() {
        true => turn,
        false => (vehicle.wheelbase_m * turn / speed_m_s.abs().max(SLOW_M_S).copysign(speed_m_s)).atan(),
    };
    let second = match vehicle.second {
        SecondCommand::YawRateRadS => turn,
        _ => steering_command_of(vehicle, angle_rad).unwrap_or(0.0),
    };
    let [[slowest, fastest], [right, left]] = vehicle.command_range;
    let within = Control { speed_m_s: speed_m_s.clamp(slowest, fastest), second: second.clamp(right, left) };
    let limited = within.speed_m_s != speed_m_s || within.second != second;
    (within, limited)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_the_reference_point_moves_with_the_vehicle() {
        // Goal: an offset is carried along by attitude and turning. Method: 2 m ahead, on a vehicle that faces north and turns left at 0.5 rad/s.
        let half = std::f64::consts::FRAC_PI_4;
        let odometry = Odometry {
            stamp_ns: 0,
            position_m: [10.0, 20.0, 1.0],
            orientation: [0.0, 0.0, half.sin(), half.cos()],
            linear_m_s: [1.0, 0.0, 0.0],
            angular_rad_s: [0.0, 0.0, 0.5],
        };
        let state = state(&odometry, [2.0, 0.0, 0.5]).expect("a state");
        let close = |found: [f64; 3], expected: [f64; 3]| found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(close(state.position_m, [10.0, 22.0, 1.5]), "{:?}", state.position_m);
        assert!(close(state.velocity_m_s, [1.0, 1.0, 0.0]), "{:?}", state.velocity_m_s);
        assert!(close(state.attitude_rad, [0.0, 0.0, std::f64::consts::FRAC_PI_2]));
        let error = super::state(&Odometry { orientation: [0.0; 4], ..odometry }, [0.0; 3]).expect_err("no attitude");
        assert_eq!(error.field(), "pose.pose.orientation");
    }

    /// Nose down: what lies ahead is lower.
    #[test]
    fn analytic_pitch_lowers_what_lies_ahead() {
        let odometry = Odometry {
            stamp_ns: 0,
            position_m: [0.0; 3],
            orientation: [0.0, 0.1_f64.sin(), 0.0, 0.1_f64.cos()],
            linear_m_s: [0.0; 3],
            angular_rad_s: [0.0; 3],
        };
        let position_m = state(&odometry, [1.0, 0.0, 0.0]).expect("a state").position_m;
        assert!((position_m[0] - 0.2_f64.cos()).abs() < 1e-12 && (position_m[2] + 0.2_f64.sin()).abs() < 1e-12, "{position_m:?}");
    }
}
