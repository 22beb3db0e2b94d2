//! Predictions that wait: who is next, and how long a new one would wait.
//!
//! Every share (a vehicle, with all its sessions and planners) gets the same part of the engine's time while it asks for more than that: start-time fair queueing over
//! the time that each prediction is expected to take. Order within a share is that of arrival. Nothing here looks at a clock.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

/// Predictions that wait, by share.
#[derive(Debug)]
pub(crate) struct FairQueue<T> {
    shares: BTreeMap<Arc<str>, Share<T>>,
    /// Virtual time: that at which the prediction began that was taken last.
    virtual_ns: u64,
    waiting: usize,
}

#[derive(Debug)]
struct Share<T> {
    waiting: VecDeque<(T, u64)>,
    /// Sum of what waits, ns.
    backlog_ns: u64,
    /// Virtual time at which its next prediction begins.
    start_ns: u64,
}

impl<T> Default for FairQueue<T> {
    fn default() -> Self {
        Self { shares: BTreeMap::new(), virtual_ns: 0, waiting: 0 }
    }
}

impl<T> FairQueue<T> {
    /// Adds a prediction that is expected to take this long.
    pub fn push(&mut self, share: &Arc<str>, item: T, cost_ns: u64) {
        let virtual_ns = self.virtual_ns;
        let entry = self.shares.entry(Arc::clone(share)).or_insert(Share { waiting: VecDeque::new(), backlog_ns: 0, start_ns: virtual_ns });
        if entry.waiting.is_empty() {
            // Who asked for nothing has saved nothing up.
            entry.start_ns = entry.start_ns.max(virtual_ns);
        }
        entry.waiting.push_back((item, cost_ns));
        entry.backlog_ns += cost_ns;
        self.waiting += 1;
    }

    /// The next prediction, with the time that it is expected to take.
    pub fn pop(&mut self) -> Option<(T, u64)> {
        let next = self.shares.values_mut().filter(|share| !share.waiting.is_empty()).min_by_key(|share| share.start_ns)?;
        let (item, cost_ns) = next.waiting.pop_front()?;
        self.virtual_ns = self.virtual_ns.max(next.start_ns);
        next.backlog_ns -= cost_ns;
        // Predictions of unknown cost take turns as if each took a little.
        next.start_ns += cost_ns.max(1);
        self.waiting -= 1;
        let virtual_ns = self.virtual_ns;
        self.shares.retain(|_, share| !share.waiting.is_empty() || share.start_ns > virtual_ns);
        Some((item, cost_ns))
    }

    /// Time that a new prediction of this share would wait for others at most, ns: for its own backlog, and for as much of each other share.
    pub fn wait_ns(&self, share: &str, cost_ns: u64) -> u64 {
        let own_ns = self.shares.get(share).map_or(0, |share| share.backlog_ns);
        let others = self.shares.iter().filter(|(name, _)| &***name != share);
        own_ns + others.map(|(_, other)| other.backlog_ns.min(own_ns + cost_ns)).sum::<u64>()
    }

    /// Predictions that wait.
    pub fn len(&self) -> usize {
        self.waiting
    }

    /// Predictions of one share that wait.
    pub fn len_of(&self, share: &str) -> usize {
        self.shares.get(share).map_or(0, |share| share.waiting.len())
    }

    /// Takes everything out.
    pub fn drain(&mut self) -> Vec<T> {
        self.waiting = 0;
        std::mem::take(&mut self.shares).into_values().flat_map(|share| share.waiting).map(|(item, _)| item).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn share(name: &str) -> Arc<str> {
        name.into()
    }

    #[test]
    fn analytic_shares_get_the_same_time_whatever_they_ask_for() {
        let mut queue = FairQueue::default();
        // One asks for 60 long ones, one for short ones, one comes later.
        (0..60).for_each(|_| queue.push(&share("greedy"), 'g', 30));
        (0..60).for_each(|_| queue.push(&share("modest"), 'm', 10));
        let served = |queue: &mut FairQueue<char>, time_ns: u64| {
            let mut times = BTreeMap::new();
            let mut total = 0;
            while total < time_ns {
                let (who, cost) = queue.pop().unwrap();
                *times.entry(who).or_insert(0) += cost;
                total += cost;
            }
            times
        };
        let first = served(&mut queue, 600);
        assert!(first[&'g'].abs_diff(300) <= 30 && first[&'m'].abs_diff(300) <= 30, "{first:?}");
        (0..60).for_each(|_| queue.push(&share("late"), 'l', 10));
        let second = served(&mut queue, 600);
        // Nothing is made up for: a third each.
        assert!(second.values().all(|time| u64::abs_diff(*time, 200) <= 40), "{second:?}");
    }

    #[test]
    fn analytic_order_within_a_share_is_that_of_arrival_and_nothing_is_lost() {
        let mut queue = FairQueue::default();
        (0..50_u32).for_each(|i| queue.push(&share(["a", "b", "c"][i as usize % 3]), i, u64::from(i % 7)));
        assert_eq!((queue.len(), queue.len_of("a"), queue.len_of("nobody")), (50, 17, 0));
        let mut out = Vec::new();
        while let Some((i, cost)) = queue.pop() {
            assert_eq!(cost, u64::from(i % 7));
            out.push(i);
        }
        for residue in 0..3 {
            assert!(out.iter().filter(|i| **i % 3 == residue).is_sorted());
        }
        out.sort_unstable();
        assert_eq!(out, (0..50).collect::<Vec<_>>());
        assert!(queue.len() == 0 && queue.pop().is_none());
        queue.push(&share("a"), 1, 1);
        assert_eq!((queue.drain(), queue.len()), (vec![1], 0));
    }

    #[test]
    fn property_the_wait_told_is_never_exceeded() {
        // Whatever waits, a new prediction begins no later than was told, if nobody new comes.
        let mut random = 7_u64;
        let mut next = |below: u64| {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (random >> 33) % below
        };
        for _ in 0..200 {
            let mut queue = FairQueue::default();
            let names = ["a", "b", "c", "d"].map(share);
            for i in 0..next(40) {
                queue.push(&names[next(4) as usize], i, 1 + next(50));
            }
            for _ in 0..next(5) {
                let _ = queue.pop();
            }
            let (who, cost) = (&names[next(4) as usize], 1 + next(50));
            let told = queue.wait_ns(who, cost);
            queue.push(who, 999, cost);
            let mut waited = 0;
            while let Some((i, cost)) = queue.pop() {
                if i == 999 {
                    break;
                }
                waited += cost;
            }
            // A share that was served a little ahead of the others is behind by one prediction of each.
            assert!(waited <= told + 4 * 50, "{waited} after {told} were told");
        }
    }
}
