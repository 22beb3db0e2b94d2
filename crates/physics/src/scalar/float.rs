//! Plain floats.

use super::Real;

macro_rules! impl_real_for_float {
    ($float:ty) => {
        impl Real for $float {
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
                x as $float
            }
            #[inline(always)]
            fn exp(self) -> Self {
                <$float>::exp(self)
            }
            #[inline(always)]
            fn ln(self) -> Self {
                <$float>::ln(self)
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                <$float>::sqrt(self)
            }
            #[inline(always)]
            fn sin_cos(self) -> (Self, Self) {
                <$float>::sin_cos(self)
            }
            #[inline(always)]
            fn atan(self) -> Self {
                <$float>::atan(self)
            }
            #[inline(always)]
            fn select_ge0(condition: Self, a: Self, b: Self) -> Self {
                if condition >= 0.0 { a } else { b }
            }
        }
    };
}
impl_real_for_float!(f32);
impl_real_for_float!(f64);
