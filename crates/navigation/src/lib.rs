//! Closed-loop path tracking: a sampling planner that knows the model only through the client API drives a plant that knows nothing of the model.
//!
//! One [`run`](run_lap) is a lap of a closed [`ReferencePath`]. Every 0.1 s of the plant's time the plant is measured, the measurement goes to the
//! service, and every few steps the [`Mppi`] planner asks a [`Forecaster`] what its candidates would do *from the next step on*: the command of the present
//! step has already been sent. Places further ahead are tried through the same service, and come to with [`Caution`] where the vehicle would slide. All time is the plant's: planning costs none of it, and the same seeds give the same lap.
#![forbid(unsafe_code)]

mod caution;
mod error;
mod forecast;
mod kept_lap;
mod lap;
mod link;
mod map_layers;
mod mppi;
mod oracle;
pub mod plant_message;
mod plausibility;
mod reference_path;
mod remote;
mod report;
mod score;
mod session;
mod tracker;
mod trial;

pub use caution::{Caution, CautionSettings, Stretch};
pub use error::NavigationError;
pub use forecast::{Forecaster, KinematicForecaster, Situation};
pub use kept_lap::KeptLap;
pub use lap::{Lap, LapPlan, Lean, Scored, run_lap};
pub use link::{Answer, BuiltInPlant, PlantLink, Reading, Start};
pub use map_layers::map_layers;
pub use mppi::{Decision, Mppi, MppiSettings};
pub use oracle::SoilAhead;
pub use reference_path::ReferencePath;
pub use remote::RemotePlant;
pub use report::{NavigationReport, SoilKind, lost};
pub use score::{Figures, Ratio, Run, Summary, lap_file_name, ratio, summarise};
pub use session::ServedForecaster;
pub use tracker::TrackingCost;
pub use trial::Surroundings;
