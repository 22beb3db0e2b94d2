//! Which numbers of the present start of the vehicle's software were accepted.

use std::collections::VecDeque;

/// Runs of numbers without a gap that are remembered. A stream that loses nothing needs one.
pub(super) const RUNS_MAX: usize = 64;

/// Accepted numbers as runs without a gap, both ends included, ascending. Of more than are remembered the lowest are forgotten.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Numbers(VecDeque<(u64, u64)>);

impl Numbers {
    /// Runs of an image; `None` where they do not ascend with a gap between any two, or are too many.
    pub fn of_runs(runs: &[(u64, u64)]) -> Option<Self> {
        let apart = runs.windows(2).all(|pair| pair[0].1.checked_add(1).is_some_and(|next| next < pair[1].0));
        (runs.len() <= RUNS_MAX && apart && runs.iter().all(|(first, last)| first <= last)).then(|| Self(runs.iter().copied().collect()))
    }

    /// All numbers up to this one.
    pub fn up_to(last: u64) -> Self {
        Self([(0, last)].into())
    }

    /// The runs.
    pub fn runs(&self) -> Vec<(u64, u64)> {
        self.0.iter().copied().collect()
    }

    /// Whether a number was accepted; `false` of one that was forgotten.
    pub fn contains(&self, number: u64) -> bool {
        let after = self.0.partition_point(|(first, _)| *first <= number);
        after > 0 && number <= self.0[after - 1].1
    }

    /// Notes an accepted number.
    pub fn insert(&mut self, number: u64) {
        if self.contains(number) {
            return;
        }
        let place = self.0.partition_point(|(first, _)| *first <= number);
        let begins = number.checked_add(1).filter(|next| self.0.get(place).is_some_and(|(first, _)| first == next));
        let goes_on = place > 0 && self.0[place - 1].1 + 1 == number;
        match (goes_on, begins) {
            (true, Some(_)) => {
                let (_, last) = self.0.remove(place).expect("it was looked at; this is a bug");
                self.0[place - 1].1 = last;
            }
            (true, None) => self.0[place - 1].1 = number,
            (false, Some(_)) => self.0[place].0 = number,
            (false, None) => {
                self.0.insert(place, (number, number));
                if self.0.len() > RUNS_MAX {
                    self.0.pop_front();
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    /// Goal: what was accepted is known, in whatever order, and in one run where nothing is missing. Method: against a set, numbers in a scrambled order.
    #[test]
    fn property_numbers_are_those_of_a_set() {
        let (mut numbers, mut oracle) = (Numbers::default(), BTreeSet::new());
        for i in 0..60_u64 {
            let number = i * 37 % 101;
            numbers.insert(number);
            oracle.insert(number);
            assert!((0..110).all(|n| numbers.contains(n) == oracle.contains(&n)), "after {number}: {numbers:?}");
            assert_eq!(Numbers::of_runs(&numbers.runs()), Some(numbers.clone()));
        }
        (0..101).for_each(|number| numbers.insert(number));
        assert_eq!(numbers.runs(), [(0, 100)]);
        [u64::MAX, u64::MAX - 1].into_iter().for_each(|number| numbers.insert(number));
        assert_eq!(numbers.runs(), [(0, 100), (u64::MAX - 1, u64::MAX)]);
    }

    /// Goal: memory is bounded, by what is oldest, and no image brings what cannot be. Method: every other number; runs that touch, cross or are too many.
    #[test]
    fn analytic_of_many_runs_the_lowest_are_forgotten() {
        let mut numbers = Numbers::default();
        (0..100).for_each(|i| numbers.insert(2 * i));
        assert_eq!(
            (numbers.runs().len(), numbers.contains(198), numbers.contains(72), numbers.contains(70)),
            (RUNS_MAX, true, true, false)
        );
        for impossible in [vec![(2, 1)], vec![(1, 3), (4, 5)], vec![(5, 6), (1, 2)], (0..65).map(|i| (2 * i, 2 * i)).collect()] {
            assert_eq!(Numbers::of_runs(&impossible), None, "{impossible:?}");
        }
    }
}
