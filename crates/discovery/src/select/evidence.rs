//! How surprising the scores of a group of drives are, given those of drives without an effect.
//!
//! The unit of replication is the drive. The score of a column scatters from drive to drive with a variance that is measured, not assumed: for any
//! combination of columns it is the scatter of that combination over the null drives, so no large covariance has to be inverted. A drive that says more
//! than the usual one about a column (it is faster, or rougher) is also allowed to scatter more.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

use crate::candidates::SHARE_SD;
use crate::observe::condense::Condensed;
use crate::reference::tail::{equivalent_z, ln_chi_square_tail};

/// Least scatter of the scores of a block of several columns, as a ratio of variances to what the metric says (chosen).
const BLOCK_FLOOR: f64 = 0.3;

/// Fewest drives without an effect whose scatter is a measure (chosen).
const NULL_DRIVES_MIN: usize = 4;

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
        if drives.len() < NULL_DRIVES_MIN { None } else { Self::of(drives) }
    }

    fn of(drives: &[&Condensed]) -> Option<Self> {
        let first = drives.first().filter(|_| drives.len() > 1)?;
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

    /// From the drives that are judged, against a model that is right on average: the scatter is theirs about their own mean, the share zero. `None` with
    /// fewer than two.
    pub fn about_zero(drives: &[&Condensed]) -> Option<Self> {
        let measured = Self::of(drives)?;
        let size = measured.share.len();
        // The centre is known without drives.
        Some(Self { share: DVector::zeros(size), total: DVector::from_element(size, f64::INFINITY), ..measured })
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

/// An effect that was fitted.
#[derive(Clone, Debug)]
pub struct Fitted {
    /// Its columns.
    pub columns: Vec<usize>,
    /// How wrong its predicted response may be, as a share of it.
    pub mismatch: f64,
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
    /// Evidence of a block of columns after others have been fitted, whose responses are believed.
    pub fn remainder(&self, fitted: &[usize], block: &[usize]) -> Remainder {
        self.remainder_since(self, &[Fitted { columns: fitted.to_vec(), mismatch: 0.0 }], block)
    }

    /// Evidence of a block of columns after effects have been fitted, each of which may be wrong by its share of what it explains: a force beside a sensor makes the sensor's
    /// answer no worse. Where the fit went through the physics these are the scores of what it left, and `before` those that it started from, which say how much was to
    /// be explained.
    pub fn remainder_since(&self, before: &Group, effects: &[Fitted], block: &[usize]) -> Remainder {
        let fitted: Vec<usize> = effects.iter().flat_map(|e| e.columns.iter().copied()).collect();
        let fitting = self.fitting(&fitted);
        // A_BE (A_EE + prior)⁻¹: what the fit takes from the scores of the block.
        let cross = part(&self.information, &fitted, block);
        let pull = fitting.as_ref().map_or_else(|| DMatrix::zeros(block.len(), fitted.len()), |c| c.solve(&cross).transpose());
        let fitted_score = self.score.select_rows(&fitted);
        let score = self.score.select_rows(block) - &pull * &fitted_score;
        let doubted = match fitting {
            Some(fitting) => self.doubted(&fitting.solve(&before.score.select_rows(&fitted)), effects, block),
            None => DVector::zeros(block.len()),
        };
        let mut information = part(&self.information, block, block);
        if !fitted.is_empty() {
            information -= &pull * cross;
        }
        // Score covariance of T t with T = [-pull, 1].
        let all: Vec<usize> = fitted.iter().chain(block).copied().collect();
        let mut transform = DMatrix::zeros(block.len(), all.len());
        transform.view_mut((0, 0), (block.len(), fitted.len())).copy_from(&-&pull);
        transform.view_mut((0, fitted.len()), (block.len(), block.len())).fill_with_identity();
        let mut covariance = &transform * part(&self.covariance, &all, &all) * transform.transpose();
        for i in 0..block.len() {
            covariance[(i, i)] += doubted[i] + 1e-12 + 1e-6 * self.information[(block[i], block[i])];
            information[(i, i)] = information[(i, i)].max(1e-12);
        }
        if block.len() > 1 {
            // Thirty null drives tell little of the least scattered direction of a block.
            covariance += &information * BLOCK_FLOOR;
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

    /// A_EE + prior of fitted columns; `None` where there are none.
    fn fitting(&self, fitted: &[usize]) -> Option<Cholesky<f64, Dyn>> {
        let mut own = part(&self.information, fitted, fitted);
        for i in 0..fitted.len() {
            own[(i, i)] += SHARE_SD.powi(-2) + 1e-9;
        }
        own.cholesky().filter(|_| !fitted.is_empty())
    }

    /// Variance of the scores of a block for what fitted effects may be wrong by: each by its share of what it explains there, with the size that it has in the fit of all, whose
    /// `shares` are those of the columns of all effects.
    fn doubted(&self, shares: &DVector<f64>, effects: &[Fitted], block: &[usize]) -> DVector<f64> {
        let mut variance = DVector::zeros(block.len());
        let mut from = 0;
        for effect in effects {
            let own = shares.rows(from, effect.columns.len());
            from += effect.columns.len();
            let explained = part(&self.information, block, &effect.columns) * own;
            variance += (explained * effect.mismatch).map(|v| v * v);
        }
        variance
    }

    /// Shares of a set of columns fitted together.
    pub fn joint_shares(&self, columns: &[usize]) -> Vec<f64> {
        self.remainder(&[], columns).shares
    }
}

/// Some rows and columns of a matrix.
fn part(matrix: &DMatrix<f64>, rows: &[usize], columns: &[usize]) -> DMatrix<f64> {
    DMatrix::from_fn(rows.len(), columns.len(), |i, j| matrix[(rows[i], columns[j])])
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};

    /// Information of two columns at a cosine of 0.8 and one apart from them.
    fn information() -> DMatrix<f64> {
        DMatrix::from_row_slice(3, 3, &[100.0, 80.0, 0.0, 80.0, 100.0, 0.0, 0.0, 0.0, 50.0])
    }

    /// A drive with a share of the first column; its scores scatter four times as much as the information says.
    fn drive(rng: &mut ChaCha8Rng, share: f64) -> Condensed {
        let lower = information().cholesky().unwrap().l();
        let mut noise = DVector::zeros(3);
        for i in 0..3 {
            noise[i] = StandardNormal.sample(rng);
        }
        Condensed {
            score: 2.0 * lower * noise + information().column(0) * share,
            information: information(),
            square: 0.0,
            soil_score: DVector::zeros(0),
            soil_information: DMatrix::zeros(0, 0),
        }
    }

    #[test]
    fn analytic_the_scatter_of_null_drives_is_the_measure_of_evidence() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let nulls: Vec<Condensed> = (0..400).map(|_| drive(&mut rng, 0.0)).collect();
        let nulls = Nulls::new(&nulls.iter().collect::<Vec<_>>()).unwrap();
        assert!((nulls.dispersion(0) - 4.0).abs() < 0.8, "{}", nulls.dispersion(0));
        let group: Vec<Condensed> = (0..5).map(|_| drive(&mut rng, 1.0)).collect();
        let group = nulls.group(group.iter());
        // Five drives with a share of 1: score 500 with a variance of 5 · 4 · 100, z = 11.
        let found = group.remainder(&[], &[0]);
        assert!((found.z - 11.2).abs() < 3.0 && (found.shares[0] - 1.0).abs() < 0.3, "{found:?}");
        assert!(group.remainder(&[], &[2]).z < 3.5);
    }

    #[test]
    fn analytic_a_fitted_cause_leaves_nothing_to_its_shadow_but_not_the_reverse() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let nulls: Vec<Condensed> = (0..60).map(|_| drive(&mut rng, 0.0)).collect();
        let nulls = Nulls::new(&nulls.iter().collect::<Vec<_>>()).unwrap();
        let group: Vec<Condensed> = (0..5).map(|_| drive(&mut rng, 3.0)).collect();
        let group = nulls.group(group.iter());
        assert!(group.remainder(&[], &[1]).z > 15.0, "the shadow stands out as well");
        assert!(group.remainder(&[0], &[1]).z < 3.5);
        assert!(group.remainder(&[1], &[0]).z > 8.0);
        let doubted = group.remainder_since(&group, &[Fitted { columns: vec![1], mismatch: 0.5 }], &[0]).z;
        assert!(doubted < group.remainder(&[1], &[0]).z, "a response that is believed less leaves less evidence");
    }

    /// Goal: an effect that is known roughly makes the answer of another one no worse, however alike the two are. Method: two fitted columns at a cosine of 0.8, one with a share of 3
    /// and one with none, before a block that both resemble; doubted is what the first explains there, 3 · 60.
    #[test]
    fn analytic_each_fitted_effect_is_doubted_by_its_own_share() {
        let information = DMatrix::from_row_slice(3, 3, &[100.0, 80.0, 60.0, 80.0, 100.0, 80.0, 60.0, 80.0, 100.0]);
        let group = Group { score: information.column(0) * 3.0, information, covariance: DMatrix::zeros(3, 3) };
        let doubted = |effects: &[Fitted]| {
            let fitted: Vec<usize> = effects.iter().flat_map(|e| e.columns.clone()).collect();
            group.doubted(&group.fitting(&fitted).unwrap().solve(&group.score.select_rows(&fitted)), effects, &[2])[0]
        };
        let of = |first: f64, second: f64| {
            let effects = [(0, first), (1, second)].map(|(column, mismatch)| Fitted { columns: vec![column], mismatch });
            doubted(&effects).sqrt()
        };
        // The prior of a share takes a little of it.
        assert!((of(0.12, 0.02) / (0.12 * 180.0) - 1.0).abs() < 0.02, "{}", of(0.12, 0.02));
        assert!(of(0.0, 0.12) < 0.02 * 180.0, "{}", of(0.0, 0.12));
        let together = [Fitted { columns: vec![0, 1], mismatch: 0.1 }];
        assert!((doubted(&together).sqrt() / 18.0 - 1.0).abs() < 0.02, "columns of one effect err together");
        assert!(group.fitting(&[]).is_none(), "nothing is fitted, so nothing is doubted");
    }
}
