//! The machine's clocks: the one that the engine sees, and that of the calendar.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use nesam_engine::Clock;
use tokio::time::Instant;

/// Nanoseconds since the clock was made; of simulated time inside a simulation.
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

/// The calendar's clock, ns since 1970; 0 on a machine that believes it is earlier.
pub(crate) fn unix_ns() -> i64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| i64::try_from(since.as_nanos()).unwrap_or(i64::MAX))
}
