//! What a vehicle reports, and what the session answers.

use nesam_physics::{Control, VehicleState, WHEELS};

/// Measurement of one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measurement {
    /// Position in the vehicle's own numbering; `None` = not numbered.
    pub sequence: Option<u64>,
    /// Start of the vehicle's software that the numbers and stamps belong to; `None` = not told.
    pub boot: Option<u64>,
    /// Instant of the state, ns of the vehicle's clock.
    pub stamp_ns: i64,
    /// Measured state: pose in World, twist in Body.
    pub state: VehicleState<f64>,
    /// Command applied from this instant on.
    pub command: Control<f64>,
    /// Wheels, where they are measured.
    pub wheels: WheelMeasurement,
}

/// Optional measurements of the wheels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WheelMeasurement {
    /// Speeds of FL, FR, RL, RR, rad/s.
    pub speed_rad_s: Option<[f64; WHEELS]>,
    /// Road-wheel angles of the front wheels (left, right), rad.
    pub road_wheel_angle_rad: Option<[f64; 2]>,
}

/// What became of a measurement.
#[derive(Clone, Debug, PartialEq)]
pub enum Outcome {
    /// It ends a step of the history.
    Applied,
    /// Accepted, but denser than the grid of the model; the step at the next grid point is made of it and the next measurement.
    Buffered {
        /// Time until then, s.
        next_step_in_s: f64,
    },
    /// Accepted before; nothing changed.
    Duplicate,
    /// Behind the window before the newest accepted one, numbered against the order of the stamps, or of a former start of the vehicle; nothing changed.
    TooOld {
        /// How far its stamp lies behind, s; 0 when only the sequence number is old.
        behind_s: f64,
    },
    /// A number is NaN or infinite; nothing changed.
    NotFinite {
        /// Path of the number below the measurement.
        field: String,
    },
    /// Further ahead of the last one than time has passed since; nothing changed. A second one in a row proves that the clock was set.
    Future {
        /// How far its stamp lies ahead of where the last one and the time since then put it, s.
        ahead_s: f64,
    },
    /// Applied after the vehicle's clock was set; the history starts again here.
    ClockJump {
        /// By how much, s; negative = back.
        jump_s: f64,
    },
    /// Applied after the vehicle was restarted; the history starts again here, the soil stays.
    Restarted,
    /// In the history, but the buffer that became final with it was refused by the soil filter.
    Gated {
        /// Normalised innovation squared, -.
        nis: f64,
    },
    /// Applied after a pause; the history starts again here.
    Gap {
        /// Time since the previous step, s.
        gap_s: f64,
    },
}

impl Outcome {
    /// Whether the measurement changed the session.
    pub fn accepted(&self) -> bool {
        !matches!(self, Self::Duplicate | Self::TooOld { .. } | Self::NotFinite { .. } | Self::Future { .. })
    }

    /// Name for metrics and logs.
    pub fn label(&self) -> &'static str {
        match self {
            Self::Applied => "applied",
            Self::Buffered { .. } => "buffered",
            Self::Duplicate => "duplicate",
            Self::TooOld { .. } => "too_old",
            Self::NotFinite { .. } => "not_finite",
            Self::Gated { .. } => "gated",
            Self::Gap { .. } => "gap",
            Self::Future { .. } => "future",
            Self::ClockJump { .. } => "clock_jump",
            Self::Restarted => "restarted",
        }
    }
}

impl Measurement {
    /// Path of the first number that is NaN or infinite.
    pub fn not_finite(&self) -> Option<String> {
        if let Some(entry) = crate::limits::not_finite(&self.state) {
            return Some(format!("state.{entry}"));
        }
        let commands = [("command.speed_m_s", self.command.speed_m_s), ("command.second", self.command.second)];
        if let Some((field, _)) = commands.iter().find(|(_, v)| !v.is_finite()) {
            return Some((*field).to_string());
        }
        let bad = |values: &[f64]| values.iter().position(|v| !v.is_finite());
        if let Some(i) = self.wheels.speed_rad_s.and_then(|v| bad(&v)) {
            return Some(format!("wheels.speed_rad_s[{i}]"));
        }
        self.wheels.road_wheel_angle_rad.and_then(|v| bad(&v)).map(|i| format!("wheels.road_wheel_angle_rad[{i}]"))
    }
}
