//! The χ² distribution, which NIS follows when the filter is consistent.

/// P(χ² > x) for an even number of degrees of freedom: e^(-x/2) Σ_{j < dof/2} (x/2)^j / j! (exact, no table).
///
/// A buffer of whole transitions has 6 B rows, always even.
///
/// # Panics
/// When `dof` is odd or 0.
pub fn chi_square_tail(dof: usize, x: f64) -> f64 {
    assert!(dof > 0 && dof.is_multiple_of(2), "the closed form holds for an even number of degrees of freedom, got {dof}");
    if x <= 0.0 {
        return 1.0;
    }
    // What is infinite, or no number, is as far out as can be.
    if !x.is_finite() {
        return 0.0;
    }
    let half = 0.5 * x;
    let mut log_term = -half;
    let mut tail = log_term.exp();
    for j in 1..dof / 2 {
        log_term += (half / j as f64).ln();
        tail += log_term.exp();
    }
    tail.clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn published_quantiles_of_tables() {
        // (dof, upper 2.5 % point, upper 97.5 % point)
        for (dof, high, low) in [(2, 7.378, 0.0506), (6, 14.449, 1.237), (60, 83.298, 40.482)] {
            assert!((chi_square_tail(dof, high) - 0.025).abs() < 1e-4, "{dof}: {}", chi_square_tail(dof, high));
            assert!((chi_square_tail(dof, low) - 0.975).abs() < 1e-4, "{dof}: {}", chi_square_tail(dof, low));
        }
    }

    #[test]
    fn property_far_tails_neither_overflow_nor_leave_the_unit_interval() {
        assert_eq!(chi_square_tail(60, 1e9), 0.0);
        assert_eq!(chi_square_tail(60, -1.0), 1.0);
        assert_eq!([f64::MAX, f64::INFINITY, f64::NAN].map(|x| chi_square_tail(60, x)), [0.0; 3]);
        let tail = chi_square_tail(60, 300.0);
        assert!(tail > 0.0 && tail < 1e-30, "{tail}");
    }
}
