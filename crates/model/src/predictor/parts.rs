//! Where the time of rollouts goes, for benches.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use super::Predictor;
use crate::ModelError;
use crate::rollout::{Rollout, RolloutExtras, RolloutQuery};

/// Processor time of one query by parts, summed over its threads, s.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PartTimes {
    /// Terrain tokens looked up and interpolated (on the exact mode: encoded).
    pub lookup_s: f64,
    /// Transformer and heads.
    pub network_s: f64,
    /// Terramechanics and Newton-Euler.
    pub physics_s: f64,
    /// Ground, actuators, soil and states.
    pub rest_s: f64,
}

/// Clocks that blocks add to.
#[derive(Debug, Default)]
pub(super) struct PartClocks([AtomicU64; 4]);

/// Index of a part in [`PartClocks`].
#[derive(Clone, Copy, Debug)]
pub(super) enum Part {
    Lookup,
    Network,
    Physics,
    Rest,
}

/// A watch that says what went by since it was last looked at; without clocks it does nothing.
pub(super) struct Watch<'a> {
    clocks: Option<&'a PartClocks>,
    since: Option<Instant>,
}

impl<'a> Watch<'a> {
    pub(super) fn start(clocks: Option<&'a PartClocks>) -> Self {
        Self { clocks, since: clocks.map(|_| Instant::now()) }
    }

    /// Adds the time since the last look to a part.
    pub(super) fn add_to(&mut self, part: Part) {
        if let (Some(clocks), Some(since)) = (self.clocks, &mut self.since) {
            let now = Instant::now();
            clocks.0[part as usize].fetch_add((now - *since).as_nanos() as u64, Ordering::Relaxed);
            *since = now;
        }
    }
}

impl Predictor {
    /// The rollout of a query and where its time went. Waiting threads are not counted, preempted ones are.
    ///
    /// # Errors
    /// As [`Predictor::rollout`].
    pub fn rollout_by_parts(&self, query: &RolloutQuery<'_>) -> Result<(Rollout, PartTimes), ModelError> {
        let clocks = PartClocks::default();
        let (rollout, _) = self.rollout_timed(query, &RolloutExtras::default(), Some(&clocks))?;
        let of = |part: Part| Duration::from_nanos(clocks.0[part as usize].load(Ordering::Relaxed)).as_secs_f64();
        let times =
            PartTimes { lookup_s: of(Part::Lookup), network_s: of(Part::Network), physics_s: of(Part::Physics), rest_s: of(Part::Rest) };
        Ok((rollout, times))
    }
}
