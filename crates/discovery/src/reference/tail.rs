//! Tail probabilities: χ² for the degrees of freedom of the catalogue, and the standard normal deviate of equal probability.

use core::f64::consts::PI;

/// ln P(χ²_k > x) for k = 1 or even k (closed forms; other k take the next even one, which is conservative).
pub fn ln_chi_square_tail(x: f64, k: usize) -> f64 {
    let x = x.max(0.0);
    if k == 1 {
        return ln_two_sided(x.sqrt());
    }
    // P = e^{-x/2} Σ_{j < k/2} (x/2)^j / j!
    let half = 0.5 * x;
    let (mut term, mut sum) = (1.0, 1.0);
    for j in 1..k.div_ceil(2) {
        term *= half / j as f64;
        sum += term;
    }
    sum.ln() - half
}

/// ln P(|Z| > z): a series below 2.5, Lentz's continued fraction of Mills' ratio above.
pub fn ln_two_sided(z: f64) -> f64 {
    let density = -0.5 * z * z - 0.5 * (2.0 * PI).ln();
    if z < 2.5 {
        // P(|Z| < z) = 2 φ(z) Σ z^{2j+1} / (1·3·5…(2j+1))
        let (mut term, mut sum) = (z, z);
        for j in 1..60 {
            term *= z * z / (2 * j + 1) as f64;
            sum += term;
        }
        return (1.0 - 2.0 * density.exp() * sum).max(1e-300).ln();
    }
    // Mills' ratio 1 / (z + 1 / (z + 2 / (z + 3 / …))).
    let mut fraction = z;
    for j in (1..80).rev() {
        fraction = z + f64::from(j) / fraction;
    }
    (2.0f64).ln() + density - fraction.ln()
}

/// z with ln P(|Z| > z) = `ln_p`.
pub fn equivalent_z(ln_p: f64) -> f64 {
    let (mut low, mut high) = (0.0, 2.0 + (-2.0 * ln_p).max(0.0).sqrt());
    for _ in 0..80 {
        let middle = 0.5 * (low + high);
        if ln_two_sided(middle) > ln_p {
            low = middle;
        } else {
            high = middle;
        }
    }
    0.5 * (low + high)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn published_tail_values() {
        for (z, p) in [(0.0, 1.0), (1.0, 0.317_310_5), (1.959_964, 0.05), (2.6, 0.009_322_4), (5.0, 5.733_03e-7)] {
            assert!((ln_two_sided(z).exp() / p - 1.0).abs() < 1e-5, "{z}");
        }
        for (x, k, p) in [(3.841_459, 1, 0.05), (5.991_465, 2, 0.05), (9.487_729, 4, 0.05)] {
            assert!((ln_chi_square_tail(x, k).exp() / p - 1.0).abs() < 1e-5, "{x} {k}");
        }
    }

    #[test]
    fn property_deviate_and_tail_are_inverse() {
        for z in [0.1, 1.0, 2.499, 2.501, 6.0, 40.0] {
            assert!((equivalent_z(ln_two_sided(z)) - z).abs() < 1e-6, "{z}");
        }
    }
}
