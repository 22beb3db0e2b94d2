//! The size of an effect: generalised least squares on the mean statistics of a group of drives, by Gauss-Newton through the physics.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};
use nesam_physics::{SOIL_DIM, SoilCorrection, Vehicle};
use rayon::prelude::*;

use crate::candidates::Candidate;
use crate::channels::{RIM_AT, STEERING_AT};
use crate::expectation::{Expectation, mean};
use crate::features::{FEATURES, Prepared, SOIL_SD, Stepping};
use crate::observe::ObservedDrive;

const ITERATIONS: usize = 5;
/// Steps below this share of a posterior standard deviation end the iteration.
const CONVERGED: f64 = 0.05;

/// How wrong the predicted shift of a statistic may be, as a share of the observed shift (chosen): the angle of a measured road wheel follows from
/// the card, a rim under drag from the slope of traction, which is known to a factor.
fn disbelief(statistic: usize) -> f64 {
    match statistic {
        f if f < STEERING_AT => 0.1,
        STEERING_AT => 0.02,
        f if (RIM_AT..RIM_AT + 4).contains(&f) => 0.5,
        _ => 0.15,
    }
}

/// What a fit needs besides drives.
#[derive(Clone, Copy, Debug)]
pub struct Bench<'a> {
    /// Vehicle of the reference.
    pub vehicle: &'a Vehicle,
    /// Physics.
    pub stepping: Stepping,
}

/// A drive to fit.
pub type Member<'a> = (&'a ObservedDrive, &'a Prepared);

/// The weight of each statistic for one group of drives: the scatter of such groups without an effect, and how far predicted shifts are believed.
#[derive(Debug)]
pub struct Weighing<'a> {
    expectation: &'a Expectation,
    weight: Cholesky<f64, Dyn>,
    /// Squared distance of the group without an effect.
    pub misfit: f64,
}

/// A fitted hypothesis.
#[derive(Clone, Debug)]
pub struct Fit {
    candidate: Candidate,
    /// Values of the free parameters.
    pub values: Vec<f64>,
    /// Posterior standard deviations.
    pub sd: Vec<f64>,
    /// Values that one step gives when each drive in turn is left out.
    pub jackknife: Vec<Vec<f64>>,
    /// Whether the physical range holds a parameter.
    pub held: Vec<bool>,
    /// Squared distance that is left, prior included.
    pub misfit: f64,
    at: Linearised,
}

/// A soil correction common to all drives that explains them best without an effect.
#[derive(Clone, Copy, Debug)]
pub struct SoilFit {
    /// The correction.
    pub correction: SoilCorrection,
    /// Squared distance that is left, prior included.
    pub misfit: f64,
}

/// Statistics of each drive at the fitted values, and their derivatives.
#[derive(Clone, Debug)]
struct Linearised {
    statistics: Vec<DVector<f64>>,
    slopes: Vec<DMatrix<f64>>,
}

/// A Gauss-Newton step: where it leads, its covariance, and the squared distance that the linearisation promises there.
struct Step {
    values: Vec<f64>,
    covariance: DMatrix<f64>,
    misfit: f64,
}

impl<'a> Weighing<'a> {
    /// For the drives whose statistics are given.
    pub fn new<'s>(expectation: &'a Expectation, group: impl ExactSizeIterator<Item = &'s DVector<f64>>) -> Self {
        let observed = expectation.deviation(&mean(group));
        let doubt = DVector::from_fn(observed.len(), |i, _| (disbelief(expectation.used()[i]) * observed[i]).powi(2));
        let weight = expectation.weight(Some(&doubt));
        let misfit = observed.dot(&weight.solve(&observed));
        Self { expectation, weight, misfit }
    }

    fn distance(&self, statistics: &DVector<f64>) -> f64 {
        let residual = self.expectation.deviation(statistics);
        residual.dot(&self.weight.solve(&residual))
    }

    /// One step from `values`, on the drives in `kept`; `priors` are mean and standard deviation of each value.
    fn step(&self, at: &Linearised, kept: &[usize], values: &[f64], priors: &[[f64; 2]]) -> Step {
        let residual = self.expectation.deviation(&mean(kept.iter().map(|&d| &at.statistics[d])));
        let all = DMatrix::zeros(FEATURES, values.len());
        let slope = kept.iter().fold(all, |sum, &d| sum + &at.slopes[d]) / kept.len().max(1) as f64;
        let slope = slope.select_rows(self.expectation.used());
        let mut information = slope.tr_mul(&self.weight.solve(&slope));
        let mut score = -slope.tr_mul(&self.weight.solve(&residual));
        for (i, [centre, sd]) in priors.iter().enumerate() {
            information[(i, i)] += sd.powi(-2);
            score[i] += (centre - values[i]) * sd.powi(-2);
        }
        let covariance = information.cholesky().map_or_else(|| DMatrix::zeros(values.len(), values.len()), |c| c.inverse());
        let moved = &covariance * score;
        let left = residual + slope * &moved;
        let values: Vec<f64> = values.iter().zip(moved.iter()).map(|(v, m)| v + m).collect();
        Step { misfit: left.dot(&self.weight.solve(&left)) + prior_misfit(priors, &values), values, covariance }
    }

    /// The best soil: one step with the derivatives at the nominal soil, which is where the prior keeps it.
    pub fn fit_soil(&self, members: &[Member<'_>]) -> SoilFit {
        let at = Linearised {
            statistics: members.iter().map(|(_, p)| p.statistics.clone()).collect(),
            slopes: members.iter().map(|(_, p)| -p.soil.transpose()).collect(),
        };
        let kept: Vec<usize> = (0..members.len()).collect();
        let step = self.step(&at, &kept, &[0.0; SOIL_DIM], &[[0.0, 1.0]; SOIL_DIM]);
        let mut correction = SoilCorrection::NONE;
        correction.delta = core::array::from_fn(|i| SOIL_SD[i] * step.values[i]);
        SoilFit { correction, misfit: step.misfit }
    }

    /// The size of a hypothesis by Gauss-Newton from a start.
    pub fn fit(&self, bench: &Bench<'_>, members: &[Member<'_>], candidate: Candidate, start: Vec<f64>) -> Fit {
        let priors = priors(candidate);
        let all: Vec<usize> = (0..members.len()).collect();
        let mut values = start;
        let mut held = candidate.clamp(&mut values);
        let mut at = linearised(bench, members, candidate, &values);
        let mut misfit = self.distance(&mean(at.statistics.iter())) + prior_misfit(&priors, &values);
        for _ in 0..ITERATIONS {
            let step = self.step(&at, &all, &values, &priors);
            let mut share = 1.0;
            let mut moved = 0.0f64;
            while share > 0.1 && moved == 0.0 {
                let mut trial: Vec<f64> = values.iter().zip(&step.values).map(|(v, t)| v + share * (t - v)).collect();
                let trial_held = candidate.clamp(&mut trial);
                let statistics: Vec<DVector<f64>> = members.par_iter().map(|m| statistics(bench, *m, candidate, &trial)).collect();
                let trial_misfit = self.distance(&mean(statistics.iter())) + prior_misfit(&priors, &trial);
                if trial_misfit < misfit {
                    let sd = |i: usize| step.covariance[(i, i)].sqrt().max(1e-12);
                    moved = (0..trial.len()).map(|i| (trial[i] - values[i]).abs() / sd(i)).fold(1e-9, f64::max);
                    (values, held, misfit) = (trial, trial_held, trial_misfit);
                    at.statistics = statistics;
                }
                share *= 0.4;
            }
            if moved < CONVERGED {
                break;
            }
            at = linearised(bench, members, candidate, &values);
        }
        let covariance = self.step(&at, &all, &values, &priors).covariance;
        let others = |d: &usize| -> Vec<usize> { all.iter().copied().filter(|i| i != d).collect() };
        let jackknife =
            if all.len() > 1 { all.iter().map(|d| self.step(&at, &others(d), &values, &priors).values).collect() } else { Vec::new() };
        let sd = (0..values.len()).map(|i| covariance[(i, i)].sqrt()).collect();
        Fit { candidate, values, sd, jackknife, held, misfit, at }
    }

    /// Values and squared distance of a fitted hypothesis on a part of its drives: one step from the whole fit's linearisation.
    pub fn refit(&self, fit: &Fit, kept: &[usize]) -> (Vec<f64>, f64) {
        let mut step = self.step(&fit.at, kept, &fit.values, &priors(fit.candidate));
        fit.candidate.clamp(&mut step.values);
        (step.values, step.misfit)
    }
}

fn priors(candidate: Candidate) -> Vec<[f64; 2]> {
    candidate.free().iter().map(|f| [f.mean, f.sd]).collect()
}

fn prior_misfit(priors: &[[f64; 2]], values: &[f64]) -> f64 {
    priors.iter().zip(values).map(|([centre, sd], v)| ((v - centre) / sd).powi(2)).sum()
}

fn statistics(bench: &Bench<'_>, (drive, prepared): Member<'_>, candidate: Candidate, values: &[f64]) -> DVector<f64> {
    let vehicle = bench.vehicle.with_effects(&[candidate.effect(values)]);
    prepared.of(&drive.deviations(&bench.stepping.model(&vehicle), &SoilCorrection::NONE))
}

fn linearised(bench: &Bench<'_>, members: &[Member<'_>], candidate: Candidate, values: &[f64]) -> Linearised {
    let free = candidate.free();
    let (statistics, slopes) = members
        .par_iter()
        .map(|member| {
            let mut slope = DMatrix::zeros(FEATURES, free.len());
            for (i, f) in free.iter().enumerate() {
                let at = |sign: f64| {
                    let mut moved = values.to_vec();
                    moved[i] += sign * f.step;
                    statistics(bench, *member, candidate, &moved)
                };
                slope.set_column(i, &((at(1.0) - at(-1.0)) / (2.0 * f.step)));
            }
            (statistics(bench, *member, candidate, values), slope)
        })
        .unzip();
    Linearised { statistics, slopes }
}

impl Fit {
    /// Half width of the 95 % interval of a value: the wider of the posterior's and the jackknife's over drives, both with Student's t.
    pub fn half_width(&self, i: usize, inflation: f64) -> f64 {
        const T_975: [f64; 10] = [12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23];
        /// Student's t for the thirty drives behind a covariance.
        const T_NULLS: f64 = 2.05;
        let posterior = T_NULLS * self.sd[i] * inflation;
        let n = self.jackknife.len();
        if n < 3 {
            return posterior;
        }
        let mean = self.jackknife.iter().map(|v| v[i]).sum::<f64>() / n as f64;
        let square = self.jackknife.iter().map(|v| (v[i] - mean).powi(2)).sum::<f64>();
        let t = T_975.get(n - 2).copied().unwrap_or(2.1);
        posterior.max(t * (square * (n - 1) as f64 / n as f64).sqrt())
    }
}
