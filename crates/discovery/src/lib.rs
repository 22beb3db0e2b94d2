//! From a measured residual to a physical effect.
//!
//! A vehicle does not move as predicted; which effect does the model lack? The answer is a *change* against the frozen bundle, because the physics
//! core alone is further off than most effects are large. The steps are
//!
//! 1. [`observe_all`] cuts measured drives into short segments and says what the bundle's physics predicts there ([`channels`] by residual layer);
//! 2. [`Reference`] is what such deviations usually are, measured on drives that training never saw, with null groups for honest thresholds;
//! 3. [`scan`] projects the soil of each drive (with its prior) and constant offsets out and scores every hypothesis ([`Candidate`]) jointly;
//! 4. [`refit`] estimates the size of the strongest by Gauss-Newton, [`select`] ranks them and refuses what lies at a bound or explains too little;
//! 5. [`held_out`] predicts drives that were not fitted before, with the best soil alone, and with the effect;
//! 6. [`diagnose`] does all of it, [`report`] writes JSON and HTML.
//!
//! Ground truth is never read. First cut: one effect at a time, from the start of the drives.
#![forbid(unsafe_code)]

mod candidates;
pub mod channels;
mod diagnose;
mod error;
pub mod held_out;
mod normal;
mod observe;
mod reference;
pub mod refit;
pub mod report;
pub mod scan;
pub mod select;
mod tail;
pub mod whitening;

pub use candidates::{CATALOGUE, Candidate};
pub use diagnose::{ChannelDeviation, Diagnosis, Estimate, OnProgress, Options, Verdict, diagnose};
pub use error::DiscoveryError;
pub use held_out::{HeldOut, Learned, Scoring};
pub use observe::{ObservedDrive, observe, observe_all};
pub use reference::{DRIVES_MIN, NullGroups, Reference};
pub use scan::Stepping;
