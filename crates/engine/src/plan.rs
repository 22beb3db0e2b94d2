//! Predictions that wait, in the order in which they will be computed, and what that order promises.
//!
//! Every share (a vehicle, with all its sessions and planners) gets the same part of the engine's time while it asks for more than that: start-time fair queueing over
//! the time that each prediction is expected to take, and order of arrival within a share. A place in the plan is a promise: nothing is put before a prediction that
//! would then miss its due time. Urgent ones, which do not wait for the one that is computed, stand before all others. Nothing here looks at a clock.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// Share by which waiting and computing may take longer than expected: measurements come in between, and times scatter.
const LONGER: f64 = 0.3;

/// A prediction is short beside one that needs this many times as long (chosen): that one is then held up little.
const LONG_FOR_SHORT: u64 = 4;

/// Predictions that wait, in the order of the plan.
#[derive(Debug)]
pub(crate) struct Plan<T> {
    waiting: VecDeque<Planned<T>>,
    /// Virtual time at which the next prediction of each share begins, where that is still to come.
    next_start_ns: BTreeMap<Arc<str>, u64>,
    /// Virtual time: that at which the prediction began that was taken last.
    virtual_ns: u64,
}

/// A prediction in the plan.
#[derive(Debug)]
pub(crate) struct Planned<T> {
    /// What waits.
    pub item: T,
    /// Whom it counts for.
    pub share: Arc<str>,
    /// Time that it is expected to take, ns.
    pub cost_ns: u64,
    /// Instant by which it has to be done, ns; `u64::MAX` = whenever.
    pub due_ns: u64,
    /// Whether it is computed before the one that runs goes on.
    pub is_urgent: bool,
    /// Virtual time at which its share lets it begin.
    start_ns: u64,
}

/// Where a new prediction would stand.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Place {
    index: usize,
    /// Time for which it would wait, ns.
    pub wait_ns: u64,
    is_urgent: bool,
}

/// What runs when a new prediction might be computed before that goes on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Underway {
    /// Time that it is expected to take in all, ns.
    pub cost_ns: u64,
    /// Time that it still needs, without the urgent ones for which it waits, ns.
    pub left_ns: u64,
    /// The same for the fewest samples that are of use: with these it ends when it is due.
    pub least_left_ns: u64,
    /// Time after which it is given up, ns.
    pub given_up_after_ns: u64,
    /// Time that an urgent one is expected to need that is computed now, ns.
    pub urgent_left_ns: u64,
    /// Time for which others may still be computed before it goes on, ns.
    pub spare_ns: u64,
    /// Instant by which it has to be done, ns; `u64::MAX` = whenever.
    pub due_ns: u64,
}

impl<T> Default for Plan<T> {
    fn default() -> Self {
        Self { waiting: VecDeque::new(), next_start_ns: BTreeMap::new(), virtual_ns: 0 }
    }
}

/// Instant until which something is surely done that is expected to take this long from now on, ns.
pub(crate) fn surely_done_ns(now_ns: u64, expected_ns: u64) -> u64 {
    now_ns.saturating_add(((1.0 + LONGER) * expected_ns as f64) as u64)
}

/// Time to count on for a prediction that has run for so long, ns, before [`surely_done_ns`] adds to it: it adds to the whole, since whether it takes longer shows at the end.
pub(crate) fn left_ns(expected_ns: u64, ran_ns: u64) -> u64 {
    budget_ns(ran_ns, surely_done_ns(0, expected_ns))
}

/// What may be expected to take until then, for it to be surely done, ns.
pub(crate) fn budget_ns(now_ns: u64, due_ns: u64) -> u64 {
    (due_ns.saturating_sub(now_ns) as f64 / (1.0 + LONGER)) as u64
}

impl<T> Plan<T> {
    /// The place of a new prediction at `now_ns`, when the one that runs is expected to need `running_ns` more: where its share lets it begin, or behind the last one that
    /// would be late otherwise. One pass over what waits.
    pub fn place(&self, share: &str, cost_ns: u64, now_ns: u64, running_ns: u64) -> Place {
        let start_ns = self.start_of(share);
        let mut wait_ns = running_ns + self.waiting.iter().map(|planned| planned.cost_ns).sum::<u64>();
        let mut index = self.waiting.len();
        for planned in self.waiting.iter().rev() {
            let would_be_late = wait_ns + cost_ns > budget_ns(now_ns, planned.due_ns);
            if would_be_late || planned.is_urgent || planned.start_ns <= start_ns || &*planned.share == share {
                break;
            }
            index -= 1;
            wait_ns -= planned.cost_ns;
        }
        Place { index, wait_ns, is_urgent: false }
    }

    /// The place of a new prediction that is computed before the one that runs goes on: where it is much shorter than that, nobody is late by it and none
    /// of its share waits, for these come first.
    pub fn urgent_place(&self, share: &str, cost_ns: u64, now_ns: u64, underway: Underway) -> Option<Place> {
        let index = self.waiting.iter().take_while(|planned| planned.is_urgent).count();
        let (urgent, others) = (self.waiting.range(..index), self.waiting.range(index..));
        let before_ns: u64 = urgent.map(|planned| planned.cost_ns).sum();
        let wait_ns = underway.urgent_left_ns + before_ns;
        let is_short = cost_ns < underway.cost_ns / LONG_FOR_SHORT && wait_ns + cost_ns <= underway.spare_ns;
        let is_late = |done_ns: u64, due_ns: u64| done_ns > budget_ns(now_ns, due_ns);
        let mut done_ns = (wait_ns + cost_ns + underway.left_ns).min(underway.given_up_after_ns);
        let harms_nobody = !is_late(wait_ns + cost_ns + underway.least_left_ns, underway.due_ns)
            && others.clone().all(|planned| {
                done_ns += planned.cost_ns;
                // Who is late whatever happens is not held up.
                &*planned.share != share
                    && (!is_late(done_ns, planned.due_ns) || (now_ns + done_ns).saturating_sub(cost_ns) > planned.due_ns)
            });
        (is_short && harms_nobody).then_some(Place { index, wait_ns, is_urgent: true })
    }

    /// Whether the next prediction is urgent.
    pub fn is_next_urgent(&self) -> bool {
        self.waiting.front().is_some_and(|planned| planned.is_urgent)
    }

    /// Puts a prediction there that is expected to take this long.
    pub fn insert(&mut self, place: Place, share: Arc<str>, item: T, cost_ns: u64, due_ns: u64) {
        let start_ns = self.start_of(&share);
        // Predictions of unknown cost take turns as if each took a little.
        self.next_start_ns.insert(Arc::clone(&share), start_ns + cost_ns.max(1));
        self.waiting.insert(place.index, Planned { item, share, cost_ns, due_ns, is_urgent: place.is_urgent, start_ns });
    }

    /// Virtual time at which a new prediction of this share may begin: who asked for nothing has saved nothing up.
    fn start_of(&self, share: &str) -> u64 {
        self.next_start_ns.get(share).map_or(self.virtual_ns, |next| self.virtual_ns.max(*next))
    }

    /// The next prediction.
    pub fn pop(&mut self) -> Option<Planned<T>> {
        let next = self.waiting.pop_front()?;
        self.virtual_ns = self.virtual_ns.max(next.start_ns);
        let virtual_ns = self.virtual_ns;
        self.next_start_ns.retain(|_, start_ns| *start_ns > virtual_ns);
        Some(next)
    }

    /// Time that may pass from `now_ns` on before the first prediction of the plan begins, so that all that can be are done when they are due, ns.
    pub fn spare_ns(&self, now_ns: u64) -> u64 {
        let done_ns = self.waiting.iter().scan(now_ns, |done_ns, planned| {
            *done_ns += planned.cost_ns;
            Some((*done_ns, planned.due_ns))
        });
        // What is late whatever happens holds nobody up, and what is due whenever neither.
        let waits_for = done_ns.filter(|(done_ns, due_ns)| done_ns <= due_ns && *due_ns < u64::MAX);
        waits_for.map(|(done_ns, due_ns)| budget_ns(now_ns, due_ns).saturating_sub(done_ns - now_ns)).min().unwrap_or(u64::MAX)
    }

    /// Predictions that wait.
    pub fn len(&self) -> usize {
        self.waiting.len()
    }

    /// Predictions of one share that wait.
    pub fn len_of(&self, share: &str) -> usize {
        self.waiting.iter().filter(|planned| &*planned.share == share).count()
    }

    /// Takes everything out.
    pub fn drain(&mut self) -> Vec<T> {
        self.next_start_ns.clear();
        self.waiting.drain(..).map(|planned| planned.item).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WHENEVER: u64 = u64::MAX;

    fn push<T>(plan: &mut Plan<T>, share: &str, item: T, cost_ns: u64) {
        let place = plan.place(share, cost_ns, 0, 0);
        plan.insert(place, share.into(), item, cost_ns, WHENEVER);
    }

    /// Numbers below a bound, the same ones each time.
    fn random(seed: u64) -> impl FnMut(u64) -> u64 {
        let mut state = seed;
        move |below| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) % below
        }
    }

    #[test]
    fn analytic_shares_get_the_same_time_whatever_they_ask_for() {
        let mut plan = Plan::default();
        // One asks for 60 long ones, one for short ones, one comes later.
        (0..60).for_each(|_| push(&mut plan, "greedy", 'g', 30));
        (0..60).for_each(|_| push(&mut plan, "modest", 'm', 10));
        let served = |plan: &mut Plan<char>, time_ns: u64| {
            let mut times = BTreeMap::new();
            let mut total = 0;
            while total < time_ns {
                let next = plan.pop().unwrap();
                *times.entry(next.item).or_insert(0) += next.cost_ns;
                total += next.cost_ns;
            }
            times
        };
        let first = served(&mut plan, 600);
        assert!(first[&'g'].abs_diff(300) <= 30 && first[&'m'].abs_diff(300) <= 30, "{first:?}");
        (0..60).for_each(|_| push(&mut plan, "late", 'l', 10));
        let second = served(&mut plan, 600);
        // Nothing is made up for: a third each.
        assert!(second.values().all(|time| u64::abs_diff(*time, 200) <= 40), "{second:?}");
    }

    #[test]
    fn analytic_order_within_a_share_is_that_of_arrival_and_nothing_is_lost() {
        let mut plan = Plan::default();
        (0..50_u32).for_each(|i| push(&mut plan, ["a", "b", "c"][i as usize % 3], i, u64::from(i % 7)));
        assert_eq!((plan.len(), plan.len_of("a"), plan.len_of("nobody")), (50, 17, 0));
        let mut out = Vec::new();
        while let Some(next) = plan.pop() {
            assert_eq!(next.cost_ns, u64::from(next.item % 7));
            out.push(next.item);
        }
        for residue in 0..3 {
            assert!(out.iter().filter(|i| **i % 3 == residue).is_sorted());
        }
        out.sort_unstable();
        assert_eq!(out, (0..50).collect::<Vec<_>>());
        assert!(plan.len() == 0 && plan.pop().is_none());
        push(&mut plan, "a", 1, 1);
        assert_eq!((plan.drain(), plan.len()), (vec![1], 0));
    }

    #[test]
    fn analytic_a_promise_comes_before_a_fair_place() {
        let mut plan = Plan::default();
        // Three of one share, 10 each; the second has to be done at 26 = 1.3 · 20.
        for (i, due_ns) in [(0, WHENEVER), (1, 26), (2, WHENEVER)] {
            let place = plan.place("a", 10, 0, 0);
            plan.insert(place, "a".into(), i, 10, due_ns);
        }
        // Another share would come after the first one; it comes after the second.
        assert_eq!(plan.place("b", 10, 0, 0), Place { index: 2, wait_ns: 20, is_urgent: false });
        assert_eq!(plan.place("a", 10, 0, 7), Place { index: 3, wait_ns: 37, is_urgent: false });
        // The first one is taken: it may take what it asked for. Three instants later nothing is left to spare, and then the second is late whatever happens.
        assert_eq!(plan.pop().map(|next| next.item), Some(0));
        assert_eq!((plan.spare_ns(0), plan.spare_ns(13), plan.spare_ns(17)), (10, 0, WHENEVER));
    }

    /// Goal: a short one is computed before the one that runs goes on, unless somebody is late by it, one of its share waits, or that one waited long enough. Method:
    /// by hand; one runs that needs 100 more.
    #[test]
    fn analytic_a_short_one_does_not_wait_for_a_long_one() {
        let underway = Underway {
            cost_ns: 100,
            left_ns: 100,
            least_left_ns: 100,
            given_up_after_ns: WHENEVER,
            urgent_left_ns: 0,
            spare_ns: 100,
            due_ns: WHENEVER,
        };
        let mut plan = Plan::default();
        let place = |plan: &Plan<u32>, share, cost_ns, underway| {
            plan.urgent_place(share, cost_ns, 0, underway).map(|place| (place.index, place.wait_ns))
        };
        assert_eq!((place(&plan, "a", 24, underway), place(&plan, "a", 25, underway)), (Some((0, 0)), None), "a quarter");
        // 1.3 · (24 + 100) = 161.2.
        let due = |due_ns: u64| Underway { due_ns, ..underway };
        assert_eq!((place(&plan, "a", 24, due(162)), place(&plan, "a", 24, due(161))), (Some((0, 0)), None));
        // With fewer samples it is in time.
        assert_eq!(place(&plan, "a", 24, Underway { least_left_ns: 90, ..due(161) }), Some((0, 0)));
        assert_eq!(place(&plan, "a", 24, Underway { spare_ns: 23, ..underway }), None, "it waited long enough");
        assert_eq!(place(&plan, "a", 24, Underway { urgent_left_ns: 7, ..underway }), Some((0, 7)));
        // Behind other urgent ones, before all others, of which one has to be done at 1.3 · (10 + 10 + 100 + 30).
        let others = plan.place("b", 30, 0, 100);
        plan.insert(others, "b".into(), 0, 30, 195);
        let first = plan.urgent_place("a", 10, 0, underway).unwrap();
        plan.insert(first, "a".into(), 1, 10, WHENEVER);
        assert_eq!((place(&plan, "a", 10, underway), place(&plan, "a", 11, underway)), (Some((1, 10)), None));
        assert_eq!(place(&plan, "b", 1, underway), None, "order within a share");
        assert!(plan.is_next_urgent() && plan.place("c", 1, 0, 100).index >= 1);
        assert_eq!(plan.pop().map(|next| (next.item, next.is_urgent)), Some((1, true)));
        assert!(!plan.is_next_urgent());
    }

    #[test]
    fn property_what_was_in_time_stays_in_time() {
        let mut next = random(7);
        for _ in 0..300 {
            let mut plan = Plan::default();
            let (mut now_ns, mut promised) = (0, 0);
            for i in 0..80 {
                let (share, cost_ns, due_ns) = (["a", "b", "c", "d"][next(4) as usize], 1 + next(50), now_ns + 20 + next(600));
                let place = plan.place(share, cost_ns, now_ns, 0);
                if surely_done_ns(now_ns, place.wait_ns + cost_ns) <= due_ns {
                    plan.insert(place, share.into(), i, cost_ns, due_ns);
                    promised += 1;
                }
                // What is computed takes as long as expected, or a little longer.
                if next(3) == 0
                    && let Some(done) = plan.pop()
                {
                    now_ns += done.cost_ns * (100 + next(30)) / 100;
                    assert!(now_ns <= done.due_ns, "done at {now_ns}, due {}", done.due_ns);
                }
            }
            assert!(promised > 20, "{promised}");
            while let Some(done) = plan.pop() {
                now_ns += done.cost_ns * 13 / 10;
                assert!(now_ns <= done.due_ns, "done at {now_ns}, due {}", done.due_ns);
            }
        }
    }
}
