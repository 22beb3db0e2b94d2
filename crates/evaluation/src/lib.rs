//! Prediction error against measured drives: windows, baselines, intervals, reports.
//!
//! An evaluation asks one question: how far from the measured motion is a model after 1…K steps, when it knows only what a vehicle
//! knew at the start of the window and the commands that follow? The steps are
//!
//! 1. [`all_windows`] cuts the drives into windows by the rule of the contract;
//! 2. [`WindowPredictor`] is one of the models ([`ModelName`]): the bundle's, its ablations, or a baseline ([`Kinematic`], fitted on
//!    training drives by [`Baselines::fit`], and [`constant_velocity`]);
//! 3. [`predict_all`] runs a model over all windows, [`score`] compares with the [`Truth`] and gives an [`ErrorSummary`] with
//!    intervals from a bootstrap over whole drives ([`Resamples`]);
//! 4. [`Evaluation`] writes the JSON, [`report`] the HTML, [`write_predictions`] every predicted pose.
//!
//! `nesam adapt` puts one step between: [`adapt_all`] runs the soil filter over the drives, and [`WindowPredictor::Adapted`] predicts each
//! window with what was learned by its start.
//!
//! Distances are in metres and angles in radians inside; scores of angles are in degrees, as their keys say.
#![forbid(unsafe_code)]

mod adapt;
mod adapt_output;
mod baselines;
mod bootstrap;
mod constant_velocity;
mod coverage;
mod coverage_score;
mod dimension;
mod error;
mod errors;
mod evaluate;
mod inside;
mod kinematic;
mod kinematic_fit;
mod known_soil;
mod models;
mod output;
mod predictions;
mod predictors;
pub mod report;
mod score;
mod slices;
mod soil_ceiling;
#[cfg(test)]
mod test_vehicle;
mod true_soil;
mod twin;
mod wheel_rates;
mod windows;

pub use adapt::{Consistency, DriveAdaptation, TimedUpdate, adapt_all, adapt_drive, calibrate_noise, check_forecasts};
pub use adapt_output::{Adaptation, Part, Row};
pub use baselines::Baselines;
pub use bootstrap::{DEFAULT_RESAMPLES, Resamples, median, quantile_sorted};
pub use constant_velocity::constant_velocity;
pub use coverage::{LinearisedWindow, SoilKnowledge, linearise_windows};
pub use coverage_score::{Share, StepCoverage, calibrate_regions, calibrate_rollout_noise, coverage};
pub use dimension::{DIMENSION_KEYS, POSE_DIM, Pose, absolute_error, horizontal_distance, pose_of};
pub use error::EvaluationError;
pub use errors::{PATH_FLOOR_M, PosePath, StepError, WindowErrors, path_length_m};
pub use evaluate::{DriveMaps, HorizonCurve, ModelPaths, ModelScore, path_median_m, predict_all, score};
pub use inside::{Agreement, Comparison, Pairs, ResidualPart, look_inside};
pub use kinematic::{Kinematic, curvature_1_m, ground_pose};
pub use known_soil::KnownSoil;
pub use models::ModelName;
pub use output::{Evaluation, Provenance};
pub use predictions::write_predictions;
pub use predictors::{Inputs, WindowPredictor, roll_out};
pub use score::{ErrorSummary, ErrorTree, PerDimension, PositionError, paired_difference, paired_ratio, summarise, values};
pub use slices::{Slice, slices};
pub use soil_ceiling::{BestCorrection, best_correction};
pub use true_soil::TrueSoil;
pub use twin::{TwinPlan, TwinReport, run_twins, run_twins_against};
pub use wheel_rates::wheel_rates;
pub use windows::{Truth, Window, all_windows, history_steps};
