//! The ground under drives that no map tells of.
//!
//! A data sheet says nothing of the ground, and a model on trial is judged on it: hard ground under a model that assumes loam is wrong in every turn, and what makes up
//! for that would be named. So one soil, common to all drives, is fitted before anything is sought, and once more beside what was found: what is compared with the best
//! soil alone stands on the best soil itself. It is sought from what the model assumes and from hard ground: from loam no step of a fit leads to a floor.

use nalgebra::{DMatrix, DVector};
use nesam_evaluation::EvaluationError;
use nesam_physics::effects::ScheduledEffect;
use nesam_physics::{HARD_GROUND, SOIL_DIM, SoilCorrection};
use rayon::prelude::*;

use crate::claims::Case;
use crate::observe::channels::Row;
use crate::observe::condense::{Condensed, SOIL_SD, difference, profiled};
use crate::observe::metric::Metric;
use crate::observe::{Bench, ObservedDrive};
use crate::proof::Trial;

/// Steps of Gauss-Newton.
const ITERATIONS: usize = 6;
/// How often a step that explains less is halved.
const HALVINGS: usize = 3;
/// Squared distance below which a step explains nothing more.
const NOTHING: f64 = 0.5;
/// Half of the distance over which soils are differentiated, standard deviations.
const STEP: f64 = 0.25;

/// Soils under drives that no map tells of, in the order of the soil vector.
#[derive(Clone, Copy, Debug)]
pub struct Soils {
    /// What the model assumed.
    pub assumed: [f64; SOIL_DIM],
    /// What explains the drives best without an effect where predictions are better on it, else what was assumed.
    pub alone: [f64; SOIL_DIM],
    /// What is taken beside the claimed effects.
    pub beside: [f64; SOIL_DIM],
}

/// A soil fitted to drives.
#[derive(Clone, Debug)]
pub(crate) struct Ground {
    /// From where it was sought.
    from: SoilCorrection,
    /// Shares of the prior standard deviation of each parameter.
    shares: DVector<f64>,
    /// What each drive says of the shares there.
    drives: Vec<Condensed>,
    /// Squared distance of the drives that is left on it, with that from where it was sought.
    left: f64,
}

impl Ground {
    /// The soil under drives without a further effect, on which predictions of the fitted drives are better than on the assumed one; `None` where there is none. It is
    /// drawn to the assumed one or to hard ground: first tried is what explains the drives better.
    ///
    /// # Errors
    /// The first error of the model.
    pub fn found(bench: Bench<'_>, metric: &Metric, drives: &[&ObservedDrive], trial: &Trial<'_>) -> Result<Option<Self>, EvaluationError> {
        let none = SoilCorrection::NONE;
        let assumed = trial.predictor.bundle().default_soil();
        let hard = SoilCorrection { delta: none.coordinates.between(&assumed, &HARD_GROUND), ..none };
        let mut sought = [none, hard].map(|ground| Self::fitted(&Bench { ground, ..bench }, metric, drives, &[]));
        sought.sort_by(|a, b| a.left.total_cmp(&b.left));
        for ground in sought {
            if trial.ground_is_better((&[], &none), (&[], &ground.correction()))? {
                return Ok(Some(ground));
            }
        }
        Ok(None)
    }

    /// Fits one soil to drives with effects, drawn to that of the bench by its prior, by Gauss-Newton through the physics.
    pub fn fitted(bench: &Bench<'_>, metric: &Metric, drives: &[&ObservedDrive], effects: &[ScheduledEffect]) -> Self {
        // Corrections are added in the coordinates in which the prior is one.
        let rows_at = |shares: &DVector<f64>| -> Vec<Vec<Row>> {
            let soil = correction(shares);
            drives.par_iter().map(|drive| drive.deviations(bench, effects, &soil)).collect()
        };
        let said_at = |shares: &DVector<f64>, rows: &[Vec<Row>]| -> Vec<Condensed> {
            let of = |(drive, rows): (&&ObservedDrive, &Vec<Row>)| said_of_soil(bench, metric, drive, effects, shares, rows);
            drives.par_iter().zip(rows).map(of).collect()
        };
        let distance = |shares: &DVector<f64>, rows: &[Vec<Row>]| {
            let of = |rows: &Vec<Row>| profiled(metric, rows, &[], &[], &[]).square;
            rows.par_iter().map(of).collect::<Vec<f64>>().iter().sum::<f64>() + shares.norm_squared()
        };
        let shares = DVector::zeros(SOIL_DIM);
        let rows = rows_at(&shares);
        let mut least = distance(&shares, &rows);
        let mut best = Self { from: bench.ground, drives: said_at(&shares, &rows), shares, left: least };
        for _ in 0..ITERATIONS {
            let mut to = best.without(None);
            let next = (0..=HALVINGS).find_map(|_| {
                let (shares, rows) = (to.clone(), rows_at(&to));
                to = (&to + &best.shares) * 0.5;
                let left = distance(&shares, &rows);
                (left < least).then_some((left, shares, rows))
            });
            let Some((left, shares, rows)) = next else { break };
            best = Self { drives: said_at(&shares, &rows), shares, left, ..best };
            let gain = least - left;
            least = left;
            if gain < NOTHING {
                break;
            }
        }
        best
    }

    /// The same to the drives of a case, from what was found of the ground before.
    pub fn beside(case: &Case<'_>, effects: &[ScheduledEffect]) -> Self {
        Self::fitted(&case.bench, &case.metric, &case.drives(), effects)
    }

    /// The soil as a correction of the assumed one.
    pub fn correction(&self) -> SoilCorrection {
        self.moved(&self.shares)
    }

    /// The assumed soil, where predictions are no better on a fitted one.
    pub fn assumed() -> Self {
        Self { from: SoilCorrection::NONE, shares: DVector::zeros(SOIL_DIM), drives: Vec::new(), left: f64::INFINITY }
    }

    fn moved(&self, shares: &DVector<f64>) -> SoilCorrection {
        let step = correction(shares);
        SoilCorrection { delta: core::array::from_fn(|i| self.from.delta[i] + step.delta[i]), ..step }
    }

    /// The same by one step without a drive.
    pub fn correction_without(&self, drive: usize) -> SoilCorrection {
        self.moved(&self.without(Some(drive)))
    }

    /// Where one step leads from here, a drive left out.
    fn without(&self, drive: Option<usize>) -> DVector<f64> {
        let (mut information, mut score) = (DMatrix::identity(SOIL_DIM, SOIL_DIM), -&self.shares);
        for (_, own) in self.drives.iter().enumerate().filter(|(d, _)| Some(*d) != drive) {
            information += &own.information;
            score += &own.score;
        }
        let step = information.cholesky().map_or_else(|| DVector::zeros(SOIL_DIM), |c| c.solve(&score));
        (&self.shares + step).map(|share| share.clamp(-2.0, 2.0))
    }
}

/// What a drive says of each soil parameter, beside effects and at a soil, where its deviations are `rows`.
fn said_of_soil(
    bench: &Bench<'_>,
    metric: &Metric,
    drive: &ObservedDrive,
    effects: &[ScheduledEffect],
    shares: &DVector<f64>,
    rows: &[Row],
) -> Condensed {
    let at = |i: usize, step: f64| {
        let mut moved = shares.clone();
        moved[i] += step;
        drive.deviations(bench, effects, &correction(&moved))
    };
    let columns: Vec<_> = (0..SOIL_DIM).map(|i| difference(&at(i, -STEP), &at(i, STEP), 0.5 / STEP)).collect();
    profiled(metric, rows, &columns, &[], &[])
}

fn correction(shares: &DVector<f64>) -> SoilCorrection {
    SoilCorrection { delta: core::array::from_fn(|i| SOIL_SD[i] * shares[i]), ..SoilCorrection::NONE }
}
