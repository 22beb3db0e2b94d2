//! Vectors as the scalar of the physics: sixteen vehicles step together.

use core::ops::{Add, Div, Mul, Neg, Sub};

use nesam_physics::Real;

use super::elementary;
use super::vector::Vector;

/// Sixteen real numbers.
#[derive(Clone, Copy, Debug)]
pub struct Numbers<V>(pub V);

impl<V: Vector> Add for Numbers<V> {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self(self.0.add(other.0))
    }
}
impl<V: Vector> Sub for Numbers<V> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self(self.0.sub(other.0))
    }
}
impl<V: Vector> Mul for Numbers<V> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        Self(self.0.mul(other.0))
    }
}
impl<V: Vector> Div for Numbers<V> {
    type Output = Self;
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        Self(self.0.div(other.0))
    }
}
impl<V: Vector> Neg for Numbers<V> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self(self.0.neg())
    }
}

impl<V: Vector> Real for Numbers<V> {
    type Value = Self;
    const PLAIN: bool = true;
    const SINGLE: bool = true;
    type Four = Self;
    #[inline(always)]
    fn value(self) -> Self {
        self
    }
    #[inline(always)]
    fn from_value(value: Self) -> Self {
        value
    }
    #[inline(always)]
    fn lit(x: f64) -> Self {
        Self(V::splat(x as f32))
    }
    #[inline(always)]
    fn exp(self) -> Self {
        Self(elementary::exp(self.0))
    }
    #[inline(always)]
    fn ln(self) -> Self {
        Self(elementary::ln(self.0))
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(self.0.sqrt())
    }
    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        let (sin, cos) = elementary::sin_cos(self.0);
        (Self(sin), Self(cos))
    }
    #[inline(always)]
    fn sin_cos_of_half_turn(self) -> (Self, Self) {
        let (sin, cos) = elementary::sin_cos_of_half_turn(self.0);
        (Self(sin), Self(cos))
    }
    #[inline(always)]
    fn atan(self) -> Self {
        Self(elementary::atan(self.0))
    }
    #[inline(always)]
    fn select_ge0(condition: Self, a: Self, b: Self) -> Self {
        Self(condition.0.select_ge0(a.0, b.0))
    }
}
