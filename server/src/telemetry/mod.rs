//! What the server counts.

mod alarms;
mod histogram;
mod metrics;
mod reloads;

pub use metrics::{Metrics, Transport};
pub(crate) use reloads::{Part, Reloads};
