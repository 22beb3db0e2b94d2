//! Effects between command and wheel: what the actuators make of what they are told.

mod acceleration_limit;
mod locked_differential;
mod skid_steer_track;
mod speed_delay;
mod speed_gain;
mod speed_lag;
mod steering_backlash;
mod steering_compliance;
mod steering_delay;
mod steering_lag;
mod steering_offset;
mod steering_ratio;
mod torque_limit;
mod turn_acceleration_limit;
mod turn_efficiency;
mod turn_limit;
mod wheel_speed_limit;

pub use acceleration_limit::AccelerationLimit;
pub use locked_differential::LockedDifferential;
pub use skid_steer_track::SkidSteerTrack;
pub use speed_delay::SpeedDelay;
pub use speed_gain::SpeedGain;
pub use speed_lag::SpeedLag;
pub use steering_backlash::SteeringBacklash;
pub use steering_compliance::SteeringCompliance;
pub use steering_delay::SteeringDelay;
pub use steering_lag::SteeringLag;
pub use steering_offset::SteeringOffset;
pub use steering_ratio::SteeringRatio;
pub use torque_limit::TorqueLimit;
pub use turn_acceleration_limit::TurnAccelerationLimit;
pub use turn_efficiency::TurnEfficiency;
pub use turn_limit::TurnLimit;
pub use wheel_speed_limit::WheelSpeedLimit;

/// What effects change between command and wheel; all zero by default. Pairs are (speed, second command).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ActuatorTerms {
    /// Delay of the commands, s.
    pub delay_s: [f64; 2],
    /// Time constant of a first-order lag of the commands, s.
    pub lag_s: [f64; 2],
    /// Relative gain of the speed command, -.
    pub speed_gain: f64,
    /// Play of the steering from end to end, in the unit of the second command.
    pub steering_play: f64,
    /// Relative gain of the steering behind its actuator, -.
    pub steering_ratio: f64,
    /// Added to the steering behind its actuator, in the unit of the second command.
    pub steering_offset: f64,
    /// Steering given way per side force on the front axle, rad/N.
    pub steering_compliance_rad_n: f64,
    /// Share of the drive's authority that is lost, -.
    pub torque_lost: f64,
    /// Share of the difference of the rims of an axle that a lock takes away, -.
    pub lock: f64,
    /// Inverse of the largest turning of the rims of a skid-steer base, s/rad.
    pub turn_limit_inverse_s_rad: f64,
    /// Inverse of the largest accelerations of the rims of a skid-steer base: of their mean speed, s²/m, and of their turning, s²/rad.
    pub acceleration_limit_inverse: [f64; 2],
    /// Inverse of the largest speed of a rim of a skid-steer base, s/m.
    pub rim_limit_inverse_s_m: f64,
    /// Relative change of the yaw rate of a skid-steer base per turning of its rims, -.
    pub turn_efficiency: f64,
    /// Added to the track of a differential drive, m.
    pub track_m: f64,
}

impl ActuatorTerms {
    /// Whether commands arrive at the actuators otherwise than they were sent, or leave them with play.
    #[inline]
    pub fn alters_commands(&self) -> bool {
        self.delay_s != [0.0; 2] || self.lag_s != [0.0; 2] || self.speed_gain != 0.0 || self.steering_play != 0.0
    }
}
