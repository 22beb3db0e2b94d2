//! Sessions, measurements and predictions behind one thread.
//!
//! The service keeps a [`Session`] for each vehicle: the last measured steps, the map it drives on, the correction of its soil. Everything that
//! reads or changes a session is a [`Command`]; [`Engine::execute`] answers one command at one instant and does nothing else: no network, no
//! thread, no clock. The same commands at the same instants give the same answers, so a run can be recorded ([`EngineHandle::spawn_tapped`]) and
//! replayed bit for bit.
//!
//! [`EngineHandle::spawn`] puts an engine behind a bounded queue on a thread of its own, and computes predictions on another, one at a time, from what the
//! sessions were when their turn came: measurements do not wait for them. A prediction that is much shorter than the one at work does not wait for its turn, as far as nobody is late
//! by it: that one pauses within a step. A full queue is an
//! [`EngineError::Overloaded`], never a wait and never a panic, and so is a prediction that would not be done before its deadline; one whose asker has
//! gone or whose deadline has passed is skipped or given up. Vehicles share the time for predictions evenly.
//!
//! ```text
//! server ── Command ──► EngineHandle ──► queue ──► Engine::execute ──► Session, Predictor
//!        ◄── Answer (callback) ◄──────────────────────┘
//! ```
#![forbid(unsafe_code)]

mod candidates;
mod clock;
mod command;
mod demand;
mod engine;
mod error;
mod extras;
mod fleet;
mod forward;
mod grid;
mod handle;
mod heard;
mod limits;
mod maps;
mod measurement;
mod plan;
mod query;
mod queue;
mod ranking;
mod service_time;
mod session;
mod shown;
pub mod sync;

pub use candidates::{Candidates, Drawing};
pub use clock::{Clock, ManualClock};
pub use command::{Command, Event, MeasureAnswer, OpenSession, Reply, SessionView, Snapshot};
pub use engine::{Engine, EventSink};
pub use error::EngineError;
pub use extras::{CovarianceQuery, Covariances, ExtraOutputs, Jacobians, PredictExtras, WhatIfSoils};
pub use fleet::{FleetCell, FleetShare};
pub use forward::{SentCommand, StartInstant};
pub use grid::StepGrid;
pub use handle::{Answer, EngineHandle, Executed, Submission, Tap, execute_guarded};
pub use limits::{Limits, check_name};
pub use maps::MapRegistry;
pub use measurement::{Measurement, Outcome, WheelMeasurement};
pub use nesam_adaptation::{FORECAST_AHEAD, FilterSnapshot, ForecastCheck, JointSnapshot};
pub use nesam_fleet_soil::{CellEvidence, CellKey, EvidenceParts, FleetSoilError, FleetSoilSettings};
pub use query::{ALARM_ACTIVE, PredictQuery, Prediction, Provenance, SOIL_NOT_LEARNED};
pub use queue::DUE_AFTER;
pub use ranking::{CostWeights, PathCost, Ranking};
pub use session::{
    Alarm, AlarmKind, AppliedEffect, AppliedEffects, AppliedParameter, BufferTest, OpenForecast, Session, SessionImage, SoilEstimate,
    SoilState, TrackImage, UNCERTAIN_MAX, WatchImage,
};
pub use shown::Shown;
