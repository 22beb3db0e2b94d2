//! Lanes: eight f32 for batched inference and the forward pass of training, four f64 for the wheels of one vehicle.

use super::{Real, f32x8, f64x4};

macro_rules! impl_real_for_lanes {
    ($lanes:ty, $float:ty) => {
        impl Real for $lanes {
            type Value = Self;
            type Four = Self;
            #[inline(always)]
            fn abreast(_: [&Self; 4]) -> Option<Self> {
                None
            }
            #[inline(always)]
            fn apart(four: &Self) -> [Self; 4] {
                [*four; 4]
            }
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
                <$lanes>::splat(x as $float)
            }
            #[inline(always)]
            fn exp(self) -> Self {
                <$lanes>::exp(self)
            }
            #[inline(always)]
            fn ln(self) -> Self {
                <$lanes>::ln(self)
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                <$lanes>::sqrt(self)
            }
            #[inline(always)]
            fn sin_cos(self) -> (Self, Self) {
                <$lanes>::sin_cos(self)
            }
            #[inline(always)]
            fn atan(self) -> Self {
                <$lanes>::atan(self)
            }
            #[inline(always)]
            fn select_ge0(condition: Self, a: Self, b: Self) -> Self {
                condition.simd_ge(<$lanes>::ZERO).select(a, b)
            }
        }
    };
}
impl_real_for_lanes!(f32x8, f32);
impl_real_for_lanes!(f64x4, f64);
