//! Names of the models that `evaluate` can compare, as the JSON contract spells them.

use std::fmt;
use std::str::FromStr;

use crate::error::EvaluationError;

/// A model of the contract.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum ModelName {
    /// The whole model.
    Nesam,
    /// Without the learned state residual (paper: "w/o SR").
    NesamNoResidual,
    /// With wheel sinkage suppressed (paper: "Sinkage = 0").
    NesamZeroSinkage,
    /// Pure end to end on the same tokens, trained with the same budget.
    Transformer,
    /// A kinematic bicycle with the same learned residual.
    KinematicResidual,
    /// Newton-Euler on rigid ground with the same learned residual.
    RigidResidual,
    /// Best-fit bicycle or differential drive.
    Kinematic,
    /// The measured body twist goes on.
    ConstantVelocity,
}

/// Names of the contract that later versions fill in.
const RESERVED: [&str; 3] = ["tal_elev_sem", "tal_elev", "tal_sem"];

impl ModelName {
    /// Every model of this version, in the order of tables and plots.
    pub const ALL: [Self; 8] = [
        Self::Nesam,
        Self::NesamNoResidual,
        Self::NesamZeroSinkage,
        Self::Transformer,
        Self::KinematicResidual,
        Self::RigidResidual,
        Self::Kinematic,
        Self::ConstantVelocity,
    ];

    /// The name in JSON, Parquet and options.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Nesam => "nesam",
            Self::NesamNoResidual => "nesam_no_residual",
            Self::NesamZeroSinkage => "nesam_zero_sinkage",
            Self::Transformer => "transformer",
            Self::KinematicResidual => "kinematic_residual",
            Self::RigidResidual => "rigid_residual",
            Self::Kinematic => "kinematic",
            Self::ConstantVelocity => "constant_velocity",
        }
    }

    /// Whether the model needs the weights of the main bundle.
    pub fn is_nesam(self) -> bool {
        matches!(self, Self::Nesam | Self::NesamNoResidual | Self::NesamZeroSinkage)
    }

    /// Whether the model needs a bundle of its own, trained as a baseline.
    pub fn is_trained_baseline(self) -> bool {
        matches!(self, Self::Transformer | Self::KinematicResidual | Self::RigidResidual)
    }
}

impl fmt::Display for ModelName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl FromStr for ModelName {
    type Err = EvaluationError;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        if let Some(found) = Self::ALL.into_iter().find(|m| m.as_str() == name) {
            return Ok(found);
        }
        let choices = Self::ALL.map(Self::as_str).join(", ");
        let name = name.to_string();
        Err(if RESERVED.contains(&name.as_str()) {
            EvaluationError::ModelNotAvailable { name, choices }
        } else {
            EvaluationError::UnknownModel { name, choices }
        })
    }
}
