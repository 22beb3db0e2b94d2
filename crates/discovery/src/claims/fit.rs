//! The size of effects: generalised least squares on the deviations of a group of drives, by Gauss-Newton through the physics, jointly with the soil of
//! each drive.

use nalgebra::{DMatrix, DVector};
use nesam_physics::SoilCorrection;
use rayon::prelude::*;

use crate::candidates::{Candidate, Free};
use crate::observe::channels::Row;
use crate::observe::condense::{Condensed, Signatures, difference};
use crate::observe::metric::Metric;
use crate::observe::{Bench, ObservedDrive};
use nesam_physics::effects::ScheduledEffect;

const ITERATIONS: usize = 5;
/// Steps below this share of a standard deviation end the iteration.
const CONVERGED: f64 = 0.05;
/// How often a step that explains less is halved.
const HALVINGS: usize = 4;
/// Rise of the squared distance from which a step explains less.
const RISE: f64 = 0.5;

/// A drive with everything that does not depend on which drives it is judged with.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// The drive.
    pub drive: ObservedDrive,
    /// How columns shift its deviations.
    pub signatures: Signatures,
    /// What it says.
    pub condensed: Condensed,
}

/// A hypothesis with the time from which it acts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Term {
    /// The hypothesis.
    pub candidate: Candidate,
    /// When it begins, s; 0 = always there.
    pub onset_s: f64,
}

/// Fitted effects.
#[derive(Clone, Debug)]
pub struct Fit {
    /// What was fitted.
    pub terms: Vec<Term>,
    /// Values of the free parameters of each term.
    pub values: Vec<Vec<f64>>,
    /// Posterior covariance of all values, term by term, in the metric.
    pub covariance: DMatrix<f64>,
    /// Whether the physical range holds a parameter.
    pub held: Vec<Vec<bool>>,
    /// Values that one step gives when each drive in turn is left out.
    pub jackknife: Vec<Vec<Vec<f64>>>,
}

impl Fit {
    /// The effects with their fitted parameters.
    pub fn effects(&self) -> Vec<ScheduledEffect> {
        timed(&self.terms, &self.values)
    }

    /// The effects that one step without a drive gives.
    pub fn effects_without(&self, drive: usize) -> Vec<ScheduledEffect> {
        let values = self.jackknife.get(drive).unwrap_or(&self.values);
        let mut values = values.clone();
        for (term, values) in self.terms.iter().zip(&mut values) {
            term.candidate.clamp(values);
        }
        timed(&self.terms, &values)
    }

    /// Posterior standard deviation of what has these derivatives in the values of a term.
    pub fn sd(&self, term: usize, derivatives: &[(usize, f64)]) -> f64 {
        let first: usize = self.values[..term].iter().map(Vec::len).sum();
        let pairs = derivatives.iter().flat_map(|a| derivatives.iter().map(move |b| (a, b)));
        pairs.map(|(a, b)| a.1 * b.1 * self.covariance[(first + a.0, first + b.0)]).sum::<f64>().max(0.0).sqrt()
    }

    /// Standard deviation over drives of what follows from the values of a term, by the jackknife; `None` with fewer than three drives.
    pub fn jackknife_sd(&self, term: usize, of: impl Fn(&[f64]) -> f64) -> Option<f64> {
        let n = self.jackknife.len();
        if n < 3 {
            return None;
        }
        let left_out: Vec<f64> = self.jackknife.iter().map(|values| of(&values[term])).collect();
        let mean = left_out.iter().sum::<f64>() / n as f64;
        let square = left_out.iter().map(|v| (v - mean).powi(2)).sum::<f64>();
        Some((square * (n - 1) as f64 / n as f64).sqrt())
    }
}

fn timed(terms: &[Term], values: &[Vec<f64>]) -> Vec<ScheduledEffect> {
    terms.iter().zip(values).map(|(t, v)| ScheduledEffect { effect: t.candidate.effect(v), onset_s: t.onset_s }).collect()
}

/// What a fit begins from and is drawn to.
#[derive(Clone, Debug)]
pub struct Start {
    /// Values of the free parameters of each term.
    pub values: Vec<Vec<f64>>,
    /// Share of each parameter that drives without an effect show, in the unit of the parameter.
    pub offset: Vec<f64>,
    /// Weight of the priors, which are those of a change of a known vehicle at 1.
    pub prior: f64,
}

/// Fits terms.
pub fn fit(bench: &Bench<'_>, metric: &Metric, drives: &[&Prepared], terms: &[Term], start: Start) -> Fit {
    let Start { mut values, offset, prior } = start;
    let mut held = clamp(terms, &mut values);
    let all: Vec<usize> = (0..drives.len()).collect();
    let rows_at = |values: &[Vec<f64>]| -> Vec<Vec<Row>> {
        let effects = timed(terms, values);
        drives.par_iter().map(|prepared| prepared.drive.deviations(bench, &effects, &SoilCorrection::NONE)).collect()
    };
    let mut at = linearised(bench, metric, drives, terms, &values, &rows_at(&values));
    let mut covariance = DMatrix::zeros(0, 0);
    for _ in 0..ITERATIONS {
        let (mut moved, spread) = step(terms, &at, &all, &values, prior, &vec![0.0; offset.len()]);
        covariance = spread;
        let (before, most) = (flat(&values), at.iter().map(|d| d.square).sum::<f64>() + from_priors(terms, &values, prior) + RISE);
        // Far from a tangent a step may lead past what is sought.
        let next = (0..=HALVINGS).find_map(|_| {
            let mut values = shaped(terms, &moved);
            let held = clamp(terms, &mut values);
            let rows = rows_at(&values);
            moved = moved.iter().zip(&before).map(|(to, from)| 0.5 * (to + from)).collect();
            (square(metric, drives, &rows) + from_priors(terms, &values, prior) <= most).then_some((values, held, rows))
        });
        let Some((to, ends, rows)) = next else { break };
        (values, held) = (to, ends);
        let largest = flat(&values)
            .iter()
            .zip(&before)
            .enumerate()
            .map(|(i, (a, b))| (a - b).abs() / covariance[(i, i)].sqrt().max(1e-12))
            .fold(0.0, f64::max);
        at = linearised(bench, metric, drives, terms, &values, &rows);
        if largest < CONVERGED {
            break;
        }
    }
    let others = |d: usize| -> Vec<usize> { all.iter().copied().filter(|i| *i != d).collect() };
    let jackknife = if all.len() > 1 {
        all.iter().map(|d| shaped(terms, &step(terms, &at, &others(*d), &values, prior, &offset).0)).collect()
    } else {
        Vec::new()
    };
    let centred: Vec<f64> = flat(&values).iter().zip(&offset).map(|(v, o)| v - o).collect();
    let mut values = shaped(terms, &centred);
    for (held, now) in held.iter_mut().flatten().zip(clamp(terms, &mut values).into_iter().flatten()) {
        *held |= now;
    }
    Fit { terms: terms.to_vec(), values, covariance, held, jackknife }
}

/// Score and information of each drive in the free parameters, soil profiled out, where its deviations are `rows`.
fn linearised(
    bench: &Bench<'_>,
    metric: &Metric,
    drives: &[&Prepared],
    terms: &[Term],
    values: &[Vec<f64>],
    rows: &[Vec<Row>],
) -> Vec<Condensed> {
    let of = |(prepared, rows): (&&Prepared, &Vec<Row>)| {
        let columns = parameter_columns(bench, prepared, terms, values);
        prepared.signatures.profiled(metric, rows, &columns)
    };
    drives.par_iter().zip(rows).map(of).collect()
}

/// Squared distance of all drives in the metric, soil profiled out, where their deviations are `rows`.
fn square(metric: &Metric, drives: &[&Prepared], rows: &[Vec<Row>]) -> f64 {
    let of = |(prepared, rows): (&&Prepared, &Vec<Row>)| prepared.signatures.profiled(metric, rows, &[]).square;
    drives.par_iter().zip(rows).map(of).collect::<Vec<f64>>().iter().sum()
}

/// How the deviations of a drive shift with each free parameter of the terms.
pub fn parameter_columns(bench: &Bench<'_>, prepared: &Prepared, terms: &[Term], values: &[Vec<f64>]) -> Vec<Vec<Row>> {
    let at = |values: &[Vec<f64>]| prepared.drive.deviations(bench, &timed(terms, values), &SoilCorrection::NONE);
    let mut columns = Vec::new();
    for (t, term) in terms.iter().enumerate() {
        for i in 0..term.candidate.free().len() {
            let step = term.candidate.step(i, bench.vehicle.mass_kg);
            let side = |sign: f64| {
                let mut moved = values.to_vec();
                moved[t][i] += sign * step;
                at(&moved)
            };
            // A parameter that cannot be negative, such as a delay, is differentiated forward at zero.
            let low = term.candidate.range(i)[0];
            let (less, factor) = if values[t][i] - step < low { (at(values), 1.0 / step) } else { (side(-1.0), 0.5 / step) };
            columns.push(difference(&less, &side(1.0), factor));
        }
    }
    columns
}

/// A step from `values`, with priors of weight `prior`, on the drives in `kept`: where it leads, less `offset`, and its covariance in the metric.
fn step(terms: &[Term], at: &[Condensed], kept: &[usize], values: &[Vec<f64>], prior: f64, offset: &[f64]) -> (Vec<f64>, DMatrix<f64>) {
    let values = flat(values);
    let size = values.len();
    let (mut information, mut score) = (DMatrix::zeros(size, size), DVector::zeros(size));
    for d in kept {
        information += &at[*d].information;
        score += &at[*d].score;
    }
    for (i, f) in terms.iter().flat_map(|t| t.candidate.free()).enumerate() {
        information[(i, i)] += prior * f.sd.powi(-2);
        score[i] += (f.mean - values[i]) * prior * f.sd.powi(-2);
    }
    let covariance = information.cholesky().map_or_else(|| DMatrix::zeros(size, size), |c| c.inverse());
    let moved = &covariance * score;
    (values.iter().zip(moved.iter()).zip(offset).map(|((v, m), o)| v + m - o).collect(), covariance)
}

/// Squared distance of values from priors of this weight.
fn from_priors(terms: &[Term], values: &[Vec<f64>], prior: f64) -> f64 {
    let of = |(f, value): (&Free, f64)| prior * ((value - f.mean) / f.sd).powi(2);
    terms.iter().flat_map(|t| t.candidate.free()).zip(flat(values)).map(of).sum()
}

fn clamp(terms: &[Term], values: &mut [Vec<f64>]) -> Vec<Vec<bool>> {
    terms.iter().zip(values).map(|(term, values)| term.candidate.clamp(values)).collect()
}

fn flat(values: &[Vec<f64>]) -> Vec<f64> {
    values.iter().flatten().copied().collect()
}

fn shaped(terms: &[Term], flat: &[f64]) -> Vec<Vec<f64>> {
    let mut rest = flat;
    terms
        .iter()
        .map(|t| {
            let (own, others) = rest.split_at(t.candidate.free().len());
            rest = others;
            own.to_vec()
        })
        .collect()
}
