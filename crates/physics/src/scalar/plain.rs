//! Numbers without derivatives: floats, and lanes of them (eight f32 for batched inference and the forward pass of training, four f64 for the wheels of one
//! vehicle).

use super::{Real, f32x8, f64x4};

/// [`Real`] by the methods of the type itself, and what each has of its own.
macro_rules! impl_real {
    ($number:ty { $($own:tt)* }) => {
        impl Real for $number {
            type Value = Self;
            const PLAIN: bool = true;
            $($own)*
            #[inline(always)]
            fn value(self) -> Self {
                self
            }
            #[inline(always)]
            fn from_value(value: Self) -> Self {
                value
            }
            #[inline(always)]
            fn exp(self) -> Self {
                <$number>::exp(self)
            }
            #[inline(always)]
            fn ln(self) -> Self {
                <$number>::ln(self)
            }
            #[inline(always)]
            fn sqrt(self) -> Self {
                <$number>::sqrt(self)
            }
            #[inline(always)]
            fn sin_cos(self) -> (Self, Self) {
                <$number>::sin_cos(self)
            }
            #[inline(always)]
            fn atan(self) -> Self {
                <$number>::atan(self)
            }
        }
    };
}

macro_rules! impl_real_for_float {
    ($float:ty { $($own:tt)* }) => {
        impl_real!($float {
            $($own)*
            #[inline(always)]
            fn lit(x: f64) -> Self {
                x as $float
            }
            #[inline(always)]
            fn select_ge0(condition: Self, a: Self, b: Self) -> Self {
                if condition >= 0.0 { a } else { b }
            }
        });
    };
}

macro_rules! impl_real_for_lanes {
    ($lanes:ty, $float:ty) => {
        impl_real!($lanes {
            const SINGLE: bool = <$float as Real>::SINGLE;
            type Four = Self;
            #[inline(always)]
            fn lit(x: f64) -> Self {
                <$lanes>::splat(x as $float)
            }
            #[inline(always)]
            fn select_ge0(condition: Self, a: Self, b: Self) -> Self {
                condition.simd_ge(<$lanes>::ZERO).select(a, b)
            }
        });
    };
}

impl_real_for_float!(f32 {
    const SINGLE: bool = true;
    type Four = Self;
});
impl_real_for_float!(f64 {
    const SINGLE: bool = false;
    type Four = f64x4;
    #[inline(always)]
    fn abreast(four: [&Self; 4]) -> Option<f64x4> {
        Some(f64x4::new(four.map(|number| *number)))
    }
    #[inline(always)]
    fn apart(four: &f64x4) -> [Self; 4] {
        four.to_array()
    }
});
impl_real_for_lanes!(f32x8, f32);
impl_real_for_lanes!(f64x4, f64);
