//! Bulldozing: the soil that a wheel pushes aside and ahead.
//!
//! Side bulldozing is an option of [`wheel_wrench`](super::wheel_wrench) (see [`WheelGeometry::side_soil_unit_weight_n_m3`]); front
//! bulldozing is a free function for those who study deep sinkage. Both are off in the step of the vehicle, because their unit weight
//! is not among the six parameters of the paper's soil.

use crate::scalar::Real;
use crate::soil::Soil;
use crate::terramechanics::slip::ContactMotion;
use crate::terramechanics::wheel::{SINKAGE_FLOOR_M, SINKAGE_SHARE_MAX, WheelGeometry, angle_of_depth, exit_angle};

/// Slip angle within which the side resistance grows to its full size, rad (chosen: about one degree, so that it is smooth at zero).
const SLIP_ANGLE_SCALE_RAD: f64 = 0.02;
/// Travel per rim speed below which the slip angle is regularised, - (chosen: a wheel that spins on the spot has no slip angle).
const TRAVEL_FLOOR: f64 = 0.02;

/// Part of the rim that lies in the soil.
#[derive(Clone, Copy, Debug)]
pub struct ContactArc<T> {
    /// Entry angle θ_1, rad.
    pub entry_rad: T,
    /// Exit angle θ_2, rad.
    pub exit_rad: T,
    /// cos θ_1.
    pub cos_entry: T,
}

impl<T: Real> ContactArc<T> {
    /// Arc of a wheel at a sinkage, m, with the angles of [`wheel_wrench`](super::wheel_wrench).
    pub fn of(wheel: &WheelGeometry, sinkage_m: T, soil: &Soil<T>) -> Self {
        let z = sinkage_m.max(T::lit(SINKAGE_FLOOR_M)).min(T::lit(SINKAGE_SHARE_MAX * wheel.radius_m));
        let share = z * T::lit(1.0 / wheel.radius_m);
        let (entry_rad, _, cos_entry) = angle_of_depth(share);
        Self { entry_rad, exit_rad: exit_angle(wheel, z, share, wheel.is_damped(), soil), cos_entry }
    }
}

/// Resistance of the soil per metre of a wall that pushes it aside at depth h, N/m.
///
/// Hegedüs' bulldozing law as used by Ishigami et al. (J. Field Robotics 24, 2007): R_b = D_1 (c h + D_2 γ h² / 2) with
/// D_1 = cot X_c + tan(X_c + φ), D_2 = cot X_c + cot² X_c / cot φ, and the destructive angle X_c = 45° - φ/2. `unit_weight_n_m3` is
/// γ = ρ g, N/m³. Valid for h ≥ 0 and 0 < φ < 90°; neglects the slope of the surface and the heap that grows in front of the wall.
/// Wong's passive-earth form has the same cohesive term and about half the frictional one, so this is the upper of the two in use.
#[inline(always)]
pub fn side_resistance<T: Real>(depth_m: T, unit_weight_n_m3: f64, soil: &Soil<T>) -> T {
    let tan_phi = soil.phi.tan();
    // cot(45° - φ/2) = tan(45° + φ/2) = tan(X_c + φ): one tangent gives both coefficients.
    let cot_xc = (soil.phi * T::lit(0.5) + T::lit(core::f64::consts::FRAC_PI_4)).tan();
    let d1 = cot_xc + cot_xc;
    let d2 = cot_xc + cot_xc * cot_xc * tan_phi;
    d1 * (soil.c * depth_m + d2 * depth_m * depth_m * T::lit(0.5 * unit_weight_n_m3))
}

/// Share of the side resistance that is mobilised, in (-1, 1): sign(β) (1 - e^{-|β| / 0.02}), smooth at β = 0.
///
/// β = atan(v_left / |v_forward|) is the slip angle; positive when the wheel slides to the left.
#[inline(always)]
pub fn side_mobilisation<T: Real>(motion: &ContactMotion<T>) -> T {
    let slip_angle = (motion.lateral_ratio / motion.travel_ratio.abs_smooth(TRAVEL_FLOOR)).atan();
    let size = slip_angle.abs_smooth(1e-6);
    slip_angle / size * (T::lit(1.0) - (-size * T::lit(1.0 / SLIP_ANGLE_SCALE_RAD)).exp())
}

/// Side force of the soil on the side wall of a wheel, N, positive to the left: -sign(β) ∫ R_b(h) (r - h cos θ) dθ over the arc.
///
/// h(θ) = r (cos θ - cos θ_1) is the depth of the rim (Ishigami 2007, eq. for F_y; the second term of the side force there).
// Out of line: the step inlines the wheel many times and must not carry an option that it leaves off.
#[cold]
#[inline(never)]
pub fn side_bulldozing<T: Real>(
    wheel: &WheelGeometry,
    unit_weight_n_m3: f64,
    arc: &ContactArc<T>,
    motion: &ContactMotion<T>,
    soil: &Soil<T>,
) -> T {
    let radius = T::lit(wheel.radius_m);
    let length = arc.entry_rad - arc.exit_rad;
    let mut sum = T::lit(0.0);
    for &(t2, weight) in wheel.rule.nodes() {
        let (_, cos) = (arc.entry_rad - length * T::lit(t2)).sin_cos();
        let depth = (cos - arc.cos_entry) * radius;
        sum = sum + side_resistance(depth, unit_weight_n_m3, soil) * (radius - depth * cos) * T::lit(weight);
    }
    -(side_mobilisation(motion) * sum * length)
}

/// Bearing-capacity factors of general shear failure, -.
#[derive(Clone, Copy, Debug)]
pub struct BearingCapacity<T> {
    /// Surcharge factor N_q = e^{π tan φ} tan²(45° + φ/2) (Prandtl 1921, Reissner 1924).
    pub n_q: T,
    /// Cohesion factor N_c = (N_q - 1) cot φ (Prandtl 1921).
    pub n_c: T,
    /// Weight factor N_γ = 2 (N_q + 1) tan φ (Vesić 1973); Terzaghi's own N_γ has no closed form.
    pub n_gamma: T,
}

impl<T: Real> BearingCapacity<T> {
    /// Factors of a friction angle, rad, 0 < φ < 90°.
    #[inline(always)]
    pub fn new(phi_rad: T) -> Self {
        let tan_phi = phi_rad.tan();
        let tan_half = (phi_rad * T::lit(0.5) + T::lit(core::f64::consts::FRAC_PI_4)).tan();
        let n_q = (tan_phi * T::lit(core::f64::consts::PI)).exp() * tan_half * tan_half;
        Self { n_q, n_c: (n_q - T::lit(1.0)) / tan_phi, n_gamma: T::lit(2.0) * (n_q + T::lit(1.0)) * tan_phi }
    }
}

/// Resistance of the soil heaped up ahead of a wheel, N: R_b = b (c z K_pc + γ z² K_pγ / 2) (Bekker 1969; Wong, *Theory of Ground
/// Vehicles*, ch. 2), with K_pc = (N_c - tan φ) cos² φ and K_pγ = (2 N_γ / tan φ + 1) cos² φ.
///
/// Takes the width b (m), sinkage z (m), and unit weight γ (N/m³). Valid for 0 < φ < 90° and dense soil (general shear failure; for
/// loose soil Wong takes 2/3 of tan φ); matters for wide or deeply sunk wheels only.
#[inline(always)]
pub fn front_bulldozing<T: Real>(width_m: f64, sinkage_m: T, unit_weight_n_m3: f64, soil: &Soil<T>) -> T {
    let capacity = BearingCapacity::new(soil.phi);
    let (tan_phi, (_, cos)) = (soil.phi.tan(), soil.phi.sin_cos());
    let k_pc = (capacity.n_c - tan_phi) * cos * cos;
    let k_pg = (T::lit(2.0) * capacity.n_gamma / tan_phi + T::lit(1.0)) * cos * cos;
    let weight = sinkage_m * sinkage_m * T::lit(0.5 * unit_weight_n_m3);
    (soil.c * sinkage_m * k_pc + weight * k_pg) * T::lit(width_m)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::terramechanics::{GaussRule, WheelWrench, wheel_wrench};

    /// φ = 30° makes every coefficient a root of three, c = 1 kPa.
    fn soil() -> Soil<f64> {
        Soil { k_phi: 8e6, k_c: 10.0, n: 1.46, c: 1e3, phi: 30f64.to_radians(), k_shear: 0.021 }
    }

    fn wrench(unit_weight: Option<f64>, sinkage_m: f64, tan_slip_angle: f64, soil: &Soil<f64>) -> WheelWrench<f64> {
        let wheel = WheelGeometry { side_soil_unit_weight_n_m3: unit_weight, rule: GaussRule::new(24), ..WheelGeometry::new(0.058, 0.05) };
        wheel_wrench(&wheel, sinkage_m, &ContactMotion::from_slip(0.2, tan_slip_angle), soil)
    }

    fn close(got: f64, want: f64, tolerance: f64) {
        assert!((got - want).abs() <= tolerance * want.abs(), "got {got}, want {want}");
    }

    #[test]
    fn analytic_side_resistance_at_thirty_degrees() {
        // cot 30° = √3, so D_1 = D_2 = 2 √3 and R_b = 2 √3 c h + 6 γ h² = 69.282 + 31.2 N/m at 2 cm.
        close(side_resistance(0.02, 13e3, &soil()), 100.482_032, 1e-8);
    }

    #[test]
    fn analytic_side_wall_integral_of_a_weightless_soil() {
        // γ = 0, λ = 0: D_1 c r² ∫_0^θ1 [(cos θ - C) - (cos θ - C)² cos θ] dθ with C = cos θ_1 has a closed form.
        let (r, z) = (0.058, 0.02);
        let cos = 1.0 - z / r;
        let entry = f64::acos(cos);
        let sin = entry.sin();
        let first = sin - entry * cos;
        let second = sin - sin.powi(3) / 3.0 - cos * (entry + sin * cos) + cos * cos * sin;
        let want = 12f64.sqrt() * 1e3 * r * r * (first - second);
        // At 45° the mobilisation is one but for e^{-39}.
        let got = wrench(None, z, 1.0, &soil()).side_n - wrench(Some(0.0), z, 1.0, &soil()).side_n;
        close(got, want, 1e-9);
    }

    #[test]
    fn property_side_bulldozing_opposes_sliding_and_grows() {
        let force = |z: f64, weight: f64, soil: &Soil<f64>| wrench(None, z, 0.5, soil).side_n - wrench(Some(weight), z, 0.5, soil).side_n;
        let base = force(0.02, 13e3, &soil());
        assert!(base > 0.0);
        assert!(force(0.025, 13e3, &soil()) > base, "depth");
        assert!(force(0.02, 15e3, &soil()) > base, "unit weight");
        assert!(force(0.02, 13e3, &Soil { c: 1.2e3, ..soil() }) > base, "cohesion");
        assert!(force(0.02, 13e3, &Soil { phi: 0.55, ..soil() }) > base, "friction angle");
        let mut previous = 0.0;
        for tan in [0.0, 1e-3, 1e-2, 0.03, 0.1, 0.3] {
            let [left, right] = [tan, -tan].map(|t| wrench(Some(13e3), 0.02, t, &soil()).side_n);
            assert!((left + right).abs() < 1e-9, "odd in the slip angle");
            assert!(left <= previous, "slip angle {tan}");
            previous = left;
        }
    }

    /// The arc of a wheel on its own is that of the wrench, also where soil springs back elastically.
    #[test]
    fn property_an_arc_has_the_angles_of_the_wrench() {
        let soil = Soil { k_phi: 2e6, k_c: 5e3, n: 0.8, ..soil() };
        let motion = ContactMotion::from_slip(0.2, 0.5);
        let settled = WheelGeometry::new(0.467, 0.254);
        for plain in [WheelGeometry { recovery: 0.05, ..settled.clone() }, settled.on_damped_soil(1e4)] {
            let with_wall = WheelGeometry { side_soil_unit_weight_n_m3: Some(13e3), ..plain.clone() };
            let [with, without] = [&with_wall, &plain].map(|wheel| wheel_wrench(wheel, 0.04, &motion, &soil).side_n);
            let arc = ContactArc::of(&plain, 0.04, &soil);
            close(side_bulldozing(&plain, 13e3, &arc, &motion, &soil), with - without, 1e-9);
        }
    }

    #[test]
    fn property_side_bulldozing_touches_the_side_force_only() {
        let [off, on] = [None, Some(13e3)].map(|weight| wrench(weight, 0.02, 0.5, &soil()));
        let rest = |w: &WheelWrench<f64>| [w.thrust_n, w.resistance_n, w.normal_n, w.torque_n_m].map(f64::to_bits);
        assert_eq!(rest(&off), rest(&on));
    }

    #[test]
    fn published_bearing_capacity_at_thirty_degrees() {
        // Vesić (1973), table: N_q 18.40, N_c 30.14, N_γ 22.40, to the two digits printed.
        let factors = BearingCapacity::new(30f64.to_radians());
        for (got, want) in [(factors.n_q, 18.40), (factors.n_c, 30.14), (factors.n_gamma, 22.40)] {
            assert!((got - want).abs() < 0.006, "got {got}, want {want}");
        }
    }

    #[test]
    fn analytic_front_bulldozing_at_thirty_degrees() {
        // K_pc = (30.13963 - 0.57735) 0.75 = 22.17171; K_pγ = (4 · 19.40112 + 1) 0.75 = 58.95337;
        // R_b = 0.05 (20 · 22.17171 + 2.6 · 58.95337) = 29.83565 N.
        close(front_bulldozing(0.05, 0.02, 13e3, &soil()), 29.835_65, 1e-6);
        assert!(front_bulldozing(0.05, 0.03, 13e3, &soil()) > front_bulldozing(0.05, 0.02, 13e3, &soil()));
    }
}
