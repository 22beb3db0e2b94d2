//! What makes a matrix a covariance.

use nalgebra::DMatrix;

/// Says why a square matrix, row-major with `size` rows, is no covariance: it is not finite or not symmetric, or has a negative variance or eigenvalue. What has no
/// variance may be in it, as long as it covaries with nothing. `rounding` is what correlations may be off by.
///
/// # Errors
/// What is wrong, and where.
pub fn check_covariance(size: usize, entries: &[f64], rounding: f64) -> Result<(), String> {
    if entries.len() != size * size {
        return Err(format!("has {} entries, {size} x {size} are needed", entries.len()));
    }
    if !entries.iter().all(|v| v.is_finite()) {
        return Err("holds a number that is not finite".into());
    }
    let entry = |r: usize, c: usize| entries[size * r + c];
    if let Some(at) = (0..size).find(|at| entry(*at, *at) < 0.0) {
        return Err(format!("has the variance {} at [{at}, {at}], at least 0 is needed", entry(at, at)));
    }
    let scale = |r: usize, c: usize| entry(r, r).sqrt() * entry(c, c).sqrt();
    for (r, c) in (0..size).flat_map(|r| (0..r).map(move |c| (r, c))) {
        let (here, mirrored) = (entry(r, c), entry(c, r));
        if (here - mirrored).abs() > rounding * scale(r, c).max(here.abs()) {
            return Err(format!("is not symmetric at [{r}, {c}]: {here} and {mirrored}"));
        }
    }
    // Correlations, with a little more than one on the diagonal, also where there is no variance: no Cholesky factor, and the matrix has a negative eigenvalue.
    let lifted = DMatrix::from_fn(size, size, |r, c| match (entry(r, c), scale(r, c)) {
        _ if r == c => 1.0 + rounding,
        (here, scale) if scale > 0.0 => here / scale,
        (0.0, _) => 0.0,
        _ => f64::INFINITY,
    });
    if lifted.cholesky().is_some() { Ok(()) } else { Err("is not positive semi-definite".into()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: covariances are told from other matrices, by what keeps them from being one. Method: matrices of two rows whose eigenvalues are known, at the
    /// rounding of f64 and at that of numbers that travelled as f32.
    #[test]
    fn analytic_covariances_are_told_from_other_matrices() {
        let fault = |entries: [f64; 4], rounding: f64| check_covariance(2, &entries, rounding).err().unwrap_or_default();
        for rounding in [1e-9, 1e-4] {
            for entries in [[4.0, 1.0, 1.0, 1.0], [4.0, 2.0, 2.0, 1.0], [0.0, 0.0, 0.0, 1e-12], [0.0; 4]] {
                assert_eq!(fault(entries, rounding), "", "{entries:?}");
            }
            for (entries, why) in [
                ([-1.0, 0.0, 0.0, 1.0], "has the variance -1 at [0, 0]"),
                ([4.0, 2.1, 2.1, 1.0], "positive semi-definite"),
                ([0.0, 1e-3, 1e-3, 1.0], "positive semi-definite"),
                ([4.0, 1e300, 1e300, 1.0], "positive semi-definite"),
                ([4.0, 1.0, 1e300, 1.0], "not symmetric at [1, 0]"),
                ([4.0, 1.0, 0.9, 1.0], "not symmetric at [1, 0]"),
                ([f64::NAN, 0.0, 0.0, 1.0], "not finite"),
                ([1.0, f64::INFINITY, f64::INFINITY, 1.0], "not finite"),
            ] {
                assert!(fault(entries, rounding).contains(why), "{entries:?}: {}", fault(entries, rounding));
            }
        }
        // Correlations of 1 + 1e-5, and of 0.5 that differ by 1e-5: within the rounding of f32.
        for (entries, why) in [([1.0, 1.00001, 1.00001, 1.0], "positive semi-definite"), ([4.0, 1.0, 1.00002, 1.0], "not symmetric")] {
            assert!(fault(entries, 1e-9).contains(why), "{entries:?}");
            assert_eq!(fault(entries, 1e-4), "", "{entries:?}");
        }
        assert!(check_covariance(2, &[1.0; 3], 1e-9).is_err(), "too few entries");
    }
}
