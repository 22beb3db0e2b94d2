//! The time grid of the model laid over the stamps of a vehicle.

/// Where a stamp lies on the grid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// It is the next step.
    Step,
    /// It lies before the next grid point.
    Between {
        /// Time until the grid point, ns.
        remaining_ns: i64,
    },
    /// More than one and a half steps after the last one.
    Gap {
        /// Time since the last step, ns.
        gap_ns: i64,
    },
}

/// The grid of one uninterrupted run of measurements.
///
/// A fixed grid would drift away from a vehicle whose clock or rate is slightly off, and steps counted from the last stamp would shorten with every
/// early stamp. So of all stamps the one nearest to the grid point is taken (it lies within half of the present sampling interval), and the grid
/// follows the stamps slowly: each step moves it by a fifth of the difference.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StepGrid {
    step_ns: i64,
    /// Last step.
    last_ns: i64,
    /// Last stamp of all.
    seen_ns: i64,
    /// Next grid point.
    next_ns: i64,
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

    /// Takes a stamp later than all before and says where it lies. After a gap the caller starts a new grid.
    pub fn take(&mut self, stamp_ns: i64) -> Place {
        let gap_ns = stamp_ns.saturating_sub(self.last_ns);
        if gap_ns > self.step_ns / 2 * 3 {
            return Place::Gap { gap_ns };
        }
        let interval = stamp_ns.saturating_sub(self.seen_ns).min(self.step_ns);
        self.seen_ns = stamp_ns;
        let remaining_ns = self.next_ns.saturating_sub(stamp_ns);
        if remaining_ns > interval / 2 {
            return Place::Between { remaining_ns };
        }
        self.last_ns = stamp_ns;
        self.next_ns = self.next_ns.saturating_add(self.step_ns).saturating_sub(remaining_ns / 5);
        Place::Step
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: i64 = 100_000_000;

    /// Distances between the steps that a source of this period gives, ns; panics on a gap.
    fn steps(period_ns: i64, count: i64) -> Vec<i64> {
        let mut grid = StepGrid::start(0, STEP);
        let mut taken = vec![0];
        for i in 1..count {
            match grid.take(i * period_ns) {
                Place::Step => taken.push(i * period_ns),
                Place::Between { .. } => {}
                Place::Gap { gap_ns } => panic!("gap of {gap_ns} ns at sample {i} of period {period_ns} ns"),
            }
        }
        taken.windows(2).map(|w| w[1] - w[0]).collect()
    }

    #[test]
    fn analytic_divisors_of_the_step_give_even_steps() {
        for period_ms in [100, 50, 20, 10, 5] {
            let steps = steps(period_ms * 1_000_000, 5000);
            assert!(steps.iter().all(|s| *s == STEP), "{period_ms} ms: {:?}", &steps[..8]);
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
    fn property_odd_rates_average_to_the_step() {
        for period_ms in [40, 30, 33, 7] {
            let steps = steps(period_ms * 1_000_000, 10_000);
            let mean = steps.iter().sum::<i64>() as f64 / steps.len() as f64;
            // 33 ms locks to every third sample, 99 ms.
            assert!((mean / STEP as f64 - 1.0).abs() < 0.011, "{period_ms} ms: {mean}");
        }
    }

    #[test]
    fn analytic_one_missing_sample_is_a_gap() {
        let mut grid = StepGrid::start(0, STEP);
        assert_eq!(grid.take(2 * STEP), Place::Gap { gap_ns: 2 * STEP });
        assert_eq!(grid.take(i64::MAX), Place::Gap { gap_ns: i64::MAX });
        assert_eq!(grid.take(STEP + STEP / 2), Place::Step);
    }
}
