//! From the clock of the log to the step of the model.

use std::f64::consts::PI;

use nesam_physics::wrap_angle;

/// Longest usual step of a log, s: the longest that drives are resampled to. What is longer counts milliseconds or the like.
pub const STEP_MAX_S: f64 = 10.0;
/// Samples of a drive at most: eleven days at 10 Hz. A longer one would take gigabytes.
const SAMPLES_MAX: f64 = 1e7;
/// A log is coarser than the model where the model's step is shorter than this share of the log's usual one: below 9 Hz at steps of 0.1 s, which `nesam import`
/// doubts (chosen).
const COARSER: f64 = 0.9;

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
    /// Time stamps of a log whose commands change inside steps; `None` of one that lies on the grid, and of a coarser one.
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
        let stamps_s = (COARSER * median_s <= dt_s).then(|| time_s.to_vec());
        Ok(Self { time_s: grid, places, dt_s, stamps_s })
    }

    /// Linear interpolation of N channels.
    pub(crate) fn linear<const N: usize>(&self, values: &[[f64; N]]) -> Vec<[f64; N]> {
        self.blend(values, |a, b, share| a + share * (b - a))
    }

    /// Interpolation of angles along the shorter way; results are wrapped into (-pi, pi]. What lies there keeps every bit where nothing is interpolated.
    pub(crate) fn angles<const N: usize>(&self, values: &[[f64; N]]) -> Vec<[f64; N]> {
        let mut angles = self.blend(values, |a, b, share| wrap_angle(a + share * wrap_angle(b - a)));
        let outside = angles.as_flattened_mut().iter_mut().filter(|angle| !(**angle > -PI && **angle <= PI));
        outside.for_each(|angle| *angle = wrap_angle(*angle));
        angles
    }

    /// The value of the last sample at or before each time (zero-order hold).
    pub(crate) fn held<T: Copy>(&self, values: &[T]) -> Vec<T> {
        self.places.iter().map(|p| values[p.last()]).collect()
    }

    /// The mean over each step, from its sample to the next, of values that hold from their stamp on; the value at its begin where the log lies on the grid or
    /// is coarser than the step. The last value holds on.
    ///
    /// A step has one command. In a log off the grid it changes inside steps: taken at their begin, it would come half a step late on average, and nearly a whole
    /// one where stamps come just after the grid.
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
            assert!(wrap_angle(v[0] - 3.0 - t).abs() < 1e-12 && v[0].abs() <= PI);
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
        // Logs on the grid, in single precision and with stamps within a tenth of a step of it too, and coarser ones keep every bit.
        let single: Vec<f64> = clock(41, 0.1).iter().map(|t| f64::from(*t as f32)).collect();
        let near: Vec<f64> = (0..41).map(|k| 0.1 * f64::from(k) + if k % 3 == 1 { 0.009 } else { 0.0 }).collect();
        for time in [clock(41, 0.1), single, near, clock(41, 0.125), clock(9, 0.5)] {
            let values: Vec<[f64; 1]> = (0..time.len()).map(|k| [(0.7 * k as f64).sin()]).collect();
            let grid = Grid::new(&time, 0.1).unwrap();
            assert_eq!(grid.averaged(&values), grid.held(&values));
        }
    }

    #[test]
    fn analytic_commands_near_the_step_of_the_model_come_in_time() {
        // Goal: a log near 10 Hz that is not on the grid does not shift its commands. Method: a ramp u(t) = t, told at each stamp and held: its mean over a
        // step is the stamp that holds, weighted by time. A clock that is 0.1 % fast or slow, stamps that tremble by 20 ms, and 9.7 Hz.
        let jitter: Vec<f64> = (0..201).map(|k| 0.1 * f64::from(k) + if k % 3 == 1 { 0.02 } else { 0.0 }).collect();
        for time in [clock(201, 0.1001), clock(201, 0.0999), jitter, clock(201, 1.0 / 9.7)] {
            let values: Vec<[f64; 1]> = time.iter().map(|t| [*t]).collect();
            let grid = Grid::new(&time, 0.1).unwrap();
            let held_at = |t: f64| time.iter().rev().find(|stamp| **stamp <= t + 1e-9).copied().unwrap();
            for (t, mean) in grid.time_s.iter().zip(grid.averaged(&values)) {
                // The midpoint rule over a thousand parts is off by less than one of them of the change.
                let expected = (0..1000).map(|i| held_at(t + 1e-4 * (f64::from(i) + 0.5))).sum::<f64>() / 1000.0;
                assert!((mean[0] - expected).abs() < 2e-4, "{} for {expected} at {t}", mean[0]);
            }
        }
    }

    #[test]
    fn analytic_angles_are_wrapped_on_the_grid_too() {
        // Goal: angles that count on, or lie in 0 to 2 pi, are the same on and off the grid; what lies in (-pi, pi] keeps every bit.
        let yaw = |t: f64| -2.0 + 0.7 * t;
        let inside = |t: f64| wrap_angle(yaw(t));
        for time in [clock(101, 0.1), clock(101, 0.103)] {
            let grid = Grid::new(&time, 0.1).unwrap();
            let told = |of: &dyn Fn(f64) -> f64| grid.angles(&time.iter().map(|t| [of(*t)]).collect::<Vec<_>>());
            for counted in [told(&yaw), told(&|t| yaw(t).rem_euclid(std::f64::consts::TAU)), told(&|t| yaw(t) + 40.0 * PI)] {
                for (wrapped, [angle]) in told(&inside).into_iter().zip(counted) {
                    assert!(angle > -PI && angle <= PI && wrap_angle(angle - wrapped[0]).abs() < 1e-12, "{angle} for {}", wrapped[0]);
                }
            }
        }
        let grid = Grid::new(&clock(101, 0.1), 0.1).unwrap();
        let values: Vec<[f64; 2]> = (0..101).map(|k| [0.03 * f64::from(k) - 1.5, if k == 7 { PI } else { -1e-300 }]).collect();
        assert_eq!(grid.angles(&values), values);
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
