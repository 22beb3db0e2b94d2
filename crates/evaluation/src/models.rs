//! Names of the models that `evaluate` can compare, as the JSON contract spells them.

use std::fmt;
use std::str::FromStr;

use crate::error::EvaluationError;

/// A model of the contract.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum ModelName {
    /// The whole model.
    Nesam,
    /// Without the learned state residual (paper: "w/o SR"), retrained where there is a bundle of that form.
    NesamNoResidual,
    /// With wheel sinkage suppressed (paper: "Sinkage = 0"), retrained where there is a bundle of that form.
    NesamZeroSinkage,
    /// The whole model whose residual is switched off at inference only.
    NesamNoResidualSwitch,
    /// The whole model whose sinkage is suppressed at inference only.
    NesamZeroSinkageSwitch,
    /// Pure end to end on the same tokens, trained with the same budget.
    Transformer,
    /// A kinematic bicycle with the same learned residual.
    KinematicResidual,
    /// Newton-Euler on rigid ground with the same learned residual.
    RigidResidual,
    /// Terrain-Attentive Learning on elevation and semantics.
    TalElevSem,
    /// Terrain-Attentive Learning on elevation.
    TalElev,
    /// Terrain-Attentive Learning on semantics.
    TalSem,
    /// Best-fit bicycle or differential drive.
    Kinematic,
    /// The measured body twist goes on.
    ConstantVelocity,
}

impl ModelName {
    /// Every model of this version, in the order of tables and plots.
    pub const ALL: [Self; 13] = [
        Self::Nesam,
        Self::NesamNoResidual,
        Self::NesamZeroSinkage,
        Self::NesamNoResidualSwitch,
        Self::NesamZeroSinkageSwitch,
        Self::Transformer,
        Self::KinematicResidual,
        Self::RigidResidual,
        Self::TalElevSem,
        Self::TalElev,
        Self::TalSem,
        Self::Kinematic,
        Self::ConstantVelocity,
    ];

    /// The name in JSON, Parquet and options.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Nesam => "nesam",
            Self::NesamNoResidual => "nesam_no_residual",
            Self::NesamZeroSinkage => "nesam_zero_sinkage",
            Self::NesamNoResidualSwitch => "nesam_no_residual_switch",
            Self::NesamZeroSinkageSwitch => "nesam_zero_sinkage_switch",
            Self::Transformer => "transformer",
            Self::KinematicResidual => "kinematic_residual",
            Self::RigidResidual => "rigid_residual",
            Self::TalElevSem => "tal_elev_sem",
            Self::TalElev => "tal_elev",
            Self::TalSem => "tal_sem",
            Self::Kinematic => "kinematic",
            Self::ConstantVelocity => "constant_velocity",
        }
    }

    /// Whether the model needs the weights of the main bundle.
    pub fn is_nesam(self) -> bool {
        self == Self::Nesam || self.is_ablation() || self.is_switch()
    }

    /// Whether the model is a form of the main one that is better retrained.
    pub fn is_ablation(self) -> bool {
        matches!(self, Self::NesamNoResidual | Self::NesamZeroSinkage)
    }

    /// Whether the model is the main bundle with a part switched off.
    pub fn is_switch(self) -> bool {
        matches!(self, Self::NesamNoResidualSwitch | Self::NesamZeroSinkageSwitch)
    }

    /// Whether the model needs a bundle of its own, trained as a baseline.
    pub fn is_trained_baseline(self) -> bool {
        matches!(self, Self::Transformer | Self::KinematicResidual | Self::RigidResidual | Self::TalElevSem | Self::TalElev | Self::TalSem)
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
        Err(EvaluationError::UnknownModel { name: name.to_string(), choices })
    }
}
