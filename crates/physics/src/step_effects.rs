//! What effects change within a step: forces on the body, and wheels that are not those of the card.
//!
//! The step asks two plain flags; everything here stands out of its line, so a vehicle without effects neither computes nor carries it.

use crate::effects::EffectTerms;
use crate::scalar::Real;
use crate::soil::Soil;
use crate::state::VehicleState;
use crate::step::{StepInput, StepModel, WheelContact};
use crate::terramechanics::{
    ContactArc, ContactMotion, Support, WheelGeometry, WheelMotion, balance_sinkage, front_bulldozing, side_bulldozing,
};
use crate::vec3::{Tilt, Vec3, add, cross, dot, scale};
use crate::vehicle::SecondCommand;

/// Speed around which a resistance of a wheel changes its sign, m/s (chosen, as for wheel drag).
const RESISTANCE_SPEED_M_S: f64 = 0.07;

/// Speed backwards at which the rear wheels have become the leading ones, m/s (chosen, as for slip).
const LEAD_CHANGE_M_S: f64 = 0.1;

/// Share to which a wheel that goes ahead at `forward_m_s` leads, so that the wheels of the other axle follow in its rut: the front wheels do unless the vehicle goes
/// backwards. One that stands is taken to have come forwards.
fn leading_share<T: Real>(wheel: usize, forward_m_s: T) -> T {
    let one = T::lit(1.0);
    let front = (one + forward_m_s * T::lit(1.0 / LEAD_CHANGE_M_S)).max(T::lit(0.0)).min(one);
    if wheel < 2 { front } else { one - front }
}

fn add_wrench<T: Real>(rhs: &mut [T; 6], wrench: &[T]) {
    for (sum, part) in rhs.iter_mut().zip(wrench) {
        *sum = *sum + *part;
    }
}

/// Which parts of a step effects change.
#[derive(Clone, Debug)]
pub(crate) struct Altered {
    /// A force acts on the body beside those of the wheels.
    pub(crate) on_body: bool,
    /// A wheel, its command or its soil is another one.
    pub(crate) on_wheels: bool,
    /// Wheels of front and rear axle, where they are not the card's.
    axles: Option<[WheelGeometry; 2]>,
}

impl Altered {
    pub(crate) fn new(effects: &EffectTerms, wheel: &WheelGeometry) -> Self {
        let (force, actuator) = (&effects.force, &effects.actuator);
        let resized = force.radius_relative != [0.0; 2];
        Self {
            on_body: force.acts_on_body(),
            on_wheels: force.acts_on_wheels()
                || effects.soil.acts_on_wheels()
                || actuator.lock != 0.0
                || actuator.steering_compliance_rad_n != 0.0,
            axles: resized.then(|| force.radius_relative.map(|k| WheelGeometry { radius_m: wheel.radius_m * (1.0 + k), ..wheel.clone() })),
        }
    }
}

impl StepModel {
    /// Whether all wheels are those of the card.
    #[inline(always)]
    pub(crate) fn of_one_geometry(&self) -> bool {
        self.altered.axles.is_none()
    }

    /// Geometry of a wheel.
    #[inline(always)]
    pub(crate) fn wheel_at(&self, i: usize) -> &WheelGeometry {
        match &self.altered.axles {
            None => &self.wheel,
            Some(axles) => &axles[i / 2],
        }
    }

    /// Adds drag, tow, wind, a free form and written wrenches to the generalised force (N, N m) about the reference point, Body.
    #[cold]
    #[inline(never)]
    pub(crate) fn add_body_forces<T: Real>(&self, state: &VehicleState<T>, input: &StepInput<T>, tilt: &Tilt<T>, rhs: &mut [T; 6]) {
        let mean = |of: &dyn Fn(usize) -> T, count: usize| (1..count).fold(of(0), |sum, i| sum + of(i)) * T::lit(1.0 / count as f64);
        let angle = mean(&|i| input.wheels.angle_rad[i], 2);
        let slopes = [mean(&|i| input.ground[i].slope_ahead, 4), mean(&|i| input.ground[i].slope_left, 4)];
        self.add_body_forces_at(state, input.state.attitude_rad[2] + state.attitude_rad[2], [angle, slopes[0], slopes[1]], tilt, rhs);
    }

    /// The same at a heading in World (rad), a mean angle of the front wheels (rad) and mean slopes of the ground ahead and to the left.
    pub(crate) fn add_body_forces_at<T: Real>(
        &self,
        state: &VehicleState<T>,
        yaw_rad: T,
        [angle, ahead, left]: [T; 3],
        tilt: &Tilt<T>,
        rhs: &mut [T; 6],
    ) {
        let terms = &self.vehicle.effects.force;
        let v = state.velocity_m_s;
        let mut force = scale(v, -self.drag_n_s_m(v));
        force[0] = force[0] - T::lit(terms.tow_n);
        if terms.wind_n != [0.0; 2] {
            let [east, north] = terms.wind_n.map(T::lit);
            let (sin, cos) = yaw_rad.sin_cos();
            force = add(force, tilt.to_body([cos * east + sin * north, cos * north - sin * east, T::lit(0.0)]));
        }
        for axis in 0..3 {
            rhs[axis] = rhs[axis] + force[axis];
        }
        rhs[4] = rhs[4] + T::lit(terms.tow_moment_n_m);
        if terms.turning_resistance != 0.0 && self.vehicle.second == SecondCommand::YawRateRadS {
            let (weight, wheelbase) = (self.body.mass_kg * self.vehicle.gravity_m_s2, self.vehicle.wheelbase_m);
            let sideways = state.angular_velocity_rad_s[2] * T::lit(0.5 * wheelbase);
            let most = T::lit(0.25 * terms.turning_resistance * weight * wheelbase);
            rhs[5] = rhs[5] - most * sideways / sideways.abs_smooth(RESISTANCE_SPEED_M_S);
        }
        for free_form in terms.free_form.iter().filter(|form| form.acts()) {
            add_wrench(rhs, free_form.at(v[0], angle, ahead, left).as_flattened());
        }
        if terms.written[0].is_some() {
            let (rate, [roll, pitch, _]) = (state.angular_velocity_rad_s, state.attitude_rad);
            let (mass, gravity) = (self.body.mass_kg, self.vehicle.gravity_m_s2);
            let of_vehicle = [mass, gravity].map(T::lit);
            let variables = [v[0], v[1], v[2], rate[0], rate[1], rate[2], roll, pitch, angle, ahead, left, of_vehicle[0], of_vehicle[1]];
            for written in terms.written.iter().flatten() {
                add_wrench(rhs, &written.wrench(&variables, mass));
            }
        }
    }

    /// Drag of the body over its speed, N s/m.
    fn drag_n_s_m<T: Real>(&self, velocity_m_s: Vec3<T>) -> T {
        let terms = &self.vehicle.effects.force;
        let speed = (dot(velocity_m_s, velocity_m_s) + T::lit(1e-12)).sqrt();
        T::lit(terms.linear_drag_n_s_m) + T::lit(terms.quadratic_drag_n_s2_m2) * speed
    }

    /// Adds what a drag C takes away in a sub-step of `h` s beyond the whole speed, h C - M, to the matrix: a drag that is large against the mass stops it and does not
    /// turn it around. Smaller ones add nothing.
    #[cold]
    #[inline(never)]
    pub(crate) fn damp_by_drag<T: Real>(&self, velocity_m_s: Vec3<T>, h: T, lhs: &mut [[T; 6]; 6]) {
        let terms = &self.vehicle.effects.force;
        if [terms.linear_drag_n_s_m, terms.quadratic_drag_n_s2_m2] == [0.0; 2] {
            return;
        }
        let damping = (h * self.drag_n_s_m(velocity_m_s) - T::lit(self.body.mass_kg)).max(T::lit(0.0));
        for (axis, row) in lhs.iter_mut().enumerate().take(3) {
            row[axis] = row[axis] + damping;
        }
    }

    /// Road-wheel angle under the side force of steady cornering, rad.
    #[cold]
    #[inline(never)]
    pub(crate) fn yielding_angle<T: Real>(&self, i: usize, state: &VehicleState<T>, input: &StepInput<T>) -> T {
        let compliance = self.vehicle.effects.actuator.steering_compliance_rad_n;
        if i > 1 || compliance == 0.0 {
            return input.wheels.angle_rad[i];
        }
        let [front, rear] = [0, 2].map(|wheel| self.vehicle.wheel_centre_m[wheel][0]);
        let on_front = self.body.mass_kg * -rear / (front - rear);
        let side = T::lit(compliance * on_front) * state.velocity_m_s[0] * state.angular_velocity_rad_s[2];
        input.wheels.angle_rad[i] - side
    }

    /// Rim speed of a wheel with the heading `forward`, m/s: of another radius, or locked to its partner.
    #[cold]
    #[inline(never)]
    pub(crate) fn altered_rim_speed<T: Real>(&self, i: usize, state: &VehicleState<T>, forward: Vec3<T>, input: &StepInput<T>) -> T {
        let effects = &self.vehicle.effects;
        let along = |centre: [f64; 3]| dot(add(state.velocity_m_s, cross(state.angular_velocity_rad_s, centre.map(T::lit))), forward);
        let centre = self.vehicle.wheel_centre_m[i];
        let own = along(centre);
        let followed = match effects.actuator.lock {
            0.0 => own,
            lock => {
                let partner = self.vehicle.wheel_centre_m[i ^ 1];
                let middle = along(core::array::from_fn(|axis| 0.5 * (centre[axis] + partner[axis])));
                own + T::lit(lock) * (middle - own)
            }
        };
        let rim = input.wheels.rim_speed_m_s(i, followed, state.velocity_m_s[0]);
        match effects.force.radius_relative[i / 2] {
            0.0 => rim,
            relative => rim + input.wheels.servo_m_s(i) * T::lit(relative),
        }
    }

    /// Rim speed of a wheel of another radius where it is servoed or measured, m/s, else 0.
    #[cold]
    #[inline(never)]
    pub(crate) fn resized_servo_m_s<T: Real>(&self, i: usize, input: &StepInput<T>) -> T {
        input.wheels.servo_m_s(i) * T::lit(1.0 + self.vehicle.effects.force.radius_relative[i / 2])
    }

    /// Sinkage over that which balances the load, from the slip.
    #[cold]
    #[inline(never)]
    pub(crate) fn digging<T: Real>(&self, slip: T) -> T {
        match self.vehicle.effects.soil.slip_sinkage {
            0.0 => T::lit(1.0),
            per_slip => (T::lit(1.0) + T::lit(per_slip) * slip.abs_smooth(1e-3)).max(T::lit(0.1)),
        }
    }

    /// Force added to a spring against roll and pitch, N.
    #[cold]
    #[inline(never)]
    pub(crate) fn stabiliser_n<T: Real>(&self, i: usize, state: &VehicleState<T>, tilt: &Tilt<T>, input: &StepInput<T>) -> T {
        let [roll, pitch] = self.vehicle.effects.force.roll_pitch_stiffness;
        if roll == 0.0 && pitch == 0.0 {
            return T::lit(0.0);
        }
        let half = T::lit(0.5);
        let pressed: [T; 4] = core::array::from_fn(|w| T::lit(self.wheel_at(w).radius_m) - self.distance(w, state, tilt, input));
        let axle = |w: usize| (pressed[w & 2] + pressed[w & 2 | 1]) * half;
        let in_roll = (pressed[i] - pressed[i ^ 1]) * half;
        let in_pitch = (axle(i) - axle(i ^ 2)) * half;
        (T::lit(roll) * in_roll + T::lit(pitch) * in_pitch) * T::lit(self.vehicle.suspension_n_m[i])
    }

    /// Soil that a wheel meets that goes ahead at `forward_m_s`, its crust as the mean down to the sinkage of the balance without it.
    #[cold]
    #[inline(never)]
    pub(crate) fn soil_under<T: Real>(
        &self,
        i: usize,
        forward_m_s: T,
        support: &Support<T>,
        ratio: T,
        motion: &ContactMotion<T>,
        soil: &Soil<T>,
    ) -> Soil<T> {
        let terms = &self.vehicle.effects.soil;
        let wheel = self.wheel_at(i);
        let soil = terms.under_wheel(soil, T::lit(1.0) - leading_share(i, forward_m_s), wheel.width_m);
        if !terms.has_crust() {
            return soil;
        }
        let sinkage = balance_sinkage(wheel, support, motion, &soil) * ratio;
        terms.under_crust(&soil, sinkage)
    }

    /// Adds resistances of a wheel to its traction, then caps it.
    #[cold]
    #[inline(never)]
    #[allow(clippy::too_many_arguments)]
    pub(crate) fn alter_traction<T: Real>(
        &self,
        i: usize,
        wheel_motion: &WheelMotion<T>,
        motion: &ContactMotion<T>,
        soil: &Soil<T>,
        share: T,
        damping: &mut [T; 2],
        contact: &mut WheelContact<T>,
    ) {
        let wheel = self.wheel_at(i);
        let resistance = self.resistance_n(i, wheel_motion.forward_m_s, contact.normal_n, contact.sinkage_m, soil);
        let speed = wheel_motion.forward_m_s.abs_smooth(RESISTANCE_SPEED_M_S);
        contact.forward_n = contact.forward_n - resistance * wheel_motion.forward_m_s / speed;
        damping[0] = damping[0] + (resistance / speed).max(T::lit(0.0));
        let [side_share, side_weight] = self.vehicle.effects.soil.side_bulldozing;
        if side_share != 0.0 {
            let arc = ContactArc::of(wheel, contact.sinkage_m, soil);
            let side = T::lit(side_share) * share * side_bulldozing(wheel, side_weight, &arc, motion, soil);
            contact.left_n = contact.left_n + side;
            damping[1] = damping[1] + (-side * wheel_motion.left_m_s).max(T::lit(0.0)) / wheel_motion.left_m_s.abs_smooth(0.02).sqr();
        }
        if self.vehicle.effects.force.friction_cap_inverse != 0.0 {
            let kept = self.kept_by_cap(contact.normal_n, [contact.forward_n, contact.left_n]);
            (contact.forward_n, contact.left_n) = (contact.forward_n * kept, contact.left_n * kept);
            // The slopes of a force that is capped are capped with it.
            *damping = damping.map(|d| d * kept);
        }
    }

    /// Force that effects hold against the rolling of a wheel that goes ahead at `forward_m_s`, at a load (N) and a sinkage (m), N.
    fn resistance_n<T: Real>(&self, i: usize, forward_m_s: T, normal_n: T, sinkage_m: T, soil: &Soil<T>) -> T {
        let effects = &self.vehicle.effects;
        let [front_share, front_weight] = effects.soil.front_bulldozing;
        let rolling = T::lit(effects.force.rolling_resistance) * normal_n;
        if front_share == 0.0 {
            return rolling;
        }
        let heaped = T::lit(front_share) * front_bulldozing(self.wheel_at(i).width_m, sinkage_m, front_weight, soil);
        rolling + leading_share(i, forward_m_s) * heaped
    }

    /// Share of a tangential force (forward, left; N) that a cap on friction leaves at a load, N.
    fn kept_by_cap<T: Real>(&self, normal_n: T, [forward_n, left_n]: [T; 2]) -> T {
        let tangential = (forward_n.sqr() + left_n.sqr() + T::lit(1.0)).sqrt();
        (normal_n * T::lit(1.0 / self.vehicle.effects.force.friction_cap_inverse) / tangential).min(T::lit(1.0))
    }

    /// What a wheel that goes ahead at `forward_m_s` at this load (N), sinkage (m) and drawbar pull (N) pulls on with the resistances and the cap of effects, N.
    #[cold]
    #[inline(never)]
    pub(crate) fn altered_pull_n<T: Real>(&self, i: usize, forward_m_s: T, normal_n: T, sinkage_m: T, drawbar_n: T, soil: &Soil<T>) -> T {
        let pull = drawbar_n - self.resistance_n(i, forward_m_s, normal_n, sinkage_m, soil);
        match self.vehicle.effects.force.friction_cap_inverse {
            0.0 => pull,
            _ => pull * self.kept_by_cap(normal_n, [pull, T::lit(0.0)]),
        }
    }
}
