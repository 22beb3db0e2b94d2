//! Contacts of the four wheels of a vehicle: sinkage in balance with the support, and the wrench of the soil there.
//!
//! Most of a step's work is here, and it is the same at every wheel, so scalars that have room for it ([`Real::abreast`]) work it out for all wheels at once.

use crate::scalar::Real;
use crate::soil::Soil;
use crate::terramechanics::{ContactMotion, Support, WheelGeometry, WheelWrench, balance_sinkage, wheel_wrench};
use crate::vehicle::WHEELS;

/// Numbers in a [`Rolling`] and in a [`Sunk`].
pub const ROLLING: usize = 14;
/// See [`ROLLING`].
pub const SUNK: usize = 6;

/// One of something for each wheel.
pub type Wheels<'a, S> = [&'a S; WHEELS];

/// What the contact of a wheel depends on.
#[derive(Clone, Copy, Debug)]
pub struct Rolling<T> {
    /// What presses the wheel down per sinkage of the balance.
    pub support: Support<T>,
    /// How it rolls and slides.
    pub motion: ContactMotion<T>,
    /// What it rolls on.
    pub soil: Soil<T>,
    /// Sinkage over that of the balance.
    pub ratio: T,
}

/// A wheel that has sunk in.
#[derive(Clone, Copy, Debug)]
pub struct Sunk<T> {
    /// Sinkage at which the soil carries what the suspension presses into it, m.
    pub balanced_m: T,
    /// The wrench of the soil at the sinkage of the wheel, `balanced_m` times the ratio.
    pub wrench: WheelWrench<T>,
}

impl<T: Real> Rolling<T> {
    /// The contact of a wheel.
    #[inline(always)]
    pub fn sink(&self, wheel: &WheelGeometry) -> Sunk<T> {
        let balanced_m = balance_sinkage(wheel, &self.support, &self.motion, &self.soil);
        Sunk { balanced_m, wrench: wheel_wrench(wheel, balanced_m * self.ratio, &self.motion, &self.soil) }
    }

    /// The contacts of four wheels, one after the other.
    #[inline(always)]
    pub fn sink_each(wheels: Wheels<'_, Self>, geometries: Wheels<'_, WheelGeometry>) -> [Sunk<T>; WHEELS] {
        core::array::from_fn(|i| wheels[i].sink(geometries[i]))
    }

    /// Its numbers: support, motion, soil, ratio, each in the order of its fields.
    #[inline(always)]
    pub fn to_array(&self) -> [T; ROLLING] {
        let Self { support, motion, soil, ratio } = *self;
        let [k_phi, k_c, n, c, phi, k_shear] = soil.to_array();
        let Support { preload_n, rate_n_m } = support;
        let ContactMotion { travel_ratio, rim_ratio, lateral_ratio, slip, pressing_m_s } = motion;
        [preload_n, rate_n_m, travel_ratio, rim_ratio, lateral_ratio, slip, pressing_m_s, k_phi, k_c, n, c, phi, k_shear, ratio]
    }

    /// From [`Rolling::to_array`].
    #[inline(always)]
    pub fn from_array(numbers: [T; ROLLING]) -> Self {
        let [preload_n, rate_n_m, travel_ratio, rim_ratio, lateral_ratio, slip, pressing_m_s, k_phi, k_c, n, c, phi, k_shear, ratio] =
            numbers;
        Self {
            support: Support { preload_n, rate_n_m },
            motion: ContactMotion { travel_ratio, rim_ratio, lateral_ratio, slip, pressing_m_s },
            soil: Soil { k_phi, k_c, n, c, phi, k_shear },
            ratio,
        }
    }

    /// The contacts of four wheels of one geometry, where the scalar has room for them side by side.
    #[inline(always)]
    pub(crate) fn sink_abreast(wheels: Wheels<'_, Self>, wheel: &WheelGeometry) -> Option<[Sunk<T>; WHEELS]> {
        let [a, b, c, d] = [wheels[0].to_array(), wheels[1].to_array(), wheels[2].to_array(), wheels[3].to_array()];
        let mut abreast = [T::abreast([&a[0], &b[0], &c[0], &d[0]])?; ROLLING];
        for (i, four) in abreast.iter_mut().enumerate().skip(1) {
            *four = T::abreast([&a[i], &b[i], &c[i], &d[i]])?;
        }
        let sunk = Rolling::from_array(abreast).sink(wheel).to_array();
        let apart: [[T; WHEELS]; SUNK] = core::array::from_fn(|k| T::apart(&sunk[k]));
        Some(core::array::from_fn(|i| Sunk::from_array(core::array::from_fn(|k| apart[k][i]))))
    }
}

impl<T: Real> Sunk<T> {
    /// Its numbers, in the order of its fields.
    #[inline(always)]
    pub fn to_array(&self) -> [T; SUNK] {
        let WheelWrench { thrust_n, resistance_n, side_n, normal_n, torque_n_m } = self.wrench;
        [self.balanced_m, thrust_n, resistance_n, side_n, normal_n, torque_n_m]
    }

    /// From [`Sunk::to_array`].
    #[inline(always)]
    pub fn from_array([balanced_m, thrust_n, resistance_n, side_n, normal_n, torque_n_m]: [T; SUNK]) -> Self {
        Self { balanced_m, wrench: WheelWrench { thrust_n, resistance_n, side_n, normal_n, torque_n_m } }
    }
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
                for (got, want) in abreast[i].to_array().into_iter().zip(plain[i].sink(&wheel).to_array()) {
                    close(got, want, want.abs() + 1.0);
                }
                for (got, want) in with_slopes[i].to_array().into_iter().zip(duals[i].sink(&wheel).to_array()) {
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
