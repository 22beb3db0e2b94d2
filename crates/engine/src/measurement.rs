//! What a vehicle reports, and what the session answers.

use nesam_physics::{Control, VehicleState, WHEELS};

/// Measurement of one instant.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measurement {
    /// Position in the vehicle's own numbering; `None` = not numbered.
    pub sequence: Option<u64>,
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
    /// It is the newest step of the history.
    Applied,
    /// Accepted, but denser than the grid of the model; it waits for the next grid point.
    Buffered {
        /// Time until then, s.
        next_step_in_s: f64,
    },
    /// Accepted before; nothing changed.
    Duplicate,
    /// Before the newest accepted one; nothing changed.
    TooOld {
        /// How far its stamp lies behind, s; 0 when only the sequence number is old.
        behind_s: f64,
    },
    /// A number is NaN or infinite; nothing changed.
    NotFinite {
        /// Path of the number below the measurement.
        field: String,
    },
    /// In the history, but refused by the soil filter.
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
        !matches!(self, Self::Duplicate | Self::TooOld { .. } | Self::NotFinite { .. })
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
