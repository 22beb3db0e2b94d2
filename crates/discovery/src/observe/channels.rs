//! What is compared: deviations of a measured segment from its prediction, and of its channels from one another, each in one residual layer.

use nesam_physics::WHEELS;
use nesam_trajectories::MeasuredChannels;

/// Steps of a segment.
pub const SEGMENT_STEPS: usize = 8;
/// Steps of a segment that are averaged together: the first half shows forces before the vehicle has answered, the second the answer.
pub const BINS: [[usize; 2]; 2] = [[1, 4], [5, SEGMENT_STEPS]];
/// State channels per bin.
pub const STATE_CHANNELS: usize = 12;
/// Index of the first steering channel, one per bin.
pub const STEERING_AT: usize = STATE_CHANNELS * BINS.len();
/// Index of the first rim channel.
pub const RIM_AT: usize = STEERING_AT + BINS.len();
/// Index of the first channel that compares displacement with velocity: ahead, left, up.
pub const PATH_AT: usize = RIM_AT + WHEELS;
/// Index of the first channel that compares the change of attitude with the angular velocity: roll, pitch, yaw.
pub const TURN_AT: usize = PATH_AT + 3;
/// Number of channels.
pub const CHANNELS: usize = TURN_AT + 3;

/// Deviations of one segment, measured minus predicted.
pub type Row = [f64; CHANNELS];

const STATE_NAMES: [&str; STATE_CHANNELS] =
    ["forward_m", "left_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad", "vx_m_s", "vy_m_s", "vz_m_s", "wx_rad_s", "wy_rad_s", "wz_rad_s"];
const WHEEL_NAMES: [&str; WHEELS] = ["fl", "fr", "rl", "rr"];
const BIN_NAMES: [&str; BINS.len()] = ["early", "late"];

/// Name of a channel with its unit, for instance `late_pitch_rad`, `rim_rr_m_s` or `turn_minus_gyro_yaw_rad`.
pub fn name(channel: usize) -> String {
    match channel {
        c if c < STEERING_AT => format!("{}_{}", BIN_NAMES[c / STATE_CHANNELS], STATE_NAMES[c % STATE_CHANNELS]),
        c if c < RIM_AT => format!("{}_road_wheel_angle_rad", BIN_NAMES[c - STEERING_AT]),
        c if c < PATH_AT => format!("rim_{}_m_s", WHEEL_NAMES[c - RIM_AT]),
        c if c < TURN_AT => format!("path_minus_velocity_{}_m", ["ahead", "left", "up"][c - PATH_AT]),
        c => format!("turn_minus_gyro_{}_rad", ["roll", "pitch", "yaw"][(c - TURN_AT).min(2)]),
    }
}

/// Name of the level of a channel.
pub fn level_name(channel: usize) -> String {
    format!("level of {}", name(channel))
}

/// Residual layer of a channel: `actuator`, `force`, `kinematic` or `map`.
pub fn layer(channel: usize) -> &'static str {
    match channel {
        c if c >= PATH_AT => "kinematic",
        c if c >= STEERING_AT => "actuator",
        c => match c % STATE_CHANNELS {
            2..=4 => "map",
            _ => "force",
        },
    }
}

/// Which channels of a drive are compared: what is measured and predicted. Rims that are servoed turn as they are told, others follow the ground under them,
/// which is known where velocity is measured. Without a map, height, roll and pitch tell of the ground and not of the vehicle.
pub fn available(measured: &MeasuredChannels, rims_servoed: bool, mapped: bool) -> [bool; CHANNELS] {
    let w = measured.angular_velocity;
    let (position, height, velocity, [roll, pitch, yaw]) =
        (measured.position, measured.height, measured.linear_velocity, measured.attitude);
    let attitude = roll && pitch && yaw;
    let (heave, sway) = (velocity && mapped, [w[0] && mapped, w[1] && mapped]);
    let tilt = [roll && mapped, pitch && mapped];
    let state = [position, position, height && mapped, tilt[0], tilt[1], yaw, velocity, velocity, heave, sway[0], sway[1], w[2]];
    core::array::from_fn(|c| match c {
        c if c < STEERING_AT => state[c % STATE_CHANNELS],
        c if c < RIM_AT => measured.road_wheel_angle,
        c if c < PATH_AT => measured.wheel_speed && (velocity || rims_servoed),
        c if c < TURN_AT => position && velocity && attitude && (height || c < PATH_AT + 2),
        _ => attitude && w[c - TURN_AT],
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regress_roll_and_pitch_that_are_not_measured_are_not_compared() {
        let all = available(&MeasuredChannels::POSE_AND_TWIST, false, true);
        let level = MeasuredChannels { attitude: [false, true, true], ..MeasuredChannels::POSE_AND_TWIST };
        let lost: Vec<String> = (0..CHANNELS).filter(|c| all[*c] && !available(&level, false, true)[*c]).map(name).collect();
        // What needs the whole attitude goes with it: velocities turned into World, and changes of attitude against the gyro.
        let expected = [
            "early_roll_rad",
            "late_roll_rad",
            "path_minus_velocity_ahead_m",
            "path_minus_velocity_left_m",
            "path_minus_velocity_up_m",
            "turn_minus_gyro_roll_rad",
            "turn_minus_gyro_pitch_rad",
            "turn_minus_gyro_yaw_rad",
        ];
        assert_eq!(lost, expected);
    }
}
