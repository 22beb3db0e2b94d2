//! From the clock of the log to the step of the model.

use nesam_physics::wrap_angle;

/// Longest usual step of a log, s: the longest that drives are resampled to. What is longer counts milliseconds or the like.
pub const STEP_MAX_S: f64 = 10.0;
/// Samples of a drive at most: eleven days at 10 Hz. A longer one would take gigabytes.
const SAMPLES_MAX: f64 = 1e7;
/// A log whose usual step is shorter than this share of the model's is finer; what is closer differs by jitter (chosen).
const FINER: f64 = 0.9;

/// Longest gap between samples that is bridged in a log of this usual step, s: five steps, at least half a second (chosen: beyond it the motion is unknown).
pub fn gap_limit_s(usual_step_s: f64) -> f64 {
    (5.0 * usual_step_s).max(0.5)
}

/// Where each sample of the model lies among the samples of the log: share `1 - share` of `at`, `share` of the next one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Place {
    pub(crate) at: usize,
    pub(crate) share: f64,
}

impl Place {
    /// The last sample of the log at or before this one. A share of 1 is the sample after: time stamps and grid meet there.
    fn last(&self) -> usize {
        self.at + usize::from(self.share > 1.0 - 1e-6)
    }
}

/// The resampling of one drive.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Grid {
    pub(crate) time_s: Vec<f64>,
    places: Vec<Place>,
    dt_s: f64,
    /// Time stamps of a log that is finer than the step; `None` of any other.
    stamps_s: Option<Vec<f64>>,
}

impl Grid {
    /// Plans the resampling of ascending time stamps to a step; a gap that is too long, or stamps that count no seconds, give an index and an explanation.
    ///
    /// Where the source step divides the step (20 Hz to 10 Hz) samples are picked and nothing is interpolated.
    pub(crate) fn new(time_s: &[f64], dt_s: f64) -> Result<Self, (usize, String)> {
        let Some((&first, &last)) = time_s.first().zip(time_s.last()) else {
            return Ok(Self { time_s: Vec::new(), places: Vec::new(), dt_s, stamps_s: None });
        };
        let steps: Vec<f64> = time_s.windows(2).map(|w| w[1] - w[0]).collect();
        let mut sorted = steps.clone();
        sorted.sort_by(f64::total_cmp);
        let median_s = sorted.get(sorted.len() / 2).copied().unwrap_or(dt_s);
        if median_s > STEP_MAX_S {
            let reason = format!("samples lie {median_s} s apart, at most {STEP_MAX_S} s are usual; time stamps must be in seconds");
            return Err((0, reason));
        }
        if let Some(picked) = pick(time_s, dt_s, median_s) {
            return Ok(picked);
        }
        let limit_s = gap_limit_s(median_s);
        if let Some(gap) = steps.iter().position(|step| *step > limit_s) {
            let reason = format!("a gap of {:.3} s follows, at most {limit_s:.3} s are bridged; split the drive there", steps[gap]);
            return Err((gap, reason));
        }
        let count = ((last - first) / dt_s + 1e-6).floor() + 1.0;
        if count > SAMPLES_MAX {
            let reason =
                format!("the drive of {} s has {count} samples at steps of {dt_s} s, at most {SAMPLES_MAX}; split it", last - first);
            return Err((0, reason));
        }
        let grid: Vec<f64> = (0..count as usize).map(|k| first + k as f64 * dt_s).collect();
        let mut at = 0;
        let places = grid
            .iter()
            .map(|t| {
                while at + 2 < time_s.len() && time_s[at + 1] <= *t {
                    at += 1;
                }
                if at + 1 >= time_s.len() {
                    return Place { at, share: 0.0 };
                }
                Place { at, share: ((t - time_s[at]) / (time_s[at + 1] - time_s[at])).clamp(0.0, 1.0) }
            })
            .collect();
        let stamps_s = (median_s < FINER * dt_s).then(|| time_s.to_vec());
        Ok(Self { time_s: grid, places, dt_s, stamps_s })
    }

    /// Linear interpolation of N channels.
    pub(crate) fn linear<const N: usize>(&self, values: &[[f64; N]]) -> Vec<[f64; N]> {
        self.blend(values, |a, b, share| a + share * (b - a))
    }

    /// Interpolation of angles along the shorter way; results are wrapped into (-pi, pi].
    pub(crate) fn angles<const N: usize>(&self, values: &[[f64; N]]) -> Vec<[f64; N]> {
        self.blend(values, |a, b, share| wrap_angle(a + share * wrap_angle(b - a)))
    }

    /// The value of the last sample at or before each time (zero-order hold).
    pub(crate) fn held<T: Copy>(&self, values: &[T]) -> Vec<T> {
        self.places.iter().map(|p| values[p.last()]).collect()
    }

    /// The mean over each step, from its sample to the next, of values that hold from their stamp on, where the log is finer than the step; the value at its
    /// begin where the log is not. The last value holds on.
    ///
    /// A step has one command. In a finer log it changes inside steps: taken at their begin, it would come half a step late on average.
    pub(crate) fn averaged<const N: usize>(&self, values: &[[f64; N]]) -> Vec<[f64; N]> {
        let Some(stamps_s) = &self.stamps_s else { return self.held(values) };
        let mean = |(place, from_s): (&Place, &f64)| {
            let (first, to_s) = (place.last(), from_s + self.dt_s);
            let held = values[first];
            let (mut total_s, mut more) = (0.0, [0.0; N]);
            // Stamps closer to the end of the step than this differ from it by rounding.
            let inside = |at: &usize| stamps_s[*at] < to_s - 1e-6 * self.dt_s;
            for at in (first..stamps_s.len()).take_while(inside) {
                let until_s = stamps_s.get(at + 1).map_or(to_s, |next_s| next_s.min(to_s));
                let lasts_s = until_s - stamps_s[at].max(*from_s);
                total_s += lasts_s;
                // Differences, so that what stays keeps every bit.
                for (sum, (value, held)) in more.iter_mut().zip(values[at].iter().zip(held)) {
                    *sum += lasts_s * (value - held);
                }
            }
            if total_s > 0.0 { core::array::from_fn(|i| held[i] + more[i] / total_s) } else { held }
        };
        self.places.iter().zip(&self.time_s).map(mean).collect()
    }

    fn blend<const N: usize>(&self, values: &[[f64; N]], f: impl Fn(f64, f64, f64) -> f64) -> Vec<[f64; N]> {
        let at = |p: &Place| {
            if p.share == 0.0 {
                return values[p.at];
            }
            let (a, b) = (values[p.at], values[p.at + 1]);
            core::array::from_fn(|i| f(a[i], b[i], p.share))
        };
        self.places.iter().map(at).collect()
    }
}

/// Every r-th sample, when the log is uniform and its step divides `dt_s`.
fn pick(time_s: &[f64], dt_s: f64, median_s: f64) -> Option<Grid> {
    let ratio = (dt_s / median_s).round();
    if ratio < 1.0 {
        return None;
    }
    let step = dt_s / ratio;
    // A tenth of a step forgives time stamps in single precision and small jitter.
    let uniform = time_s.iter().enumerate().all(|(k, t)| (t - time_s[0] - k as f64 * step).abs() <= 0.1 * step);
    if !uniform {
        return None;
    }
    let places: Vec<Place> = (0..time_s.len()).step_by(ratio as usize).map(|at| Place { at, share: 0.0 }).collect();
    let begin_s = time_s[0];
    let stamps_s = (ratio > 1.0).then(|| (0..time_s.len()).map(|k| begin_s + k as f64 * step).collect());
    let time_s = (0..places.len()).map(|k| begin_s + k as f64 * dt_s).collect();
    Some(Grid { time_s, places, dt_s, stamps_s })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn clock(n: usize, step: f64) -> Vec<f64> {
        (0..n).map(|k| k as f64 * step).collect()
    }

    #[test]
    fn analytic_dividing_step_picks_samples() {
        let grid = Grid::new(&clock(40, 0.05), 0.1).unwrap();
        assert_eq!(grid.time_s.len(), 20);
        assert!((grid.time_s[19] - 1.9).abs() < 1e-12);
        let values: Vec<[f64; 1]> = (0..40).map(|k| [f64::from(k)]).collect();
        assert_eq!(grid.linear(&values)[19], [38.0]);
        assert_eq!(grid.held(&values)[3], [6.0]);
        let single = Grid::new(&clock(251, 0.1).iter().map(|t| f64::from(*t as f32)).collect::<Vec<_>>(), 0.1).unwrap();
        assert_eq!(single.time_s.len(), 251, "time stamps in single precision are no jitter");
    }

    #[test]
    fn analytic_lines_and_angles_survive_interpolation() {
        // 15 Hz to 10 Hz: a line stays a line, a turn through pi does not jump, commands are held.
        let time = clock(31, 1.0 / 15.0);
        let grid = Grid::new(&time, 0.1).unwrap();
        assert_eq!(grid.time_s.len(), 21);
        let line: Vec<[f64; 1]> = time.iter().map(|t| [3.0 * t - 1.0]).collect();
        for (t, v) in grid.time_s.iter().zip(grid.linear(&line)) {
            assert!((v[0] - (3.0 * t - 1.0)).abs() < 1e-12);
        }
        let turn: Vec<[f64; 1]> = time.iter().map(|t| [wrap_angle(3.0 + t)]).collect();
        for (t, v) in grid.time_s.iter().zip(grid.angles(&turn)) {
            assert!(wrap_angle(v[0] - 3.0 - t).abs() < 1e-12 && v[0].abs() <= std::f64::consts::PI);
        }
        let held = grid.held(&time);
        for (t, h) in grid.time_s.iter().zip(held) {
            assert!(h <= t + 1e-9 && t - h < 1.0 / 15.0 + 1e-9, "{h} held at {t}");
        }
    }

    #[test]
    fn analytic_commands_of_a_finer_log_are_averaged_over_each_step() {
        // Goal: a change inside a step counts from where it is. Method: a command that steps from 1 to 3 at 1.04 s, in logs of 10 to 100 Hz, on the grid of
        // the steps and off it; the integral over the drive is that of the command, to the part of a stamp that the log itself is late.
        for log_hz in [15.0, 20.0, 25.0, 50.0, 100.0, 130.0] {
            let time = clock((2.0 * log_hz) as usize + 1, 1.0 / log_hz);
            let values: Vec<[f64; 2]> = time.iter().map(|t| [if *t < 1.04 { 1.0 } else { 3.0 }, 0.7]).collect();
            let changed = time.iter().copied().find(|t| *t >= 1.04).unwrap();
            let grid = Grid::new(&time, 0.1).unwrap();
            for (t, [value, constant]) in grid.time_s.iter().zip(grid.averaged(&values)) {
                let expected = 1.0 + 2.0 * ((t + 0.1 - changed) / 0.1).clamp(0.0, 1.0);
                assert!((value - expected).abs() < 1e-5, "{log_hz} Hz at {t}: {value} for {expected}");
                assert!(constant == 0.7, "what stays keeps every bit");
            }
        }
        // Logs at the step of the model, in single precision and with jitter too, and coarser ones keep every bit.
        let single: Vec<f64> = clock(41, 0.1).iter().map(|t| f64::from(*t as f32)).collect();
        let jitter: Vec<f64> = (0..41).map(|k| 0.1 * f64::from(k) + if k % 3 == 1 { 0.02 } else { 0.0 }).collect();
        for time in [clock(41, 0.1), single, jitter, clock(41, 0.125), clock(9, 0.5)] {
            let values: Vec<[f64; 1]> = (0..time.len()).map(|k| [(0.7 * k as f64).sin()]).collect();
            let grid = Grid::new(&time, 0.1).unwrap();
            assert_eq!(grid.averaged(&values), grid.held(&values));
        }
    }

    #[test]
    fn analytic_gaps_are_refused_and_short_logs_work() {
        let mut time = clock(20, 0.1);
        time.extend((0..20).map(|k| 4.0 + 0.1 * f64::from(k)));
        assert_eq!(Grid::new(&time, 0.1).unwrap_err().0, 19);
        assert_eq!(Grid::new(&[], 0.1).unwrap().time_s.len(), 0);
        assert_eq!(Grid::new(&[7.0], 0.1).unwrap().time_s, [7.0]);
        assert_eq!(Grid::new(&[0.0, 0.5], 0.1).unwrap().time_s.len(), 6);
        assert_eq!(Grid::new(&clock(30, 10.0), 10.0).unwrap().time_s.len(), 30, "the longest step there is");
        let (at, reason) = Grid::new(&clock(4000, 7.0), 0.001).unwrap_err();
        assert!(at == 0 && reason.contains("27993001 samples"), "{reason}");
    }
}
