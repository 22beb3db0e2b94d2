//! Where a clock is set back or begins anew.

/// A clock that falls back by more than this was set, s (chosen: a step of the model; less is jitter).
const BACK_S: f64 = 0.1;

/// Places in a sequence of instants, s, in the order in which they were recorded, from which on they lie before what came earlier and go on from there. A single
/// one that comes late, or rows in disorder, are none.
pub(crate) fn begins_anew(instants_s: &[f64]) -> Vec<usize> {
    let (mut begins, mut latest_s) = (Vec::new(), f64::NEG_INFINITY);
    for (at, instant_s) in instants_s.iter().enumerate() {
        let goes_on = |next_s: &f64| next_s >= instant_s && next_s - instant_s < (next_s - latest_s).abs();
        if latest_s - instant_s > BACK_S && instants_s.get(at + 1).is_some_and(goes_on) {
            begins.push(at);
            latest_s = *instant_s;
        } else {
            latest_s = latest_s.max(*instant_s);
        }
    }
    begins
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: what goes on from an earlier instant is told from what comes late. Method: a clock set back by 0.4 s and by 10 s, one that begins at zero twice, one late
    /// message, neighbours that are swapped, time that runs backwards.
    #[test]
    fn analytic_a_clock_that_is_set_back_is_told_from_what_comes_late() {
        let steps = |from_s: f64, count: usize| (0..count).map(move |k| from_s + 0.02 * k as f64);
        let then = |from_s: f64| begins_anew(&steps(0.0, 1000).chain(steps(from_s, 1000)).collect::<Vec<_>>());
        assert_eq!((then(19.6), then(10.0), then(20.0)), (vec![1000], vec![1000], vec![]));
        assert_eq!(begins_anew(&steps(3.0, 100).chain(steps(0.0, 100)).chain(steps(0.0, 100)).collect::<Vec<_>>()), [100, 200]);
        let mut late: Vec<f64> = steps(0.0, 100).collect();
        late[50] = 0.2;
        assert_eq!(begins_anew(&late), [0; 0]);
        let swapped: Vec<f64> = (0..100).map(|k| f64::from(k ^ 1)).collect();
        assert_eq!(begins_anew(&swapped), [0; 0]);
        assert_eq!(begins_anew(&(0..100).map(|k| -f64::from(k)).collect::<Vec<_>>()), [0; 0]);
    }
}
