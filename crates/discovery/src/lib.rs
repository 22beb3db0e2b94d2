//! From a measured residual to a physical effect.
//!
//! A vehicle does not move as predicted; which effect does the model lack? The answer is a *change* against the frozen bundle, because the physics
//! core alone is further off than most effects are large. The steps are
//!
//! 1. [`observe_all`] cuts measured drives into short segments and says what the bundle's physics predicts there ([`channels`] by residual layer);
//! 2. [`condense`] turns a drive into a score and an information matrix over every column of the catalogue, soil profiled out; the drive is the unit of
//!    replication;
//! 3. [`Reference`] is what such scores usually are, measured on drives that training never saw, with null groups for honest thresholds;
//! 4. [`evidence`] holds the scores of a group of drives against their scatter over null drives, for one hypothesis or after others were fitted;
//! 5. [`select`] chooses up to three effects with the rivals that the drives cannot tell from them; `dating` lets each begin at its [`onset`];
//! 6. [`fit`] estimates sizes by Gauss-Newton; [`claims`] gives intervals and refuses what lies at a bound, is unstable, changes its size or explains too little;
//! 7. [`held_out`] predicts drives that were not fitted before, with the best soil alone, and with the effects;
//! 8. [`controls`] predicts the same drives with what else might explain them: rivals, a black box, a free form of what is left;
//! 9. [`diagnose`] does all of it, [`report`] writes JSON and HTML; [`bench`] measures how often it is right.
//!
//! With [`Against::Physics`] the drives stand for themselves and the symbolic model itself is on trial: wheel speeds tell the `drive_line`, the `ground` is
//! fitted where no map tells it, and [`pursuit`] looks for further effects beside those already found.
//!
//! Ground truth is never read.
#![forbid(unsafe_code)]

pub mod bench;
mod bend;
mod black_box;
mod candidates;
pub mod channels;
pub mod claims;
pub mod condense;
mod consistency;
mod constancy;
pub mod controls;
mod dating;
mod diagnose;
mod drive_line;
mod error;
pub mod evidence;
pub mod fit;
mod free_form;
mod ground;
pub mod held_out;
mod judge;
mod judgement;
mod lack;
mod manoeuvre;
mod metric;
mod observe;
pub mod onset;
mod own_reference;
pub mod proof;
mod proven;
pub mod pursuit;
mod reference;
mod reference_drives;
pub mod report;
mod ridge;
pub mod select;
pub mod settled;
mod still;
mod tail;
mod whiteness;
mod work;

pub use candidates::{Candidate, catalogue};
pub use channels::SEGMENT_STEPS;
pub use claims::Estimate;
pub use diagnose::{Against, Diagnosis, OnProgress, Options, diagnose};
pub use error::DiscoveryError;
pub use ground::Soils;
pub use held_out::{HeldOut, Learned, Scoring};
pub use judge::Judge;
pub use judgement::{Judgement, Verdict, judge};
pub use lack::Lack;
pub use metric::Metric;
pub use observe::{Bench, ObservedDrive, Stepping, observe, observe_all};
pub use reference::{DRIVES_MIN, NullGroups, Reference};
pub use reference_drives::{ReferenceDrives, Segmented};
pub use work::Work;
