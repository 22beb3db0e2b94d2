//! Rims that a torque drives: which over-speed a hub torque brings, and what of it the contact passes on.
//!
//! A wheel's inertia is small against the slope of its traction (milliseconds), so its rim settles at once where the soil takes the torque of the hub:
//! T = r² b ∫ τ_x dθ and, under the soil contact model, the moment of the pressure ahead of the axle. The over-speed is guessed in closed form, the contact
//! evaluated there, and its force carried on to the torque exactly: one evaluation, no iteration.

use crate::scalar::Real;
use crate::soil::Soil;
use crate::state::VehicleState;
use crate::step::{StepInput, StepModel, fresh_share};
use crate::terramechanics::{
    ContactLaw, SINKAGE_FLOOR_M, SINKAGE_SHARE_MAX, Support, WheelGeometry, WheelMotion, bekker_sinkage, travel_direction, viscous_rate_n_m,
};
use crate::vehicle::WHEELS;

/// Largest share of the shear strength that the guess mobilises (chosen: beyond it the wheel spins and traction control works).
const MOBILISED_MAX: f64 = 0.95;
/// The same where couplings are asked, first and again: what they hand over keeps most wheels from spinning (chosen).
const MOBILISED: [f64; 2] = [0.7, MOBILISED_MAX];
/// Largest over-speed, m/s (chosen: middle of the range in which traction control closes the throttle of the simulated vehicle).
const OVERSPEED_MAX_M_S: f64 = 2.5;
/// Range of slips of the guess: s = (rim - ground) / rim.
const SLIP_RANGE: [f64; 2] = [-3.0, 0.6];
/// Ground speed around which directions turn, m/s (as for slip).
const SPEED_FLOOR_M_S: f64 = 0.05;
/// Coupling of a locked differential, N m s/rad (chosen: ten times a viscous one).
const LOCKED_N_M_S: f64 = 5000.0;
/// The coupling of half a lock is one part in this many and one of the whole (chosen: about that of a viscous coupling).
const LOOSENESS: f64 = 16.0;
/// What presses a wheel in the air, N: its share in a load of nothing would be 0 / 0 in f32.
const LEAST_PRELOAD_N: f64 = 0.01;
/// Bend of the curve between a straight line and a power (1 + e BEND x / (1 + x)²; within 2 % of ln(1 + x) / (1 + x) for x < 5).
const BEND: f64 = 1.35;
/// What a contact carries less per depth over radius than Bekker's parabola (fitted to contacts of this crate down to 0.8 r).
const DEEP: f64 = 0.22;
/// How much further ahead the moment lies than the pressure: the front of the contact is dragged along (fitted to the same).
const DRAGGED: f64 = 1.08;
/// Lead of the pressure of damping over the length: 2/3 of a pressure that grows with x, and the same drag (fitted to the same).
const VISCOUS_ARM: f64 = 0.8;
/// Slip over the square of the entry angle at which the shear of front and bottom balance (fitted to the same; the mean displacement alone gives 1/6).
const NEUTRAL_SLIP: f64 = 1.0 / 9.0;
/// Lever arm of the pressure ahead of the axle over the length of the contact, and what the exponent takes of it: centroid of a pressure (1 - x²)^n,
/// 0.424 of the length for n = 1/2, 3/8 for n = 1.
const ARM: f64 = 0.475;
const ARM_PER_EXPONENT: f64 = 0.1;
/// Smallest contact length, m.
const LENGTH_FLOOR_M: f64 = 5e-3;

/// What a contact can hold against a torque.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Grip<T> {
    /// Largest shear force N tan φ + c A, N.
    pub(crate) limit_n: T,
    /// Length of the contact, m.
    length_m: T,
    /// How far ahead of the axle the forces of the soil act, m: none where it is not damped.
    pub(crate) lead_m: T,
    /// Force at the rim that compaction takes of the torque, N: the load at its lead.
    pub(crate) compaction_n: T,
    /// Slip at which the shear of front and bottom balance, -.
    neutral_slip: T,
}

impl<T: Real> Grip<T> {
    /// Of a wheel at a support that presses fresh soil at a speed (m/s).
    #[inline(always)]
    pub(crate) fn settled(wheel: &WheelGeometry, support: &Support<T>, pressing_m_s: T, soil: &Soil<T>) -> Self {
        if wheel.is_damped() {
            return Self::on_damped_soil(wheel, support, pressing_m_s, soil);
        }
        let pressed = support.preload_n.relu_smooth(1.0) + T::lit(LEAST_PRELOAD_N);
        let alone = bekker_sinkage(pressed, wheel.radius_m, wheel.width_m, soil);
        let sinkage_m = alone * pressed / (pressed + support.rate_n_m * alone);
        let load_n = (support.preload_n - support.rate_n_m * sinkage_m).relu_smooth(1.0);
        let (length_m, limit_n) = held(wheel, sinkage_m, load_n, soil);
        let (entry, zero) = (length_m * T::lit(1.0 / wheel.radius_m), T::lit(0.0));
        // Chord against arc of the first shear displacement, mean over the contact: θ² / 6 ahead (surface) or behind (rim).
        let chord = entry.sqr() * T::lit(1.0 / 6.0);
        match wheel.law {
            ContactLaw::WongReece => Self { limit_n, length_m, lead_m: zero, compaction_n: zero, neutral_slip: -chord },
            ContactLaw::SoilContactModel => {
                let arm = T::lit(ARM) - T::lit(ARM_PER_EXPONENT) * soil.n;
                Self { limit_n, length_m, lead_m: zero, compaction_n: load_n * entry * arm, neutral_slip: chord }
            }
        }
    }

    /// The same on damped soil, by the sinkage that the static law leaves it beside the spring of the support and the damping.
    ///
    /// With u = z / z_1 for Bekker's sinkage z_1 under the whole preload: (1 + √λ) u^m / (1 + d z / r) + x u = 1, m = n + 1/2, x = what spring and damping give
    /// way by; √λ is how much longer the contact is for soil that springs back, d what a deep contact carries less than Bekker's parabola (fitted to the
    /// contacts of this crate). One step of Newton from the solution for a straight line, bent by 1 - 1 / m. What compaction takes
    /// comes out within a quarter, the slip of a rim within 0.1 of the contact's own from firm ground to forty centimetres in mud (a test holds it to that).
    #[inline(always)]
    fn on_damped_soil(wheel: &WheelGeometry, support: &Support<T>, pressing_m_s: T, soil: &Soil<T>) -> Self {
        let (radius, one) = (wheel.radius_m, T::lit(1.0));
        let pressed = support.preload_n.relu_smooth(1.0) + T::lit(LEAST_PRELOAD_N);
        let alone = bekker_sinkage(pressed, radius, wheel.width_m, soil);
        let viscous = viscous_rate_n_m(wheel, pressing_m_s) * alone / pressed;
        let x = support.rate_n_m * alone / pressed + viscous;
        let (m, bent) = (soil.n + T::lit(0.5), soil.n - T::lit(0.5));
        let start = (one + bent / m * T::lit(BEND) * x / (one + x).sqr()) / (one + x);
        let power = start.powf(bent);
        let depth_m = alone * start + T::lit(SINKAGE_FLOOR_M);
        let root = springing_root(wheel, depth_m, pressed * power * start, soil);
        let carried = power * (one + root) / (one + depth_m * T::lit(DEEP / radius));
        let x = x - viscous * depth_m * T::lit(0.5 / radius);
        let sinkage_m = alone * (bent * carried * start + one) / (m * carried + x);
        let load_n = (support.preload_n - support.rate_n_m * sinkage_m).relu_smooth(1.0);

        let (length_m, limit_n) = held(wheel, sinkage_m, load_n, soil);
        let entry = length_m * T::lit(1.0 / radius);
        // Centroid of a pressure (1 - x²)^n ahead of the axle: 0.424 of the length for n = 1/2, 3/8 for n = 1; that of damping, and what lies behind.
        let arm = T::lit(ARM * DRAGGED) - T::lit(ARM_PER_EXPONENT * DRAGGED) * soil.n;
        let viscous_n = viscous_rate_n_m(wheel, pressing_m_s) * length_m.sqr() * T::lit(0.5 / radius);
        let viscous_share = (viscous_n / (load_n + T::lit(LEAST_PRELOAD_N))).min(one);
        let lead_m = length_m * (arm + viscous_share * (T::lit(VISCOUS_ARM) - arm)) * (one - root);
        let compaction_n = load_n * lead_m * T::lit(1.0 / radius);
        Self { limit_n, length_m, lead_m, compaction_n, neutral_slip: entry.sqr() * T::lit(NEUTRAL_SLIP) }
    }

    /// How the rim turns whose contact takes a torque, given as force at the rim (N), on ground that passes under it at `ground_m_s`.
    ///
    /// Inverts the mean of Janosi's law over a contact of linearly growing displacement, u = 1 - (1 - e^-a) / a with a = s L / K, by a = u (2 - u) / (1 - u)
    /// (within 6 %). Of the strength, `mobilised_max` is used at most.
    #[inline(always)]
    fn rim(&self, driven_n: T, ground_m_s: T, mobilised_max: f64, soil: &Soil<T>) -> Rim<T> {
        let one = T::lit(1.0);
        let size = ground_m_s.abs_smooth(SPEED_FLOOR_M_S);
        let direction = ground_m_s / size;
        let compaction = self.compaction_n * direction.sqr();
        let share = ((driven_n * direction - compaction) / self.limit_n).min(T::lit(mobilised_max)).max(T::lit(-mobilised_max));
        let used = share.abs_smooth(1e-6);
        let free = one - used;
        let per_stretch = soil.k_shear / self.length_m;
        let slip = share * (T::lit(2.0) - used) / free * per_stretch + self.neutral_slip;
        let slip = slip.min(T::lit(SLIP_RANGE[1])).max(T::lit(SLIP_RANGE[0]));
        let slope = self.limit_n * free.sqr() / ((one + free.sqr()) * per_stretch);
        let over = direction * slip * size / (one - slip);
        Rim {
            overspeed_m_s: over.min(T::lit(OVERSPEED_MAX_M_S)).max(T::lit(-OVERSPEED_MAX_M_S)),
            taken_n: (share * self.limit_n + compaction) * direction,
            slope_n_s_m: slope * (one - slip).sqr() / size,
        }
    }
}

/// Length of a contact, m, and the largest shear force that it holds, N.
#[inline(always)]
fn held<T: Real>(wheel: &WheelGeometry, sinkage_m: T, load_n: T, soil: &Soil<T>) -> (T, T) {
    let radius = wheel.radius_m;
    let z = sinkage_m.max(T::lit(0.0)).min(T::lit(SINKAGE_SHARE_MAX * radius));
    let length_m = (z * (T::lit(2.0 * radius) - z) + T::lit(LENGTH_FLOOR_M * LENGTH_FLOOR_M)).sqrt();
    (length_m, (load_n * soil.phi.tan() + soil.c * length_m * T::lit(wheel.width_m)).relu_smooth(1.0))
}

/// Largest shear force S of a contact, N, and the sideways speed, m/s, at which its slope where the wheel does not slide to that side yet would reach it. The slope is
/// that of Janosi's law over a contact of linearly growing displacement, S L / (2 K |v|) of length L, shear modulus K and rim speed v; where the wheel slides ahead at a
/// speed o that shears the soil whole, S / |o|, as the force points against the sliding.
#[inline(always)]
pub(crate) fn sheared_sideways<T: Real>(wheel: &WheelGeometry, sinkage_m: T, load_n: T, motion: &WheelMotion<T>, soil: &Soil<T>) -> (T, T) {
    let (length_m, limit_n) = held(wheel, sinkage_m, load_n, soil);
    let rolling = soil.k_shear * T::lit(2.0) * motion.rim_speed_m_s.abs_smooth(SPEED_FLOOR_M_S) / length_m;
    let over = motion.rim_speed_m_s - motion.forward_m_s;
    (limit_n, (rolling.sqr() + over.sqr()).sqrt())
}

/// √λ for the share λ of a sinkage by which soil springs back behind the wheel: the pressure at the bottom of Bekker's wheel, 3 W / ((3 - n) b √(D z)), over the
/// elastic stiffness.
#[inline(always)]
fn springing_root<T: Real>(wheel: &WheelGeometry, sinkage_m: T, load_n: T, soil: &Soil<T>) -> T {
    let chord_m = (sinkage_m * T::lit(2.0 * wheel.radius_m)).sqrt();
    let pressure = load_n / ((T::lit(1.0) - soil.n * T::lit(1.0 / 3.0)) * chord_m * T::lit(wheel.width_m));
    let lambda = T::lit(wheel.recovery + 1e-12) + pressure * T::lit(1.0 / wheel.elastic_pa_m) / sinkage_m;
    lambda.min(T::lit(1.0)).sqrt()
}

/// What is to be added to the shear force found at the guess so that the contact of a wheel takes the torque, N, within the strength of the soil.
#[inline(always)]
pub(crate) fn carried_on_n<T: Real>(wheel: &WheelGeometry, sunk: (T, T), soil: &Soil<T>, driven_n: T, taken_n: T, thrust_n: T) -> T {
    let (sinkage_m, load_n) = sunk;
    let top = held(wheel, sinkage_m, load_n, soil).1;
    (thrust_n + driven_n - taken_n).min(top).max(-top) - thrust_n
}

/// A point of the curve of the force that a contact takes at the rim over the speed of the rim over the ground.
#[derive(Clone, Copy, Debug)]
struct Rim<T> {
    overspeed_m_s: T,
    /// Force at the rim that the contact takes there: the one that was asked for as far as it is below the strength, N.
    taken_n: T,
    slope_n_s_m: T,
}

/// Forces at the rims that couplings hand from faster wheels to slower ones, N: C times what a rim's speed is above the mean of all, C = `coupling_n_s_m`.
///
/// Each rim follows its ground and, by the slope of its traction, the force that it is handed: p_i = -C (u_i - ū) with u_i = v_i + o_i + (f_i + p_i - t_i) / k_i
/// from the point (o_i, t_i) of its curve and the force f_i alone. Linear in p; the sum of all is 0. Nothing is divided by a slope, which is next to nothing
/// for a wheel in the air.
#[inline(always)]
fn handed_over<T: Real>(coupling_n_s_m: f64, driven_n: &[T; WHEELS], ground_m_s: &[T; WHEELS], rims: &[Rim<T>; WHEELS]) -> [T; WHEELS] {
    let sum = |of: &dyn Fn(usize) -> T| (1..WHEELS).fold(of(0), |sum, i| sum + of(i));
    let coupling = T::lit(coupling_n_s_m);
    let share: [T; WHEELS] = core::array::from_fn(|i| T::lit(1.0) / (rims[i].slope_n_s_m + coupling));
    let turning: [T; WHEELS] = core::array::from_fn(|i| ground_m_s[i] + rims[i].overspeed_m_s);
    let untaken: [T; WHEELS] = core::array::from_fn(|i| driven_n[i] - rims[i].taken_n);
    let mean = sum(&|i| share[i] * (rims[i].slope_n_s_m * turning[i] + untaken[i])) / sum(&|i| share[i] * rims[i].slope_n_s_m);
    core::array::from_fn(|i| coupling * share[i] * (rims[i].slope_n_s_m * (mean - turning[i]) - untaken[i]))
}

/// Coupling of a lock that takes away a share of the difference of rims, N m s/rad: k s / (1 - s) against a slope of traction k, up to the stiffest one.
fn lock_n_m_s(share: f64) -> f64 {
    let share = share.clamp(0.0, 1.0);
    LOCKED_N_M_S * share / (share + LOOSENESS * (1.0 - share))
}

/// A wheel under torque, as the step needs it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Driven<T> {
    /// Torque of the hub over the radius, N.
    pub(crate) at_rim_n: T,
    /// What brakes and the friction of the wheel itself take of it against the travel, N.
    pub(crate) braked_n: T,
    /// How fast what drives falls with the speed of the wheel, N s/m.
    pub(crate) damping_n_s_m: T,
    /// Speed of the rim over that of the ground, m/s.
    pub(crate) overspeed_m_s: T,
}

impl StepModel {
    /// What drives the wheels, which pass over the ground at `forward_m_s` and have these grips, if torque drives this vehicle: a quarter each of
    /// what the speed control asks for through open differentials, less what brakes and the friction of the wheel itself hold against its travel, and what
    /// couplings hand from faster wheels to slower ones, sides and axles alike.
    #[inline(always)]
    pub(crate) fn driven<T: Real>(
        &self,
        grips: &[Grip<T>; WHEELS],
        forward_m_s: &[T; WHEELS],
        state: &VehicleState<T>,
        input: &StepInput<T>,
    ) -> Option<[Driven<T>; WHEELS]> {
        let line = &self.vehicle.driveline;
        let drive = line.torque.as_ref()?;
        let actuator = &self.vehicle.effects.actuator;
        let speed = state.velocity_m_s[0];
        let each: [T; WHEELS] = core::array::from_fn(|i| T::lit(1.0 / (WHEELS as f64 * self.wheel_at(i).radius_m)));
        let (mut alone_n, mut braked_n) = ([T::lit(0.0); WHEELS], [T::lit(0.0); WHEELS]);
        for i in 0..WHEELS {
            let demand = input.wheels.demand_m_s(i, speed);
            let hubs = drive.torques(demand, input.wheels.speed_m_s, speed, 1.0 - actuator.torque_lost);
            braked_n[i] = hubs.braking_n_m * each[i] + T::lit(self.vehicle.effects.force.wheel_drag_n_m[i] / self.wheel_at(i).radius_m);
            alone_n[i] = hubs.driving_n_m * each[i] - travel_direction(forward_m_s[i]) * braked_n[i];
        }
        let coupling_n_m_s = 2.0 * line.side_coupling_n_m_s + lock_n_m_s(actuator.lock);
        let coupling_n_s_m = coupling_n_m_s / (self.wheel.radius_m * self.wheel.radius_m);
        let mut at_rim_n = alone_n;
        for mobilised in MOBILISED.into_iter().filter(|_| coupling_n_s_m != 0.0) {
            let rims = core::array::from_fn(|i| grips[i].rim(at_rim_n[i], forward_m_s[i], mobilised, &input.soil));
            let handed = handed_over(coupling_n_s_m, &alone_n, forward_m_s, &rims);
            at_rim_n = core::array::from_fn(|i| alone_n[i] + handed[i]);
        }
        Some(core::array::from_fn(|i| Driven {
            at_rim_n: at_rim_n[i],
            damping_n_s_m: input.wheels.rim_gain * each[i] * T::lit(drive.per_demand_n_m_s_m),
            braked_n: braked_n[i],
            overspeed_m_s: grips[i].rim(at_rim_n[i], forward_m_s[i], MOBILISED_MAX, &input.soil).overspeed_m_s,
        }))
    }

    /// What the contacts of wheels under supports (preload, N) can hold at speeds over the ground (m/s); `None` where neither a torque nor damped soil asks for it.
    #[inline(always)]
    pub(crate) fn grips<T: Real>(&self, wheels: &[(T, T); WHEELS], soil: &Soil<T>) -> Option<[Grip<T>; WHEELS]> {
        let damped = self.wheel.is_damped();
        (damped || self.vehicle.driveline.torque.is_some()).then(|| {
            core::array::from_fn(|i| {
                let (preload_n, speed_m_s) = wheels[i];
                let mut pressing_m_s = T::lit(0.0);
                if damped {
                    let speed = speed_m_s.abs_smooth(SPEED_FLOOR_M_S);
                    pressing_m_s = speed * fresh_share(i, speed_m_s / speed);
                }
                let support = Support { preload_n, rate_n_m: T::lit(self.vehicle.suspension_n_m[i]) };
                Grip::settled(self.wheel_at(i), &support, pressing_m_s, soil)
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::terramechanics::{ContactMotion, balance_sinkage, wheel_wrench};

    fn grip(load_n: f64, soil: &Soil<f64>) -> Grip<f64> {
        let wheel = WheelGeometry::new(0.467, 0.254).with_law(ContactLaw::SoilContactModel);
        Grip::settled(&wheel, &Support { preload_n: load_n, rate_n_m: 0.0 }, 2.0, soil)
    }

    #[test]
    fn property_a_grip_knows_the_contact_that_it_guesses() {
        let mud = Soil { k_phi: 1.3e5, k_c: 700.0, n: 0.8, c: 1700.0, phi: 0.139, k_shear: 0.043 };
        let clay = Soil { k_phi: 2.8e5, k_c: 2e3, n: 0.75, c: 3545.0, phi: 0.143, k_shear: 0.04 };
        let sand = Soil { k_phi: 3.0e5, k_c: 900.0, n: 1.1, c: 500.0, phi: 0.42, k_shear: 0.04 };
        let grass = Soil { k_phi: 1.8e6, k_c: 6e3, n: 0.8, c: 3000.0, phi: 0.5, k_shear: 0.02 };
        let firm = Soil { k_phi: 1.2e7, k_c: 1e5, n: 0.9, c: 1e4, phi: 0.6, k_shear: 0.008 };
        let wheel = WheelGeometry::new(0.467, 0.254).with_law(ContactLaw::SoilContactModel).on_damped_soil(2e4);
        for (soil, pressing_m_s) in [mud, clay, sand, grass, firm].into_iter().flat_map(|soil| [(soil, 0.0), (soil, 2.5)]) {
            // A dead load, and a stiff spring that has let the vehicle sink in until it carries the same.
            let motion = ContactMotion { pressing_m_s, ..ContactMotion::from_slip(0.05, 0.03) };
            let sunk_m = balance_sinkage(&wheel, &Support { preload_n: 6000.0, rate_n_m: 0.0 }, &motion, &soil);
            let wrench = wheel_wrench(&wheel, sunk_m, &motion, &soil);
            let compaction_n = wrench.torque_n_m / wheel.radius_m - wrench.thrust_n;
            for rate_n_m in [0.0, 2e5] {
                let grip = Grip::settled(&wheel, &Support { preload_n: 6000.0 + rate_n_m * sunk_m, rate_n_m }, pressing_m_s, &soil);
                let rim = grip.rim(wrench.torque_n_m / wheel.radius_m, 2.5, MOBILISED_MAX, &soil);
                let slip = rim.overspeed_m_s / (2.5 + rim.overspeed_m_s);
                let says = format!("{soil:?}, {pressing_m_s} m/s, {rate_n_m} N/m: {} of {compaction_n} N, slip {slip}", grip.compaction_n);
                assert!((0.8..1.25).contains(&(grip.compaction_n / compaction_n)), "{says}");
                assert!((slip - 0.05).abs() < 0.1, "{says}");
            }
        }
    }

    #[test]
    fn analytic_a_lock_grows_from_nothing_to_one_that_is_stiff() {
        assert!(lock_n_m_s(0.0) == 0.0 && lock_n_m_s(1.0) == LOCKED_N_M_S && lock_n_m_s(1.3) == LOCKED_N_M_S);
        // k s / (1 - s) for a slope of traction of k, far from the end.
        for share in [0.2, 0.5, 0.7] {
            let want = LOCKED_N_M_S / LOOSENESS * share / (1.0 - share);
            assert!((lock_n_m_s(share) / want - 1.0).abs() < 0.15, "{share}: {} {want}", lock_n_m_s(share));
        }
    }

    #[test]
    fn analytic_what_is_handed_over_is_what_the_rims_it_leads_to_ask_for() {
        let loam = Soil { k_phi: 1515.04e3, k_c: 5.27e3, n: 0.7, c: 1.72e3, phi: 0.506, k_shear: 0.025 };
        let firm = Soil { k_phi: 1.2e7, k_c: 1e5, n: 1.0, c: 2e4, phi: 0.6, k_shear: 0.005 };
        // Forces before the couplings and speeds of the ground: a turn, a dragging wheel, and an axle that gets more.
        let cases = [
            ([2400.0; WHEELS], [2.05, 2.4, 1.8, 2.2]),
            ([2400.0, 2400.0, 2400.0, 500.0], [2.0; WHEELS]),
            ([4000.0, 1000.0, 2400.0, 2000.0], [2.0; WHEELS]),
        ];
        for (soil, coupling_n_s_m, (alone_n, ground_m_s)) in
            [(&loam, 1000.0), (&firm, 2000.0)].into_iter().flat_map(|(soil, c)| cases.map(|case| (soil, c, case)))
        {
            let grips = [6400.0, 6400.0, 4000.0, 8000.0].map(|load_n| grip(load_n, soil));
            let mut handed = [0.0; WHEELS];
            let rims = |handed: &[f64; WHEELS], mobilised: f64| -> [Rim<f64>; WHEELS] {
                core::array::from_fn(|i| grips[i].rim(alone_n[i] + handed[i], ground_m_s[i], mobilised, soil))
            };
            for mobilised in MOBILISED {
                handed = handed_over(coupling_n_s_m, &alone_n, &ground_m_s, &rims(&handed, mobilised));
            }
            assert!(handed.iter().sum::<f64>().abs() < 1e-6, "{handed:?}");
            let turning = rims(&handed, MOBILISED_MAX);
            let rim_m_s: [f64; WHEELS] = core::array::from_fn(|i| ground_m_s[i] + turning[i].overspeed_m_s);
            let mean = rim_m_s.iter().sum::<f64>() / WHEELS as f64;
            for (i, got) in handed.iter().enumerate() {
                let want = coupling_n_s_m * (mean - rim_m_s[i]);
                assert!((got - want).abs() < 30.0, "wheel {i}: {got} N, its rim asks for {want} N, {soil:?}, {alone_n:?}");
            }
        }
    }
}
