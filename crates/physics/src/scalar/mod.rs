//! The one scalar vocabulary in which the physics is written.
//!
//! [`Real`] is what every formula of this crate asks of its numbers; plain floats, SIMD lanes and dual numbers (also duals over lanes)
//! implement it, so training, inference, filter and discovery share one text. It is branch-free on purpose: `select_ge0`, `max` and
//! `min` instead of `if`, so that lanes and duals agree with floats.

mod dual;
mod plain;

pub use dual::Dual;
pub use wide::{f32x8, f64x4};

use core::ops::{Add, Div, Mul, Neg, Sub};

/// A real number as the physics sees it.
pub trait Real:
    Copy + core::fmt::Debug + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Div<Output = Self> + Neg<Output = Self>
{
    /// The scalar without its derivatives: itself for floats and lanes, the inner value for duals.
    ///
    /// Iterations run on values; one last Newton step on `Self` then carries the exact derivative of the implicit function.
    type Value: Real;
    /// Whether a number is its value and no more.
    const PLAIN: bool;
    /// Whether it is a plain number of single precision: what is below that is not worth another step of an iteration.
    const SINGLE: bool;
    /// Four numbers side by side, one for each wheel; lanes, which have no room for wheels, name themselves.
    type Four: Real;

    /// Four numbers as one, where there is such a type: each formula is then worked out once for all wheels.
    #[inline(always)]
    fn abreast(_: [&Self; 4]) -> Option<Self::Four> {
        None
    }
    /// The four numbers of [`Real::abreast`].
    #[inline(always)]
    fn apart(_: &Self::Four) -> [Self; 4] {
        unreachable!("numbers that were never put abreast are taken apart; this is a bug")
    }
    /// The value without derivatives.
    fn value(self) -> Self::Value;
    /// A constant from a value.
    fn from_value(value: Self::Value) -> Self;
    /// The constant `x`.
    fn lit(x: f64) -> Self;
    /// e^self.
    fn exp(self) -> Self;
    /// Natural logarithm; the caller keeps the argument positive.
    fn ln(self) -> Self;
    /// Square root; the caller keeps the argument positive where a derivative is wanted.
    fn sqrt(self) -> Self;
    /// Sine and cosine.
    fn sin_cos(self) -> (Self, Self);
    /// Sine and cosine of an angle within ±π/2, which need not be brought there first.
    #[inline(always)]
    fn sin_cos_of_half_turn(self) -> (Self, Self) {
        self.sin_cos()
    }
    /// Arc tangent.
    fn atan(self) -> Self;
    /// `a` where `condition >= 0`, else `b`. Derivatives follow the chosen branch.
    fn select_ge0(condition: Self, a: Self, b: Self) -> Self;

    /// self^exponent for self > 0.
    #[inline(always)]
    fn powf(self, exponent: Self) -> Self {
        (self.ln() * exponent).exp()
    }
    /// The larger one.
    #[inline(always)]
    fn max(self, other: Self) -> Self {
        Self::select_ge0(self - other, self, other)
    }
    /// The smaller one.
    #[inline(always)]
    fn min(self, other: Self) -> Self {
        Self::select_ge0(other - self, self, other)
    }
    /// Tangent.
    #[inline(always)]
    fn tan(self) -> Self {
        let (sin, cos) = self.sin_cos();
        sin / cos
    }
    /// self².
    #[inline(always)]
    fn sqr(self) -> Self {
        self * self
    }
    /// Smooth |self|: sqrt(self² + eps²).
    #[inline(always)]
    fn abs_smooth(self, eps: f64) -> Self {
        (self * self + Self::lit(eps * eps)).sqrt()
    }
    /// Smooth max(self, 0): (self + sqrt(self² + 4 eps²)) / 2, positive everywhere.
    #[inline(always)]
    fn relu_smooth(self, eps: f64) -> Self {
        (self + (self * self + Self::lit(4.0 * eps * eps)).sqrt()) * Self::lit(0.5)
    }
}
