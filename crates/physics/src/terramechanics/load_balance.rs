//! Sinkage at which the soil carries what the suspension presses into it.

use crate::scalar::{Dual, Real};
use crate::soil::Soil;
use crate::terramechanics::pressure_sinkage::bekker_sinkage;
use crate::terramechanics::slip::ContactMotion;
use crate::terramechanics::wheel::{WheelGeometry, wheel_wrench};

/// Newton steps on values; each shrinks the error of ln z by an order of magnitude or more.
const ITERATIONS: usize = 3;

/// What presses the wheel down: force = `preload_n` - `rate_n_m` · sinkage, never negative.
#[derive(Clone, Copy, Debug)]
pub struct Support<T> {
    /// Force at zero sinkage, N (may be negative: the wheel hangs in the air).
    pub preload_n: T,
    /// Loss of force per metre of sinkage, N/m; 0 = dead load.
    pub rate_n_m: T,
}

/// Solves W(z; θ, slip) = preload - rate z for the sinkage z > 0, m.
///
/// W is taken as a power law of exponent n + 1/2 around each iterate (Bekker's wheel), which makes Newton's method converge in a few
/// steps without branches. The iterations run on plain values; a last step on `T` gives the derivatives of the implicit function.
/// A support that lifts off (preload ≤ 0) gives a vanishing sinkage.
#[inline(always)]
pub fn balance_sinkage<T: Real>(wheel: &WheelGeometry, support: &Support<T>, motion: &ContactMotion<T>, soil: &Soil<T>) -> T {
    let values = |m: &ContactMotion<T>| ContactMotion {
        travel_ratio: m.travel_ratio.value(),
        rim_ratio: m.rim_ratio.value(),
        lateral_ratio: m.lateral_ratio.value(),
        slip: m.slip.value(),
    };
    let motion_value = values(motion);
    let soil_value = Soil::from_array(soil.to_array().map(T::value));
    let support_value = Support { preload_n: support.preload_n.value(), rate_n_m: support.rate_n_m.value() };
    let floor_n = <T::Value as Real>::lit(1.0);
    let load = support_value.preload_n.max(floor_n);
    let mut z = bekker_sinkage(load, wheel.radius_m, wheel.width_m, &soil_value);
    // With a stiff support the load falls as the wheel sinks: start where the series of both springs would settle.
    z = z * load / (load + support_value.rate_n_m * z);
    for _ in 0..ITERATIONS {
        z = newton_step(wheel, z, &support_value, &motion_value, &soil_value);
    }
    // Last step on `T`: the exact slope of the residual makes z - f / f' carry the derivatives of the implicit function.
    let slope = residual_slope(wheel, z, &support_value, &motion_value, &soil_value);
    let z = T::from_value(z);
    bounded(z, z - residual(wheel, z, support, motion, soil).0 / T::from_value(slope), wheel)
}

/// f(z) = W(z) - pressed(z), N, and the force carried W(z).
#[inline(always)]
fn residual<T: Real>(wheel: &WheelGeometry, z: T, support: &Support<T>, motion: &ContactMotion<T>, soil: &Soil<T>) -> (T, T) {
    let carried = wheel_wrench(wheel, z, motion, soil).normal_n;
    (carried - (support.preload_n - support.rate_n_m * z).relu_smooth(1.0), carried)
}

/// f'(z), N/m, by a dual number in z.
#[inline(always)]
fn residual_slope<V: Real>(wheel: &WheelGeometry, z: V, support: &Support<V>, motion: &ContactMotion<V>, soil: &Soil<V>) -> V {
    let c = Dual::<V, 1>::constant;
    let motion = ContactMotion {
        travel_ratio: c(motion.travel_ratio),
        rim_ratio: c(motion.rim_ratio),
        lateral_ratio: c(motion.lateral_ratio),
        slip: c(motion.slip),
    };
    let soil = Soil::from_array(soil.to_array().map(c));
    let support = Support { preload_n: c(support.preload_n), rate_n_m: c(support.rate_n_m) };
    residual(wheel, Dual::variable(z, 0), &support, &motion, &soil).0.eps[0]
}

/// A Newton step that takes W for a power law of exponent n + 1/2.
#[inline(always)]
fn newton_step<V: Real>(wheel: &WheelGeometry, z: V, support: &Support<V>, motion: &ContactMotion<V>, soil: &Soil<V>) -> V {
    let (f, carried) = residual(wheel, z, support, motion, soil);
    let slope = (soil.n + V::lit(0.5)) * carried / z + support.rate_n_m;
    bounded(z, z - f / slope, wheel)
}

/// Keeps a step within a decade and the wheel.
#[inline(always)]
fn bounded<T: Real>(z: T, next: T, wheel: &WheelGeometry) -> T {
    next.max(z * T::lit(0.1)).min(z * T::lit(4.0)).min(T::lit(0.85 * wheel.radius_m)).max(T::lit(1e-5))
}
