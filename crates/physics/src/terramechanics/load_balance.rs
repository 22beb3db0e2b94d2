//! Sinkage at which the soil carries what the suspension presses into it.

use crate::scalar::Real;
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
    newton_step(wheel, T::from_value(z), support, motion, soil)
}

#[inline(always)]
fn newton_step<T: Real>(wheel: &WheelGeometry, z: T, support: &Support<T>, motion: &ContactMotion<T>, soil: &Soil<T>) -> T {
    let carried = wheel_wrench(wheel, z, motion, soil).normal_n;
    let pressed = (support.preload_n - support.rate_n_m * z).relu_smooth(1.0);
    let slope = (soil.n + T::lit(0.5)) * carried / z + support.rate_n_m;
    // Derivatives flow through the residual only; the slope is a constant of the step.
    let next = z - (carried - pressed) / T::from_value(slope.value());
    next.max(z * T::lit(0.1)).min(z * T::lit(4.0)).min(T::lit(0.85 * wheel.radius_m)).max(T::lit(1e-5))
}
