//! How sure sizes are: steps of Gauss-Newton over all drives and without each.

use nalgebra::{DMatrix, DVector};
use nesam_physics::Vehicle;
use rayon::prelude::*;

use super::rims::{Log, Rims};
use super::sized::Sized;
use crate::claims::{MAGNITUDE_HALF_MAX, t_975};

/// How often a step is halved.
const HALVINGS: i32 = 4;

/// How sure sizes are.
#[derive(Debug)]
pub(super) struct Spread {
    /// Half widths of the 95 % intervals, by the scatter over drives.
    pub half_95: Vec<f64>,
    /// The sizes without each drive.
    pub without: Vec<Vec<f64>>,
}

impl Rims<'_> {
    /// What was found but for what has hardly a size, with how sure the sizes are.
    pub(super) fn sure(&self, mut found: Sized) -> (Sized, Spread) {
        loop {
            // What is best at the end of its range has no size.
            if let Some(held) = (0..found.terms.len()).find(|i| self.is_held(&found, *i)) {
                found = self.dropped(&found, held);
                continue;
            }
            let spread = self.spread(&found);
            let share = |i: usize| spread.half_95[i] / self.family[found.terms[i]].magnitude(0, found.values[i]).max(1e-12);
            let worst = (0..found.terms.len()).max_by(|a, b| share(*a).total_cmp(&share(*b)));
            match worst.filter(|i| share(*i) > MAGNITUDE_HALF_MAX) {
                Some(i) => found = self.dropped(&found, i),
                None => return (found, spread),
            }
        }
    }

    /// How sure sizes are: one step of Gauss-Newton from where all drives are explained best.
    fn spread(&self, found: &Sized) -> Spread {
        let count = found.terms.len();
        let said = self.linearised(found);
        let sum = said.iter().fold(DMatrix::zeros(count, count), |sum, (information, _)| sum + information);
        let Some(inverse) = sum.clone().cholesky().map(|c| c.inverse()) else {
            return Spread { half_95: vec![f64::INFINITY; count], without: vec![found.values.clone(); said.len()] };
        };
        let total = said.iter().fold(DVector::zeros(count), |sum, (_, score)| sum + score);
        let square = said.iter().fold(DMatrix::zeros(count, count), |sum, (_, score)| sum + score * score.transpose());
        let covariance = &inverse * square * &inverse;
        let values = DVector::from_column_slice(&found.values);
        let without = said
            .iter()
            .map(|(information, score)| {
                let rest = (&sum - information).cholesky().map_or_else(|| DVector::zeros(count), |c| c.solve(&(&total - score)));
                let mut moved: Vec<f64> = (&values + rest - &inverse * &total).iter().copied().collect();
                for (i, term) in found.terms.iter().enumerate() {
                    self.family[*term].clamp(&mut moved[i..=i]);
                }
                moved
            })
            .collect();
        let t = t_975(self.logs.iter().filter(|log| log.rims_m_s.len() > 1).count());
        Spread { half_95: (0..count).map(|i| t * covariance[(i, i)].sqrt()).collect(), without }
    }

    /// A step of Gauss-Newton towards what explains all drives best, halved until it leads there; `None` where it does not.
    pub(super) fn stepped(&self, found: &Sized) -> Option<Sized> {
        let count = found.terms.len();
        let zero = || (DMatrix::zeros(count, count), DVector::zeros(count));
        let (information, score) = self.linearised(found).into_iter().fold(zero(), |sum, own| (sum.0 + own.0, sum.1 + own.1));
        let step = information.cholesky()?.solve(&score);
        (0..HALVINGS).find_map(|k| {
            let mut values: Vec<f64> = found.values.iter().zip(step.iter()).map(|(v, s)| v + s * 0.5f64.powi(k)).collect();
            for (i, term) in found.terms.iter().enumerate() {
                self.family[*term].clamp(&mut values[i..=i]);
            }
            Some(self.sized(found.terms.clone(), values)).filter(|to| to.error() < found.error())
        })
    }

    /// Information and score of each drive in the sizes.
    fn linearised(&self, found: &Sized) -> Vec<(DMatrix<f64>, DVector<f64>)> {
        let count = found.terms.len();
        let at = |values: &[f64]| self.vehicle.with_effects(&self.effects(&found.terms, values));
        let sides: Vec<([Vehicle; 2], f64)> = (0..count)
            .map(|i| {
                let step = 0.02 * self.scale(found.terms[i], found.values[i]);
                let moved = |by: f64| {
                    let mut values = found.values.clone();
                    values[i] += by;
                    self.family[found.terms[i]].clamp(&mut values[i..=i]);
                    (at(&values), values[i])
                };
                let [(less, low), (more, high)] = [-step, step].map(moved);
                ([less, more], high - low)
            })
            .collect();
        let here = at(&found.values);
        let of = |log: &Log<'_>| {
            let left: Vec<f64> = self.deviations(&here, log).collect();
            let slope = |([less, more], apart): &([Vehicle; 2], f64)| -> Vec<f64> {
                let pairs = self.deviations(less, log).zip(self.deviations(more, log));
                pairs.map(|(less, more)| (less - more) / apart).collect()
            };
            let slopes: Vec<Vec<f64>> = sides.iter().map(slope).collect();
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
            let information = DMatrix::from_fn(count, count, |i, j| dot(&slopes[i], &slopes[j]));
            let score = DVector::from_fn(count, |i, _| dot(&slopes[i], &left));
            (information, score)
        };
        self.logs.par_iter().map(of).collect()
    }
}
