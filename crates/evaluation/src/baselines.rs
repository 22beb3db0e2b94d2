//! The fitted baselines, as a bundle carries them in `baselines.json`.

use nesam_physics::Vehicle;
use nesam_trajectories::Trajectory;
use serde::{Deserialize, Serialize};

use crate::error::EvaluationError;
use crate::kinematic::Kinematic;

/// Schema of the text; readers refuse another one.
const SCHEMA: &str = "nesam.baselines/1";

/// Baselines fitted on the training split, for which vehicle, and on what.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Baselines {
    /// Always `nesam.baselines/1`.
    pub schema: String,
    /// Name of the vehicle card.
    pub vehicle: String,
    /// Bicycle or differential drive.
    pub kinematic: Kinematic,
    /// Number of drives that the fit saw.
    pub fitted_on: usize,
    /// Steps of the fit's windows.
    pub horizon_steps: usize,
}

impl Baselines {
    /// Fits every baseline that has parameters. Give it training drives only.
    ///
    /// # Errors
    /// `EvaluationError::Fit` when no window of `horizon` steps fits the drives.
    pub fn fit(vehicle: &Vehicle, training: &[Trajectory], horizon: usize) -> Result<Self, EvaluationError> {
        let kinematic = Kinematic::fit(vehicle, training, horizon)?;
        Ok(Self { schema: SCHEMA.into(), vehicle: vehicle.name.clone(), kinematic, fitted_on: training.len(), horizon_steps: horizon })
    }

    /// Reads the text of `baselines.json`.
    ///
    /// # Errors
    /// `EvaluationError::Baselines` when the text is not of this schema or a parameter is not finite.
    pub fn from_json(text: &str) -> Result<Self, EvaluationError> {
        let fail = |reason: String| EvaluationError::Baselines { reason };
        let read: Self = serde_json::from_str(text).map_err(|e| fail(e.to_string()))?;
        if read.schema != SCHEMA {
            return Err(fail(format!("schema `{}`, expected `{SCHEMA}`", read.schema)));
        }
        if read.kinematic.to_array().iter().any(|v| !v.is_finite()) {
            return Err(fail("a kinematic parameter is not finite".into()));
        }
        Ok(read)
    }

    /// The text of `baselines.json`.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("plain numbers always serialise; this is a bug") + "\n"
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn property_text_round_trip_and_refusals() {
        let vehicle = crate::test_vehicle::bicycle();
        let kinematic = Kinematic::ideal(&vehicle);
        let fitted = Baselines { schema: SCHEMA.into(), vehicle: vehicle.name, kinematic, fitted_on: 3, horizon_steps: 32 };
        let text = fitted.to_json();
        assert_eq!(Baselines::from_json(&text).unwrap(), fitted);
        let other = text.replace("baselines/1", "baselines/2");
        assert!(Baselines::from_json(&other).unwrap_err().to_string().contains("baselines/2"));
        assert!(Baselines::from_json(&text[..40]).is_err());
        assert!(Baselines::from_json("{}").unwrap_err().to_string().contains("schema"));
    }
}
