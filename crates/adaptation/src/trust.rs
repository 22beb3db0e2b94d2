//! Beyond Algorithm 1: how large the errors of this drive are, and whether what was learned is worth using.

use std::collections::VecDeque;

use nalgebra::SVector;
use nesam_physics::SOIL_DIM;

/// Buffers between a correction and the buffer that judges it: predictions reach about three buffers ahead, onto ground that taught nothing yet.
const LEAD: usize = 2;
/// What one buffer may say for or against a correction, in units of log odds; a wild buffer says no more.
const VOTE_MAX: f64 = 2.0;
/// NIS over its degrees of freedom beyond which a buffer says no more of the scale.
const RATIO_MAX: f64 = 10.0;
/// Bounds of the scale of R_B.
const SCALE: (f64, f64) = (0.5, 30.0);

type SoilVector = SVector<f64, SOIL_DIM>;

/// Scale of R_B on this drive. R_B comes from ground that the model was trained for; elsewhere the model errs more, and a filter that does not know takes
/// the rest for soil. Covariance matching: the scale follows the mean of NIS over its degrees of freedom. Each NIS is judged with the scale of the
/// buffers before it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct NoiseScale {
    value: f64,
    memory: f64,
}

impl NoiseScale {
    /// `memory` in buffers, 0 = always 1.
    pub(crate) fn new(memory: f64) -> Self {
        Self { value: 1.0, memory }
    }

    pub(crate) fn value(&self) -> f64 {
        self.value
    }

    /// Puts the scale where a snapshot had it.
    pub(crate) fn restore(&mut self, value: f64) {
        self.value = value.clamp(SCALE.0, SCALE.1);
    }

    pub(crate) fn observe(&mut self, nis_over_dof: f64) {
        if self.memory > 0.0 {
            self.value = (self.value * (1.0 + (nis_over_dof.min(RATIO_MAX) - 1.0) / self.memory)).clamp(SCALE.0, SCALE.1);
        }
    }
}

/// Whether the ground is what it looks like. Two models are weighed: the soil prior as it is and the prior with the correction. Each buffer
/// compares what both predicted for it, with the correction of [`LEAD`] buffers before, so that only corrections that carry on count. The service
/// predicts with the average of the two, w Δθ: shrinkage towards the prior that does no harm where the prior is right.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Trust {
    memory: f64,
    prior_log_odds: f64,
    log_odds: f64,
    corrections: VecDeque<SoilVector>,
}

impl Trust {
    /// `memory` in buffers, 0 = the correction is always trusted.
    pub(crate) fn new(memory: f64, prior_log_odds: f64) -> Self {
        Self { memory, prior_log_odds, log_odds: prior_log_odds, corrections: VecDeque::new() }
    }

    /// Weight w of the correction, 0 to 1.
    pub(crate) fn weight(&self) -> f64 {
        if self.memory > 0.0 { 1.0 / (1.0 + (-self.log_odds).exp()) } else { 1.0 }
    }

    /// The correction that the present buffer judges; `None` as long as there is none that old.
    pub(crate) fn candidate(&self) -> Option<SoilVector> {
        if self.memory > 0.0 && self.corrections.len() > LEAD { self.corrections.front().copied() } else { None }
    }

    /// Takes the log likelihood of a buffer with [`Trust::candidate`] over that without it.
    pub(crate) fn vote(&mut self, log_ratio: f64) {
        if log_ratio.is_finite() {
            let kept = 1.0 - 1.0 / self.memory.max(1.0);
            self.log_odds = self.prior_log_odds + kept * (self.log_odds - self.prior_log_odds) + log_ratio.clamp(-VOTE_MAX, VOTE_MAX);
        }
    }

    /// Log odds and the corrections that later buffers judge, oldest first.
    pub(crate) fn state(&self) -> (f64, &VecDeque<SoilVector>) {
        (self.log_odds, &self.corrections)
    }

    /// Puts both where a snapshot had them.
    pub(crate) fn restore(&mut self, log_odds: f64, corrections: VecDeque<SoilVector>) {
        (self.log_odds, self.corrections) = (log_odds, corrections);
    }

    /// Remembers the correction after a buffer.
    pub(crate) fn remember(&mut self, correction: SoilVector) {
        if self.memory > 0.0 {
            self.corrections.push_back(correction);
            while self.corrections.len() > LEAD + 1 {
                self.corrections.pop_front();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_weight_of_even_odds_and_of_an_opinion_that_is_forgotten() {
        let mut trust = Trust::new(10.0, 0.0);
        assert_eq!((trust.weight(), Trust::new(0.0, -5.0).weight()), (0.5, 1.0));
        trust.vote(1.0);
        assert!((trust.weight() - 1.0 / (1.0 + (-1.0_f64).exp())).abs() < 1e-15);
        trust.vote(0.0);
        assert!((trust.log_odds - 0.9).abs() < 1e-15, "a tenth is forgotten");
        trust.vote(-100.0);
        assert!((trust.log_odds - (0.81 - VOTE_MAX)).abs() < 1e-15, "one buffer says no more than that");
        trust.vote(f64::NAN);
        assert!((trust.log_odds - (0.81 - VOTE_MAX)).abs() < 1e-15);
    }

    #[test]
    fn analytic_a_correction_is_judged_two_buffers_later() {
        let mut trust = Trust::new(10.0, 0.0);
        for k in 1..=4 {
            assert_eq!(trust.candidate().map(|c| c[0]), (k > 3).then_some(1.0), "{k}");
            trust.remember(SoilVector::repeat(f64::from(k)));
        }
    }

    #[test]
    fn analytic_scale_follows_the_mean_of_the_ratio() {
        let mut scale = NoiseScale::new(5.0);
        for _ in 0..100 {
            scale.observe(4.0 / scale.value()); // errors twice as large as R_B says
        }
        assert!((scale.value() - 4.0).abs() < 1e-9);
        let mut off = NoiseScale::new(0.0);
        off.observe(4.0);
        assert_eq!(off.value(), 1.0);
    }
}
