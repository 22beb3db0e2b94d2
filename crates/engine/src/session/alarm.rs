//! Alarms: what a watch tells, and how it is said to a person.

use nesam_adaptation::VELOCITY_DIM;
use nesam_physics::CONTRADICTIONS;

/// Share of a misfit that another soil could explain from which on the sentence names the soil. Chosen: on ground that is not what it looks like it was
/// 0.40 to 0.49, on validation drives with an effect in actuators or sensors 0.1 to 0.3 (median and most).
const SOIL_SHARE: f64 = 0.35;

/// The test that raised an alarm.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AlarmKind {
    /// Innovations larger than their covariance says.
    NisLarge,
    /// Innovations smaller than their covariance says.
    NisSmall,
    /// Consecutive innovations resemble each other.
    Correlated,
    /// The mean of a velocity against its prediction has jumped.
    MotionJump,
    /// The mean of a contradiction between sensors has jumped.
    SensorJump,
}

impl AlarmKind {
    /// All of them, in the order of their numbers from 1.
    pub const ALL: [Self; 5] = [Self::NisLarge, Self::NisSmall, Self::Correlated, Self::MotionJump, Self::SensorJump];

    /// Name for metrics and logs.
    pub fn label(self) -> &'static str {
        match self {
            Self::NisLarge => "nis_large",
            Self::NisSmall => "nis_small",
            Self::Correlated => "correlated",
            Self::MotionJump => "motion_jump",
            Self::SensorJump => "sensor_jump",
        }
    }
}

/// Names of the channels with their units: motion against its prediction, then sensors against each other.
const CHANNELS: [&str; VELOCITY_DIM + CONTRADICTIONS] = [
    "forward_m_s",
    "left_m_s",
    "up_m_s",
    "roll_rate_rad_s",
    "pitch_rate_rad_s",
    "yaw_rate_rad_s",
    "path_minus_velocity_ahead_m_s",
    "path_minus_velocity_left_m_s",
    "path_minus_velocity_up_m_s",
    "turn_minus_gyro_roll_rad_s",
    "turn_minus_gyro_pitch_rad_s",
    "turn_minus_gyro_yaw_rad_s",
];
/// The same in a sentence.
const WORDS: [&str; VELOCITY_DIM + CONTRADICTIONS] = [
    "forward",
    "to the left",
    "upwards",
    "in roll",
    "in pitch",
    "in yaw",
    "ahead",
    "to the left",
    "upwards",
    "in roll",
    "in pitch",
    "in yaw",
];

/// An episode of disagreement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Alarm {
    /// Counts the episodes of the session from 1.
    pub episode: u64,
    /// Raised, or cleared.
    pub active: bool,
    /// Test that raised it.
    pub kind: AlarmKind,
    /// Place of the channel that jumped; `None` for a test of all.
    pub channel: Option<usize>,
    /// Mean of the channel since the onset, measured minus predicted or minus integrated, m/s or rad/s.
    pub size: f64,
    /// Statistic that raised it.
    pub statistic: f64,
    /// Threshold that it passed.
    pub threshold: f64,
    /// Share of the misfit since the onset that a soil other than the map shows could explain at most, 0 to 1.
    pub soil_share: f64,
    /// Last stamp of the last buffer, ns of the vehicle's clock.
    pub stamp_ns: i64,
    /// First stamp from which on the measurements disagree, ns of the vehicle's clock.
    pub onset_ns: i64,
}

impl Alarm {
    /// Name of the channel with its unit; empty without one.
    pub fn channel_name(&self) -> &'static str {
        self.channel.and_then(|c| CHANNELS.get(c)).copied().unwrap_or_default()
    }

    /// What it looks like, in one sentence. It names soil or sensors where only those fit, and never a part of the vehicle: that is what a diagnosis is for.
    pub fn description(&self) -> String {
        let word = self.channel.and_then(|c| WORDS.get(c)).copied().unwrap_or_default();
        let angular = self.channel.is_some_and(|c| c % VELOCITY_DIM >= 3);
        let unit = if angular { "rad/s" } else { "m/s" };
        let more = if self.size < 0.0 { "less" } else { "more" };
        match self.kind {
            AlarmKind::SensorJump if angular => format!(
                "the change of attitude and the angular velocity contradict each other {word} by {:+.4} {unit}: neither soil nor forces do that, sensors or clocks do",
                self.size
            ),
            AlarmKind::SensorJump => format!(
                "displacement and velocity contradict each other {word} by {:+.3} {unit}: neither soil nor forces do that, sensors or clocks do",
                self.size
            ),
            AlarmKind::MotionJump => {
                format!("the vehicle moves {:.3} {unit} {more} {word} than predicted, {}", self.size.abs(), self.of_soil())
            }
            AlarmKind::NisLarge => format!("motion differs from prediction more than it should, {}", self.of_soil()),
            AlarmKind::Correlated => format!("motion differs from prediction in the same way all the time, {}", self.of_soil()),
            AlarmKind::NisSmall => {
                "motion differs from prediction less than expected: the noise of this bundle is too large here, and changes are seen late"
                    .into()
            }
        }
    }

    fn of_soil(&self) -> String {
        let share = 100.0 * self.soil_share;
        if self.soil_share >= SOIL_SHARE {
            format!("as it would on ground that is not what the map shows (another soil explains up to {share:.0} %)")
        } else {
            format!("and another soil explains {share:.0} % of it at most: what does is open until a diagnosis")
        }
    }

    /// The command that diagnoses what was recorded of the episode; `RECORDING` stands for the recording of the server.
    pub fn diagnose(&self, session: &str) -> String {
        format!("nesam diagnose --recording RECORDING --session={session} --from-ns {}", self.onset_ns)
    }
}
