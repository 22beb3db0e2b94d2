//! The time grid of the model laid over the stamps of a vehicle.

/// Where a step of the model lies.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StepAt {
    /// At the stamp that was taken.
    Stamp,
    /// At the grid point between the stamp before and the one that was taken, ns.
    Between(i64),
}

/// What a stamp makes of the grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// It ends one step, or two after a long interval. By ascending instant.
    Steps {
        /// The step.
        first: StepAt,
        /// The one after it.
        second: Option<StepAt>,
    },
    /// It lies before the next grid point.
    Waiting {
        /// Time until the grid point, ns.
        remaining_ns: i64,
    },
    /// More than one and a half steps after the stamp before.
    Gap {
        /// Time since the last step, ns.
        gap_ns: i64,
    },
}

/// The grid of one uninterrupted run of measurements (docs/adr/0014).
///
/// A fixed grid would drift away from a vehicle whose clock or rate is slightly off, so a stamp within an eighth of the sampling interval of the grid
/// point is a step as it is, and the grid follows by a fifth of the difference: a vehicle that measures at the rate of the model is never interpolated.
/// Everything else is: the step then lies exactly at the grid point between two stamps, so that a rate which does not divide that of
/// the model makes no steps of uneven length.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StepGrid {
    /// Step of the model, ns.
    pub step_ns: i64,
    /// Last step, ns.
    pub last_ns: i64,
    /// Last stamp of all, ns.
    pub seen_ns: i64,
    /// Next grid point, ns.
    pub next_ns: i64,
}

impl StepGrid {
    /// A grid with its first step at `stamp_ns`.
    pub fn start(stamp_ns: i64, step_ns: i64) -> Self {
        Self { step_ns, last_ns: stamp_ns, seen_ns: stamp_ns, next_ns: stamp_ns.saturating_add(step_ns) }
    }

    /// Stamp of the last step, ns.
    pub fn last_ns(&self) -> i64 {
        self.last_ns
    }

    /// Whether a grid of this vehicle can look like this after this stamp.
    pub(crate) fn fits(&self, stamp_ns: i64) -> bool {
        let within = |ns: i64, limit: i64| ns.checked_sub(stamp_ns).is_some_and(|off| off.unsigned_abs() <= limit.unsigned_abs());
        self.seen_ns == stamp_ns && within(self.last_ns, 2 * self.step_ns) && within(self.next_ns, 2 * self.step_ns)
    }

    /// Takes a stamp later than all before and says what becomes of it. After a gap the caller starts a new grid.
    pub fn take(&mut self, stamp_ns: i64) -> Place {
        let interval = stamp_ns.saturating_sub(self.seen_ns);
        if interval > self.step_ns / 2 * 3 {
            return Place::Gap { gap_ns: stamp_ns.saturating_sub(self.last_ns) };
        }
        self.seen_ns = stamp_ns;
        let Some(first) = self.next_step(stamp_ns, interval / 8) else {
            return Place::Waiting { remaining_ns: self.next_ns.saturating_sub(stamp_ns) };
        };
        let second = if first == StepAt::Stamp { None } else { self.next_step(stamp_ns, interval / 8) };
        self.pull_towards(stamp_ns, interval, second.unwrap_or(first));
        Place::Steps { first, second }
    }

    /// The next step at or before `stamp_ns`.
    fn next_step(&mut self, stamp_ns: i64, tolerance_ns: i64) -> Option<StepAt> {
        let remaining_ns = self.next_ns.saturating_sub(stamp_ns);
        if remaining_ns > tolerance_ns {
            return None;
        }
        if remaining_ns >= -tolerance_ns {
            self.last_ns = stamp_ns;
            self.next_ns = self.next_ns.saturating_add(self.step_ns).saturating_sub(remaining_ns / 5);
            return Some(StepAt::Stamp);
        }
        self.last_ns = self.next_ns;
        self.next_ns = self.next_ns.saturating_add(self.step_ns);
        Some(StepAt::Between(self.last_ns))
    }

    /// Lets the grid of a vehicle that measures as often as the model steps, but between its grid points, come back to the stamps: by at most a
    /// fiftieth of a step each time.
    fn pull_towards(&mut self, stamp_ns: i64, interval_ns: i64, last: StepAt) {
        if last != StepAt::Stamp && interval_ns >= self.step_ns / 20 * 19 {
            let remaining_ns = self.next_ns.saturating_sub(stamp_ns);
            self.next_ns = self.next_ns.saturating_sub((remaining_ns / 5).clamp(0, self.step_ns / 50));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: i64 = 100_000_000;

    /// Steps that these stamps give, and how many of them lie between two stamps; panics on a gap.
    fn steps_at(stamps: impl IntoIterator<Item = i64>) -> (Vec<i64>, usize) {
        let mut stamps = stamps.into_iter();
        let first = stamps.next().unwrap();
        let (mut grid, mut taken, mut between) = (StepGrid::start(first, STEP), vec![first], 0);
        for stamp in stamps {
            match grid.take(stamp) {
                Place::Steps { first, second } => {
                    for step in [Some(first), second].into_iter().flatten() {
                        taken.push(if let StepAt::Between(at) = step { at } else { stamp });
                        between += usize::from(step != StepAt::Stamp);
                    }
                    assert_eq!(taken.last(), Some(&grid.last_ns()));
                }
                Place::Waiting { .. } => {}
                Place::Gap { gap_ns } => panic!("gap of {gap_ns} ns at {stamp} ns"),
            }
        }
        (taken, between)
    }

    /// Distances between the steps that a source of this period gives, ns.
    fn steps(period_ns: i64, count: i64) -> Vec<i64> {
        steps_at((0..count).map(|i| i * period_ns)).0.windows(2).map(|w| w[1] - w[0]).collect()
    }

    #[test]
    fn analytic_divisors_of_the_step_give_even_steps() {
        for period_ms in [100, 50, 20, 10, 5] {
            let (at, between) = steps_at((0..5000).map(|i| i * period_ms * 1_000_000));
            assert!(at.windows(2).all(|w| w[1] - w[0] == STEP) && between == 0, "{period_ms} ms: {:?}", &at[..8]);
        }
    }

    #[test]
    fn property_the_grid_follows_a_clock_that_is_off() {
        for off_ppm in [-20_000, -1_000, -100, 100, 1_000, 20_000] {
            let period = STEP + STEP / 1_000_000 * off_ppm;
            assert!(steps(period, 20_000).iter().all(|s| *s == period), "{off_ppm} ppm");
        }
    }

    #[test]
    fn property_every_rate_from_10_to_200_hz_gives_steps_of_the_model() {
        // The tolerance of an eighth of the interval is taken at both ends of a step, and the grid follows by a fifth of it.
        for rate_hz in 10..=200_i64 {
            let period = 1_000_000_000 / rate_hz;
            let steps = steps(period, 20_000);
            let worst = steps.iter().map(|s| (s - STEP).abs()).max().unwrap();
            assert!(worst <= period / 4 + period / 40, "{rate_hz} Hz: {worst} ns off");
            let mean = steps.iter().sum::<i64>() as f64 / steps.len() as f64;
            assert!((mean / STEP as f64 - 1.0).abs() < 0.02, "{rate_hz} Hz: {mean}");
        }
    }

    #[test]
    fn property_a_source_that_slipped_between_the_grid_points_finds_back() {
        let slipped = (0..200).map(|i| i * STEP + if i >= 20 { STEP / 2 } else { 0 });
        let (at, between) = steps_at(slipped);
        assert!((1..60).contains(&between), "{between} steps were interpolated");
        assert!(at.windows(2).all(|w| (w[1] - w[0] - STEP).abs() <= STEP / 7));
        assert_eq!(at.last(), Some(&(199 * STEP + STEP / 2)), "the newest stamp is the newest step again");
    }

    #[test]
    fn analytic_one_missing_sample_is_a_gap() {
        let mut grid = StepGrid::start(0, STEP);
        assert_eq!(grid.take(2 * STEP), Place::Gap { gap_ns: 2 * STEP });
        assert_eq!(grid.take(i64::MAX), Place::Gap { gap_ns: i64::MAX });
        // Up to one and a half steps without a stamp are bridged: the step lies where the grid has it.
        let both = Place::Steps { first: StepAt::Between(STEP), second: None };
        assert_eq!(grid.take(STEP + STEP / 2), both);
    }

    #[test]
    fn analytic_a_long_interval_after_an_early_stamp_ends_two_steps() {
        let mut grid = StepGrid::start(0, STEP);
        assert_eq!(grid.take(STEP * 8 / 10), Place::Waiting { remaining_ns: STEP / 5 });
        assert_eq!(grid.take(2 * STEP), Place::Steps { first: StepAt::Between(STEP), second: Some(StepAt::Stamp) });
    }
}
