//! What is compared: mean deviations of a measured segment from its prediction, channel by channel, each in one residual layer.

use nesam_physics::WHEELS;
use nesam_trajectories::MeasuredChannels;

/// Steps of a segment.
pub const SEGMENT_STEPS: usize = 8;
/// Steps of a segment that are averaged together: the first half shows forces before the vehicle has answered, the second the answer.
pub const BINS: [[usize; 2]; 2] = [[1, 4], [5, SEGMENT_STEPS]];
/// State channels per bin.
pub const STATE_CHANNELS: usize = 12;
/// Index of the steering channel.
pub const STEERING_AT: usize = STATE_CHANNELS * BINS.len();
/// Index of the first rim channel.
pub const RIM_AT: usize = STEERING_AT + 1;
/// Number of channels.
pub const CHANNELS: usize = RIM_AT + WHEELS;

/// Deviations of one segment, measured minus predicted.
pub type Row = [f64; CHANNELS];

const STATE_NAMES: [&str; STATE_CHANNELS] =
    ["forward_m", "left_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad", "vx_m_s", "vy_m_s", "vz_m_s", "wx_rad_s", "wy_rad_s", "wz_rad_s"];
const WHEEL_NAMES: [&str; WHEELS] = ["fl", "fr", "rl", "rr"];

/// Name of a channel with its unit, for instance `late_pitch_rad` or `rim_rr_m_s`.
pub fn name(channel: usize) -> String {
    match channel {
        c if c < STEERING_AT => format!("{}_{}", ["early", "late"][c / STATE_CHANNELS], STATE_NAMES[c % STATE_CHANNELS]),
        STEERING_AT => "road_wheel_angle_rad".into(),
        c => format!("rim_{}_m_s", WHEEL_NAMES[c - RIM_AT]),
    }
}

/// Residual layer of a channel: `kinematic`, `map`, `force` or `actuator`.
pub fn layer(channel: usize) -> &'static str {
    match channel {
        c if c >= STEERING_AT => "actuator",
        c => match c % STATE_CHANNELS {
            0 | 1 | 5 => "kinematic",
            2..=4 => "map",
            _ => "force",
        },
    }
}

/// Which channels a drive measures; an estimated channel is not compared.
pub fn available(measured: &MeasuredChannels) -> [bool; CHANNELS] {
    let w = measured.angular_velocity;
    let state = [
        measured.position,
        measured.position,
        measured.height,
        measured.attitude,
        measured.attitude,
        measured.attitude,
        measured.linear_velocity,
        measured.linear_velocity,
        measured.linear_velocity,
        w[0],
        w[1],
        w[2],
    ];
    core::array::from_fn(|c| match c {
        c if c < STEERING_AT => state[c % STATE_CHANNELS],
        STEERING_AT => measured.road_wheel_angle,
        _ => measured.wheel_speed && measured.linear_velocity,
    })
}
