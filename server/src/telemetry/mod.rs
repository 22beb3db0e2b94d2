//! What the server counts.

mod alarms;
mod histogram;
mod metrics;

pub use metrics::{Metrics, Transport};
