//! What drives without an effect say: mean and scatter of their statistics, and how surprising a group of drives is.
//!
//! The unit of replication is the drive. The mean of n drives scatters as C / n about a centre that N null drives know to C / N; with few null
//! drives the correlations of C are shrunk towards zero (Ledoit and Wolf 2004 give the reason; the share is chosen).

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

use crate::candidates::{COLUMNS, Candidate, SHARE_SD};
use crate::features::FEATURES;
use crate::tail::{equivalent_z, ln_chi_square_tail};

/// Share of the correlations that is not believed: with thirty null drives for fifteen statistics, groups of null drives then scatter nearly as the
/// shrunk covariance says (chosen on null drives).
const SHRINKAGE: f64 = 0.5;

/// Centre and covariance of the mean statistics of a group of null drives, over the statistics that are used.
#[derive(Clone, Debug)]
pub struct Expectation {
    used: Vec<usize>,
    centre: DVector<f64>,
    covariance: DMatrix<f64>,
}

/// Evidence of a group before comparison with null groups.
#[derive(Clone, Debug)]
pub struct Strength {
    /// Evidence of each hypothesis of [`Candidate::ALL`] as the two-sided standard normal deviate of equal probability.
    pub z: Vec<f64>,
    /// Best shares of each hypothesis' linear form.
    pub shares: Vec<Vec<f64>>,
    /// Squared distance of the group from the centre, per statistic.
    pub distance: f64,
}

impl Expectation {
    /// From null drives, for a group of `n` others; `None` with fewer than three null drives, or when no statistic is used.
    pub fn new(nulls: &[&DVector<f64>], usable: &[bool; FEATURES], n: usize) -> Option<Self> {
        let used: Vec<usize> = (0..FEATURES).filter(|f| usable[*f]).collect();
        if nulls.len() < 3 || used.is_empty() || n == 0 {
            return None;
        }
        let count = nulls.len() as f64;
        let rows: Vec<DVector<f64>> = nulls.iter().map(|v| v.select_rows(&used)).collect();
        let centre = rows.iter().fold(DVector::zeros(used.len()), |sum, r| sum + r) / count;
        let mut covariance = DMatrix::zeros(used.len(), used.len());
        for row in &rows {
            let d = row - &centre;
            covariance += &d * d.transpose();
        }
        covariance *= (1.0 / n as f64 + 1.0 / count) / (count - 1.0);
        for i in 0..used.len() {
            covariance[(i, i)] = covariance[(i, i)].max(1e-18);
            for j in 0..used.len() {
                if i != j {
                    covariance[(i, j)] *= 1.0 - SHRINKAGE;
                }
            }
        }
        Some(Self { used, centre, covariance })
    }

    /// Statistics in use.
    pub fn used(&self) -> &[usize] {
        &self.used
    }

    /// How far a group's mean statistics are from the centre, over the statistics in use.
    pub fn deviation(&self, mean: &DVector<f64>) -> DVector<f64> {
        mean.select_rows(&self.used) - &self.centre
    }

    /// Deviation of each statistic in use in standard deviations.
    pub fn significance(&self, mean: &DVector<f64>) -> DVector<f64> {
        let d = self.deviation(mean);
        DVector::from_fn(d.len(), |i, _| d[i] / self.covariance[(i, i)].sqrt())
    }

    /// The covariance with a further variance of each statistic, ready to weigh with.
    pub fn weight(&self, further: Option<&DVector<f64>>) -> Cholesky<f64, Dyn> {
        let mut covariance = self.covariance.clone();
        for (i, variance) in further.into_iter().flat_map(|f| f.iter().enumerate()) {
            covariance[(i, i)] += variance;
        }
        covariance.cholesky().expect("a shrunk covariance is positive definite; this is a bug")
    }

    /// Evidence for every hypothesis in the mean statistics of a group, given how the columns shift them.
    pub fn strength(&self, mean: &DVector<f64>, signature: &DMatrix<f64>) -> Strength {
        let weight = self.weight(None);
        let d = self.deviation(mean);
        let g = signature.select_columns(&self.used);
        let weighted = weight.solve(&d);
        let score = &g * &weighted;
        let information = &g * weight.solve(&g.transpose());
        let shares: Vec<Vec<f64>> = Candidate::ALL.iter().map(|c| shares(&information, &score, *c)).collect();
        let z = Candidate::ALL.iter().zip(&shares).map(|(c, shares)| {
            let gain: f64 = c.columns().zip(shares).map(|(j, s)| score[j] * s).sum();
            // A wheel can drag but not push.
            let possible = !matches!(c, Candidate::WheelDrag(_)) || shares[0] > 0.0;
            equivalent_z(ln_chi_square_tail(if possible { gain } else { 0.0 }, shares.len()))
        });
        Strength { z: z.collect(), distance: d.dot(&weighted) / d.len() as f64, shares }
    }
}

fn shares(information: &DMatrix<f64>, score: &DVector<f64>, candidate: Candidate) -> Vec<f64> {
    let c = candidate.columns();
    let mut own: DMatrix<f64> = information.view((c.start, c.start), (c.len(), c.len())).into_owned();
    for i in 0..c.len() {
        own[(i, i)] += SHARE_SD.powi(-2);
    }
    let score = score.rows(c.start, c.len()).into_owned();
    own.cholesky().map_or_else(|| vec![0.0; c.len()], |l| l.solve(&score).iter().copied().collect())
}

/// Mean of vectors; zero without any.
pub fn mean<'a>(values: impl ExactSizeIterator<Item = &'a DVector<f64>>) -> DVector<f64> {
    let count = values.len().max(1) as f64;
    values.fold(DVector::zeros(FEATURES), |sum, v| sum + v) / count
}

/// Mean of the signatures of drives.
pub fn mean_signature<'a>(values: impl ExactSizeIterator<Item = &'a DMatrix<f64>>) -> DMatrix<f64> {
    let count = values.len().max(1) as f64;
    values.fold(DMatrix::zeros(COLUMNS, FEATURES), |sum, v| sum + v) / count
}
