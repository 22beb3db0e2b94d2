//! One step of the symbolic half: contact, wrench, Newton-Euler, increment (paper §III-C).
//!
//! Contact forces are stiff against Δt = 0.1 s, so a step is a few sub-steps of a linearly implicit Newton-Euler: forces are evaluated at
//! the current state, and their damping and stiffness enter the mass matrix, (M + h C + h² K) Δν = h (f - h K ν). The matrix is
//! symmetric positive definite, so the step is stable for a parked 50-kg robot and a rolling 2.5-tonne truck alike.

use crate::contacts::{Rolling, Sunk, Wheels};
use crate::driveline::WheelCommand;
use crate::linear::{is_positive_definite, solve_spd};
use crate::ride::Ride;
use crate::scalar::Real;
use crate::soil::Soil;
use crate::state::VehicleState;
use crate::step_effects::Altered;
use crate::terramechanics::{ContactLaw, Support, TRAVEL_SPEED_FLOOR_M_S, WheelGeometry, WheelMotion, WheelWrench, travel_direction};
use crate::torque_drive::{Driven, carried_on_n, sheared_sideways};
use crate::vec3::{Tilt, Vec3, add, cross, dot, normalise, scale};
use crate::vehicle::{Vehicle, WHEELS};

/// Ground under one wheel centre: height (m) and slope in the heading frame (rise per metre ahead, per metre to the left).
#[derive(Clone, Copy, Debug)]
pub struct Ground<T> {
    /// Height above the datum of the state's z, m.
    pub height_m: T,
    /// ∂h/∂(ahead), -.
    pub slope_ahead: T,
    /// ∂h/∂(left), -.
    pub slope_left: T,
}

/// Everything one step depends on.
#[derive(Clone, Copy, Debug)]
pub struct StepInput<T> {
    /// State; x and y are not read, and the yaw only by a force fixed in World: else the step is the same everywhere and in every direction.
    pub state: VehicleState<T>,
    /// What the drive line makes of the command.
    pub wheels: WheelCommand<T>,
    /// Learned log-ratio of each wheel's sinkage to the load-balanced one; 0 = the symbolic model alone.
    pub sinkage_log_ratio: [T; WHEELS],
    /// Soil θ.
    pub soil: Soil<T>,
    /// Ground under each wheel.
    pub ground: [Ground<T>; WHEELS],
}

/// Contact of one wheel at the end of the step.
#[derive(Clone, Copy, Debug)]
pub struct WheelContact<T> {
    /// Sinkage ŝ, m.
    pub sinkage_m: T,
    /// Load carried, N.
    pub normal_n: T,
    /// Force along the wheel's heading, N.
    pub forward_n: T,
    /// Force to the left, N.
    pub left_n: T,
    /// Slip, -.
    pub slip: T,
    /// Speed of the rim over that of the ground along the wheel's heading, m/s.
    pub overspeed_m_s: T,
}

/// Result of a step.
#[derive(Clone, Copy, Debug)]
pub struct StepOutput<T> {
    /// Δx_NE: displacement in the heading frame of the start, change of attitude, and change of both velocities in Body.
    pub increment: VehicleState<T>,
    /// Contacts during the last sub-step.
    pub contacts: [WheelContact<T>; WHEELS],
}

/// A vehicle prepared for stepping: constants derived once.
#[derive(Clone, Debug)]
pub struct StepModel {
    pub(crate) vehicle: Vehicle,
    pub(crate) wheel: WheelGeometry,
    pub(crate) altered: Altered,
    static_load_n: [f64; WHEELS],
    pub(crate) body: RigidBody,
    pub(crate) ride_shift: Ride,
    pub(crate) substeps: usize,
    pub(crate) dt_s: f64,
}

/// Speed around which the friction of a dragging wheel changes its sign, m/s (chosen).
const DRAG_SPEED_M_S: f64 = 0.07;
/// Over-speed of a rim below which the secant of its thrust is held, m/s (chosen).
const SECANT_FLOOR_M_S: f64 = 0.02;
/// Speed of a wheel to its side below which the slope of the shear law counts instead of the secant, m/s (chosen: well below what a turning vehicle slides).
const SHEARED_M_S: f64 = 0.005;

/// Speed around which the contact of a wheel passes from one side of the axle to the other, m/s (chosen: creep of a parked vehicle).
const LEAD_SPEED_M_S: f64 = 0.05;

/// Mass, inertia about the reference point, and centre of mass, effects included.
#[derive(Clone, Debug)]
pub(crate) struct RigidBody {
    pub(crate) mass_kg: f64,
    inertia_kg_m2: [[f64; 3]; 3],
    centre_m: [f64; 3],
    /// M [c]×, the lower left block of the spatial inertia.
    coupling_kg_m: [[f64; 3]; 3],
}

impl RigidBody {
    /// Element (i, j) of the inertia of a mass (kg) at a point (m), kg m².
    fn of_point(m: f64, r: [f64; 3], i: usize, j: usize) -> f64 {
        m * (if i == j { dot(r, r) } else { 0.0 } - r[i] * r[j])
    }

    /// Whether a body can be so: an inertia about the centre of mass that is positive definite.
    pub(crate) fn is_physical(&self) -> bool {
        let (m, c) = (self.mass_kg, self.centre_m);
        let about_centre = core::array::from_fn(|i| core::array::from_fn(|j| self.inertia_kg_m2[i][j] - Self::of_point(m, c, i, j)));
        is_positive_definite(&about_centre)
    }

    pub(crate) fn new(vehicle: &Vehicle) -> Self {
        let force = &vehicle.effects.force;
        let (m, r) = (force.added_mass_kg, force.added_at_m);
        let mass_kg = vehicle.mass_kg + m;
        let point = Self::of_point;
        let mut inertia_kg_m2: [[f64; 3]; 3] =
            core::array::from_fn(|i| core::array::from_fn(|j| vehicle.inertia_kg_m2[i][j] + point(m, r, i, j)));
        let mut centre_m = scale(r, m / mass_kg);
        let shift = force.centre_shift_m;
        if shift != [0.0; 3] {
            inertia_kg_m2 = core::array::from_fn(|i| core::array::from_fn(|j| inertia_kg_m2[i][j] + point(vehicle.mass_kg, shift, i, j)));
            centre_m = add(centre_m, scale(shift, vehicle.mass_kg / mass_kg));
        }
        let [x, y, z] = scale(centre_m, mass_kg);
        Self { mass_kg, inertia_kg_m2, centre_m, coupling_kg_m: [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]] }
    }
}

/// How a wheel stands on its ground: axes (ahead, left, normal) and the lever arm of the contact in Body, velocities of the contact, and what presses it down.
#[derive(Clone, Copy, Debug)]
struct Stance<T> {
    axes: [Vec3<T>; 3],
    lever: Vec3<T>,
    /// From the point of the ground below the axle to the contact, Body, m; `None` = the contact is there.
    lead: Option<Vec3<T>>,
    forward_m_s: T,
    left_m_s: T,
    preload_n: T,
}

impl<T: Real> Stance<T> {
    /// Puts the contact ahead of the axle in the direction of travel, where it slides by the turning of the wheel (rad/s, Body) too.
    #[inline(always)]
    fn lead_by(&mut self, lead_m: T, angular_velocity_rad_s: Vec3<T>) {
        let ahead_m = lead_m * self.forward_m_s / self.forward_m_s.abs_smooth(LEAD_SPEED_M_S);
        self.lead = Some(scale(self.axes[0], ahead_m));
        self.left_m_s = self.left_m_s + ahead_m * dot(angular_velocity_rad_s, self.axes[2]);
    }
}

/// How a wheel rolls over its ground, and the direction of it in (-1, 1).
#[derive(Clone, Copy, Debug)]
struct Roll<T> {
    motion: WheelMotion<T>,
    direction: T,
    contact: Rolling<T>,
}

/// Contact of one wheel as the assembly needs it: axes, lever arm, forces and their rates.
struct Contribution<T> {
    axes: [Vec3<T>; 3],
    lever: Vec3<T>,
    lead: Option<Vec3<T>>,
    force: [T; 3],
    damping: [T; 3],
    stiffness_n_m: T,
    contact: WheelContact<T>,
}

impl StepModel {
    /// Prepares a vehicle for steps of `dt_s` seconds in `substeps` sub-steps (2 is enough for 0.1 s, see the convergence test).
    pub fn new(vehicle: &Vehicle, dt_s: f64, substeps: usize) -> Self {
        let mut wheel = WheelGeometry::new(vehicle.wheel_radius_m, vehicle.wheel_width_m).with_law(vehicle.contact_law);
        if vehicle.soil_damping_pa_s_m > 0.0 && vehicle.contact_law == ContactLaw::SoilContactModel {
            wheel = wheel.on_damped_soil(vehicle.soil_damping_pa_s_m);
        }
        wheel.recovery = (wheel.recovery + vehicle.effects.soil.recovery).max(0.0);
        wheel.c1 = (wheel.c1 + vehicle.effects.soil.theta_m_shift).max(0.0);
        Self {
            altered: Altered::new(&vehicle.effects, &wheel),
            wheel,
            static_load_n: vehicle.static_load_n(),
            body: RigidBody::new(vehicle),
            ride_shift: [0.0; 3],
            vehicle: vehicle.clone(),
            substeps,
            dt_s: dt_s / (1.0 + vehicle.effects.sensor.clock_drift),
        }
    }

    /// Δt, s of true time: that of the log, corrected for its clock.
    pub fn dt_s(&self) -> f64 {
        self.dt_s
    }

    /// The vehicle.
    pub fn vehicle(&self) -> &Vehicle {
        &self.vehicle
    }

    /// Position of each wheel centre in the heading frame relative to the reference point, m: where the ground must be looked up.
    pub fn wheel_offsets_heading<T: Real>(&self, roll_rad: T, pitch_rad: T) -> [Vec3<T>; WHEELS] {
        let tilt = Tilt::new(roll_rad, pitch_rad);
        self.vehicle.wheel_centre_m.map(|p| tilt.to_heading(p.map(T::lit)))
    }

    /// Advances the state by one Δt and returns the increment (paper: Δx_NE) and the contacts.
    #[inline(always)]
    pub fn step<T: Real>(&self, input: &StepInput<T>) -> StepOutput<T> {
        self.step_by(input, Rolling::sink_each)
    }

    /// The same with somebody else who works [`Rolling::sink_each`] out, which is most of a step's work, in faster instructions.
    #[inline(always)]
    pub fn step_by<T: Real>(
        &self,
        input: &StepInput<T>,
        sink: impl Fn(Wheels<'_, Rolling<T>>, Wheels<'_, WheelGeometry>) -> [Sunk<T>; WHEELS],
    ) -> StepOutput<T> {
        let h = T::lit(self.dt_s / self.substeps as f64);
        let zero = T::lit(0.0);
        let mut state = input.state;
        state.position_m = [zero, zero, input.state.position_m[2]];
        state.attitude_rad[2] = zero;
        let mut contacts = None;
        for _ in 0..self.substeps {
            contacts = Some(self.substep(&mut state, input, h, &sink));
        }
        let (before, after) = (input.state.to_array(), state.to_array());
        let mut increment = VehicleState::from_array(core::array::from_fn(|i| after[i] - before[i]));
        increment.position_m = [state.position_m[0], state.position_m[1], state.position_m[2] - input.state.position_m[2]];
        increment.attitude_rad[2] = state.attitude_rad[2];
        StepOutput { increment, contacts: contacts.expect("a step has at least one sub-step; this is a bug") }
    }

    #[inline(always)]
    fn substep<T: Real>(
        &self,
        state: &mut VehicleState<T>,
        input: &StepInput<T>,
        h: T,
        sink: &impl Fn(Wheels<'_, Rolling<T>>, Wheels<'_, WheelGeometry>) -> [Sunk<T>; WHEELS],
    ) -> [WheelContact<T>; WHEELS] {
        let tilt = Tilt::new(state.attitude_rad[0], state.attitude_rad[1]);
        let (v, w) = (state.velocity_m_s, state.angular_velocity_rad_s);
        let mass = T::lit(self.body.mass_kg);
        let inertia = self.body.inertia_kg_m2;
        let inertia_w: Vec3<T> = core::array::from_fn(|r| dot(inertia[r].map(T::lit), w));
        let gravity = tilt.to_body([T::lit(0.0), T::lit(0.0), T::lit(-self.vehicle.gravity_m_s2)]);

        // Newton-Euler about the reference point, centre of mass at c: M (v̇ + ω × v + ω̇ × c + ω × (ω × c)) = F + M g,
        // I ω̇ + ω × I ω + M c × (v̇ + ω × v) = τ + c × M g. Without effects c = 0 and these are the paper's equations.
        let c = self.body.centre_m.map(T::lit);
        let carried = add(gravity, scale(cross(w, v), T::lit(-1.0)));
        let force = scale(add(carried, scale(cross(w, cross(w, c)), T::lit(-1.0))), mass);
        let torque = add(scale(cross(w, inertia_w), T::lit(-1.0)), scale(cross(c, carried), mass));
        let mut rhs = [force[0], force[1], force[2], torque[0], torque[1], torque[2]];
        if self.altered.on_body {
            self.add_body_forces(state, input, &tilt, &mut rhs);
        }
        let zero = T::lit(0.0);
        let mut lhs = [[zero; 6]; 6];
        for r in 0..3 {
            lhs[r][r] = mass;
            for c in 0..3 {
                lhs[r + 3][c + 3] = T::lit(inertia[r][c]);
                lhs[r + 3][c] = T::lit(self.body.coupling_kg_m[r][c]);
            }
        }
        if self.altered.on_body {
            self.damp_by_drag(v, h, &mut lhs);
        }

        let mut stances: [Stance<T>; WHEELS] = core::array::from_fn(|i| self.stance(i, state, &tilt, input));
        let grips = self.grips(&stances.each_ref().map(|s| (s.preload_n, s.forward_m_s)), &input.soil);
        if let Some(grips) = grips.as_ref().filter(|_| self.wheel.is_damped()) {
            for (stance, grip) in stances.iter_mut().zip(grips) {
                stance.lead_by(grip.lead_m, w);
            }
        }
        let driven = grips.and_then(|grips| self.driven(&grips, &stances.each_ref().map(|s| s.forward_m_s), state, input));
        let driven = |i: usize| driven.as_ref().map(|driven| &driven[i]);
        let rolls: [Roll<T>; WHEELS] = core::array::from_fn(|i| self.roll(i, &stances[i], driven(i), state, input));
        let sunk = self.sink(rolls.each_ref().map(|roll| &roll.contact), sink);
        let contacts = core::array::from_fn(|i| {
            let wheel = self.wheel_contribution(i, &stances[i], driven(i), &rolls[i], &sunk[i], input);
            assemble(&wheel, v, w, h, &mut lhs, &mut rhs);
            wheel.contact
        });
        let delta = solve_spd(lhs, rhs.map(|f| f * h));

        let mean = |now: Vec3<T>, change: [T; 3]| add(now, scale(change, T::lit(0.5)));
        let (dv, dw) = ([delta[0], delta[1], delta[2]], [delta[3], delta[4], delta[5]]);
        let rates = tilt.attitude_rates(mean(w, dw));
        let (sin_yaw, cos_yaw) = (state.attitude_rad[2] + rates[2] * h * T::lit(0.5)).sin_cos();
        let travelled = scale(tilt.to_heading(mean(v, dv)), h);
        let in_start_heading =
            [cos_yaw * travelled[0] - sin_yaw * travelled[1], sin_yaw * travelled[0] + cos_yaw * travelled[1], travelled[2]];
        state.position_m = add(state.position_m, in_start_heading);
        state.attitude_rad = add(state.attitude_rad, scale(rates, h));
        state.velocity_m_s = add(v, dv);
        state.angular_velocity_rad_s = add(w, dw);
        contacts
    }

    /// How a wheel stands on its ground, before it is known how it turns.
    #[inline(always)]
    fn stance<T: Real>(&self, i: usize, state: &VehicleState<T>, tilt: &Tilt<T>, input: &StepInput<T>) -> Stance<T> {
        let one = T::lit(1.0);
        let centre = self.vehicle.wheel_centre_m[i].map(T::lit);
        let velocity = add(state.velocity_m_s, cross(state.angular_velocity_rad_s, centre));
        let normal = tilt.to_body(normalise([-input.ground[i].slope_ahead, -input.ground[i].slope_left, one]));
        let (sin, cos) = if self.altered.on_wheels { self.yielding_angle(i, state, input) } else { input.wheels.angle_rad[i] }.sin_cos();
        let heading = [cos, sin, T::lit(0.0)];
        let forward = normalise(add(heading, scale(normal, -dot(heading, normal))));
        let left = cross(normal, forward);

        let distance = self.distance(i, state, tilt, input);
        let (rate, damper) = (T::lit(self.vehicle.suspension_n_m[i]), T::lit(self.vehicle.suspension_n_s_m[i]));
        let closing = -dot(velocity, normal);
        let mut preload_n = T::lit(self.static_load_n[i]) + rate * (T::lit(self.wheel_at(i).radius_m) - distance) + damper * closing;
        if self.altered.on_wheels {
            preload_n = preload_n + self.stabiliser_n(i, state, tilt, input);
        }
        Stance {
            axes: [forward, left, normal],
            lever: add(centre, scale(normal, -distance)),
            lead: None,
            forward_m_s: dot(velocity, forward),
            left_m_s: dot(velocity, left),
            preload_n,
        }
    }

    /// How a wheel rolls once it is known how it turns.
    #[inline(always)]
    fn roll<T: Real>(
        &self,
        i: usize,
        stance: &Stance<T>,
        driven: Option<&Driven<T>>,
        state: &VehicleState<T>,
        input: &StepInput<T>,
    ) -> Roll<T> {
        let Stance { axes, forward_m_s, left_m_s, preload_n, .. } = *stance;
        let rate = T::lit(self.vehicle.suspension_n_m[i]);
        let mut ratio = input.sinkage_log_ratio[i].exp();
        let rim_speed_m_s = match (driven, self.altered.on_wheels) {
            (Some(driven), altered) => {
                let servo_m_s = if altered { self.resized_servo_m_s(i, input) } else { input.wheels.servo_m_s(i) };
                servo_m_s + input.wheels.rim_follow * (forward_m_s + driven.overspeed_m_s)
            }
            (None, false) => input.wheels.rim_speed_m_s(i, forward_m_s, state.velocity_m_s[0]),
            (None, true) => self.altered_rim_speed(i, state, axes[0], input),
        };
        let wheel_motion = WheelMotion { rim_speed_m_s, forward_m_s, left_m_s };
        let (direction, mut motion) = wheel_motion.contact();
        if self.wheel.is_damped() {
            motion.pressing_m_s = motion.pressing_m_s * fresh_share(i, direction);
        }
        let mut soil = input.soil;
        if self.altered.on_wheels {
            ratio = ratio * self.digging(motion.slip);
            soil = self.soil_under(i, forward_m_s, &Support { preload_n, rate_n_m: rate * ratio }, ratio, &motion, &soil);
        }
        let support = Support { preload_n, rate_n_m: rate * ratio };
        Roll { motion: wheel_motion, direction, contact: Rolling { support, motion, soil, ratio } }
    }

    /// The contacts of all wheels.
    #[inline(always)]
    fn sink<T: Real>(
        &self,
        wheels: Wheels<'_, Rolling<T>>,
        sink: &impl Fn(Wheels<'_, Rolling<T>>, Wheels<'_, WheelGeometry>) -> [Sunk<T>; WHEELS],
    ) -> [Sunk<T>; WHEELS] {
        let abreast = if self.of_one_geometry() { Rolling::sink_abreast(wheels, &self.wheel) } else { None };
        abreast.unwrap_or_else(|| sink(wheels, core::array::from_fn(|i| self.wheel_at(i))))
    }

    /// Forces of one wheel and how they change with its velocity.
    #[inline(always)]
    fn wheel_contribution<T: Real>(
        &self,
        i: usize,
        stance: &Stance<T>,
        driven: Option<&Driven<T>>,
        roll: &Roll<T>,
        sunk: &Sunk<T>,
        input: &StepInput<T>,
    ) -> Contribution<T> {
        let wheel = self.wheel_at(i);
        let Stance { axes, lever, lead, preload_n, .. } = *stance;
        let Roll { motion: wheel_motion, direction, contact: Rolling { motion, soil, ratio, .. } } = *roll;
        let Sunk { balanced_m: balanced, wrench } = *sunk;
        let (rate, damper) = (T::lit(self.vehicle.suspension_n_m[i]), T::lit(self.vehicle.suspension_n_s_m[i]));
        let sinkage = balanced * ratio;
        let load = (preload_n - rate * sinkage).relu_smooth(1.0);
        let share = load / wrench.normal_n.relu_smooth(1.0);
        let (mut drag, mut contact) = self.traction(i, &wrench, share, (sinkage, load), roll, input);
        if let Some(driven) = driven {
            let thrust_n = wrench.thrust_n * share;
            let other_n = wrench.torque_n_m * share * T::lit(1.0 / wheel.radius_m) - thrust_n;
            // Beside its thrust the torque of a wheel is shear that follows the rim, or the moment of the pressure ahead of its axle.
            let (turned_n, resisting_n) = match wheel.law {
                ContactLaw::WongReece => (other_n * direction, wrench.resistance_n * share),
                ContactLaw::SoilContactModel => (other_n * travel_direction(wheel_motion.forward_m_s), other_n),
            };
            let more = carried_on_n(wheel, (sinkage, load), &soil, driven.at_rim_n, thrust_n * direction + turned_n, thrust_n * direction);
            contact.forward_n = contact.forward_n + input.wheels.rim_follow * more;
            let stopping = self.stopping(resisting_n.relu_smooth(1.0) + driven.braked_n, contact.forward_n, load, &wheel_motion);
            drag[0] = drag[0] + input.wheels.rim_follow * (driven.damping_n_s_m + stopping - drag[0]);
        }
        if self.altered.on_wheels {
            self.alter_traction(i, &wheel_motion, &motion, &soil, share, &mut drag, &mut contact);
        }
        let soil_rate = (soil.n + T::lit(0.5)) * load / balanced;
        let in_series = soil_rate / (soil_rate + rate);
        Contribution {
            axes,
            lever,
            lead,
            force: [contact.forward_n, contact.left_n, load],
            damping: [drag[0], drag[1], damper * in_series],
            stiffness_n_m: rate * in_series,
            contact,
        }
    }

    /// Distance of a wheel centre from the tangent plane of its ground, m, moved along as the wheel travels over the slope.
    #[inline(always)]
    pub(crate) fn distance<T: Real>(&self, i: usize, state: &VehicleState<T>, tilt: &Tilt<T>, input: &StepInput<T>) -> T {
        let offset = tilt.to_heading(self.vehicle.wheel_centre_m[i].map(T::lit));
        let travelled = state.position_m;
        let ground = input.ground[i].height_m + input.ground[i].slope_ahead * travelled[0] + input.ground[i].slope_left * travelled[1];
        let slope = T::lit(1.0) + input.ground[i].slope_ahead.sqr() + input.ground[i].slope_left.sqr();
        (travelled[2] + offset[2] - ground) / slope.sqrt()
    }

    /// Tractive forces at the load actually carried, and how they fall with the velocity of the wheel: by secants, which bound the tangents of the concave shear law,
    /// so that the implicit step never under-damps.
    #[inline(always)]
    fn traction<T: Real>(
        &self,
        i: usize,
        wrench: &WheelWrench<T>,
        share: T,
        (sinkage_m, load): (T, T),
        roll: &Roll<T>,
        input: &StepInput<T>,
    ) -> ([T; 2], WheelContact<T>) {
        let Roll { motion, direction, contact: Rolling { motion: contact, soil, .. } } = *roll;
        let drag_n = self.drag_at_tread(i, wrench.thrust_n * share, load, &motion, &input.soil);
        let opposing = motion.forward_m_s / motion.forward_m_s.abs_smooth(DRAG_SPEED_M_S);
        let resistance_n = wrench.resistance_n * share;
        let forward_n = wrench.thrust_n * share * direction - resistance_n * travel_direction(motion.forward_m_s) - drag_n * opposing;
        let left_n = wrench.side_n * share;

        let overspeed_m_s = motion.rim_speed_m_s - motion.forward_m_s;
        let thrust = (wrench.thrust_n * share).abs_smooth(1.0) / overspeed_m_s.abs_smooth(SECANT_FLOOR_M_S);
        let friction = drag_n / motion.forward_m_s.abs_smooth(DRAG_SPEED_M_S);
        // Where next to nothing is sheared sideways the secant has no value, and the tangent of the law takes its place.
        let (limit_n, sliding_m_s) = sheared_sideways(self.wheel_at(i), sinkage_m, load, &motion, &soil);
        let sheared = sliding_m_s.min(T::lit(SHEARED_M_S));
        let held_n = limit_n / sliding_m_s * sheared;
        let side = ((left_n.sqr() + held_n.sqr()) / (motion.left_m_s.sqr() + sheared.sqr())).sqrt();
        let stopping = self.stopping(resistance_n.relu_smooth(1.0), forward_n, load, &motion);
        let drag = [input.wheels.slip_feedback() * thrust + stopping + friction.max(T::lit(0.0)), side];
        (drag, WheelContact { sinkage_m, normal_n: load, forward_n, left_n, slip: contact.slip, overspeed_m_s })
    }
}

impl StepModel {
    /// How a motion resistance R falls with the forward speed v of its wheel, N s/m. It turns around with v; so near v = 0 its secant R / |v| stops the wheel without
    /// turning it back. That fades out above twice what R changes v by in a sub-step, where it would only brake late. Where the force on the wheel, N, drives it on, the
    /// secant is that at the speed it comes to: a vehicle that sets off does not turn around.
    #[inline(always)]
    fn stopping<T: Real>(&self, resistance_n: T, forward_n: T, load_n: T, motion: &WheelMotion<T>) -> T {
        let per_load = T::lit(self.vehicle.gravity_m_s2 * self.dt_s / self.substeps as f64) / (load_n + T::lit(1.0));
        let gained_m_s = (travel_direction(motion.forward_m_s) * forward_n * per_load).max(T::lit(0.0));
        let speed_m_s = motion.forward_m_s.abs_smooth(TRAVEL_SPEED_FLOOR_M_S) + gained_m_s;
        let fades_2 = (T::lit(2.0) * resistance_n * per_load + T::lit(0.01)).sqr();
        resistance_n * fades_2 / ((speed_m_s.sqr() + fades_2) * speed_m_s)
    }

    /// Force that friction at the wheels of an axle takes from the tread of one of them, N ([`Vehicle::drag_at_tread_n_m`]).
    ///
    /// The slope of traction is the tangent of the exponential shear law at the mobilised share u of its limit: thrust / over-speed · (1 - u) (-ln(1 - u)) / u.
    /// Without drag, or where it brakes a hub under torque ([`StepModel::driven`]), nothing is computed.
    fn drag_at_tread<T: Real>(&self, wheel: usize, thrust_n: T, load_n: T, motion: &WheelMotion<T>, soil: &Soil<T>) -> T {
        let torque_takes_it = self.vehicle.driveline.torque.is_some();
        if torque_takes_it || self.vehicle.effects.force.wheel_drag_n_m.iter().all(|drag| *drag == 0.0) {
            return T::lit(0.0);
        }
        let over = (motion.rim_speed_m_s - motion.forward_m_s).abs_smooth(SECANT_FLOOR_M_S);
        let (sin, cos) = soil.phi.sin_cos();
        let thrust = thrust_n.abs_smooth(1.0);
        let mobilised = (thrust / (load_n * sin / cos).relu_smooth(1.0)).min(T::lit(0.95)).max(T::lit(0.05));
        let free = T::lit(1.0) - mobilised;
        let slope = thrust / over * free * -free.ln() / mobilised;
        self.vehicle.drag_at_tread_n_m(wheel, slope) / T::lit(self.wheel.radius_m)
    }
}

/// Share of the soil before a wheel that no wheel has pressed yet, for a direction of travel in (-1, 1): the wheels of the other axle roll where those of the leading
/// one have been. Neglects that they leave the ruts in a turn (recorded drives do not side with it).
#[inline(always)]
pub(crate) fn fresh_share<T: Real>(wheel: usize, direction: T) -> T {
    T::lit(0.5) + direction * T::lit(if wheel < 2 { 0.5 } else { -0.5 })
}

/// Adds a wheel's forces and rates: f += Gᵀ (F - h K ν), A += h Gᵀ (C + h K) G with G the velocity of the contact in its own axes. Springs and dampers of
/// suspensions feel the axle, so the velocity along the normal is that below it, and the moment of the normal force at its lead is added.
#[inline(always)]
fn assemble<T: Real>(wheel: &Contribution<T>, v: Vec3<T>, w: Vec3<T>, h: T, lhs: &mut [[T; 6]; 6], rhs: &mut [T; 6]) {
    for axis in 0..3 {
        let e = wheel.axes[axis];
        let lead = wheel.lead.as_ref();
        let lever = lead.filter(|_| axis == 1).map_or(wheel.lever, |lead| add(wheel.lever, *lead));
        let moment = cross(lever, e);
        let g = [e[0], e[1], e[2], moment[0], moment[1], moment[2]];
        let mut force = wheel.force[axis];
        let mut damping = wheel.damping[axis];
        if axis == 2 {
            if let Some(lead) = lead {
                let ahead = cross(*lead, e);
                for r in 0..3 {
                    rhs[r + 3] = rhs[r + 3] + ahead[r] * force;
                }
            }
            force = force - h * wheel.stiffness_n_m * (dot(e, v) + dot(moment, w));
            damping = damping + h * wheel.stiffness_n_m;
        }
        let weight = damping * h;
        for r in 0..6 {
            rhs[r] = rhs[r] + g[r] * force;
            let scaled = g[r] * weight;
            for c in 0..=r {
                lhs[r][c] = lhs[r][c] + scaled * g[c];
            }
        }
    }
}
