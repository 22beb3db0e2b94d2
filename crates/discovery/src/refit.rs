//! Refit: the size of an effect by Gauss-Newton on the segments, jointly with the soil of each drive.

use nalgebra::{DMatrix, DVector};
use nesam_physics::effects::Effect;
use nesam_physics::{SOIL_DIM, SoilCorrection, Vehicle};
use rayon::prelude::*;

use crate::candidates::Candidate;
use crate::channels::Row;
use crate::normal::{Normal, Nuisance, SOIL_SD};
use crate::observe::ObservedDrive;
use crate::scan::{Prepared, Stepping, difference};
use crate::whitening::Whitening;

const ITERATIONS: usize = 8;
/// Steps below this share of a posterior standard deviation end the iteration.
const CONVERGED: f64 = 0.02;

/// What a refit needs besides drives.
#[derive(Clone, Copy, Debug)]
pub struct Bench<'a> {
    /// Whitening by the reference.
    pub whitening: &'a Whitening<'a>,
    /// Vehicle of the reference.
    pub vehicle: &'a Vehicle,
    /// Physics.
    pub stepping: Stepping,
}

/// A drive to fit.
pub type Member<'a> = (&'a ObservedDrive, &'a Prepared);

/// A fitted hypothesis.
#[derive(Clone, Debug)]
pub struct Fit {
    /// The hypothesis.
    pub candidate: Candidate,
    /// Values of the free parameters.
    pub values: Vec<f64>,
    /// Posterior standard deviations for deviations of unit variance.
    pub sd: Vec<f64>,
    /// Whether the physical range holds a parameter.
    pub held: Vec<bool>,
    /// Misfit that is left.
    pub misfit: f64,
    /// The same plus the prior's.
    pub penalised: f64,
}

impl Fit {
    /// The effect.
    pub fn effect(&self) -> Effect {
        self.candidate.effect(&self.values)
    }
}

/// What is varied.
#[derive(Clone, Copy, Debug)]
enum Unknown {
    Effect(Candidate),
    /// One soil correction common to all drives.
    Soil,
}

impl Unknown {
    /// Prior mean, prior sd and difference step of each value.
    fn priors(self) -> Vec<[f64; 3]> {
        match self {
            Self::Effect(c) => c.free().iter().map(|f| [f.mean, f.sd, f.step]).collect(),
            Self::Soil => SOIL_SD.iter().map(|sd| [0.0, *sd, 0.5 * sd]).collect(),
        }
    }

    fn rows(self, bench: &Bench<'_>, drive: &ObservedDrive, values: &[f64]) -> Vec<Row> {
        match self {
            Self::Effect(c) => {
                let vehicle = bench.vehicle.with_effects(&[c.effect(values)]);
                drive.deviations(&bench.stepping.model(&vehicle), &SoilCorrection::NONE)
            }
            Self::Soil => {
                let mut soil = SoilCorrection::NONE;
                soil.delta.copy_from_slice(values);
                drive.deviations(&bench.stepping.model(bench.vehicle), &soil)
            }
        }
    }

    fn nuisance(self, prepared: &Prepared) -> &Nuisance {
        match self {
            Self::Effect(_) => &prepared.nuisance,
            Self::Soil => &prepared.offsets,
        }
    }

    /// Misfit of all drives plus the prior's.
    fn objective(self, bench: &Bench<'_>, members: &[Member<'_>], values: &[f64]) -> f64 {
        let misfit: f64 = members
            .par_iter()
            .map(|(drive, prepared)| {
                let residual = bench.whitening.residual(drive, &self.rows(bench, drive, values));
                self.nuisance(prepared).normal(&residual, &[]).misfit
            })
            .collect::<Vec<f64>>()
            .iter()
            .sum();
        misfit + self.priors().iter().zip(values).map(|([mean, sd, _], v)| ((v - mean) / sd).powi(2)).sum::<f64>()
    }

    fn linearised(self, bench: &Bench<'_>, members: &[Member<'_>], values: &[f64]) -> Normal {
        let parts: Vec<Normal> = members
            .par_iter()
            .map(|(drive, prepared)| {
                let base = self.rows(bench, drive, values);
                let residual = bench.whitening.residual(drive, &base);
                let directions: Vec<DVector<f64>> = self
                    .priors()
                    .iter()
                    .enumerate()
                    .map(|(i, [_, _, step])| {
                        let at = |sign: f64| {
                            let mut moved = values.to_vec();
                            moved[i] += sign * step;
                            self.rows(bench, drive, &moved)
                        };
                        bench.whitening.direction(drive, &difference(&at(1.0), &at(-1.0), -0.5 / step), &base)
                    })
                    .collect();
                self.nuisance(prepared).normal(&residual, &directions)
            })
            .collect();
        Normal::sum(&parts).expect("a refit has drives; this is a bug")
    }

    /// Gauss-Newton with halved steps; returns values, posterior covariance and whether a range holds each value.
    fn solve(self, bench: &Bench<'_>, members: &[Member<'_>], start: Vec<f64>) -> (Vec<f64>, DMatrix<f64>, Vec<bool>) {
        let priors = self.priors();
        let clamp = |values: &mut Vec<f64>| match self {
            Self::Effect(c) => c.clamp(values),
            Self::Soil => vec![false; SOIL_DIM],
        };
        let mut values = start;
        let mut held = clamp(&mut values);
        let mut best = self.objective(bench, members, &values);
        let mut covariance = DMatrix::identity(priors.len(), priors.len());
        for _ in 0..ITERATIONS {
            let normal = self.linearised(bench, members, &values);
            let (mut information, mut score) = (normal.information, normal.score);
            for (i, [mean, sd, _]) in priors.iter().enumerate() {
                information[(i, i)] += sd.powi(-2);
                score[i] += (mean - values[i]) * sd.powi(-2);
            }
            let Some(inverse) = information.cholesky().map(|c| c.inverse()) else { break };
            covariance = inverse;
            let step = &covariance * score;
            let mut share = 1.0;
            let mut moved = 0.0f64;
            while share > 0.05 {
                let mut trial: Vec<f64> = values.iter().zip(step.iter()).map(|(v, s)| v + share * s).collect();
                let trial_held = clamp(&mut trial);
                let objective = self.objective(bench, members, &trial);
                if objective < best {
                    moved = (0..trial.len()).map(|i| (trial[i] - values[i]).abs() / covariance[(i, i)].sqrt()).fold(0.0, f64::max);
                    (values, held, best) = (trial, trial_held, objective);
                    break;
                }
                share *= 0.5;
            }
            if moved < CONVERGED {
                break;
            }
        }
        (values, covariance, held)
    }
}

/// Fits one hypothesis from a start; where a hypothesis has several starts, the best end counts.
pub fn fit_effect(bench: &Bench<'_>, members: &[Member<'_>], candidate: Candidate, start: Vec<f64>) -> Fit {
    let fits = candidate.starts(start).into_iter().map(|s| fit_from(bench, members, candidate, s));
    fits.min_by(|a, b| a.penalised.total_cmp(&b.penalised)).expect("a hypothesis has a start; this is a bug")
}

fn fit_from(bench: &Bench<'_>, members: &[Member<'_>], candidate: Candidate, start: Vec<f64>) -> Fit {
    let unknown = Unknown::Effect(candidate);
    let (values, covariance, held) = unknown.solve(bench, members, start);
    let prior: f64 = unknown.priors().iter().zip(&values).map(|([mean, sd, _], v)| ((v - mean) / sd).powi(2)).sum();
    let penalised = unknown.objective(bench, members, &values);
    let sd = (0..values.len()).map(|i| covariance[(i, i)].sqrt()).collect();
    Fit { candidate, values, sd, held, misfit: penalised - prior, penalised }
}

/// The soil correction, common to all drives, that explains them best without any effect.
pub fn fit_soil(bench: &Bench<'_>, members: &[Member<'_>]) -> SoilCorrection {
    let (values, _, _) = Unknown::Soil.solve(bench, members, vec![0.0; SOIL_DIM]);
    let mut soil = SoilCorrection::NONE;
    soil.delta.copy_from_slice(&values);
    soil
}

/// Misfit of a hypothesis at given values, with the prior's.
pub fn misfit_at(bench: &Bench<'_>, members: &[Member<'_>], candidate: Candidate, values: &[f64]) -> f64 {
    Unknown::Effect(candidate).objective(bench, members, values)
}
