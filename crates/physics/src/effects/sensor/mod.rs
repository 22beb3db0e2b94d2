//! Effects between the motion and what is measured of it.
//!
//! A prediction takes measured states back to true ones, rolls those out, and reports as the sensors would measure.

mod clock_drift;
mod gyro_bias;
mod gyro_scale;
mod lever_arm;
mod mount_angle;
mod observation;
mod pose_latency;
mod position_latency;
mod velocity_scale;

pub use clock_drift::ClockDrift;
pub use gyro_bias::GyroBias;
pub use gyro_scale::GyroScale;
pub use lever_arm::LeverArm;
pub use mount_angle::MountAngle;
pub use pose_latency::PoseLatency;
pub use position_latency::PositionLatency;
pub use velocity_scale::VelocityScale;

/// What effects change of measurements; all zero by default.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SensorTerms {
    /// Added to the measured yaw rate, rad/s.
    pub gyro_bias_rad_s: f64,
    /// Relative scale of the measured angular velocity, -.
    pub gyro_scale: f64,
    /// Relative scale of the measured linear velocity, -.
    pub velocity_scale: f64,
    /// Age of a measured position, s.
    pub position_latency_s: f64,
    /// Age of a measured position and heading, s; adds to that of the position.
    pub pose_latency_s: f64,
    /// Place whose position and velocity are measured, from the reference point, Body, m.
    pub lever_arm_m: [f64; 3],
    /// Roll, pitch, yaw of the sensors against Body, rad.
    pub mount_rad: [f64; 3],
    /// Relative rate of the log's clock against true time, -.
    pub clock_drift: f64,
}
