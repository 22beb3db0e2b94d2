//! What each share asks for and gets, and how much each may have when all together ask for more than there is.
//!
//! Shares are divided max-min: who asks for less than an even part gets all of it, and what is left is divided evenly among the others (Bertsekas and Gallager, *Data
//! Networks*, 6.5.2). Both rates are sums that fade with time. Nothing here looks at a clock.

use std::collections::BTreeMap;
use std::sync::Arc;

/// Time in which what was asked and given fades to 1/e, ns.
const MEMORY_NS: f64 = 2e9;
/// Pause after which the level is computed again, ns.
const LEVEL_HOLDS_NS: u64 = 20_000_000;
/// A share that asked for less than this time lately is forgotten, ns.
const FORGOTTEN_NS: f64 = 1e3;
/// What the shares may have together, as a part of the time: what is expected is not all that a prediction takes. Less makes all wait a little less.
const CAPACITY: f64 = 0.9;
/// Part of the time before its deadline for which a share may wait that had a quarter more than its level.
const LEAST_ROOM: f64 = 0.5;

/// What shares asked for and got lately.
#[derive(Debug)]
pub(crate) struct Demand {
    shares: BTreeMap<Arc<str>, Rates>,
    /// Time that each share may have, ns in the memory; infinite while there is enough for all.
    level_ns: f64,
    level_at_ns: u64,
}

/// Faded sums of one share.
#[derive(Clone, Copy, Debug, Default)]
struct Rates {
    asked_ns: f64,
    given_ns: f64,
    at_ns: u64,
}

impl Rates {
    /// The sums as they have faded until then.
    fn at(self, now_ns: u64) -> Self {
        let faded = (-(now_ns.saturating_sub(self.at_ns) as f64) / MEMORY_NS).exp();
        Self { asked_ns: self.asked_ns * faded, given_ns: self.given_ns * faded, at_ns: self.at_ns.max(now_ns) }
    }
}

impl Default for Demand {
    fn default() -> Self {
        Self { shares: BTreeMap::new(), level_ns: f64::INFINITY, level_at_ns: 0 }
    }
}

impl Demand {
    /// A share asks for this much time.
    pub fn ask(&mut self, share: &Arc<str>, cost_ns: u64, now_ns: u64) {
        let rates = self.shares.entry(Arc::clone(share)).or_default();
        *rates = rates.at(now_ns);
        rates.asked_ns += cost_ns as f64;
        if now_ns.saturating_sub(self.level_at_ns) >= LEVEL_HOLDS_NS {
            self.shares.retain(|_, rates| {
                *rates = rates.at(now_ns);
                rates.asked_ns > FORGOTTEN_NS
            });
            self.level_ns = level(self.shares.values().map(|rates| rates.asked_ns).collect(), CAPACITY * MEMORY_NS);
            self.level_at_ns = now_ns;
        }
    }

    /// A share gets so much time more, or less where that is negative.
    pub fn give(&mut self, share: &str, cost_ns: f64, now_ns: u64) {
        if let Some(rates) = self.shares.get_mut(share) {
            *rates = rates.at(now_ns);
            rates.given_ns = (rates.given_ns + cost_ns).max(0.0);
        }
    }

    /// Part of the time before its deadline for which a prediction of this share may wait: all while the share had no more than its level, half when it had a quarter
    /// more. So there is room for whoever had less, and no time is left unused.
    pub fn room(&self, share: &str) -> f64 {
        let given_ns = self.shares.get(share).map_or(0.0, |rates| rates.given_ns);
        (1.0 - 4.0 * (1.0 - LEAST_ROOM) * (given_ns / self.level_ns - 1.0)).clamp(LEAST_ROOM, 1.0)
    }

    /// Time until a share that gets nothing is at its level again, ns.
    pub fn recovers_ns(&self, share: &str) -> u64 {
        let given_ns = self.shares.get(share).map_or(0.0, |rates| rates.given_ns);
        (MEMORY_NS * (given_ns / self.level_ns).ln()).max(0.0) as u64
    }
}

/// The part that everybody gets who asks for more than it, when what was asked for is met as far as `total` goes; infinite when it goes far enough.
fn level(mut asked: Vec<f64>, total: f64) -> f64 {
    asked.sort_unstable_by(f64::total_cmp);
    let mut left = total;
    for (met, one) in asked.iter().enumerate() {
        let even = left / (asked.len() - met) as f64;
        if *one > even {
            return even;
        }
        left -= one;
    }
    f64::INFINITY
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_level_of_a_division_that_is_max_min() {
        assert_eq!(level(vec![], 1.0), f64::INFINITY);
        assert_eq!(level(vec![0.5, 0.5], 1.0), f64::INFINITY);
        assert_eq!(level(vec![3.0], 1.0), 1.0);
        assert_eq!(level(vec![3.0, 1.0, 4.0, 0.5], 4.0), 1.25);
        assert_eq!(level(vec![1.0; 4], 1.0), 0.25);
    }

    #[test]
    fn analytic_who_had_more_than_its_part_has_less_room() {
        let (greedy, modest): (Arc<str>, Arc<str>) = ("greedy".into(), "modest".into());
        let mut demand = Demand::default();
        assert_eq!((demand.room("nobody"), demand.recovers_ns("nobody")), (1.0, 0));
        // Both ask for ten seconds, one gets them; each may have half of what there is.
        for share in [&greedy, &modest] {
            demand.ask(share, 10_000_000_000, 0);
        }
        demand.ask(&modest, 0, LEVEL_HOLDS_NS);
        demand.give(&greedy, 1.125 * 0.5 * CAPACITY * MEMORY_NS, LEVEL_HOLDS_NS);
        assert!((demand.room(&greedy) - 0.75).abs() < 1e-9 && demand.room(&modest) == 1.0, "{}", demand.room(&greedy));
        assert!((demand.recovers_ns(&greedy) as f64 - 2e9 * 1.125_f64.ln()).abs() < 1.0);
        demand.give(&greedy, 10e9, LEVEL_HOLDS_NS);
        assert_eq!(demand.room(&greedy), LEAST_ROOM);
        // It fades, and there is enough for who asks for little.
        demand.ask(&greedy, 1_000_000_000, 60_000_000_000);
        assert_eq!((demand.room(&greedy), demand.shares.len()), (1.0, 1));
        demand.give("nobody", 1.0, 60_000_000_000);
        assert_eq!(demand.shares.len(), 1);
    }
}
