//! One recorded drive at the step of the model.

use nesam_physics::{Control, VehicleState, WHEELS};

use crate::ground_truth::GroundTruth;
use crate::velocity::replace_in_hindsight;

/// Part of a set that a drive belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Split {
    /// For training (and validation cut from it).
    Train,
    /// For scoring only.
    Test,
}

impl Split {
    /// `train` or `test`.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Train => "train",
            Self::Test => "test",
        }
    }
}

/// Where the linear velocity comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum VelocitySource {
    /// Measured in Body (`vbx`, `vby`, `vbz`).
    Body,
    /// Measured in World (`vx`, `vy`, `vz`), rotated with the measured attitude.
    World,
    /// Not measured: smoothed backward differences of the measured position, which use the past only.
    Positions,
}

/// Which channels of the states are measurements; the others are causal estimates, and of a pose zeros.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MeasuredChannels {
    /// Horizontal position.
    pub position: bool,
    /// Height; false = taken for zero.
    pub height: bool,
    /// Roll, pitch and yaw; false = taken for zero.
    pub attitude: [bool; 3],
    /// Linear velocity; false = estimated from positions.
    pub linear_velocity: bool,
    /// Where the linear velocity comes from.
    pub velocity_source: VelocitySource,
    /// Angular velocity about Body x, y, z; false = estimated from attitudes.
    pub angular_velocity: [bool; 3],
    /// Wheel speeds.
    pub wheel_speed: bool,
    /// Road-wheel angles.
    pub road_wheel_angle: bool,
}

impl MeasuredChannels {
    /// Pose and twist measured, of wheels nothing.
    pub const POSE_AND_TWIST: Self = Self {
        position: true,
        height: true,
        attitude: [true; 3],
        linear_velocity: true,
        velocity_source: VelocitySource::Body,
        angular_velocity: [true; 3],
        wheel_speed: false,
        road_wheel_angle: false,
    };

    /// Which of x, y, z, roll, pitch and yaw are measured.
    pub fn pose(&self) -> [bool; 6] {
        let [roll, pitch, yaw] = self.attitude;
        [self.position, self.position, self.height, roll, pitch, yaw]
    }

    /// Whether a state says where the vehicle is in three dimensions, so that it can be put on a map.
    pub fn whole_pose(&self) -> bool {
        self.pose() == [true; 6]
    }
}

/// A recorded drive, resampled to a fixed step; all vectors have one entry per sample.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    /// Trajectory id.
    pub id: String,
    /// Set, as it was asked for.
    pub set: String,
    /// World of the drive; `None` where the index names none, the root has no map of it, or height, roll or pitch are not measured: on a map a state with
    /// zeros for them stands in the ground or in the air.
    pub world: Option<String>,
    /// Split; `None` where there is no index.
    pub split: Option<Split>,
    /// Step between samples, s.
    pub dt_s: f64,
    /// Time of each sample, s.
    pub time_s: Vec<f64>,
    /// Measured states, noise included; see `measured` for what is estimated.
    pub states: Vec<VehicleState<f64>>,
    /// Commands, each valid from its sample to the next; of a log that is finer than the step the mean of what was commanded between them.
    pub controls: Vec<Control<f64>>,
    /// Measured wheel speeds FL, FR, RL, RR, rad/s; a skid-steer vehicle repeats left and right.
    pub wheel_speed_rad_s: Option<Vec<[f64; WHEELS]>>,
    /// Measured road-wheel angles of the front wheels (left, right), rad.
    pub road_wheel_angle_rad: Option<Vec<[f64; 2]>>,
    /// What is measured.
    pub measured: MeasuredChannels,
    /// Ground truth, only where it was asked for.
    pub truth: Option<GroundTruth>,
}

impl Trajectory {
    /// The drive with velocities that are not measured estimated in hindsight, from what came before and after each sample. For identification only: nothing
    /// that predicts may see it. What is measured stays.
    pub fn in_hindsight(&self) -> Self {
        let mut seen = self.clone();
        replace_in_hindsight(&mut seen.states, &self.measured, self.dt_s);
        seen
    }
}
