//! From a measured residual to a physical effect.
//!
//! A vehicle does not move as predicted; which effect does the model lack? The answer is a *change* against the frozen bundle, because the physics
//! core alone is further off than most effects are large. The steps are
//!
//! 1. [`observe_all`] cuts measured drives into short segments and says what the bundle's physics predicts there ([`channels`] by residual layer);
//! 2. [`features`] condenses a drive into robust statistics; the drive is the unit of replication;
//! 3. [`Reference`] is what such statistics usually are, measured on drives that training never saw, with null groups for honest thresholds;
//! 4. [`expectation`] scores every hypothesis ([`Candidate`]) against the scatter of null drives, which contains soil, roughness and model error;
//! 5. [`fit`] estimates the size of the strongest, and of another soil, by Gauss-Newton; [`select`] ranks them and refuses what lies at a bound or
//!    explains too little;
//! 6. [`held_out`] predicts drives that were not fitted before, with the best soil alone, and with the effect;
//! 7. [`diagnose`] does all of it, [`report`] writes JSON and HTML.
//!
//! Ground truth is never read. One effect at a time, present from the start of the drives; what is outside the catalogue is to come out unexplained.
#![forbid(unsafe_code)]

mod candidates;
pub mod channels;
mod diagnose;
mod error;
pub mod expectation;
pub mod features;
pub mod fit;
pub mod held_out;
mod observe;
mod reference;
pub mod report;
pub mod select;
mod tail;

pub use candidates::{CATALOGUE, Candidate};
pub use diagnose::{Diagnosis, Estimate, OnProgress, Options, StatisticDeviation, Verdict, diagnose};
pub use error::DiscoveryError;
pub use features::Stepping;
pub use held_out::{HeldOut, Learned, Scoring};
pub use observe::{ObservedDrive, observe, observe_all};
pub use reference::{DRIVES_MIN, NullGroups, Reference};
