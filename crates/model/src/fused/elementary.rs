//! Exponential, logarithm and trigonometry in vectors.
//!
//! Polynomials are least-maximum fits of this project in f64, rounded to f32; the bounds stated are the largest errors against f64 that the tests below find.

use super::vector::Vector;

/// Σ c_i x^i, by Horner's rule.
#[inline(always)]
fn polynomial<V: Vector, const N: usize>(x: V, c: [f32; N]) -> V {
    let mut sum = V::splat(c[N - 1]);
    for i in (0..N - 1).rev() {
        sum = sum.mul_add(x, V::splat(c[i]));
    }
    sum
}

/// e^x with a relative error below 2e-7, x held to [-87.3, 88.3]; a number that is none stays none.
#[inline(always)]
pub fn exp<V: Vector>(x: V) -> V {
    let x = V::splat(88.3).min(V::splat(-87.3).max(x));
    let n = x.mul(V::splat(core::f32::consts::LOG2_E)).round();
    // ln 2 in two parts: the first has few bits, so its product with n is exact.
    let r = n.mul_add(V::splat(-0.693_145_75), x);
    let r = n.mul_add(V::splat(-1.428_606_8e-6), r);
    let tail = polynomial(r, [0.5, 0.166_665_18, 0.041_666_206, 0.008_368_882, 0.001_395_047_6]);
    let fraction = r.mul(r).mul_add(tail, r).add(V::splat(1.0));
    // 2^n: n + 127 stands in the low bits of n + 127 + 2^23.
    fraction.mul(n.add(V::splat(8_388_735.0)).shift_to_exponent())
}

/// ln x for normal x > 0 (no number where x is not finite), with an error below 2e-7 of its size or 5e-8, whichever is larger.
#[inline(always)]
pub fn ln<V: Vector>(x: V) -> V {
    let exponent = x.exponent_over_2_23().sub(V::splat(8_388_608.0 + 126.0));
    let mantissa = x.mantissa();
    // Into [√½, √2), so that ln 1 is 0 from both sides.
    let low = mantissa.sub(V::splat(core::f32::consts::FRAC_1_SQRT_2));
    let m = low.select_ge0(mantissa, mantissa.add(mantissa));
    let e = low.select_ge0(exponent, exponent.sub(V::splat(1.0)));
    let t = m.sub(V::splat(1.0));
    let tail =
        polynomial(t, [0.333_333_16, -0.250_008_1, 0.200_022_86, -0.166_245_54, 0.141_811_97, -0.131_287_68, 0.128_816_22, -0.078_595_46]);
    let square = t.mul(t);
    let small = square.mul(t).mul_add(tail, e.mul(V::splat(1.428_606_8e-6)));
    let result = square.mul_add(V::splat(-0.5), small).add(t);
    // x - x is 0, or no number where x is none.
    e.mul_add(V::splat(0.693_145_75), result).add(x.sub(x))
}

/// (sin x, cos x) for |x| < 1000, with an error below 2e-7.
#[inline(always)]
pub fn sin_cos<V: Vector>(x: V) -> (V, V) {
    let n = x.mul(V::splat(core::f32::consts::FRAC_2_PI)).round();
    // π/2 in three parts of few bits.
    let r = n.mul_add(V::splat(-1.570_312_5), x);
    let r = n.mul_add(V::splat(-4.835_128_8e-4), r);
    let r = n.mul_add(V::splat(-3.139_164_7e-7), r);
    let square = r.mul(r);
    let sine = square.mul(r).mul_add(polynomial(square, [-0.166_666_55, 0.008_332_178, -1.951_729_8e-4]), r);
    let fourth = square.mul(square);
    let cosine =
        fourth.mul_add(polynomial(square, [0.041_666_646, -0.001_388_736_8, 2.443_845e-5]), square.mul_add(V::splat(-0.5), V::splat(1.0)));
    // Quadrant n mod 4 as a float in -2..=2: odd ones swap sine and cosine; |q| > 1 turns the sign of the cosine, and so on.
    let q = n.sub(n.mul(V::splat(0.25)).round().mul(V::splat(4.0)));
    let odd = V::splat(0.5).sub(q.abs().sub(V::splat(1.0)).abs());
    let (s, c) = (odd.select_ge0(cosine, sine), odd.select_ge0(sine, cosine));
    // sin: + for q = 0, 1; - for q = ±2, -1.  cos: + for 0, -1; - for 1, ±2.
    let sin_positive = V::splat(0.75).sub(q.sub(V::splat(0.5)).abs());
    let cos_positive = V::splat(0.75).sub(q.add(V::splat(0.5)).abs());
    (sin_positive.select_ge0(s, s.neg()), cos_positive.select_ge0(c, c.neg()))
}

/// (sin x, cos x) for |x| <= 1.58, a little more than a quarter turn, with an error below 2e-7.
#[inline(always)]
pub fn sin_cos_of_half_turn<V: Vector>(x: V) -> (V, V) {
    let square = x.mul(x);
    let sine = square.mul(x).mul_add(polynomial(square, [-0.166_666_57, 0.008_333_006, -1.980_581_1e-4, 2.598_275_2e-6]), x);
    let fourth = square.mul(square);
    let tail = polynomial(square, [0.041_666_657, -0.001_388_855_7, 2.476_855_3e-5, -2.617_818e-7]);
    (sine, fourth.mul_add(tail, square.mul_add(V::splat(-0.5), V::splat(1.0))))
}

/// arctan x with an error below 2e-7.
#[inline(always)]
pub fn atan<V: Vector>(x: V) -> V {
    let one = V::splat(1.0);
    let size = x.abs();
    // |x| > tan 3π/8: π/2 - atan 1/|x|; |x| > tan π/8: π/4 + atan (|x| - 1) / (|x| + 1).
    let far = size.sub(V::splat(2.414_213_6));
    let middle = size.sub(V::splat(0.414_213_57));
    let numerator = far.select_ge0(one.neg(), middle.select_ge0(size.sub(one), size));
    let denominator = far.select_ge0(size, middle.select_ge0(size.add(one), one));
    let base =
        far.select_ge0(V::splat(core::f32::consts::FRAC_PI_2), middle.select_ge0(V::splat(core::f32::consts::FRAC_PI_4), V::splat(0.0)));
    let t = numerator.div(denominator);
    let square = t.mul(t);
    let tail = polynomial(square, [-0.333_329_56, 0.199_779_26, -0.138_798_46, 0.080_602_98]);
    let angle = base.add(square.mul(t).mul_add(tail, t));
    x.select_ge0(angle, angle.neg())
}

/// tanh x = 1 - 2 / (e^2x + 1), with an error below 2e-7.
#[inline(always)]
pub fn tanh<V: Vector>(x: V) -> V {
    let one = V::splat(1.0);
    one.sub(V::splat(2.0).div(exp(x.add(x)).add(one)))
}

/// 1 / σ(2 √(2/π) (x + 0.044715 x³)).
#[inline(always)]
fn gelu_divisor<V: Vector>(x: V) -> V {
    let inner = x.mul(x).mul(x).mul_add(V::splat(0.044_715), x);
    exp(inner.mul(V::splat(-2.0 * 0.797_884_6))).add(V::splat(1.0))
}

/// GELU, tanh form: x σ(2 √(2/π) (x + 0.044715 x³)).
#[inline(always)]
pub fn gelu<V: Vector>(x: V) -> V {
    x.div(gelu_divisor(x))
}

/// Slope of [`gelu`].
#[inline(always)]
pub fn gelu_slope<V: Vector>(x: V) -> V {
    let one = V::splat(1.0);
    let share = one.div(gelu_divisor(x));
    let inner_slope = x.mul(x).mul_add(V::splat(3.0 * 0.044_715), one).mul(V::splat(2.0 * 0.797_884_6));
    x.mul(share).mul(one.sub(share)).mul_add(inner_slope, share)
}

/// 1 / σ(x).
#[inline(always)]
fn silu_divisor<V: Vector>(x: V) -> V {
    exp(x.neg()).add(V::splat(1.0))
}

/// SiLU: x σ(x).
#[inline(always)]
pub fn silu<V: Vector>(x: V) -> V {
    x.div(silu_divisor(x))
}

/// Slope of [`silu`].
#[inline(always)]
pub fn silu_slope<V: Vector>(x: V) -> V {
    let one = V::splat(1.0);
    let share = one.div(silu_divisor(x));
    x.mul(share).mul_add(one.sub(share), share)
}

#[cfg(test)]
mod tests {
    use super::super::vector::{Kernel, LANES, Lane, Path};
    use super::*;

    /// All functions of one lane of numbers: exp, ln of the absolute, sin, cos, atan, tanh, gelu, silu, sin and cos of half a turn.
    struct Functions(Lane);

    impl Kernel for Functions {
        type Output = [Lane; 10];
        #[inline(always)]
        fn run<V: Vector>(self) -> Self::Output {
            let x = V::load(&self.0.0);
            let (sin, cos) = sin_cos(x);
            let (sin_near, cos_near) = sin_cos_of_half_turn(x);
            let mut out = [Lane::ZERO; 10];
            for (out, value) in out.iter_mut().zip([exp(x), ln(x.abs()), sin, cos, atan(x), tanh(x), gelu(x), silu(x), sin_near, cos_near])
            {
                value.store(&mut out.0);
            }
            out
        }
    }

    fn gelu_f64(x: f64) -> f64 {
        x / (1.0 + (-2.0 * f64::from(0.797_884_6f32) * (x + f64::from(0.044_715f32) * x * x * x)).exp())
    }

    #[test]
    fn analytic_functions_keep_their_stated_errors() {
        // Dense around zero and over every range that physics and network use, up to the ends of f32's exponential.
        let grid = |i: usize| {
            let share = i as f64 / 200_000.0;
            [20.0 * share - 10.0, 170.0 * share - 85.0, 1e-3 + share * 1e-2, (share * 60.0 - 30.0).exp()][i % 4] as f32
        };
        for base in (0..200_000).step_by(LANES) {
            let lane = Lane::from_fn(|l| grid(base + l));
            let results = Path::fastest().run(Functions(lane));
            for (l, x) in lane.0.iter().enumerate() {
                let x = f64::from(*x);
                let of = |i: usize| f64::from(results[i][l]);
                if x.abs() < 85.0 {
                    assert!((of(0) / x.exp() - 1.0).abs() < 2e-7, "exp {x}: {}", of(0));
                }
                let ln = x.abs().ln();
                assert!(x == 0.0 || (of(1) - ln).abs() < 5e-8f64.max(2e-7 * ln.abs()), "ln {x}: {} {ln}", of(1));
                if x.abs() < 1000.0 {
                    assert!((of(2) - x.sin()).abs() < 2e-7 && (of(3) - x.cos()).abs() < 2e-7, "sin, cos {x}: {} {}", of(2), of(3));
                }
                if x.abs() <= 1.58 {
                    assert!((of(8) - x.sin()).abs() < 2e-7 && (of(9) - x.cos()).abs() < 2e-7, "sin, cos {x}: {} {}", of(8), of(9));
                }
                assert!((of(4) - x.atan()).abs() < 2e-7, "atan {x}: {}", of(4));
                assert!((of(5) - x.tanh()).abs() < 2e-7, "tanh {x}: {}", of(5));
                let scale = 4e-7 * x.abs().max(1.0);
                assert!((of(6) - gelu_f64(x)).abs() < scale, "gelu {x}: {} {}", of(6), gelu_f64(x));
                assert!((of(7) - x / (1.0 + (-x).exp())).abs() < scale, "silu {x}: {}", of(7));
            }
        }
    }

    #[test]
    fn property_a_number_that_is_none_stays_none() {
        for path in Path::available() {
            let results = path.run(Functions(Lane([f32::NAN; LANES])));
            for (i, result) in results.iter().enumerate() {
                assert!(result.iter().all(|x| x.is_nan()), "function {i} on {} makes a number of none", path.as_str());
            }
        }
    }
}
