//! The machine's clock, as the engine sees it.

use std::time::{Duration, Instant};

use nesam_engine::Clock;

/// Nanoseconds since the clock was made.
#[derive(Clone, Copy, Debug)]
pub struct MonotonicClock(Instant);

impl Default for MonotonicClock {
    fn default() -> Self {
        Self(Instant::now())
    }
}

impl MonotonicClock {
    /// Time since the clock was made.
    pub fn elapsed(&self) -> Duration {
        self.0.elapsed()
    }
}

impl Clock for MonotonicClock {
    fn now_ns(&self) -> u64 {
        u64::try_from(self.0.elapsed().as_nanos()).unwrap_or(u64::MAX)
    }
}
