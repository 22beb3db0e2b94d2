//! Eight f32 lanes: batched inference and the forward pass of training.

use super::{Real, f32x8};

impl Real for f32x8 {
    type Value = Self;
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
        f32x8::splat(x as f32)
    }
    #[inline(always)]
    fn exp(self) -> Self {
        f32x8::exp(self)
    }
    #[inline(always)]
    fn ln(self) -> Self {
        f32x8::ln(self)
    }
    #[inline(always)]
    fn sqrt(self) -> Self {
        f32x8::sqrt(self)
    }
    #[inline(always)]
    fn sin_cos(self) -> (Self, Self) {
        f32x8::sin_cos(self)
    }
    #[inline(always)]
    fn atan(self) -> Self {
        f32x8::atan(self)
    }
    #[inline(always)]
    fn select_ge0(condition: Self, a: Self, b: Self) -> Self {
        condition.simd_ge(f32x8::ZERO).select(a, b)
    }
}
