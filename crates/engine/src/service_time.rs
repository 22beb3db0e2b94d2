//! How long a prediction takes, learned from those before it.

use crate::WhatIfSoils;
use crate::extras::SIGMA_POINTS;
use crate::query::PredictQuery;

/// Work of a prediction besides its steps, in sample-steps.
const FIXED_WORK: f64 = 256.0;
/// Work of a sample-step with Jacobians and with covariance, in sample-steps (`Limits::jacobian_samples_max`).
const JACOBIAN_WORK: f64 = 100.0;
const COVARIANCE_WORK: f64 = 33.0;
/// Work of a sample-step whose terrain is encoded for it alone (16 samples of 32 steps: 0.25 s, and 5 ms on the pose grid with the fixed work in it).
const EXACT_WORK: f64 = 70.0;
/// Shares of a new time in the estimate, when it is shorter and when it is longer than expected: what happens once, such as another program's turn, says nothing
/// of the next prediction.
const SHORTER: f64 = 0.5;
const LONGER: f64 = 0.1;
/// A longer time counts as this many times the expected one at most.
const OUTLIER: f64 = 4.0;

/// Expected time of a unit of work.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct ServiceTime {
    /// `None` before the first prediction.
    ns_per_work: Option<f64>,
}

/// Samples that the kernels compute at once: fewer of them are not faster.
const LANES: usize = 16;

/// Work of one sample of a prediction, in sample-steps.
fn sample_work(query: &PredictQuery) -> f64 {
    let extras = &query.extras;
    let soils = match &extras.soils {
        WhatIfSoils::Estimate => 1,
        WhatIfSoils::Added(soils) => soils.len(),
        WhatIfSoils::SigmaPoints => SIGMA_POINTS,
    };
    let exact = if extras.exact_terrain { EXACT_WORK } else { 0.0 };
    let derived =
        exact + if extras.jacobians { JACOBIAN_WORK } else { 0.0 } + if extras.covariance.is_some() { COVARIANCE_WORK } else { 0.0 };
    query.horizon as f64 * (soils as f64 + derived)
}

/// Work of the first `samples` of a prediction, in sample-steps.
pub(crate) fn work(query: &PredictQuery, samples: usize) -> f64 {
    fixed_work(query) + samples as f64 * sample_work(query)
}

/// Work that does not grow with the samples, in sample-steps.
fn fixed_work(query: &PredictQuery) -> f64 {
    FIXED_WORK + if query.extras.interpolation_deviation { EXACT_WORK * query.horizon as f64 } else { 0.0 }
}

/// Work of encoding nodes of terrain that nobody had asked for before, in sample-steps. It is done once, so nothing is expected of it: it only keeps the time
/// that it took out of that of the samples.
pub(crate) fn encoding_work(nodes: u64) -> f64 {
    EXACT_WORK * nodes as f64
}

impl ServiceTime {
    /// Expected time, ns; 0 while nothing is known.
    pub fn expected_ns(&self, work: f64) -> u64 {
        self.ns_per_work.map_or(0, |ns| (ns * work) as u64)
    }

    /// Samples of a prediction that are expected to be done within this time, between the fewest that it asks for and all.
    pub fn affordable(&self, query: &PredictQuery, time_ns: u64) -> usize {
        let Some(ns_per_work) = self.ns_per_work else { return query.samples };
        let samples = (time_ns as f64 / ns_per_work - fixed_work(query)) / sample_work(query);
        if samples >= query.samples as f64 {
            return query.samples;
        }
        (samples.max(0.0) as usize / LANES * LANES).clamp(query.least(), query.samples)
    }

    /// Learns from a prediction that took this long.
    pub fn learn(&mut self, work: f64, busy_ns: u64) {
        let seen = busy_ns as f64 / work;
        self.ns_per_work = Some(match self.ns_per_work {
            None => seen,
            Some(held) if seen < held => held + SHORTER * (seen - held),
            Some(held) => held + LONGER * (seen.min(OUTLIER * held) - held),
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::candidates::Candidates;

    fn of_shape(samples: usize, horizon: usize) -> PredictQuery {
        PredictQuery {
            session: "s".into(),
            start: None,
            instant: None,
            use_history: true,
            samples,
            samples_min: 0,
            horizon,
            controls: Candidates::Given(vec![0.0; 2 * samples * horizon]),
            cost: None,
            extras: Default::default(),
        }
    }

    #[test]
    fn analytic_as_many_samples_as_there_is_time_for() {
        let query = |samples_min| PredictQuery { samples_min, ..of_shape(1000, 10) };
        let mut time = ServiceTime::default();
        assert_eq!(time.affordable(&query(1), 1), 1000, "nothing is known yet");
        time.learn(1.0, 1000);
        // 1 µs for each of 256 + 10 n: n = (2256 - 256) / 10 in 2.256 ms, in whole lanes 192.
        assert_eq!(time.affordable(&query(1), 2_256_000), 192);
        assert_eq!(time.affordable(&query(500), 2_256_000), 500, "no fewer than are of use");
        assert_eq!(time.affordable(&query(7), 0), 7);
        assert_eq!((time.affordable(&query(1), u64::MAX), query(0).least()), (1000, 1000));
        let mut short = query(1);
        short.keep_first(48);
        assert_eq!((short.samples, short.controls.asked().1.len()), (48, 960));
    }

    #[test]
    fn analytic_the_estimate_follows_the_machine_and_forgets_the_cold_start() {
        let mut time = ServiceTime::default();
        assert_eq!(time.expected_ns(1e4), 0);
        // The first prediction touches memory for the first time: twenty times as long.
        time.learn(1e4, 20_000_000);
        for _ in 0..10 {
            time.learn(1e4, 1_000_000);
        }
        assert!((1_000_000..1_050_000).contains(&time.expected_ns(1e4)), "{}", time.expected_ns(1e4));
        // One that hangs says little, a machine that got slower is followed.
        time.learn(1e4, 1_000_000_000);
        assert!(time.expected_ns(1e4) < 1_400_000, "{}", time.expected_ns(1e4));
        for _ in 0..60 {
            time.learn(2e4, 4_000_000);
        }
        assert!((1_950_000..2_050_000).contains(&time.expected_ns(1e4)), "{}", time.expected_ns(1e4));
    }

    /// Found from outside: three samples on a new map take a second or two on two processors, nearly all of it for some hundred nodes of terrain; 2000 samples were then
    /// expected to take minutes.
    #[test]
    fn regress_a_small_question_about_new_terrain_does_not_make_large_ones_look_slow() {
        let (small, large) = (of_shape(3, 32), of_shape(2000, 32));
        let mut time = ServiceTime::default();
        time.learn(work(&small, 3) + encoding_work(800), 1_700_000_000);
        let expected_ns = time.expected_ns(work(&large, 2000));
        assert!(expected_ns < 3_000_000_000, "{expected_ns}");
    }
}
