//! What the network asks of its numbers.

use nesam_physics::scalar::{Dual, Real};
use nesam_physics::wrap_angle;

/// A float or a dual over it: branches may look at the value.
pub trait Number: Real<Value = f64> + Send + Sync {
    /// self += factor · x for a constant factor.
    fn add_scaled(&mut self, factor: f64, x: &Self);

    /// The angle within (-pi, pi], with the derivatives that it had.
    fn wrapped(self) -> Self {
        self + Self::lit(wrap_angle(self.value()) - self.value())
    }

    /// Hyperbolic tangent.
    fn tanh(self) -> Self {
        // Beyond ±20 it is ±1 to the last bit.
        let one = Self::lit(1.0);
        let doubled = (self + self).max(Self::lit(-40.0)).min(Self::lit(40.0));
        one - Self::lit(2.0) / (doubled.exp() + one)
    }
}

impl Number for f64 {
    #[inline(always)]
    fn add_scaled(&mut self, factor: f64, x: &Self) {
        *self = factor.mul_add(*x, *self);
    }
}

impl<const N: usize> Number for Dual<f64, N> {
    #[inline(always)]
    fn add_scaled(&mut self, factor: f64, x: &Self) {
        self.re = factor.mul_add(x.re, self.re);
        for (sum, tangent) in self.eps.iter_mut().zip(&x.eps) {
            *sum = factor.mul_add(*tangent, *sum);
        }
    }
}
