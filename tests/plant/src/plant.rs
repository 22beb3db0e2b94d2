//! The vehicle on its ground.

use std::sync::Arc;

use crate::card::PlantVehicle;
use crate::contact::{Contact, SoilMemory, Wheel, press};
use crate::drive_line::{DriveLine, Torques, spin_after};
use crate::effects::HiddenEffects;
use crate::ground::Ground;
use crate::math::{Rotation, Vec3, add, cross, dot, norm, scale, solve, sub};

/// Wheels of a vehicle: FL, FR, RL, RR.
pub const WHEELS: usize = 4;
/// Time between commands, s.
pub const STEP_S: f64 = 0.1;
/// Steps of the integration in one of these.
const SUB_STEPS: usize = 50;
/// Depth at which wheels are set down, m: they settle within a second.
const SET_DOWN_M: f64 = 0.03;
/// Speed over which forces that oppose the motion turn round, m/s.
const OPPOSING_FADE_M_S: f64 = 0.05;

/// A command, held for [`STEP_S`].
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Command {
    /// Forward speed, m/s.
    pub speed_m_s: f64,
    /// Steering, normalised to -1 (right) to 1 (left).
    pub steering: f64,
}

/// What is the case, without sensor errors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Truth {
    /// Time since the plant was made, s.
    pub time_s: f64,
    /// x y z (World, m), roll pitch yaw (rad), velocity of the reference point and angular velocity (Body, m/s and rad/s).
    pub state: [f64; 12],
    /// Wheel speeds, rad/s.
    pub wheel_rad_s: [f64; WHEELS],
    /// Road-wheel angles, front left and right, rad.
    pub road_wheel_rad: [f64; 2],
    /// Position of the steering actuator, normalised.
    pub steering: f64,
    /// Deepest pressed node under each wheel, m; 0 = in the air.
    pub sinkage_max_m: [f64; WHEELS],
    /// Mean over the pressed nodes, m.
    pub sinkage_mean_m: [f64; WHEELS],
    /// (rim speed - ground speed) / max(0.2, |rim speed|, |ground speed|).
    pub slip: [f64; WHEELS],
    /// Force of the soil on each wheel, World, mean of the last [`STEP_S`], N.
    pub force_n: [[f64; 3]; WHEELS],
    /// World z of each wheel's centre, m.
    pub wheel_height_m: [f64; WHEELS],
}

/// Motion of the vehicle. The chassis carries everything in its plane; along Body z the unsprung masses move on their own.
#[derive(Clone, Debug)]
struct Motion {
    /// Centre of gravity with payload, World.
    centre: Vec3,
    rotation: Rotation,
    /// Of the centre of gravity, Body.
    velocity: Vec3,
    rate: Vec3,
    /// Wheel centres above their place at rest, Body z, m.
    lift: [f64; WHEELS],
    /// Their absolute speed along Body z, m/s.
    lift_rate: [f64; WHEELS],
    spin: [f64; WHEELS],
}

/// Masses with the payload.
#[derive(Clone, Debug)]
struct Masses {
    total_kg: f64,
    sprung_kg: f64,
    /// Centre of gravity relative to the reference point, Body.
    centre: Vec3,
    inertia: [Vec3; 3],
    /// Moment of the sprung weight about the centre of gravity per m/s^2 of gravity along Body z, kg m.
    tilting: [f64; 2],
    preload_n: [f64; WHEELS],
}

/// A vehicle, the soil under it, and what nobody knows of either.
#[derive(Clone, Debug)]
pub struct Plant {
    vehicle: Arc<PlantVehicle>,
    ground: Arc<Ground>,
    effects: HiddenEffects,
    masses: Masses,
    soil: SoilMemory,
    motion: Motion,
    drive_line: DriveLine,
    time_s: f64,
    contacts: [Contact; WHEELS],
    mean_force: [Vec3; WHEELS],
}

impl Plant {
    /// Sets the vehicle down at rest on fresh soil, heading `yaw_rad`, on the plane through the ground under its wheels.
    pub fn at_rest(vehicle: Arc<PlantVehicle>, ground: Arc<Ground>, effects: HiddenEffects, x_m: f64, y_m: f64, yaw_rad: f64) -> Self {
        let pose = resting_pose(&vehicle, &ground, x_m, y_m, yaw_rad);
        let state: [f64; 12] = std::array::from_fn(|i| if i < 6 { pose[i] } else { 0.0 });
        let mut plant = Self {
            masses: Masses::of(&vehicle, &effects),
            soil: SoilMemory::fresh(&ground),
            motion: Motion {
                centre: [0.0; 3],
                rotation: Rotation::from_attitude([0.0; 3]),
                velocity: [0.0; 3],
                rate: [0.0; 3],
                lift: [0.0; WHEELS],
                lift_rate: [0.0; WHEELS],
                spin: [0.0; WHEELS],
            },
            drive_line: DriveLine::default(),
            time_s: 0.0,
            contacts: [Contact::default(); WHEELS],
            mean_force: [[0.0; 3]; WHEELS],
            vehicle,
            ground,
            effects,
        };
        plant.set_state(&state, [0.0; WHEELS], 0.0);
        plant
    }

    /// Moves the chassis to a state (order of [`Truth::state`]) with these wheel speeds and this position of the steering actuator; springs, ruts and pedal
    /// stay as they are.
    pub fn set_state(&mut self, state: &[f64; 12], wheel_rad_s: [f64; WHEELS], steering: f64) {
        let rotation = Rotation::from_attitude([state[3], state[4], state[5]]);
        let rate = [state[9], state[10], state[11]];
        let motion = &mut self.motion;
        let relative: [f64; WHEELS] = std::array::from_fn(|w| motion.lift_rate[w] - chassis_rise(motion, &self.vehicle, &self.masses, w));
        motion.rotation = rotation;
        motion.rate = rate;
        motion.centre = add([state[0], state[1], state[2]], rotation.to_world(self.masses.centre));
        motion.velocity = add([state[6], state[7], state[8]], cross(rate, self.masses.centre));
        for (w, relative) in relative.into_iter().enumerate() {
            motion.lift_rate[w] = relative + chassis_rise(motion, &self.vehicle, &self.masses, w);
        }
        motion.spin = wheel_rad_s;
        self.drive_line.steering = steering;
    }

    /// Follows a command for [`STEP_S`].
    pub fn advance(&mut self, command: Command) {
        self.drive_line.command(self.time_s, command);
        self.mean_force = [[0.0; 3]; WHEELS];
        let dt_s = STEP_S / SUB_STEPS as f64;
        for _ in 0..SUB_STEPS {
            self.step(dt_s);
            for (mean, contact) in self.mean_force.iter_mut().zip(&self.contacts) {
                *mean = add(*mean, scale(contact.force, 1.0 / SUB_STEPS as f64));
            }
        }
    }

    fn step(&mut self, dt_s: f64) {
        let (vehicle, masses) = (Arc::clone(&self.vehicle), self.masses.clone());
        let rotation = self.motion.rotation;
        let forward = self.velocity_of_reference()[0];
        let torques = self.drive_line.step(&vehicle, &self.effects, self.time_s, forward, &self.motion.spin, dt_s);
        let gravity = rotation.to_body([0.0, 0.0, -vehicle.gravity_m_s2]);
        // In the plane of the chassis everything moves together; along Body z the sprung mass hangs on the springs.
        let mut plane = [masses.total_kg * gravity[0], masses.total_kg * gravity[1]];
        let mut up = masses.sprung_kg * gravity[2];
        let mut moment = [masses.tilting[1] * gravity[2], -masses.tilting[0] * gravity[2], 0.0];
        let mut lift_acceleration = [0.0; WHEELS];
        let mut spin = self.motion.spin;
        for w in 0..WHEELS {
            let wheel = self.wheel(w);
            let contact = press(&self.ground, &mut self.soil, &wheel, dt_s);
            let (force, turning) = (rotation.to_body(contact.force), rotation.to_body(contact.moment));
            let axle = rotation.to_body(wheel.axle);
            let place = self.place(w);
            let rise = chassis_rise(&self.motion, &vehicle, &masses, w);
            let spring = masses.preload_n[w]
                + vehicle.spring_n_m[w] * self.motion.lift[w]
                + vehicle.damper_n_s_m[w] * (self.motion.lift_rate[w] - rise);
            let about_axle = dot(turning, axle);
            let new_spin = self.spin_of(w, &torques, about_axle, contact.spin_damping, dt_s);
            // What turns the wheel is taken from the chassis: drive shafts and brake calipers hold on to it.
            let held = vehicle.spin_inertia_kg_m2 * (new_spin - spin[w]) / dt_s - about_axle;
            spin[w] = new_spin;
            plane = [plane[0] + force[0], plane[1] + force[1]];
            up += spring;
            let at_wheel = cross(place, [force[0], force[1], spring]);
            moment = add(moment, sub(add(at_wheel, sub(turning, scale(axle, about_axle))), scale(axle, held)));
            lift_acceleration[w] = (force[2] - spring) / vehicle.unsprung_kg + gravity[2]
                - cross(self.motion.rate, add(self.motion.velocity, cross(self.motion.rate, place)))[2];
            self.contacts[w] = contact;
        }
        let other = self.other_forces(forward);
        plane = [plane[0] + other[0], plane[1] + other[1]];
        let m = &mut self.motion;
        let turning = cross(m.rate, m.velocity);
        let acceleration =
            [plane[0] / masses.total_kg - turning[0], plane[1] / masses.total_kg - turning[1], up / masses.sprung_kg - turning[2]];
        let gyroscopic = cross(m.rate, masses.inertia.map(|row| dot(row, m.rate)));
        let angular = solve(&masses.inertia, sub(moment, gyroscopic));
        m.velocity = add(m.velocity, scale(acceleration, dt_s));
        m.rate = add(m.rate, scale(angular, dt_s));
        m.spin = spin;
        for (w, acceleration) in lift_acceleration.into_iter().enumerate() {
            m.lift_rate[w] += acceleration * dt_s;
            m.lift[w] += (m.lift_rate[w] - chassis_rise(m, &vehicle, &masses, w)) * dt_s;
        }
        m.centre = add(m.centre, scale(m.rotation.to_world(m.velocity), dt_s));
        m.rotation = m.rotation.turned(m.rate, dt_s);
        self.time_s += dt_s;
    }

    fn spin_of(&self, w: usize, torques: &Torques, about_axle: f64, damping: f64, dt_s: f64) -> f64 {
        let driving = torques.drive_n_m[w] + about_axle;
        spin_after(self.motion.spin[w], self.vehicle.spin_inertia_kg_m2, driving, torques.friction_n_m[w], damping, dt_s)
    }

    /// Forces of hidden effects at the centre of gravity, Body x and y, N.
    fn other_forces(&self, forward: f64) -> [f64; 2] {
        let e = &self.effects;
        let opposing = (forward / OPPOSING_FADE_M_S).tanh();
        let weight = self.masses.total_kg * self.vehicle.gravity_m_s2;
        let against = e.tow_n
            + e.rolling_resistance * weight * opposing
            + e.linear_drag_n_s_m * forward
            + e.quadratic_drag_n_s2_m2 * forward * forward.abs();
        let wind = self.motion.rotation.to_body([e.wind_n[0], e.wind_n[1], 0.0]);
        [wind[0] - against, wind[1]]
    }

    /// Wheel centre relative to the centre of gravity, Body.
    fn place(&self, w: usize) -> Vec3 {
        let at = sub(self.vehicle.wheel_centre_m[w], self.masses.centre);
        [at[0], at[1], at[2] + self.motion.lift[w]]
    }

    fn wheel(&self, w: usize) -> Wheel {
        let (m, place) = (&self.motion, self.place(w));
        let angle = if w < 2 { self.road_wheel_angles()[w] } else { 0.0 };
        let axle = m.rotation.to_world([-angle.sin(), angle.cos(), 0.0]);
        let in_plane = add(m.velocity, cross(m.rate, place));
        let of_axle = if w < 2 { self.effects.tyre_radius_front } else { self.effects.tyre_radius_rear };
        let radius = 1.0 + self.effects.tyre_radius + of_axle;
        Wheel {
            centre: add(m.centre, m.rotation.to_world(place)),
            axle,
            radius_m: self.vehicle.radius_m * radius,
            width_m: self.vehicle.width_m,
            velocity: m.rotation.to_world([in_plane[0], in_plane[1], m.lift_rate[w]]),
            rate: add(m.rotation.to_world(m.rate), scale(axle, m.spin[w])),
        }
    }

    fn road_wheel_angles(&self) -> [f64; 2] {
        let position = self.drive_line.steering + self.effects.steering_offset;
        self.vehicle.road_wheel_angles(position).map(|angle| angle * (1.0 + self.effects.steering_ratio))
    }

    fn velocity_of_reference(&self) -> Vec3 {
        sub(self.motion.velocity, cross(self.motion.rate, self.masses.centre))
    }

    /// What is the case now.
    pub fn truth(&self) -> Truth {
        let m = &self.motion;
        let position = sub(m.centre, m.rotation.to_world(self.masses.centre));
        let (attitude, velocity) = (m.rotation.attitude(), self.velocity_of_reference());
        let wheels: [Wheel; WHEELS] = std::array::from_fn(|w| self.wheel(w));
        let slip = std::array::from_fn(|w| {
            let wheel = &wheels[w];
            let heading = [wheel.axle[1], -wheel.axle[0], 0.0];
            let along = dot(wheel.velocity, heading) / norm(heading).max(1e-9);
            let rim = m.spin[w] * wheel.radius_m;
            (rim - along) / rim.abs().max(along.abs()).max(0.2)
        });
        Truth {
            time_s: self.time_s,
            state: std::array::from_fn(|i| [position, attitude, velocity, m.rate][i / 3][i % 3]),
            wheel_rad_s: m.spin,
            road_wheel_rad: self.road_wheel_angles(),
            steering: self.drive_line.steering,
            sinkage_max_m: self.contacts.map(|c| c.sinkage_max_m),
            sinkage_mean_m: self.contacts.map(|c| c.sinkage_mean_m),
            slip,
            force_n: self.mean_force,
            wheel_height_m: wheels.map(|w| w.centre[2]),
        }
    }

    /// The ground that it drives on.
    pub fn ground(&self) -> &Ground {
        &self.ground
    }

    /// What is wrong with it.
    pub fn effects(&self) -> &HiddenEffects {
        &self.effects
    }
}

/// Upward speed (Body z) of the chassis where wheel `w` is attached, m/s.
fn chassis_rise(motion: &Motion, vehicle: &PlantVehicle, masses: &Masses, w: usize) -> f64 {
    let at = sub(vehicle.wheel_centre_m[w], masses.centre);
    motion.velocity[2] + motion.rate[0] * at[1] - motion.rate[1] * at[0]
}

impl Masses {
    fn of(vehicle: &PlantVehicle, effects: &HiddenEffects) -> Self {
        let (load, at) = (effects.payload_kg, effects.payload_at_m);
        let sprung_alone = vehicle.mass_kg - WHEELS as f64 * vehicle.unsprung_kg;
        let total_kg = vehicle.mass_kg + load;
        let centre = scale(at, load / total_kg);
        // The card's inertia holds for the whole vehicle; in roll and pitch the unsprung masses move on their own along Body z.
        let mut inertia = vehicle.inertia_kg_m2;
        for place in vehicle.wheel_centre_m {
            inertia[0][0] -= vehicle.unsprung_kg * place[1] * place[1];
            inertia[1][1] -= vehicle.unsprung_kg * place[0] * place[0];
        }
        for (mass, arm) in [(vehicle.mass_kg, centre), (load, sub(at, centre))] {
            for (i, row) in inertia.iter_mut().enumerate() {
                for (j, entry) in row.iter_mut().enumerate() {
                    let diagonal = if i == j { dot(arm, arm) } else { 0.0 };
                    *entry += mass * (diagonal - arm[i] * arm[j]);
                }
            }
        }
        let first_moment = |axis: usize| load * at[axis] - (sprung_alone + load) * centre[axis];
        let (front, rear) = (vehicle.wheel_centre_m[0][0], -vehicle.wheel_centre_m[2][0]);
        let half = 0.5 * sprung_alone * vehicle.gravity_m_s2 / (front + rear);
        Self {
            total_kg,
            sprung_kg: sprung_alone + load,
            centre,
            inertia,
            tilting: [first_moment(0), first_moment(1)],
            preload_n: [half * rear, half * rear, half * front, half * front],
        }
    }
}

/// x y z roll pitch yaw of a vehicle set down on the plane through the ground under its wheels.
fn resting_pose(vehicle: &PlantVehicle, ground: &Ground, x_m: f64, y_m: f64, yaw_rad: f64) -> [f64; 6] {
    let (sin, cos) = yaw_rad.sin_cos();
    let place = vehicle.wheel_centre_m;
    let height: [f64; WHEELS] = std::array::from_fn(|w| {
        let [bx, by, bz] = place[w];
        let under = ground.height_m(x_m + cos * bx - sin * by, y_m + sin * bx + cos * by).unwrap_or(0.0);
        under + vehicle.radius_m - SET_DOWN_M - bz
    });
    let along = 0.5 * (height[0] + height[1] - height[2] - height[3]) / (place[0][0] - place[2][0]);
    let across = 0.5 * (height[0] + height[2] - height[1] - height[3]) / (place[0][1] - place[1][1]);
    let middle = 0.25 * place.iter().map(|p| p[0]).sum::<f64>();
    let pitch = -along.atan();
    let z = 0.25 * height.iter().sum::<f64>() - along * middle;
    [x_m, y_m, z, (across * pitch.cos()).atan(), pitch, yaw_rad]
}
