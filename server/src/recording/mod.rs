//! Recording what the engine did, and doing it again.
//!
//! A recording holds every command that the engine's thread executed, in that order and with the instant of the engine's clock, and every answer:
//! sessions meet in maps and forks, so one run of the server is one recording and not one for each session. It is an MCAP file of the project's own
//! protobuf messages, with their descriptors as schemas, so that viewers open it; and it is enough to repeat the run on another machine that
//! has the bundle, because maps are in it too.
//!
//! - [`Recorder`] hears the engine ([`nesam_engine::Tap`]), queues what it hears and writes it on a thread of its own. What the disk cannot follow is
//!   dropped and counted, never waited for.
//! - [`Recording`] reads the parts of a recording back, finished or not.
//! - [`window`] gives back what one session measured, for a diagnosis.
//! - [`replay`] executes the commands on a fresh engine and compares the answers bit for bit.
//!
//! ```text
//! metadata nesam.recording      what ran: program, bundle, limits, machine, zero of the clock, part number
//! messages                      one command = consecutive messages of one sequence number; the last one is its answer
//! metadata nesam.recording.end  why this part ends and what was dropped; missing after a crash
//! ```

mod answer;
mod command;
mod difference;
mod error;
mod header;
mod part;
mod reader;
mod recorder;
mod replay;
mod schema;
mod topic;
mod window;

pub use difference::FieldDifference;
pub use error::RecordingError;
pub use header::RecordingHeader;
pub(crate) use header::utc;
pub use reader::{Ending, RecordedCommand, Recording};
pub(crate) use recorder::FLUSH_EVERY;
pub use recorder::{Recorder, RecorderCounts};
pub use replay::{Difference, KindCount, ReplayReport, replay};
pub use topic::Topic;
pub use window::{RecordedWindow, window};
