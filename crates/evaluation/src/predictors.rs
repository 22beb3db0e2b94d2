//! One closed set of predictors behind one call.

use std::sync::Arc;

use nesam_model::{HistoryStep, MeasuredWheels, Predictor, RolloutQuery, SoilField, Variant};
use nesam_physics::{Control, SoilCorrection, Vehicle};
use nesam_terrain::WorldMap;

use crate::adapt::DriveAdaptation;
use crate::constant_velocity::constant_velocity;
use crate::dimension::{POSE_DIM, pose_of};
use crate::error::EvaluationError;
use crate::errors::PosePath;
use crate::kinematic::{KINEMATIC_PARAMETERS, Kinematic, is_skid};
use crate::models::ModelName;
use crate::windows::Window;

/// What drives a prediction over its horizon.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Inputs {
    /// The recorded commands: what a planner knows.
    #[default]
    Commands,
    /// The measured wheel speeds and steering angles of the future: for studying the model.
    Wheels,
}

impl Inputs {
    /// As in JSON.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Commands => "commands",
            Self::Wheels => "wheels",
        }
    }
}

/// A model that is ready to predict windows.
#[derive(Clone, Debug)]
pub enum WindowPredictor {
    /// The bundle's model or one of its ablations.
    Nesam {
        /// Loaded bundle.
        predictor: Arc<Predictor>,
        /// Ablation.
        variant: Variant,
        /// What drives the prediction.
        inputs: Inputs,
    },
    /// The bundle's model with the soil that was learned up to the start of each window.
    Adapted {
        /// Loaded bundle.
        predictor: Arc<Predictor>,
        /// What the filter made of each drive, in the order of the drives.
        filtered: Arc<Vec<DriveAdaptation>>,
    },
    /// The bundle's model on a soil that is given for each drive: what a perfect filter would know.
    OnSoil {
        /// Loaded bundle.
        predictor: Arc<Predictor>,
        /// Soil of each drive, in the order of the drives.
        soils: Arc<Vec<Arc<dyn SoilField>>>,
    },
    /// The kinematic baseline with its fit.
    Kinematic {
        /// Fitted parameters.
        model: Kinematic,
        /// Geometry.
        vehicle: Arc<Vehicle>,
    },
    /// The measured twist goes on.
    ConstantVelocity,
}

impl WindowPredictor {
    /// The predictor behind a name.
    ///
    /// # Errors
    /// `EvaluationError::KinematicNotFitted` when the kinematic baseline is asked for without a fit; `NoBundle` when
    /// the model needs a bundle and none was given.
    pub fn new(
        name: ModelName,
        predictor: Option<&Arc<Predictor>>,
        vehicle: &Arc<Vehicle>,
        kinematic: Option<Kinematic>,
        inputs: Inputs,
    ) -> Result<Self, EvaluationError> {
        let nesam = |variant| match predictor {
            Some(predictor) => Ok(Self::Nesam { predictor: Arc::clone(predictor), variant, inputs }),
            None => Err(EvaluationError::NoBundle { name: name.as_str() }),
        };
        Ok(match name {
            ModelName::Nesam => nesam(Variant::Full)?,
            ModelName::NesamNoResidual | ModelName::NesamNoResidualSwitch => nesam(Variant::NoResidual)?,
            ModelName::NesamZeroSinkage | ModelName::NesamZeroSinkageSwitch => nesam(Variant::ZeroSinkage)?,
            ModelName::ConstantVelocity => Self::ConstantVelocity,
            ModelName::Kinematic => {
                let model = kinematic.ok_or_else(|| EvaluationError::KinematicNotFitted {
                    reason: "the bundle carries no fit for this vehicle and no set of the data root has a train split; leave it out with --models".into(),
                })?;
                Self::Kinematic { model, vehicle: Arc::clone(vehicle) }
            }
            // A trained baseline is the form that its own bundle was trained as.
            _ => nesam(Variant::Full)?,
        })
    }

    /// Number of fitted or learned parameters.
    pub fn parameters(&self) -> usize {
        match self {
            Self::Nesam { predictor, .. } | Self::Adapted { predictor, .. } | Self::OnSoil { predictor, .. } => {
                predictor.bundle().parameters
            }
            Self::Kinematic { .. } => KINEMATIC_PARAMETERS,
            Self::ConstantVelocity => 0,
        }
    }

    /// Refuses a window whose drive does not measure what this model reads over the horizon.
    ///
    /// # Errors
    /// `EvaluationError::NoWheels` naming the drive.
    pub fn check_inputs(&self, window: &Window<'_>) -> Result<(), EvaluationError> {
        match self {
            Self::Nesam { predictor, inputs: Inputs::Wheels, .. } => window.measured_wheels(is_steered(predictor)).map(|_| ()),
            _ => Ok(()),
        }
    }

    /// Predicts the poses after steps 1…K of a window from what is known at its start: measured history, map and future commands.
    ///
    /// # Errors
    /// `EvaluationError::Model` naming drive and window when the model refuses the query.
    pub fn predict(&self, window: &Window<'_>, map: Option<&Arc<WorldMap>>) -> Result<PosePath, EvaluationError> {
        let drive = window.trajectory;
        let start = &drive.states[window.start];
        let future = &drive.controls[window.start..window.start + window.horizon];
        let poses = match self {
            Self::Nesam { predictor, variant, inputs } => {
                let wheels = match inputs {
                    Inputs::Commands => None,
                    Inputs::Wheels => Some(window.measured_wheels(is_steered(predictor))?),
                };
                return roll_out(predictor, *variant, SoilCorrection::NONE, window, wheels.as_deref(), map);
            }
            Self::Adapted { predictor, filtered } => {
                let soil = filtered[window.drive].soil_at(window.start, map);
                return roll_out_on(predictor, Variant::Full, &soil, window, None, map);
            }
            Self::OnSoil { predictor, soils } => {
                return roll_out_on(predictor, Variant::Full, soils[window.drive].as_ref(), window, None, map);
            }
            Self::Kinematic { model, vehicle } => {
                let past = &drive.controls[window.first_history..window.start];
                model.predict(vehicle, start, past, future, drive.dt_s, map.map(Arc::as_ref))
            }
            Self::ConstantVelocity => constant_velocity(start, window.horizon, drive.dt_s),
        };
        Ok(PosePath { poses, predicts: [true; POSE_DIM] })
    }
}

/// Whether the vehicle of a bundle has road-wheel angles.
fn is_steered(predictor: &Predictor) -> bool {
    !is_skid(&predictor.bundle().vehicle)
}

/// Rolls the model out from the start of a window under its recorded commands.
///
/// # Errors
/// `EvaluationError::Model` naming drive and window when the model refuses the query.
pub fn roll_out(
    predictor: &Predictor,
    variant: Variant,
    soil_correction: SoilCorrection,
    window: &Window<'_>,
    wheels: Option<&[MeasuredWheels]>,
    map: Option<&Arc<WorldMap>>,
) -> Result<PosePath, EvaluationError> {
    roll_out_on(predictor, variant, &soil_correction, window, wheels, map)
}

/// The same on a soil that may differ from place to place.
///
/// # Errors
/// As [`roll_out`].
pub fn roll_out_on(
    predictor: &Predictor,
    variant: Variant,
    soil: &dyn SoilField,
    window: &Window<'_>,
    wheels: Option<&[MeasuredWheels]>,
    map: Option<&Arc<WorldMap>>,
) -> Result<PosePath, EvaluationError> {
    let drive = window.trajectory;
    let history = window.history();
    let future = &drive.controls[window.start..window.start + window.horizon];
    let controls: Vec<f32> = future.iter().flat_map(Control::packed).collect();
    let query = RolloutQuery {
        history: &history,
        start: drive.states[window.start],
        controls: &controls,
        samples: 1,
        horizon: window.horizon,
        map,
        soil_correction: SoilCorrection::NONE,
        variant,
        start_time_s: Some(window.since_log_start_s()),
        wheels,
    };
    let rollout = predictor.rollout_on(&query, soil).map_err(|source| EvaluationError::Model {
        trajectory: drive.id.clone(),
        start: window.start,
        source,
    })?;
    let poses = (0..window.horizon).map(|k| pose_of(&rollout.state_f64(0, k))).collect();
    Ok(PosePath { poses, predicts: [true; POSE_DIM] })
}

impl Window<'_> {
    /// What the wheels were measured to do over each step of the horizon: the mean of the step's two ends. `steered`: the vehicle has road-wheel angles.
    ///
    /// # Errors
    /// `EvaluationError::NoWheels` naming the drive when wheel speeds, or the angles of steered wheels, were not measured.
    pub fn measured_wheels(&self, steered: bool) -> Result<Vec<MeasuredWheels>, EvaluationError> {
        let drive = self.trajectory;
        let missing = || EvaluationError::NoWheels { trajectory: drive.id.clone() };
        let speeds = drive.wheel_speed_rad_s.as_ref().ok_or_else(missing)?;
        let angles = drive.road_wheel_angle_rad.as_ref();
        if steered && angles.is_none() {
            return Err(missing());
        }
        let mean = |a: f64, b: f64| 0.5 * (a + b);
        let step = |j: usize| MeasuredWheels {
            speed_rad_s: core::array::from_fn(|i| mean(speeds[j][i], speeds[j + 1][i])),
            angle_rad: core::array::from_fn(|i| match angles {
                Some(angles) if i < 2 => mean(angles[j][i], angles[j + 1][i]),
                _ => 0.0,
            }),
        };
        Ok((self.start..self.start + self.horizon).map(step).collect())
    }

    /// Measured states and commands before the start, oldest first.
    pub fn history(&self) -> Vec<HistoryStep> {
        (self.first_history..self.start)
            .map(|j| HistoryStep { state: self.trajectory.states[j], control: self.trajectory.controls[j] })
            .collect()
    }
}
