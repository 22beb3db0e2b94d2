//! What the vehicles of a fleet have learned of the ground, kept by place and by what the ground looks like.
//!
//! Each buffer of a soil filter adds an [`Increment`] of information to the cell and the colour under the vehicle: what the posterior knows more than the prior of that
//! update. Increments add up whatever their order and whoever brought them, and since a session's own prior is subtracted, what a session took out of the map never
//! comes back into it. A vehicle that begins somewhere takes the [`FleetSoilMap::prior`]: the evidence from ground around it that looks alike, fused with the filter's own prior.
//!
//! Maps on several servers tell each other what was brought to them ([`FleetSoilMap::hear`]) and all know then what one map would.
//!
//! Evidence ages: it halves with a half-life, and a vehicle that stands further away, or on ground of another colour, counts it less. Numbers only: no network, no clock.
#![forbid(unsafe_code)]

mod cell;
mod error;
mod increment;
mod map;
mod settings;

pub use cell::{CellKey, Colour};
pub use error::FleetSoilError;
pub use increment::{Increment, SoilBelief};
pub use map::{CellEvidence, EvidenceParts, FleetPrior, FleetSoilMap};
pub use settings::FleetSoilSettings;
