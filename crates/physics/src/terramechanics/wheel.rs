//! Stress integration under a rigid wheel (Wong & Reece 1967), the Bekker-Wong operator B of the paper (§III-B).

use crate::scalar::Real;
use crate::soil::Soil;
use crate::terramechanics::bulldozing::{ContactArc, side_bulldozing};
use crate::terramechanics::gauss::GaussRule;
use crate::terramechanics::pressure_sinkage::normal_stress;
use crate::terramechanics::shear::{mobilised_share, mohr_coulomb};
use crate::terramechanics::slip::ContactMotion;

/// Shear displacement below which its direction is smoothed, m.
const SHEAR_FLOOR_M: f64 = 1e-6;
/// Largest sinkage as a share of the radius at which the contact geometry is evaluated.
pub(crate) const SINKAGE_SHARE_MAX: f64 = 0.9;
/// Smallest sinkage, m: a wheel off the ground carries no load, but its contact stays differentiable.
pub(crate) const SINKAGE_FLOOR_M: f64 = 1e-5;
/// Sliding speed over rim speed around which the direction of sliding turns smoothly (chosen: 5 cm/s at 2.5 m/s).
const SLIDING_FLOOR: f64 = 0.02;
/// Recovery λ of the soil contact model (chosen: the elastic part of soils with a stiffness of 4e7 Pa/m under a tonne is a few millimetres).
const ELASTIC_RECOVERY: f64 = 0.05;
/// Elastic stiffness of damped soil, Pa/m (that of the simulated drives: it springs back by two to five millimetres under half a tonne).
const ELASTIC_PA_M: f64 = 4e7;

/// How stresses act under the wheel: a family of laws, of which measured drives choose (`nesam train` keeps the one whose symbolic rollouts are better).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ContactLaw {
    /// Stress normal to the rim with its maximum ahead of the bottom, shear along the rim (Wong & Reece 1967), the law of the paper.
    #[default]
    WongReece,
    /// Pressure by the local depth across the undeformed surface, shear in that surface against the local sliding velocity and mobilised by the
    /// displacement (soil contact model: Krenn & Gibbesch 2011; Tasora et al. 2019). Compaction brakes the wheel's rotation, not the vehicle, and the
    /// front of the contact, which slides forwards, brakes what the bottom drives.
    SoilContactModel,
}

impl ContactLaw {
    /// The family.
    pub const ALL: [Self; 2] = [Self::WongReece, Self::SoilContactModel];
}

/// Geometry and contact coefficients of a wheel.
#[derive(Clone, Debug, PartialEq)]
pub struct WheelGeometry {
    /// Radius r, m.
    pub radius_m: f64,
    /// Width b, m.
    pub width_m: f64,
    /// c_1 of the angle of maximum stress θ_m = (c_1 + c_2 |s|) θ_1 (Wong & Reece 1967; 0.4 after Ishigami 2007).
    pub c1: f64,
    /// c_2 of the same (0.15).
    pub c2: f64,
    /// Recovery λ of the exit angle θ_2 = -acos(1 - λ z / r) beyond what is elastic; 0 = none.
    pub recovery: f64,
    /// Elastic stiffness of damped soil, Pa/m: behind the axle it springs back by its pressure over this. Infinite = not at all.
    pub elastic_pa_m: f64,
    /// Pressure by which the soil resists being pressed down, over the speed of that, Pa s/m: viscous part of the contact (soil contact model: Tasora et al.
    /// 2019; a linear law of rate for the pressure that Grahn 1991 measured to grow with the speed of penetration). 0 = as slow as a plate test.
    pub soil_damping_pa_s_m: f64,
    /// Unit weight γ of the soil that the side wall pushes aside, N/m³; `None` = no side bulldozing.
    pub side_soil_unit_weight_n_m3: Option<f64>,
    /// How stresses act.
    pub law: ContactLaw,
    /// Quadrature.
    pub rule: GaussRule,
}

impl WheelGeometry {
    /// Wheel with the coefficients of Ishigami (2007), five quadrature nodes, and no side bulldozing.
    pub fn new(radius_m: f64, width_m: f64) -> Self {
        let law = ContactLaw::WongReece;
        Self {
            radius_m,
            width_m,
            c1: 0.4,
            c2: 0.15,
            recovery: 0.0,
            elastic_pa_m: f64::INFINITY,
            soil_damping_pa_s_m: 0.0,
            side_soil_unit_weight_n_m3: None,
            law,
            rule: GaussRule::new(5),
        }
    }

    /// The same wheel under a law, with the coefficients of that law.
    pub fn with_law(self, law: ContactLaw) -> Self {
        match law {
            ContactLaw::WongReece => Self { law, ..self },
            ContactLaw::SoilContactModel => Self { law, c1: 0.0, c2: 0.0, recovery: ELASTIC_RECOVERY, ..self },
        }
    }

    /// The same wheel on soil that resists being pressed fast and springs back by its pressure over its stiffness, instead of by a share of the sinkage.
    pub fn on_damped_soil(self, soil_damping_pa_s_m: f64) -> Self {
        Self { soil_damping_pa_s_m, elastic_pa_m: ELASTIC_PA_M, recovery: 0.0, ..self }
    }

    /// Whether the soil is damped: what follows from where its pressure acts is worked out then only.
    #[inline(always)]
    pub(crate) fn is_damped(&self) -> bool {
        self.soil_damping_pa_s_m > 0.0
    }
}

/// Resultant of the contact stresses, in the wheel's contact frame (x = rolling direction, y = left, z = away from the ground).
#[derive(Clone, Copy, Debug)]
pub struct WheelWrench<T> {
    /// Thrust H = r b ∫ τ_x cos θ dθ, N.
    pub thrust_n: T,
    /// Compaction resistance R = r b ∫ σ sin θ dθ, N.
    pub resistance_n: T,
    /// Side force of the soil on the wheel, -r b ∫ τ_y dθ, N, and that of side bulldozing where it is asked for.
    pub side_n: T,
    /// Normal force W = r b ∫ (σ cos θ + τ_x sin θ) dθ, N.
    pub normal_n: T,
    /// Driving torque T = r² b ∫ τ_x dθ, N m.
    pub torque_n_m: T,
}

impl<T: Real> WheelWrench<T> {
    /// Drawbar pull DP = H - R, N.
    #[inline(always)]
    pub fn drawbar_n(&self) -> T {
        self.thrust_n - self.resistance_n
    }
}

/// Angle whose cosine is 1 - depth / r, with its sine; exact and smooth for 0 < depth < 2 r.
#[inline(always)]
pub(super) fn angle_of_depth<T: Real>(depth_share: T) -> (T, T, T) {
    let cos = T::lit(1.0) - depth_share;
    let sin = (depth_share * (T::lit(2.0) - depth_share)).sqrt();
    // tan(θ/2) = sin / (1 + cos): no branch at θ = π/2.
    ((sin / (T::lit(1.0) + cos)).atan() * T::lit(2.0), sin, cos)
}

/// Exit angle θ_2 = -acos(1 - (λz + e)/r) of a sinkage z (m), which is this share of the radius, rad.
#[inline(always)]
pub(super) fn exit_angle<T: Real>(wheel: &WheelGeometry, z: T, share: T, damped: bool, soil: &Soil<T>) -> T {
    let mut springs_back = share * T::lit(wheel.recovery) + T::lit(1e-24);
    if damped {
        let elastic = normal_stress(z, wheel.width_m, soil) * T::lit(1.0 / (wheel.elastic_pa_m * wheel.radius_m));
        springs_back = (springs_back + elastic).min(share);
    }
    -angle_of_depth(springs_back).0
}

/// Integrates normal and shear stress over the contact arc at a given sinkage (m).
///
/// Entry angle θ_1 = acos(1 - z/r); exit θ_2 = -acos(1 - (λz + e)/r) with e what the soil springs back elastically; maximum stress at
/// θ_m = (c_1 + c_2 |s|) θ_1; directions and shear by the wheel's [`ContactLaw`]. The rim presses soil down at [`ContactMotion::pressing_m_s`] sin θ, for
/// which the soil's damping adds pressure ahead of the axle and takes it away behind, down to none; neglects that the axle itself moves up or down. Side
/// bulldozing is added where the wheel asks for it; neglects the shear of the side wall. Sinkage is limited to [1e-5 m, 0.9 r].
#[inline(always)]
pub fn wheel_wrench<T: Real>(wheel: &WheelGeometry, sinkage_m: T, motion: &ContactMotion<T>, soil: &Soil<T>) -> WheelWrench<T> {
    if wheel.is_damped() { on_damped_soil(wheel, sinkage_m, motion, soil) } else { integrated::<T, false>(wheel, sinkage_m, motion, soil) }
}

/// Stands out of the line of soil that is not damped.
#[cold]
#[inline(never)]
fn on_damped_soil<T: Real>(wheel: &WheelGeometry, sinkage_m: T, motion: &ContactMotion<T>, soil: &Soil<T>) -> WheelWrench<T> {
    integrated::<T, true>(wheel, sinkage_m, motion, soil)
}

#[inline(always)]
fn integrated<T: Real, const DAMPED: bool>(
    wheel: &WheelGeometry,
    sinkage_m: T,
    motion: &ContactMotion<T>,
    soil: &Soil<T>,
) -> WheelWrench<T> {
    let radius = wheel.radius_m;
    let z = sinkage_m.max(T::lit(SINKAGE_FLOOR_M)).min(T::lit(SINKAGE_SHARE_MAX * radius));
    let share = z * T::lit(1.0 / radius);
    let (entry, sin_entry, cos_entry) = angle_of_depth(share);
    let exit = exit_angle(wheel, z, share, DAMPED, soil);
    let slip_size = motion.slip.abs_smooth(1e-9);
    let peak = entry * (T::lit(wheel.c1) + T::lit(wheel.c2) * slip_size).min(T::lit(0.999));
    let (front, rear) = (entry - peak, peak - exit);
    let tan_phi = soil.phi.tan();
    let per_modulus = T::lit(1.0) / soil.k_shear;

    let viscous = motion.pressing_m_s * T::lit(wheel.soil_damping_pa_s_m);
    let zero = T::lit(0.0);
    let mut sum = WheelWrench { thrust_n: zero, resistance_n: zero, side_n: zero, normal_n: zero, torque_n_m: zero };
    for &(t2, weight) in wheel.rule.nodes() {
        let theta_front = entry - front * T::lit(t2);
        let front_trig = theta_front.sin_cos_of_half_turn();
        // The rear branch mirrors the front stress (Wong & Reece 1967): one evaluation of depth^n serves both.
        let still = normal_stress((front_trig.1 - cos_entry) * T::lit(radius), wheel.width_m, soil);
        let still_strength = mohr_coulomb(still, tan_phi, soil);
        let theta_rear = exit + rear * T::lit(t2);
        for (theta, (sin, cos), arc) in [(theta_front, front_trig, front), (theta_rear, theta_rear.sin_cos_of_half_turn(), rear)] {
            let (sigma, strength) = if DAMPED {
                let sigma = (still + viscous * sin).max(zero);
                (sigma, mohr_coulomb(sigma, tan_phi, soil))
            } else {
                (still, still_strength)
            };
            let at = ContactPoint { sin, cos, swept: entry - theta, sin_entry };
            let w = arc * T::lit(weight);
            match wheel.law {
                ContactLaw::WongReece => {
                    let [tau_x, tau_y] = shear_along_rim(radius, &at, motion, strength, per_modulus);
                    sum.thrust_n = sum.thrust_n + tau_x * cos * w;
                    sum.resistance_n = sum.resistance_n + sigma * sin * w;
                    sum.side_n = sum.side_n - tau_y * w;
                    sum.normal_n = sum.normal_n + (sigma * cos + tau_x * sin) * w;
                    sum.torque_n_m = sum.torque_n_m + tau_x * w;
                }
                ContactLaw::SoilContactModel => {
                    let across = cos * w;
                    let [tau_x, tau_y] = shear_in_surface(radius, &at, motion, strength, per_modulus);
                    sum.thrust_n = sum.thrust_n + tau_x * across;
                    sum.side_n = sum.side_n - tau_y * across;
                    sum.normal_n = sum.normal_n + sigma * across;
                    sum.torque_n_m = sum.torque_n_m + (tau_x * cos + sigma * sin) * across;
                }
            }
        }
    }
    let area = T::lit(radius * wheel.width_m);
    let sheared_n = sum.side_n * area;
    let side_n = match wheel.side_soil_unit_weight_n_m3 {
        None => sheared_n,
        Some(unit_weight) => {
            let arc = ContactArc { entry_rad: entry, exit_rad: exit, cos_entry };
            sheared_n + side_bulldozing(wheel, unit_weight, &arc, motion, soil)
        }
    };
    WheelWrench {
        thrust_n: sum.thrust_n * area,
        resistance_n: sum.resistance_n * area,
        side_n,
        normal_n: sum.normal_n * area,
        torque_n_m: sum.torque_n_m * area * T::lit(radius),
    }
}

/// Load that damping carries over the sinkage, N/m, of a shallow contact that presses at u: b r d u ∫ sin θ cos θ dθ = b d u (z - z² / 2r).
#[inline(always)]
pub(crate) fn viscous_rate_n_m<T: Real>(wheel: &WheelGeometry, pressing_m_s: T) -> T {
    pressing_m_s.max(T::lit(0.0)) * T::lit(wheel.soil_damping_pa_s_m * wheel.width_m)
}

/// A point of the contact arc: sine and cosine of its angle, the angle swept since the rim entered the soil, and the sine there.
struct ContactPoint<T> {
    sin: T,
    cos: T,
    swept: T,
    sin_entry: T,
}

/// Shear stress (x, y) along the rim, Pa: j_x = r [(θ_1 - θ) - (v_x / rΩ)(sin θ_1 - sin θ)], j_y = r (v_y / rΩ)(θ_1 - θ), combined isotropically (Jia 2011).
#[inline(always)]
fn shear_along_rim<T: Real>(radius: f64, at: &ContactPoint<T>, motion: &ContactMotion<T>, strength: T, per_modulus: T) -> [T; 2] {
    let j_x = (motion.rim_ratio * at.swept - motion.travel_ratio * (at.sin_entry - at.sin)) * T::lit(radius);
    let j_y = motion.lateral_ratio * at.swept * T::lit(radius);
    let j = (j_x * j_x + j_y * j_y + T::lit(SHEAR_FLOOR_M * SHEAR_FLOOR_M)).sqrt();
    let mobilised = strength * mobilised_share(j, per_modulus) / j;
    [mobilised * j_x, mobilised * j_y]
}

/// Shear stress (x, y) in the surface of the ground, Pa: against the sliding velocity u = (rΩ cos θ - v_x, -v_y), mobilised by its integral
/// j_x = r [(sin θ_1 - sin θ) - (v_x / rΩ)(θ_1 - θ)], j_y = r (v_y / rΩ)(θ_1 - θ). Neglects that soil sheared by a front wheel stays sheared, and the path of a
/// point that slides forth and back.
#[inline(always)]
fn shear_in_surface<T: Real>(radius: f64, at: &ContactPoint<T>, motion: &ContactMotion<T>, strength: T, per_modulus: T) -> [T; 2] {
    let j_x = (motion.rim_ratio * (at.sin_entry - at.sin) - motion.travel_ratio * at.swept) * T::lit(radius);
    let j_y = motion.lateral_ratio * at.swept * T::lit(radius);
    let j = (j_x * j_x + j_y * j_y + T::lit(SHEAR_FLOOR_M * SHEAR_FLOOR_M)).sqrt();
    let (u_x, u_y) = (motion.rim_ratio * at.cos - motion.travel_ratio, motion.lateral_ratio);
    let mobilised = strength * mobilised_share(j, per_modulus) / (u_x * u_x + u_y * u_y + T::lit(SLIDING_FLOOR * SLIDING_FLOOR)).sqrt();
    [mobilised * u_x, mobilised * u_y]
}
