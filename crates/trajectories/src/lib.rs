//! Recorded drives: data roots, vehicle cards, splits, windows.
//!
//! A [`DataRoot`] is a folder with one vehicle card, an optional `worlds/` folder and a folder per set; [`DataRoot::load_set`] gives the
//! drives of a set as [`Trajectory`]s at the step of the model. Only measured channels are read: what a vehicle does not measure is
//! estimated from the past alone and declared in [`MeasuredChannels`]. Ground truth of simulated sets is read only on request and is
//! kept apart in [`GroundTruth`]. [`windows`] says which samples of a drive are scored.
//!
//! Every error names the file, and the column and row or the key, that it is about; rows count from 0 over the whole file.
#![forbid(unsafe_code)]

mod card_parts;
mod channels;
mod command_range;
mod commands;
mod data_root;
mod data_sheet;
mod drive;
mod error;
mod ground_truth;
mod index;
mod json;
mod lacking;
mod limited_start;
mod recorded;
mod reports;
mod resample;
mod soil_truth;
mod table;
mod trajectory;
mod velocity;
mod windows;

pub use card_parts::mass_of_parts_kg;
pub use command_range::BeyondRange;
pub use commands::commands_from_csv;
pub use data_root::{DataRoot, SetQuery, SplitFilter};
pub use data_sheet::{card_from_json, card_to_json, read_vehicle_card, read_vehicle_card_with_notes};
pub use error::TrajectoryError;
pub use ground_truth::GroundTruth;
pub use limited_start::limited_starts;
pub use recorded::Recorded;
pub use reports::{Report, drives_of_reports, has_a_piece};
pub use resample::{STEP_MAX_S, gap_limit_s};
pub use soil_truth::{RegionSoil, SoilTruth, read_ground_truth_soil};
pub use trajectory::{MeasuredChannels, Split, Trajectory, VelocitySource};
pub use velocity::to_body;
pub use windows::windows;
