//! Contacts of the four wheels of a vehicle: sinkage in balance with the support, and the wrench of the soil there.
//!
//! Most of a step's work is here, and it is the same at every wheel, so scalars that have room for it ([`Real::abreast`]) work it out for all wheels at once.

use crate::scalar::Real;
use crate::soil::Soil;
use crate::terramechanics::{ContactMotion, Support, WheelGeometry, WheelWrench, balance_sinkage, wheel_wrench};
use crate::vehicle::WHEELS;

/// What the contact of a wheel depends on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rolling<T> {
    /// What presses the wheel down per sinkage of the balance.
    pub(crate) support: Support<T>,
    /// How it rolls and slides.
    pub(crate) motion: ContactMotion<T>,
    /// What it rolls on.
    pub(crate) soil: Soil<T>,
    /// Sinkage over that of the balance.
    pub(crate) ratio: T,
}

/// A wheel that has sunk in.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sunk<T> {
    /// Sinkage at which the soil carries what the suspension presses into it, m.
    pub(crate) balanced_m: T,
    /// The wrench of the soil at the sinkage of the wheel, `balanced_m` times the ratio.
    pub(crate) wrench: WheelWrench<T>,
}

impl<T: Real> Rolling<T> {
    /// The contact of a wheel.
    #[inline(always)]
    pub(crate) fn sink(&self, wheel: &WheelGeometry) -> Sunk<T> {
        let balanced_m = balance_sinkage(wheel, &self.support, &self.motion, &self.soil);
        Sunk { balanced_m, wrench: wheel_wrench(wheel, balanced_m * self.ratio, &self.motion, &self.soil) }
    }

    /// The contacts of four wheels of one geometry, where the scalar has room for them side by side.
    #[inline(always)]
    pub(crate) fn sink_abreast(wheels: [&Self; WHEELS], wheel: &WheelGeometry) -> Option<[Sunk<T>; WHEELS]> {
        let abreast = Rolling {
            support: Support { preload_n: abreast(wheels, |w| &w.support.preload_n)?, rate_n_m: abreast(wheels, |w| &w.support.rate_n_m)? },
            motion: ContactMotion {
                travel_ratio: abreast(wheels, |w| &w.motion.travel_ratio)?,
                rim_ratio: abreast(wheels, |w| &w.motion.rim_ratio)?,
                lateral_ratio: abreast(wheels, |w| &w.motion.lateral_ratio)?,
                slip: abreast(wheels, |w| &w.motion.slip)?,
            },
            soil: Soil {
                k_phi: abreast(wheels, |w| &w.soil.k_phi)?,
                k_c: abreast(wheels, |w| &w.soil.k_c)?,
                n: abreast(wheels, |w| &w.soil.n)?,
                c: abreast(wheels, |w| &w.soil.c)?,
                phi: abreast(wheels, |w| &w.soil.phi)?,
                k_shear: abreast(wheels, |w| &w.soil.k_shear)?,
            },
            ratio: abreast(wheels, |w| &w.ratio)?,
        };
        let Sunk { balanced_m, wrench } = abreast.sink(wheel);
        let balanced_m = T::apart(&balanced_m);
        let (thrust_n, resistance_n, side_n) = (T::apart(&wrench.thrust_n), T::apart(&wrench.resistance_n), T::apart(&wrench.side_n));
        let (normal_n, torque_n_m) = (T::apart(&wrench.normal_n), T::apart(&wrench.torque_n_m));
        Some(core::array::from_fn(|i| Sunk {
            balanced_m: balanced_m[i],
            wrench: WheelWrench {
                thrust_n: thrust_n[i],
                resistance_n: resistance_n[i],
                side_n: side_n[i],
                normal_n: normal_n[i],
                torque_n_m: torque_n_m[i],
            },
        }))
    }
}

/// One number of each wheel, side by side.
#[inline(always)]
fn abreast<T: Real>(wheels: [&Rolling<T>; WHEELS], of: impl Fn(&Rolling<T>) -> &T) -> Option<T::Four> {
    T::abreast([of(wheels[0]), of(wheels[1]), of(wheels[2]), of(wheels[3])])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scalar::{Dual, f32x8};
    use crate::terramechanics::{ContactLaw, WheelMotion};

    /// Four wheels on four soils: driving hard, braking, sliding sideways, and in the air.
    fn wheels<T: Real>(slope: impl Fn(f64, usize) -> T) -> [Rolling<T>; WHEELS] {
        let soils = [
            [1.515e6, 5.27e3, 0.7, 1720.0, 0.506, 0.025],
            [8.0e5, 1.1e3, 1.05, 900.0, 0.55, 0.015],
            [2.0e5, 1.3e4, 0.45, 4000.0, 0.25, 0.03],
            [1.2e7, 1.0e5, 1.0, 2.0e4, 0.6, 0.005],
        ];
        let of = [(9000.0, 3.0, 2.2, 0.1, 1.0), (4000.0, 1.5, 2.0, -0.3, 0.8), (7000.0, 2.0, 2.0, 1.5, 1.4), (-500.0, 2.1, 2.0, 0.0, 1.0)];
        core::array::from_fn(|i| {
            let (preload_n, rim, forward, left, ratio) = of[i];
            let number = |x: f64, at: usize| slope(x, at);
            let motion =
                WheelMotion { rim_speed_m_s: number(rim, 0), forward_m_s: number(forward, 1), left_m_s: number(left, 2) }.contact().1;
            let soil = Soil::from_array(core::array::from_fn(|k| number(soils[i][k], k)));
            Rolling {
                support: Support { preload_n: number(preload_n, 3), rate_n_m: number(1.2e5, 4) },
                motion,
                soil,
                ratio: number(ratio, 5),
            }
        })
    }

    fn numbers<T: Copy>(sunk: &Sunk<T>) -> [T; 6] {
        let w = sunk.wrench;
        [sunk.balanced_m, w.thrust_n, w.resistance_n, w.side_n, w.normal_n, w.torque_n_m]
    }

    #[test]
    fn property_wheels_abreast_are_the_wheels_one_by_one() {
        for law in ContactLaw::ALL {
            let wheel = WheelGeometry::new(0.467, 0.254).with_law(law);
            let plain = wheels::<f64>(|x, _| x);
            let duals = wheels::<Dual<f64, 6>>(|x, at| Dual { re: x, eps: Dual::<f64, 6>::variable(x, at).eps.map(|e| e * x) });
            let abreast = Rolling::sink_abreast(plain.each_ref(), &wheel).unwrap();
            let with_slopes = Rolling::sink_abreast(duals.each_ref(), &wheel).unwrap();
            for i in 0..WHEELS {
                let close = |a: f64, b: f64, size: f64| assert!((a - b).abs() <= 1e-11 * size, "{law:?}, wheel {i}: {a} and {b}");
                for (got, want) in numbers(&abreast[i]).into_iter().zip(numbers(&plain[i].sink(&wheel))) {
                    close(got, want, want.abs() + 1.0);
                }
                for (got, want) in numbers(&with_slopes[i]).into_iter().zip(numbers(&duals[i].sink(&wheel))) {
                    let size = want.re.abs() + 1.0 + want.eps.iter().map(|e| e.abs()).fold(0.0, f64::max);
                    close(got.re, want.re, size);
                    got.eps.into_iter().zip(want.eps).for_each(|(got, want)| close(got, want, size));
                }
            }
        }
    }

    #[test]
    fn property_lanes_of_vehicles_have_no_room_for_wheels() {
        let lanes = wheels::<f32x8>(|x, _| f32x8::splat(x as f32));
        assert!(Rolling::sink_abreast(lanes.each_ref(), &WheelGeometry::new(0.467, 0.254)).is_none());
    }
}
