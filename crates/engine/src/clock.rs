//! Time, passed in.

use std::sync::atomic::{AtomicU64, Ordering};

/// A monotonic clock. The server passes the machine's; tests pass a [`ManualClock`].
pub trait Clock: Send + Sync {
    /// Nanoseconds since an arbitrary fixed instant; never decreases.
    fn now_ns(&self) -> u64;
}

/// A time in seconds.
pub(crate) fn seconds(ns: i64) -> f64 {
    ns as f64 * 1e-9
}

/// A clock that stands until it is moved.
#[derive(Debug, Default)]
pub struct ManualClock(AtomicU64);

impl ManualClock {
    /// Moves the clock forward.
    pub fn advance_ns(&self, by_ns: u64) {
        self.0.fetch_add(by_ns, Ordering::Relaxed);
    }
}

impl Clock for ManualClock {
    fn now_ns(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}
