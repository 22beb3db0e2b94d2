//! From a measured residual to a physical effect.
//!
//! A vehicle does not move as predicted; which effect does the model lack? The answer is a *change* against the frozen bundle, because the physics
//! core alone is further off than most effects are large. The steps are
//!
//! 1. [`observe_all`] cuts measured drives into short segments and says what the bundle's physics predicts there ([`channels`](observe::channels) by
//!    residual layer); [`condense`](observe::condense) turns a drive into a score and an information matrix over every column of the catalogue (the
//!    `candidates`), soil profiled out; the drive is the unit of replication;
//! 2. [`Reference`] is what such scores usually are, measured on drives that training never saw, with null groups for honest thresholds;
//! 3. [`select`] chooses up to three effects with the rivals that the drives cannot tell from them: [`evidence`](select::evidence) holds the scores of a
//!    group of drives against their scatter over null drives, for one hypothesis or after others were fitted, and an effect may begin at an
//!    [`onset`](select::onset);
//! 4. [`claims`] gives sizes ([`fit`](claims::fit), by Gauss-Newton) with intervals and refuses what lies at a bound, is unstable, changes its size or
//!    explains too little;
//! 5. [`proof`] predicts drives that were not fitted ([`held_out`](proof::held_out)): before, with the best soil alone, with the effects, and with what else
//!    might explain them ([`controls`](proof::controls): rivals, a black box, a free form of what is left);
//! 6. [`diagnose`] does all of it, [`report`] writes JSON and HTML; [`bench`] measures how often it is right.
//!
//! With [`Against::Physics`] the drives stand for themselves and the symbolic model itself is on trial: wheel speeds tell the `drive_line`, the `ground` is
//! fitted where no map tells it, and [`pursuit`](select::pursuit) looks for further effects beside those already found.
//!
//! Ground truth is never read.
#![forbid(unsafe_code)]

pub mod bench;
mod candidates;
pub mod claims;
mod diagnose;
mod drive_line;
mod error;
mod ground;
mod judge;
mod judgement;
pub mod observe;
pub mod proof;
mod reference;
pub mod report;
pub mod select;
mod work;

pub use candidates::{Candidate, catalogue};
pub use claims::Estimate;
pub use diagnose::{Against, Diagnosis, OnProgress, Options, diagnose};
pub use error::DiscoveryError;
pub use ground::Soils;
pub use judge::Judge;
pub use judgement::{Judgement, Verdict, judge};
pub use observe::channels::SEGMENT_STEPS;
pub use observe::lack::Lack;
pub use observe::metric::Metric;
pub use observe::{Bench, ObservedDrive, Stepping, observe, observe_all};
pub use proof::held_out::{HeldOut, Learned, Scoring};
pub use reference::drives::{ReferenceDrives, Segmented};
pub use reference::{DRIVES_MIN, NullGroups, Reference};
pub use work::Work;
