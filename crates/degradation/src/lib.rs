//! Degraded telemetry: recorded drives as they would arrive over a bad link from poor sensors.
//!
//! 1. A [`Degradation`] says what is wrong: jitter, loss, reordering, a stepping clock, stamps that are off, an inertial sensor at its own rate with
//!    bias and coloured noise.
//! 2. [`degraded`] makes the messages of a drive in their order of arrival, the same for the same seed.
//! 3. [`drive_through`] sends them through the real engine, as a vehicle does, and asks for predictions at the instants at which an evaluation asks.
//! 4. [`summarise`] says what that costs against the clean drive, and whether the soil estimate is still to be believed.
#![forbid(unsafe_code)]

mod error;
mod link;
mod passage;
mod spec;
mod summary;

pub use error::DegradationError;
pub use link::{Arrival, Link, degraded};
pub use passage::{Asked, Passage, Setup, SoilBuffer, drive_through};
pub use spec::Degradation;
pub use summary::{RowSummary, SoilSummary, Verdict, summarise};
