//! Numbers of any size in tables and sentences.

use std::fmt;

/// A number in as few characters as it needs for three significant digits: exponents for large and small ones.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Short(pub f64);

impl fmt::Display for Short {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let size = self.0.abs();
        if size == 0.0 {
            write!(f, "0")
        } else if (1e-3..1e4).contains(&size) {
            let decimals = (2.0 - size.log10().floor()).max(0.0) as usize;
            write!(f, "{:.decimals$}", self.0)
        } else {
            write!(f, "{:.2e}", self.0)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_every_size_has_three_digits() {
        let told = |values: &[f64]| values.iter().map(|v| Short(*v).to_string()).collect::<Vec<_>>().join(" ");
        assert_eq!(told(&[1e-5, -1.234e-4, 0.001, -0.0816, 0.42]), "1.00e-5 -1.23e-4 0.00100 -0.0816 0.420");
        assert_eq!(told(&[0.0, -0.0, 1.0, 12.34, 612.4, 8000.0, 1.3e6]), "0 0 1.00 12.3 612 8000 1.30e6");
        assert_eq!(told(&[f64::INFINITY, f64::NAN]), "inf NaN");
    }
}
