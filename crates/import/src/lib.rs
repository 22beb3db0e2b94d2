//! Logs of other tools into data roots.
//!
//! A [`Log`] is a file as named columns, whatever it was: a CSV table ([`read_csv`]) or a ROS 2 bag ([`read_bag`]). A [`Mapping`] says which column is what,
//! in which unit and with which sign. [`drives`] makes drives of both in the conventions of a data root: World x east, y north, z up, Body x forward,
//! y left, z up, SI units and radians; it parts them at gaps and where a clock is set back, and says what it left out. [`write_set`] writes them as a set. [`doubts`] says of any recorded
//! drives what does not fit together: units, signs, frames.
//!
//! Nothing is smoothed, resampled or guessed here: a number in a set is a number of the log in another unit, frame or point of the vehicle. Commands alone are averaged, over the
//! time from a row to the next, where they come between rows.
#![forbid(unsafe_code)]

mod bag;
mod bag_folder;
mod clock;
mod commands;
mod error;
mod frame;
mod left_out;
mod log;
mod mapping;
mod part;
mod pose;
mod reference;
mod sense;
mod table;
mod write;

pub use bag::{Topics, read_bag};
pub use bag_folder::CONVERT;
pub use error::ImportError;
pub use frame::FrameConvention;
pub use log::Log;
pub use mapping::{COLUMNS, Mapping, Quantity};
pub use part::{Drive, Notes, Options, drives};
pub use sense::{Doubt, card_doubts, doubts, recorded_doubts};
pub use table::read_csv;
pub use write::write_set;
