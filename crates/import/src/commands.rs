//! The command of each row: the mean of what was told from it to the next row.

use nesam_trajectories::gap_limit_s;

/// A row has a command where one is known for at least this share of the time until the next row (chosen).
const KNOWN_SHARE: f64 = 0.5;
/// Commands this close to a row, and within a tenth of the time to the next, count from it, s: a program that sends both sends them one after the other (chosen, a
/// thousandth of the model's step).
const TOGETHER_S: f64 = 1e-4;

/// Time from a row to the next one, s.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Span {
    pub(crate) from_s: f64,
    pub(crate) to_s: f64,
}

/// One channel of commands of a drive. Each command holds until the next one, for a limited time: nobody knows what a vehicle does that hears nothing.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Told {
    /// Instants, s, and values; instants ascend.
    commands: Vec<(f64, f64)>,
    /// For how long a command holds at most, s: as long as a gap between samples is bridged.
    pub(crate) hold_s: f64,
}

impl Told {
    /// From instants, s, and values in any order; of two at one instant the later one counts.
    pub(crate) fn new(mut commands: Vec<(f64, f64)>) -> Self {
        commands.sort_by(|a, b| a.0.total_cmp(&b.0));
        let hold_s = gap_limit_s(usual_step_s(commands.iter().map(|(at_s, _)| *at_s)));
        Self { commands, hold_s }
    }

    /// Whether enough of a time is known to say what was commanded then.
    pub(crate) fn is_known(&self, span: Span) -> bool {
        self.over(span).is_some_and(|mean| mean.known_s >= KNOWN_SHARE * (span.to_s - span.from_s))
    }

    /// The last command at or before an instant, however old.
    pub(crate) fn last(&self, at_s: f64) -> Option<f64> {
        self.commands[..self.next(at_s)].last().map(|(_, value)| *value)
    }

    /// The first command after an instant.
    fn next(&self, at_s: f64) -> usize {
        self.commands.partition_point(|(instant_s, _)| *instant_s <= at_s)
    }

    /// The mean over what is known of a time; `None` where nothing is.
    pub(crate) fn over(&self, Span { from_s, to_s }: Span) -> Option<Mean> {
        let together_s = TOGETHER_S.min(0.1 * (to_s - from_s));
        let first = self.next(from_s + together_s).saturating_sub(1);
        let (mut held, mut known_s, mut more) = (None, 0.0, 0.0);
        let inside = |(_, (instant_s, _)): &(usize, &(f64, f64))| *instant_s < to_s - together_s;
        for (at, (instant_s, value)) in self.commands.iter().enumerate().skip(first).take_while(inside) {
            let next_s = self.commands.get(at + 1).map_or(to_s, |(next_s, _)| next_s.min(to_s));
            let lasts_s = next_s.min(instant_s + self.hold_s) - instant_s.max(from_s);
            if lasts_s > 0.0 {
                known_s += lasts_s;
                // Differences, so that what stays keeps every bit.
                more += lasts_s * (value - *held.get_or_insert(*value));
            }
        }
        held.map(|held| Mean { value: held + more / known_s, known_s, changes: more != 0.0 })
    }
}

/// What was commanded over a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Mean {
    pub(crate) value: f64,
    /// For how much of the time it is known, s.
    known_s: f64,
    /// Whether it is more than one command.
    pub(crate) changes: bool,
}

/// The median of the steps between ascending instants, s; zero of fewer than two.
pub(crate) fn usual_step_s(instants_s: impl Iterator<Item = f64>) -> f64 {
    let instants_s: Vec<f64> = instants_s.collect();
    let mut steps: Vec<f64> = instants_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
    steps.sort_by(f64::total_cmp);
    steps.get(steps.len() / 2).copied().unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn span(from_s: f64, to_s: f64) -> Span {
        Span { from_s, to_s }
    }

    #[test]
    fn analytic_a_command_counts_from_where_it_is() {
        // Commands at 10 Hz, 5 ms after each row: 5 % of a row are of the one before. Told once a row, at it: the value, to the bit.
        let late = Told::new((0..50).map(|k| (0.1 * f64::from(k) + 0.005, f64::from(k))).collect());
        let at_rows = Told::new((0..50).map(|k| (0.1 * f64::from(k), (0.7 * f64::from(k)).sin())).collect());
        for k in 1..49 {
            let row = span(0.1 * f64::from(k), 0.1 * f64::from(k + 1));
            let mean = late.over(row).unwrap();
            assert!((mean.value - (f64::from(k) - 0.05)).abs() < 1e-9 && mean.changes);
            // A microsecond off on either side is together with the row.
            for row in [row, span(row.from_s - 1e-6, row.to_s - 1e-6), span(row.from_s + 1e-6, row.to_s + 1e-6)] {
                let mean = at_rows.over(row).unwrap();
                assert!(mean.value == (0.7 * f64::from(k)).sin() && !mean.changes);
            }
        }
        // Rows that are closer than that have commands too.
        assert!(at_rows.is_known(span(0.3, 0.30005)) && at_rows.is_known(span(0.30001, 0.30002)));
        // Nothing is known before the first command; a row of which most is known has one.
        assert!(late.is_known(span(0.0, 0.1)) && !late.is_known(span(-0.1, 0.0)) && !late.is_known(span(-0.06, 0.02)));
        assert_eq!((late.over(span(0.0, 0.1)).unwrap().value, late.last(0.0)), (0.0, None));
        // Twelve commands a row, two of them at one instant: the later counts.
        let fast = Told::new((0..120).map(|k| (0.01 * f64::from(k / 2 * 2), f64::from(k))).collect());
        assert!((fast.over(span(0.1, 0.2)).unwrap().value - 15.0).abs() < 1e-9, "11, 13, 15, 17, 19 for 20 ms each");
    }

    #[test]
    fn analytic_a_command_holds_for_a_limited_time() {
        // At 10 Hz for half a second, as the live bridge; at 1 Hz for five.
        for (step_s, hold_s) in [(0.1, 0.5), (1.0, 5.0)] {
            let told = Told::new((0..10).map(|k| (step_s * f64::from(k), 3.0)).chain([(100.0, 4.0)]).collect());
            let end_s = 9.0 * step_s + hold_s;
            assert!((told.hold_s - hold_s).abs() < 1e-9);
            assert!(told.is_known(span(end_s - 0.1, end_s)) && !told.is_known(span(end_s, end_s + 0.1)));
            assert!(told.is_known(span(100.0, 100.1)) && !told.is_known(span(60.0, 60.1)) && told.last(60.0) == Some(3.0));
            let known = told.over(span(end_s - 0.1, 100.05)).unwrap().value;
            assert!((known - (0.1 * 3.0 + 0.05 * 4.0) / 0.15).abs() < 1e-6, "what is not known does not count: {known}");
        }
        let silent = Told::new(Vec::new());
        assert!(!silent.is_known(span(0.0, 0.1)) && silent.last(0.0).is_none());
    }
}
