//! Rims that a torque drives: which over-speed a hub torque brings, and what of it the contact passes on.
//!
//! A wheel's inertia is small against the slope of its traction (milliseconds), so its rim settles at once where the soil takes the torque of the hub:
//! T = r² b ∫ τ_x dθ and, under the soil contact model, the moment of the pressure ahead of the axle. The over-speed is guessed in closed form, the contact
//! evaluated there, and its force carried on to the torque exactly: one evaluation, no iteration.

use crate::scalar::Real;
use crate::soil::Soil;
use crate::state::VehicleState;
use crate::step::{StepInput, StepModel};
use crate::terramechanics::{ContactLaw, WheelGeometry, bekker_sinkage};
use crate::vehicle::WHEELS;

/// Largest share of the shear strength that the guess mobilises (chosen: beyond it the wheel spins and traction control works).
const MOBILISED_MAX: f64 = 0.95;
/// Largest over-speed, m/s (chosen: middle of the range in which traction control closes the throttle of the simulated vehicle).
const OVERSPEED_MAX_M_S: f64 = 2.5;
/// Range of slips of the guess: s = (rim - ground) / rim.
const SLIP_RANGE: [f64; 2] = [-3.0, 0.6];
/// Ground speed around which directions turn, m/s (as for slip).
const SPEED_FLOOR_M_S: f64 = 0.05;
/// Coupling of a locked differential, N m s/rad (chosen: ten times a viscous one).
const LOCKED_N_M_S: f64 = 2500.0;
/// Smallest contact length, m.
const LENGTH_FLOOR_M: f64 = 5e-3;

/// What a contact can hold against a torque.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Grip<T> {
    /// Largest shear force N tan φ + c A, N.
    pub(crate) limit_n: T,
    /// Length of the contact, m.
    length_m: T,
    /// Force at the rim that compaction takes of the torque, N.
    compaction_n: T,
    /// Slip at which the shear of front and bottom balance, -.
    neutral_slip: T,
}

impl<T: Real> Grip<T> {
    /// Of a wheel under a load (N) at a sinkage (m).
    #[inline(always)]
    pub(crate) fn new(wheel: &WheelGeometry, sinkage_m: T, load_n: T, soil: &Soil<T>) -> Self {
        let radius = wheel.radius_m;
        let z = sinkage_m.max(T::lit(0.0)).min(T::lit(0.9 * radius));
        let length_m = (z * (T::lit(2.0 * radius) - z) + T::lit(LENGTH_FLOOR_M * LENGTH_FLOOR_M)).sqrt();
        let limit_n = (load_n * soil.phi.tan() + soil.c * length_m * T::lit(wheel.width_m)).relu_smooth(1.0);
        let entry = length_m * T::lit(1.0 / radius);
        // Chord against arc of the first shear displacement, mean over the contact: θ² / 6 ahead (surface) or behind (rim).
        let chord = entry.sqr() * T::lit(1.0 / 6.0);
        match wheel.law {
            ContactLaw::WongReece => Self { limit_n, length_m, compaction_n: T::lit(0.0), neutral_slip: -chord },
            // Centroid of a pressure (1 - x²)^n ahead of the axle: 0.424 of the length for n = 1/2, 3/8 for n = 1.
            ContactLaw::SoilContactModel => {
                let arm = T::lit(0.475) - T::lit(0.1) * soil.n;
                Self { limit_n, length_m, compaction_n: load_n * entry * arm, neutral_slip: chord }
            }
        }
    }

    /// Slip s = (rim - ground) / rim at which the contact takes a torque given as force at the rim (N), and the slope of that force over the slip, N.
    ///
    /// Inverts the mean of Janosi's law over a contact of linearly growing displacement, u = 1 - (1 - e^-a) / a with a = s L / K, by a = u (2 - u) / (1 - u)
    /// (within 6 %).
    #[inline(always)]
    fn slip(&self, driven_n: T, direction: T, soil: &Soil<T>) -> (T, T) {
        let one = T::lit(1.0);
        let shear_n = driven_n * direction - self.compaction_n * direction.sqr();
        let share = (shear_n / self.limit_n).min(T::lit(MOBILISED_MAX)).max(T::lit(-MOBILISED_MAX));
        let used = share.abs_smooth(1e-6);
        let free = one - used;
        let per_stretch = soil.k_shear / self.length_m;
        let slip = share * (T::lit(2.0) - used) / free * per_stretch + self.neutral_slip;
        let slope = self.limit_n * free.sqr() / ((one + free.sqr()) * per_stretch);
        (slip.min(T::lit(SLIP_RANGE[1])).max(T::lit(SLIP_RANGE[0])), slope)
    }

    /// What is to be added to the shear force found at the guess so that the contact takes the torque, N, within the strength of the soil.
    #[inline(always)]
    pub(crate) fn carried_on_n(&self, driven_n: T, taken_n: T, thrust_n: T) -> T {
        let wanted = thrust_n + driven_n - taken_n;
        let top = self.limit_n;
        wanted.min(top).max(-top) - thrust_n
    }
}

/// A wheel under torque, as the step needs it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Driven<T> {
    /// Torque of the hub over the radius, N.
    pub(crate) at_rim_n: T,
    /// How fast it falls with the speed of the wheel, N s/m.
    pub(crate) damping_n_s_m: T,
    /// Speed of the rim over that of the ground, m/s.
    pub(crate) overspeed_m_s: T,
}

impl StepModel {
    /// What drives wheel `i`, which passes over the ground at `forward_m_s` under a support of `preload_n`, if torque drives this vehicle: a quarter of what
    /// the speed control asks for through open differentials, and what their couplings hand from faster wheels to slower ones; friction of the wheel
    /// itself takes its part. Neglects couplings between over-speeds (they are small against the slope of traction) but for that friction.
    #[inline(always)]
    pub(crate) fn driven<T: Real>(
        &self,
        i: usize,
        preload_n: T,
        forward_m_s: T,
        state: &VehicleState<T>,
        input: &StepInput<T>,
    ) -> Option<Driven<T>> {
        let line = &self.vehicle.driveline;
        let drive = line.torque.as_ref()?;
        let wheel = self.wheel_at(i);
        let radius = wheel.radius_m;
        let each = T::lit(1.0 / (WHEELS as f64 * radius));
        // A lock is a coupling that leaves no difference: stiff against every soil.
        let coupling = (line.side_coupling_n_m_s + self.vehicle.effects.actuator.lock * LOCKED_N_M_S) / (radius * radius);
        let speed = state.velocity_m_s[0];
        let demand = input.wheels.demand_m_s(i, speed);
        let mut at_rim_n = drive.torque_n_m(demand, speed, 1.0 - self.vehicle.effects.actuator.torque_lost) * each
            - T::lit(coupling) * (forward_m_s - speed);

        let pressed = preload_n.relu_smooth(1.0);
        let alone = bekker_sinkage(pressed, radius, wheel.width_m, &input.soil);
        let rate = T::lit(self.vehicle.suspension_n_m[i]);
        let sinkage = alone * pressed / (pressed + rate * alone);
        let load = (preload_n - rate * sinkage).relu_smooth(1.0);
        let grip = Grip::new(wheel, sinkage, load, &input.soil);
        let size = forward_m_s.abs_smooth(SPEED_FLOOR_M_S);
        let direction = forward_m_s / size;
        if self.vehicle.effects.force.wheel_drag_n_m.iter().any(|drag| *drag != 0.0) {
            let slope = grip.slip(at_rim_n, direction, &input.soil).1 / size;
            at_rim_n = at_rim_n - direction * self.vehicle.drag_at_tread_n_m(i, slope) * T::lit(1.0 / radius);
        }
        let slip = grip.slip(at_rim_n, direction, &input.soil).0;
        let over = direction * slip * size / (T::lit(1.0) - slip);
        Some(Driven {
            at_rim_n,
            damping_n_s_m: input.wheels.rim_gain * each * T::lit(drive.per_demand_n_m_s_m) + T::lit(coupling),
            overspeed_m_s: over.min(T::lit(OVERSPEED_MAX_M_S)).max(T::lit(-OVERSPEED_MAX_M_S)),
        })
    }
}
