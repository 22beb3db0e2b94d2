//! How surprising the scores of a group of drives are, given those of drives without an effect.
//!
//! The unit of replication is the drive. The score of a column scatters from drive to drive with a variance that is measured, not assumed: for any
//! combination of columns it is the scatter of that combination over the null drives, so no large covariance has to be inverted. A drive that says more
//! than the usual one about a column (it is faster, or rougher) is also allowed to scatter more.

use nalgebra::{DMatrix, DVector};

use crate::candidates::SHARE_SD;
use crate::condense::Condensed;
use crate::tail::{equivalent_z, ln_chi_square_tail};

/// What drives without an effect say of each column.
#[derive(Clone, Debug)]
pub struct Nulls {
    /// Share of each column that null drives show on average: what the model is always wrong about.
    pub share: DVector<f64>,
    /// Mean information of a drive.
    typical: DVector<f64>,
    /// Information of all null drives.
    total: DVector<f64>,
    /// Covariance of the scores in units of the root of their information.
    scatter: DMatrix<f64>,
}

/// Scores of a group, less what null drives would show, with the covariance of such a group without an effect.
#[derive(Clone, Debug)]
pub struct Group {
    /// Scores. (J)
    pub score: DVector<f64>,
    /// Information. (J, J)
    pub information: DMatrix<f64>,
    /// Covariance of the scores without an effect. (J, J)
    pub covariance: DMatrix<f64>,
}

impl Nulls {
    /// From null drives; `None` with fewer than four.
    pub fn new(drives: &[&Condensed]) -> Option<Self> {
        let first = drives.first().filter(|_| drives.len() > 3)?;
        let size = first.score.len();
        let count = drives.len() as f64;
        let sum = |of: &dyn Fn(&Condensed) -> DVector<f64>| drives.iter().fold(DVector::zeros(size), |sum, d| sum + of(d));
        let total = sum(&|d| d.information.diagonal());
        let scores = sum(&|d| d.score.clone());
        let share = DVector::from_fn(size, |j, _| scores[j] / total[j].max(1e-12));
        let typical = &total / count;
        let mut scatter = DMatrix::zeros(size, size);
        for drive in drives {
            let s = DVector::from_fn(size, |j, _| {
                (drive.score[j] - share[j] * drive.information[(j, j)]) / spread(drive.information[(j, j)], typical[j])
            });
            scatter.ger(1.0 / (count - 1.0), &s, &s, 1.0);
        }
        Some(Self { share, typical, total, scatter })
    }

    /// A group of drives against these nulls.
    pub fn group<'a>(&self, drives: impl Iterator<Item = &'a Condensed>) -> Group {
        let size = self.share.len();
        let (mut score, mut information) = (DVector::zeros(size), DMatrix::zeros(size, size));
        let mut pairs = DMatrix::zeros(size, size);
        for drive in drives {
            score += &drive.score;
            information += &drive.information;
            let s = DVector::from_fn(size, |j, _| spread(drive.information[(j, j)], self.typical[j]));
            pairs.ger(1.0, &s, &s, 1.0);
        }
        // How far the centre itself is known.
        let s = DVector::from_fn(size, |j, _| information[(j, j)] / self.total[j].max(1e-12).sqrt());
        pairs.ger(1.0, &s, &s, 1.0);
        for j in 0..size {
            score[j] -= self.share[j] * information[(j, j)];
        }
        Group { score, covariance: pairs.component_mul(&self.scatter), information }
    }

    /// Factor by which the scores of a column scatter more than the metric says, as a ratio of variances.
    pub fn dispersion(&self, column: usize) -> f64 {
        self.scatter[(column, column)]
    }
}

/// Standard deviation of a score for a scatter of one: the root of the information, more where a drive says more than usual.
fn spread(information: f64, typical: f64) -> f64 {
    let information = information.max(1e-12);
    information.sqrt() * (information / typical.max(1e-12)).sqrt().max(1.0)
}

/// What remains of a block of columns after others have been fitted.
#[derive(Clone, Debug)]
pub struct Remainder {
    /// Equivalent standard normal deviate of what remains.
    pub z: f64,
    /// Shares of the block.
    pub shares: Vec<f64>,
    /// Fall of the squared distance by the block, in the metric.
    pub gain: f64,
}

impl Group {
    /// Evidence of a block of columns after `fitted` have been fitted. The predicted response of what was fitted is believed to a share `mismatch`.
    pub fn remainder(&self, fitted: &[usize], block: &[usize], mismatch: f64) -> Remainder {
        let own = self.information.select_rows(block);
        let pull = self.projection(fitted, block);
        let fitted_score = self.score.select_rows(fitted);
        let explained = &pull * &fitted_score;
        let score = self.score.select_rows(block) - &explained;
        let mut information = own.select_columns(block);
        if !fitted.is_empty() {
            information -= &pull * self.information.select_rows(fitted).select_columns(block);
        }
        // Score covariance of T t with T = [-pull, 1].
        let all: Vec<usize> = fitted.iter().chain(block).copied().collect();
        let mut transform = DMatrix::zeros(block.len(), all.len());
        transform.view_mut((0, 0), (block.len(), fitted.len())).copy_from(&-&pull);
        transform.view_mut((0, fitted.len()), (block.len(), block.len())).fill_with_identity();
        let mut covariance = &transform * self.covariance.select_rows(&all).select_columns(&all) * transform.transpose();
        for i in 0..block.len() {
            covariance[(i, i)] += (mismatch * explained[i]).powi(2) + 1e-12 + 1e-6 * self.information[(block[i], block[i])];
            information[(i, i)] = information[(i, i)].max(1e-12);
        }
        let mut penalised = information;
        for i in 0..block.len() {
            penalised[(i, i)] += SHARE_SD.powi(-2);
        }
        let shares = penalised.cholesky().map_or_else(|| DVector::zeros(block.len()), |c| c.solve(&score));
        let square = covariance.cholesky().map_or(0.0, |c| score.dot(&c.solve(&score)));
        Remainder {
            z: equivalent_z(ln_chi_square_tail(square, block.len())),
            gain: score.dot(&shares),
            shares: shares.iter().copied().collect(),
        }
    }

    /// A_BE (A_EE + prior)⁻¹: what a fit of `fitted` takes from the scores of `block`.
    fn projection(&self, fitted: &[usize], block: &[usize]) -> DMatrix<f64> {
        if fitted.is_empty() {
            return DMatrix::zeros(block.len(), 0);
        }
        let mut own = self.information.select_rows(fitted).select_columns(fitted);
        for i in 0..fitted.len() {
            own[(i, i)] += SHARE_SD.powi(-2) + 1e-9;
        }
        let cross = self.information.select_rows(fitted).select_columns(block);
        own.cholesky().map_or_else(|| DMatrix::zeros(block.len(), fitted.len()), |c| c.solve(&cross).transpose())
    }

    /// Fall of the squared distance by a set of columns together, in the metric.
    pub fn joint_gain(&self, columns: &[usize]) -> f64 {
        self.remainder(&[], columns, 0.0).gain
    }

    /// Shares of a set of columns fitted together.
    pub fn joint_shares(&self, columns: &[usize]) -> Vec<f64> {
        self.remainder(&[], columns, 0.0).shares
    }
}
