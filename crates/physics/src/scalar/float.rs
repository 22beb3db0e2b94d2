//! Plain floats.

use super::{Real, f64x4};

macro_rules! impl_real_for_float {
    ($float:ty, $four:ty, $abreast:expr, $apart:expr) => {
        impl Real for $float {
            type Value = Self;
            type Four = $four;
            #[inline(always)]
            fn abreast(four: [&Self; 4]) -> Option<$four> {
                ($abreast)(four)
            }
            #[inline(always)]
            fn apart(four: &$four) -> [Self; 4] {
                ($apart)(four)
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
impl_real_for_float!(f32, f32, |_| None, |four: &f32| [*four; 4]);
impl_real_for_float!(f64, f64x4, |four: [&f64; 4]| Some(f64x4::new(four.map(|v| *v))), |four: &f64x4| four.to_array());
