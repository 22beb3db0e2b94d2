//! Many small columns at once: ridge regression on the scores of drives, its strength chosen by leaving each drive out.

use nalgebra::{DMatrix, DVector};

use crate::observe::condense::Condensed;

/// Standard deviations of the coefficients that are tried, in the unit of the columns.
const SPREADS: [f64; 7] = [0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0];

/// Score and information.
type Normal = (DVector<f64>, DMatrix<f64>);

/// Coefficients of columns.
#[derive(Clone, Debug)]
pub struct Ridge {
    /// Coefficients, in the unit of the columns. (J)
    pub coefficients: DVector<f64>,
    /// Fall of the squared distance of the drives by coefficients that were fitted without them, as a share of it.
    pub gain: f64,
}

/// Fits the columns of drives. Columns have unit size; `keep` projects coefficients onto the directions that are allowed (J, J).
///
/// The spread is the one whose coefficients, fitted without a drive, explain that drive best; `None` when none of them explains anything, or with fewer than
/// two drives.
pub fn fit(drives: &[&Condensed], keep: Option<&DMatrix<f64>>) -> Option<Ridge> {
    if drives.len() < 2 {
        return None;
    }
    let allowed: Vec<Normal> = drives.iter().map(|d| within(d, keep)).collect();
    let size = allowed[0].0.len();
    let sum = |skip: Option<usize>| {
        let others = allowed.iter().enumerate().filter(|(d, _)| Some(*d) != skip);
        others.fold((DVector::zeros(size), DMatrix::zeros(size, size)), |(s, a), (_, (score, information))| (s + score, a + information))
    };
    let without: Vec<Normal> = (0..drives.len()).map(|d| sum(Some(d))).collect();
    let square: f64 = drives.iter().map(|d| d.square).sum();
    let gain = |spread: f64| -> f64 {
        let of = |((own_score, own_information), (score, information)): (&Normal, &Normal)| {
            explained(own_score, own_information, &solve(score, information, spread))
        };
        allowed.iter().zip(&without).map(of).sum()
    };
    let (spread, best) = SPREADS.into_iter().map(|s| (s, gain(s))).max_by(|a, b| a.1.total_cmp(&b.1))?;
    if best <= 0.0 {
        return None;
    }
    let (score, information) = sum(None);
    let coefficients = solve(&score, &information, spread);
    let coefficients = keep.map_or_else(|| coefficients.clone(), |k| k * &coefficients);
    Some(Ridge { coefficients, gain: best / square.max(1e-12) })
}

/// Fall of the squared distance of a drive by coefficients.
pub fn explained(score: &DVector<f64>, information: &DMatrix<f64>, coefficients: &DVector<f64>) -> f64 {
    2.0 * coefficients.dot(score) - coefficients.dot(&(information * coefficients))
}

fn within(drive: &Condensed, keep: Option<&DMatrix<f64>>) -> Normal {
    keep.map_or_else(|| (drive.score.clone(), drive.information.clone()), |k| (k * &drive.score, k * &drive.information * k))
}

fn solve(score: &DVector<f64>, information: &DMatrix<f64>, spread: f64) -> DVector<f64> {
    let mut penalised = information.clone();
    for i in 0..penalised.nrows() {
        penalised[(i, i)] += spread.powi(-2);
    }
    penalised.cholesky().map_or_else(|| DVector::zeros(score.len()), |c| c.solve(score))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drive(truth: &[f64], noise: f64, sign: f64) -> Condensed {
        let information = DMatrix::from_row_slice(2, 2, &[50.0, 20.0, 20.0, 40.0]);
        let truth = DVector::from_row_slice(truth);
        let score = &information * &truth + DVector::from_element(2, sign * noise);
        let square = truth.dot(&(&information * &truth)) + 10.0;
        Condensed { score, information, square, soil_score: DVector::zeros(0), soil_information: DMatrix::zeros(0, 0) }
    }

    #[test]
    fn analytic_what_all_drives_share_is_found_and_what_they_do_not_is_left() {
        let shared: Vec<Condensed> = (0..6).map(|i| drive(&[1.5, -0.5], 5.0, if i % 2 == 0 { 1.0 } else { -1.0 })).collect();
        let found = fit(&shared.iter().collect::<Vec<_>>(), None).unwrap();
        assert!((found.coefficients[0] - 1.5).abs() < 0.05 && (found.coefficients[1] + 0.5).abs() < 0.05, "{found:?}");
        let apart: Vec<Condensed> = (0..6).map(|i| drive(&[0.0, 0.0], 5.0, if i % 2 == 0 { 1.0 } else { -1.0 })).collect();
        assert!(fit(&apart.iter().collect::<Vec<_>>(), None).is_none());
    }

    #[test]
    fn analytic_directions_that_are_not_allowed_stay_zero() {
        let drives: Vec<Condensed> = (0..4).map(|_| drive(&[1.0, 1.0], 0.0, 1.0)).collect();
        let keep = DMatrix::from_row_slice(2, 2, &[1.0, 0.0, 0.0, 0.0]);
        let found = fit(&drives.iter().collect::<Vec<_>>(), Some(&keep)).unwrap();
        // The first column alone answers for what it shares with the second.
        assert!(found.coefficients[1].abs() < 1e-12 && (found.coefficients[0] - 1.4).abs() < 0.05, "{found:?}");
    }
}
