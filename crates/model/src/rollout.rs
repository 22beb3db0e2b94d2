//! The K-step rollout: queries, results and validity flags.

use std::ops::Range;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use crate::dims::{CONTEXT, FEATURES, HISTORY};
use crate::interruption::Interruption;
use crate::soil_field::SoilField;
use nesam_physics::{Control, SOIL_DIM, STATE_DIM, SoilCorrection, VehicleState, WHEELS};
use nesam_terrain::WorldMap;
use serde::{Deserialize, Serialize};

/// One step of the recent past: the measured state and the command applied from it (one token of the paper, §III-B).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HistoryStep {
    /// Measured state x_j.
    pub state: VehicleState<f64>,
    /// Command u_j, valid over [t_j, t_j + dt).
    pub control: Control<f64>,
}

/// Forms of the model: the whole, its ablations, and the baselines that share its tokens and its Transformer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Hash, Serialize, Deserialize)]
pub enum Variant {
    /// The whole model. In a query: the form that the bundle was trained as.
    #[default]
    #[serde(rename = "nesam")]
    Full,
    /// The learned state residual is switched off (paper: "NeSAM w/o SR").
    #[serde(rename = "nesam_no_residual")]
    NoResidual,
    /// The wheel sinkage is suppressed (paper: "NeSAM, Sinkage = 0").
    #[serde(rename = "nesam_zero_sinkage")]
    ZeroSinkage,
    /// No symbolic half at all: the Transformer says the whole increment (paper: "Transformer").
    #[serde(rename = "transformer")]
    Transformer,
    /// A kinematic bicycle in place of terramechanics and Newton-Euler.
    #[serde(rename = "kinematic_residual")]
    KinematicResidual,
    /// Newton-Euler on rigid ground: no soil, no sinkage.
    #[serde(rename = "rigid_residual")]
    RigidResidual,
    /// Terrain-Attentive Learning (Datar et al. 2024) on elevation and semantics: state, command and the terrain under the vehicle give the next
    /// state, without memory of what was measured before.
    #[serde(rename = "tal_elev_sem")]
    TalElevSem,
    /// The same on elevation alone.
    #[serde(rename = "tal_elev")]
    TalElev,
    /// The same on semantics alone.
    #[serde(rename = "tal_sem")]
    TalSem,
}

impl Variant {
    /// Every form.
    pub const ALL: [Self; 9] = [
        Self::Full,
        Self::NoResidual,
        Self::ZeroSinkage,
        Self::Transformer,
        Self::KinematicResidual,
        Self::RigidResidual,
        Self::TalElevSem,
        Self::TalElev,
        Self::TalSem,
    ];

    /// Name in manifests, JSON and options.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Full => "nesam",
            Self::NoResidual => "nesam_no_residual",
            Self::ZeroSinkage => "nesam_zero_sinkage",
            Self::Transformer => "transformer",
            Self::KinematicResidual => "kinematic_residual",
            Self::RigidResidual => "rigid_residual",
            Self::TalElevSem => "tal_elev_sem",
            Self::TalElev => "tal_elev",
            Self::TalSem => "tal_sem",
        }
    }

    /// The form of a name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|v| v.as_str() == name)
    }

    /// Whether soil and terramechanics are part of the form.
    pub fn has_soil(self) -> bool {
        matches!(self, Self::Full | Self::NoResidual | Self::ZeroSinkage)
    }

    /// Whether the network says the whole increment, with no symbolic half.
    pub fn is_end_to_end(self) -> bool {
        matches!(self, Self::Transformer) || !self.remembers()
    }

    /// Whether a step sees the tokens before its own.
    pub fn remembers(self) -> bool {
        !matches!(self, Self::TalElevSem | Self::TalElev | Self::TalSem)
    }

    /// The part of the terrain context z_e ‖ z_s that the form does not see.
    pub fn unseen(self) -> Range<usize> {
        match self {
            Self::TalSem => 0..FEATURES,
            Self::TalElev => FEATURES..CONTEXT,
            _ => 0..0,
        }
    }
}

/// The last steps of a history, as many as the network has positions for.
pub(crate) fn remembered(history: &[HistoryStep]) -> &[HistoryStep] {
    &history[history.len().saturating_sub(HISTORY - 1)..]
}

/// A batch of candidate command sequences from one start state.
#[derive(Clone, Debug)]
pub struct RolloutQuery<'a> {
    /// Past steps, oldest first, without the start itself; only the last `HISTORY - 1` are used. May be empty.
    pub history: &'a [HistoryStep],
    /// State to start from.
    pub start: VehicleState<f64>,
    /// Commands, row-major (samples, horizon, 2): speed in m/s, second in the unit of the card.
    pub controls: &'a [f32],
    /// Number of candidate sequences N.
    pub samples: usize,
    /// Steps K, 1 ..= `MAX_HORIZON`.
    pub horizon: usize,
    /// Ground; `None` = unknown map: flat ground through the wheels and the default soil prior, flagged.
    pub map: Option<&'a Arc<WorldMap>>,
    /// Correction Δθ of the soil prior (paper Alg. 1), `SoilCorrection::NONE` before any update.
    pub soil_correction: SoilCorrection,
    /// Ablation.
    pub variant: Variant,
    /// Time of the start, s since the start of the log, for effects that begin or drift; `None` = all have begun, and what drifts is at its end.
    pub start_time_s: Option<f64>,
    /// What the wheels were measured to do over each of the K steps, for every sample alike, in place of what the drive line makes of the commands;
    /// for studying the model, no planner knows it.
    pub wheels: Option<&'a [MeasuredWheels]>,
}

/// Wheels over one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeasuredWheels {
    /// Mean wheel speeds FL, FR, RL, RR, rad/s.
    pub speed_rad_s: [f64; WHEELS],
    /// Mean road-wheel angles, rad, positive left.
    pub angle_rad: [f64; WHEELS],
}

/// What a rollout computes beyond its states. The default is nothing, and costs nothing.
#[derive(Clone, Copy, Debug, Default)]
pub struct RolloutExtras<'a> {
    /// Soil that may differ from place to place, in place of the query's correction.
    pub field: Option<&'a dyn SoilField>,
    /// What-if soils S: corrections in place of the query's and of the field, each for all N samples. The rollout then has S N rows, the samples of the first soil
    /// first. Empty = the query's own correction alone.
    pub soils: &'a [SoilCorrection],
    /// Whether to compute [`RiskOutputs`]; only forms with soil can.
    pub risk: bool,
    /// Whether to keep [`Rollout::position_m`], for scores far from the origin.
    pub unrounded: bool,
    /// What may happen to it meanwhile.
    pub interruption: Interruption<'a>,
    /// When an answer of fewer samples is due; then the rollout has the first of them. Without what-if soils.
    pub due: Option<Due<'a>>,
}

/// When the first samples of a rollout are answer enough.
#[derive(Clone, Copy, Debug)]
pub struct Due<'a> {
    /// Raised when the answer is due.
    pub flag: &'a AtomicBool,
    /// Fewest samples that are of use: as many are computed however late it is.
    pub least: usize,
}

/// Whether the flag of a rollout was raised.
pub fn is_raised(flag: Option<&AtomicBool>) -> bool {
    flag.is_some_and(|flag| flag.load(Ordering::Relaxed))
}

/// How near each step is to a limit, row-major (samples, horizon) or (samples, horizon, 4) with the wheels FL, FR, RL, RR.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RiskOutputs {
    /// Loads of the wheels, N.
    pub wheel_load_n: Vec<f32>,
    /// Slips of the wheels, -1 (locked) to 1 (spinning on the spot).
    pub wheel_slip: Vec<f32>,
    /// Lateral load-transfer ratio, see [`nesam_physics::risk::load_transfer_ratio`].
    pub load_transfer_ratio: Vec<f32>,
    /// Traction reserve over weight, see [`nesam_physics::step::StepModel::traction_reserve`].
    pub traction_reserve: Vec<f32>,
}

/// Bits of [`Rollout::flags`], one word per sample.
pub mod flag {
    /// A state of this sample is not finite; the other samples are unaffected.
    pub const NOT_FINITE: u32 = 1;
    /// The rollout left the known map.
    pub const OFF_MAP: u32 = 2;
    /// No map was given.
    pub const NO_MAP: u32 = 4;
    /// Speed command outside the trained range, or start or predicted speed beyond it by more than a quarter of its fastest.
    pub const SPEED_UNTRAINED: u32 = 8;
    /// Second command outside the trained range.
    pub const STEERING_UNTRAINED: u32 = 16;
    /// Slope (roll or pitch) outside the trained range.
    pub const SLOPE_UNTRAINED: u32 = 32;
    /// The vehicle lies on its side or roof (|roll| or |pitch| over 60 degrees).
    pub const OVERTURNED: u32 = 64;
    /// The start lies more than half a metre above or below the ground of the map.
    pub const START_OFF_GROUND: u32 = 512;
}

/// Predicted states.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rollout {
    /// Row-major (samples, horizon, state = 12), order of `VehicleState::to_array`; yaw is wrapped into (-pi, pi].
    pub states: Vec<f32>,
    /// Row-major (samples, horizon): positions in f64, which [`Rollout::states`] rounds to half a metre at UTM coordinates of millions of metres. Empty unless
    /// asked for ([`RolloutExtras::unrounded`]).
    pub position_m: Vec<[f64; 3]>,
    /// Row-major (samples, horizon, 4): wheel sinkages, m.
    pub sinkage_m: Vec<f32>,
    /// Validity flags per sample, see [`flag`].
    pub flags: Vec<u32>,
    /// Soil used under the start pose (prior + correction, clipped), order of `SOIL_NAMES`.
    pub soil: [f64; SOIL_DIM],
    /// N.
    pub samples: usize,
    /// K.
    pub horizon: usize,
}

impl Rollout {
    /// State of sample `n` after step `k` (0-based: `k = 0` is one step after the start).
    pub fn state(&self, n: usize, k: usize) -> VehicleState<f32> {
        let at = (n * self.horizon + k) * STATE_DIM;
        let mut x = [0.0; STATE_DIM];
        x.copy_from_slice(&self.states[at..at + STATE_DIM]);
        VehicleState::from_array(x)
    }

    /// The same in f64, with the position that is not rounded where it was asked for.
    pub fn state_f64(&self, n: usize, k: usize) -> VehicleState<f64> {
        let mut state = self.state(n, k).map(f64::from);
        if let Some(position_m) = self.position_m.get(n * self.horizon + k) {
            state.position_m = *position_m;
        }
        state
    }

    /// Sinkage of sample `n` during step `k`, m.
    pub fn sinkage(&self, n: usize, k: usize) -> [f32; WHEELS] {
        let at = (n * self.horizon + k) * WHEELS;
        let mut s = [0.0; WHEELS];
        s.copy_from_slice(&self.sinkage_m[at..at + WHEELS]);
        s
    }
}
