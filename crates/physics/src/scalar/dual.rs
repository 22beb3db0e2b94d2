//! Forward-mode dual numbers over any inner scalar, lanes included.

use super::Real;
use core::ops::{Add, Div, Mul, Neg, Sub};

/// `re + Σ eps_i ε_i` with ε_i ε_j = 0: a value and its `N` partial derivatives.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Dual<T, const N: usize> {
    /// Value.
    pub re: T,
    /// Partial derivatives.
    pub eps: [T; N],
}

impl<T: Real, const N: usize> Dual<T, N> {
    /// A number that depends on none of the N inputs.
    #[inline(always)]
    pub fn constant(re: T) -> Self {
        Self { re, eps: [T::lit(0.0); N] }
    }

    /// The `index`-th input.
    #[inline(always)]
    pub fn variable(re: T, index: usize) -> Self {
        let mut dual = Self::constant(re);
        dual.eps[index] = T::lit(1.0);
        dual
    }

    /// f(self) given f and f'.
    #[inline(always)]
    fn chain(self, value: T, slope: T) -> Self {
        // Loops over the derivatives, here and below: `map` of an array is not inlined.
        let mut eps = self.eps;
        for e in &mut eps {
            *e = *e * slope;
        }
        Self { re: value, eps }
    }

    #[inline(always)]
    fn zip(self, other: Self, value: T, f: impl Fn(T, T) -> T) -> Self {
        let mut eps = self.eps;
        for (e, &o) in eps.iter_mut().zip(&other.eps) {
            *e = f(*e, o);
        }
        Self { re: value, eps }
    }
}

impl<T: Real, const N: usize> Add for Dual<T, N> {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.zip(other, self.re + other.re, |a, b| a + b)
    }
}
impl<T: Real, const N: usize> Sub for Dual<T, N> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.zip(other, self.re - other.re, |a, b| a - b)
    }
}
impl<T: Real, const N: usize> Mul for Dual<T, N> {
    type Output = Self;
    #[inline(always)]
    #[allow(clippy::suspicious_arithmetic_impl)] // The product rule is a sum.
    fn mul(self, other: Self) -> Self {
        let product_rule = |a, b| a * other.re + self.re * b;
        self.zip(other, self.re * other.re, product_rule)
    }
}
impl<T: Real, const N: usize> Div for Dual<T, N> {
    type Output = Self;
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        let inverse = T::lit(1.0) / other.re;
        let quotient = self.re * inverse;
        self.zip(other, quotient, |a, b| (a - quotient * b) * inverse)
    }
}
impl<T: Real, const N: usize> Neg for Dual<T, N> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        let mut eps = self.eps;
        for e in &mut eps {
            *e = -*e;
        }
        Self { re: -self.re, eps }
    }
}

impl<T: Real, const N: usize> Real for Dual<T, N> {
    type Value = T;
    const PLAIN: bool = false;
    const SINGLE: bool = false;
    type Four = Dual<T::Four, N>;
    #[inline(always)]
    fn abreast([a, b, c, d]: [&Self; 4]) -> Option<Self::Four> {
        let re = T::abreast([&a.re, &b.re, &c.re, &d.re])?;
        let mut eps = [re; N];
        for (i, lanes) in eps.iter_mut().enumerate() {
            *lanes = T::abreast([&a.eps[i], &b.eps[i], &c.eps[i], &d.eps[i]])?;
        }
        Some(Dual { re, eps })
    }
    #[inline(always)]
    fn apart(four: &Self::Four) -> [Self; 4] {
        let mut apart = T::apart(&four.re).map(Self::constant);
        for i in 0..N {
            for (one, eps) in apart.iter_mut().zip(T::apart(&four.eps[i])) {
                one.eps[i] = eps;
            }
        }
        apart
    }
    #[inline(always)]
    fn value(self) -> T {
        self.re
    }
    #[inline(always)]
    fn from_value(value: T) -> Self {
        Self::constant(value)
    }
    #[inline(always)]
    fn lit(x: f64) -> Self {
        Self::constant(T::lit(x))
    }
    #[inline(always)]
    fn exp(self) -> Self {
        let value = self.re.exp();
        self.chain(value, value)
    }
    #[inline(always)]
    fn ln(self) -> Self {
        self.chain(self.re.ln(), T::lit(1.0) / self.re)
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        let value = self.re.sqrt();
        self.chain(value, T::lit(0.5) / value)
    }
    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        let (sin, cos) = self.re.sin_cos();
        (self.chain(sin, cos), self.chain(cos, -sin))
    }
    #[inline(always)]
    fn atan(self) -> Self {
        self.chain(self.re.atan(), T::lit(1.0) / (T::lit(1.0) + self.re * self.re))
    }
    #[inline(always)]
    fn select_ge0(condition: Self, a: Self, b: Self) -> Self {
        a.zip(b, T::select_ge0(condition.re, a.re, b.re), |x, y| T::select_ge0(condition.re, x, y))
    }
}
