//! The dual numbers of the crate `num-dual`, made a scalar of our physics: an oracle that shares no code with ours.

use core::ops::{Add, Div, Mul, Neg, Sub};
use nalgebra::{Const, U1};
use nesam_physics::Real;
use num_dual::{DualNum, DualSVec64};

/// num-dual's vector dual number.
#[derive(Clone, Copy, Debug)]
pub struct Nd<const N: usize>(DualSVec64<N>);

impl<const N: usize> Nd<N> {
    /// The `index`-th input.
    pub fn variable(re: f64, index: usize) -> Self {
        Self(DualSVec64::from_re(re).derivative(index))
    }

    /// All partial derivatives.
    pub fn gradient(self) -> [f64; N] {
        self.0.eps.unwrap_generic(Const::<N>, U1).into()
    }
}

macro_rules! forward_operator {
    ($trait:ident, $method:ident) => {
        impl<const N: usize> $trait for Nd<N> {
            type Output = Self;
            fn $method(self, other: Self) -> Self {
                Self(self.0.$method(other.0))
            }
        }
    };
}
forward_operator!(Add, add);
forward_operator!(Sub, sub);
forward_operator!(Mul, mul);
forward_operator!(Div, div);

impl<const N: usize> Neg for Nd<N> {
    type Output = Self;
    fn neg(self) -> Self {
        Self(-self.0)
    }
}

impl<const N: usize> Real for Nd<N> {
    type Value = f64;
    const SINGLE: bool = false;
    const PLAIN: bool = false;
    type Four = Self;
    fn value(self) -> f64 {
        self.0.re
    }
    fn from_value(value: f64) -> Self {
        Self(DualSVec64::from_re(value))
    }
    fn lit(x: f64) -> Self {
        Self(DualSVec64::from_re(x))
    }
    fn exp(self) -> Self {
        Self(DualNum::exp(&self.0))
    }
    fn ln(self) -> Self {
        Self(DualNum::ln(&self.0))
    }
    fn sqrt(self) -> Self {
        Self(DualNum::sqrt(&self.0))
    }
    fn sin_cos(self) -> (Self, Self) {
        let (sin, cos) = DualNum::sin_cos(&self.0);
        (Self(sin), Self(cos))
    }
    fn atan(self) -> Self {
        Self(DualNum::atan(&self.0))
    }
    fn select_ge0(condition: Self, a: Self, b: Self) -> Self {
        if condition.0.re >= 0.0 { a } else { b }
    }
}
