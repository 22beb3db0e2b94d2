//! Which samples of a drive are scored.

/// First start: everything before it is history of the longest kind (32 tokens).
const FIRST_START: usize = 32;

/// Distance between starts, samples.
const STRIDE: usize = 8;

/// Starts i of the windows of a drive of `n_samples` samples: predict samples i + 1 ..= i + `horizon` from samples up to i.
///
/// Starts are i = 32, 40, 48, ... while i + horizon <= n - 1 (a history longer than 32 moves the first start; a shorter one does not, so
/// that scores with different histories are of the same windows). A drive too short for the first of these has the single start i = 1,
/// with the history there is; one too short even for that has i = 0, with the start itself as history (2 s at 10 Hz with horizon 19).
/// A drive of `horizon` samples or fewer has none, and neither has a horizon of 0.
pub fn windows(n_samples: usize, horizon: usize, history: usize) -> Vec<usize> {
    if horizon == 0 || n_samples <= horizon {
        return Vec::new();
    }
    let last = n_samples - 1 - horizon;
    let first = FIRST_START.max(history);
    if first <= last { (first..=last).step_by(STRIDE).collect() } else { vec![last.min(1)] }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn published_rule_of_the_product_page() {
        assert_eq!(windows(251, 32, 32).first(), Some(&32));
        assert_eq!(windows(251, 32, 32).last(), Some(&216));
        assert_eq!(windows(251, 32, 32).len(), 24);
        assert_eq!(windows(65, 32, 32), [32]);
        assert_eq!(windows(64, 32, 32), [1], "short drives start at 1");
        assert_eq!(windows(34, 32, 32), [1]);
        assert_eq!(windows(33, 32, 32), [0], "not even i = 1 fits");
        assert_eq!(windows(32, 32, 32), [0usize; 0]);
        assert_eq!(windows(20, 19, 1), [0], "2 s at 10 Hz, scored at 1.9 s");
        assert_eq!(windows(0, 32, 32), [0usize; 0]);
        assert_eq!(windows(100, 0, 32), [0usize; 0]);
        assert_eq!(windows(251, 32, 1), windows(251, 32, 32));
    }

    #[test]
    fn property_every_window_fits() {
        for n in 0..300 {
            for horizon in [1, 5, 19, 32] {
                assert!(windows(n, horizon, 32).iter().all(|i| i + horizon < n));
            }
        }
    }
}
