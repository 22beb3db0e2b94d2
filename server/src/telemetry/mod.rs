//! What the server counts.

mod histogram;
mod metrics;

pub use metrics::{Metrics, Transport};
