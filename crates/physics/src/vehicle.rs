//! What the physics must know of a vehicle.

use crate::effects::EffectTerms;
use crate::scalar::Real;
use crate::state::Control;
use crate::terramechanics::ContactLaw;

/// Number of wheels of the platforms served.
pub const WHEELS: usize = 4;

/// Meaning of the second command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SecondCommand {
    /// Normalised steering in [-1, 1], mapped to road-wheel angles by the card's table.
    SteeringNormalised,
    /// Road-wheel angle, rad.
    RoadWheelAngleRad,
    /// Yaw rate of a skid-steer vehicle, rad/s.
    YawRateRadS,
}

/// Steering: command -> road-wheel angles of the two front wheels (left, right).
#[derive(Clone, Debug, PartialEq)]
pub struct SteeringTable {
    /// Ascending commands.
    pub command: Vec<f64>,
    /// Front-left angle at each command, rad, positive left.
    pub front_left_rad: Vec<f64>,
    /// Front-right angle at each command, rad.
    pub front_right_rad: Vec<f64>,
}

/// Drive line and actuators: how commands become wheel speeds and road-wheel angles.
#[derive(Clone, Debug, PartialEq)]
pub struct Driveline {
    /// Time constant of the steering actuator's first-order lag, s.
    pub steering_lag_s: f64,
    /// Rate limit of the steering command, 1/s (or rad/s for angles).
    pub steering_rate_limit_per_s: f64,
    /// Share of the speed error that the drive line turns into rim over-speed, -.
    pub speed_gain: f64,
    /// Rim over-speed per integrated speed error, 1/s.
    pub speed_integral_gain_per_s: f64,
    /// Time constant with which the integral forgets, s.
    pub speed_integral_leak_s: f64,
    /// Bound of the integral, m.
    pub speed_integral_limit_m: f64,
    /// Largest rim over-speed the drive line can hold, m/s.
    pub overspeed_limit_m_s: f64,
    /// Servo of the rims; of a skid-steer vehicle only.
    pub rims: RimServo,
    /// Torque that the coupling between the wheels of an axle passes per difference of their speeds, N m s/rad; 0 = open differential. Under torque the
    /// axles are coupled alike.
    pub side_coupling_n_m_s: f64,
    /// Engine and brakes of a car whose hubs are driven by a torque; `None` = the rims are held at the demanded over-speed.
    pub torque: Option<TorqueDrive>,
}

/// Knots of a torque curve.
pub const TORQUE_KNOTS: usize = 5;

/// How what the speed control demands becomes a torque at the hubs. The demand (m/s) is `speed_gain` times the speed error, its integral, and what is held
/// against the usual resistance, all limited by `overspeed_limit_m_s`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TorqueDrive {
    /// Torque of the engine at all wheels together per demand where the curve is 1, N m s/m.
    pub per_demand_n_m_s_m: f64,
    /// Demand that holds the usual resistance at no speed error, m/s.
    pub holding_demand_m_s: f64,
    /// Rate at which the integral of the speed error, rebuilt from a history, follows what the measured motion says of it, 1/s; 0 = not at all.
    pub integral_observer_per_s: f64,
    /// Torque by which engine and gears brake at no demand, all wheels together, N m.
    pub closed_n_m: f64,
    /// Torque of the brakes per negative demand over that of the engine, -.
    pub brake_ratio: f64,
    /// Ascending speeds of the curve, m/s.
    pub curve_speed_m_s: [f64; TORQUE_KNOTS],
    /// What engine and gears make of a demand at these speeds over `per_demand_n_m_s_m`, -; linear between, held outside.
    pub curve: [f64; TORQUE_KNOTS],
}

/// Torques at all wheels together, N m.
#[derive(Clone, Copy, Debug)]
pub struct HubTorques<T> {
    /// What the engine gives, backwards below zero.
    pub driving_n_m: T,
    /// What brakes hold against the travel, zero or above.
    pub braking_n_m: T,
}

impl TorqueDrive {
    /// Torques for a demand at a speed (m/s both) under a speed command (m/s), of an engine that gives `share` of what it should. A negative demand brakes; of a car that
    /// is told to go backwards it drives.
    #[inline(always)]
    pub fn torques<T: Real>(&self, demand_m_s: T, told_m_s: T, speed_m_s: T, share: f64) -> HubTorques<T> {
        let (zero, one) = (T::lit(0.0), T::lit(1.0));
        let ahead = self.driving_n_m_s_m(speed_m_s, share) * demand_m_s.max(zero);
        let other = demand_m_s.min(zero) * T::lit(self.brake_ratio * self.per_demand_n_m_s_m);
        let closed = speed_m_s / speed_m_s.abs_smooth(CLOSED_SPEED_M_S) * T::lit(self.closed_n_m);
        let backwards = told_backwards(told_m_s);
        HubTorques { driving_n_m: ahead + backwards * other - closed, braking_n_m: (backwards - one) * other }
    }

    /// Demand that holds the usual resistance under a speed command (m/s), m/s.
    #[inline(always)]
    pub fn held_m_s<T: Real>(&self, command_m_s: T) -> T {
        T::lit(self.holding_demand_m_s) * command_m_s / command_m_s.abs_smooth(HOLDING_SPEED_M_S)
    }

    /// The demand (m/s) that brings a torque at all wheels together (N m) at a speed above rest (m/s); `None` where no demand brings it.
    pub fn demand_m_s(&self, torque_n_m: f64, speed_m_s: f64, share: f64) -> Option<f64> {
        let opened = torque_n_m + speed_m_s / speed_m_s.abs_smooth(CLOSED_SPEED_M_S) * self.closed_n_m;
        let per_demand = if opened > 0.0 { self.driving_n_m_s_m(speed_m_s, share) } else { self.brake_ratio * self.per_demand_n_m_s_m };
        (per_demand > 0.0).then(|| opened / per_demand)
    }

    /// Torque at all wheels together that each m/s of a driving demand brings at a speed (m/s), of an engine that gives `share` of what it should, N m / (m/s).
    pub fn driving_n_m_s_m<T: Real>(&self, speed_m_s: T, share: f64) -> T {
        self.factor(speed_m_s) * T::lit(share) * T::lit(self.per_demand_n_m_s_m)
    }

    /// What engine and gears make of a demand at a speed over what they make of it at the middle knot, -.
    #[inline(always)]
    fn factor<T: Real>(&self, speed_m_s: T) -> T {
        let mut factor = T::lit(self.curve[0]);
        for k in 1..TORQUE_KNOTS {
            let reach = self.curve_speed_m_s[k] - self.curve_speed_m_s[k - 1];
            let inside = (speed_m_s - T::lit(self.curve_speed_m_s[k - 1])).max(T::lit(0.0)).min(T::lit(reach));
            factor = factor + inside * T::lit((self.curve[k] - self.curve[k - 1]) / reach);
        }
        factor
    }
}

/// Share to which a car under torque that is told a speed, m/s, drives backwards.
#[inline(always)]
pub(crate) fn told_backwards<T: Real>(told_m_s: T) -> T {
    (told_m_s * T::lit(-1.0 / HOLDING_SPEED_M_S)).max(T::lit(0.0)).min(T::lit(1.0))
}

/// Speed around which the drag of the engine turns its direction, m/s (chosen).
const CLOSED_SPEED_M_S: f64 = 0.1;
/// Speed command around which the held demand turns its direction, and backwards from which a car drives backwards, m/s (chosen: a command of zero does neither).
const HOLDING_SPEED_M_S: f64 = 0.1;

/// How a skid-steer base turns a commanded twist into rim speeds: gains, limits, then a lag, a limit of the acceleration and the same lag once more, for the mean rim
/// speed and for the turning of the rims (their difference over the track) apart.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RimServo {
    /// Mean rim speed per commanded speed, -.
    pub speed_gain: f64,
    /// Turning of the rims per commanded yaw rate, -.
    pub yaw_gain: f64,
    /// Dead time of the commands of speed and of turning, s: nothing happens for so long, then what was told.
    pub dead_time_s: [f64; 2],
    /// Largest turning of the rims, rad/s.
    pub yaw_limit_rad_s: f64,
    /// Largest speed of a rim, m/s; beyond it both sides shrink by the same share.
    pub rim_limit_m_s: f64,
    /// Time constant of each lag of the mean rim speed, s.
    pub speed_lag_s: f64,
    /// Time constant of each lag of the turning, s.
    pub yaw_lag_s: f64,
    /// Largest acceleration of the mean rim speed, m/s², and of the turning of the rims, rad/s².
    pub acceleration_limit: [f64; 2],
    /// Yaw rate of the vehicle per turning of the rims, -. Tells how the rims turn at the start of a rollout, when only the vehicle was measured.
    pub turn_efficiency: f64,
}

impl Default for RimServo {
    /// A base that does what it is told, within 0.1 s in turning, on ground where nothing slides.
    fn default() -> Self {
        const NONE: f64 = RimServo::NO_LIMIT;
        Self {
            speed_gain: 1.0,
            yaw_gain: 1.0,
            dead_time_s: [0.0; 2],
            yaw_limit_rad_s: NONE,
            rim_limit_m_s: NONE,
            speed_lag_s: 0.0,
            yaw_lag_s: 0.05,
            acceleration_limit: [NONE; 2],
            turn_efficiency: 1.0,
        }
    }
}

impl RimServo {
    /// A limit that nothing reaches.
    pub const NO_LIMIT: f64 = 1e3;

    /// Where the rims settle under a commanded twist: (mean rim speed m/s, turning rad/s).
    pub fn target<T: Real>(&self, speed_m_s: T, yaw_rate_rad_s: T, track_m: f64) -> [T; 2] {
        let size = |x: T| T::select_ge0(x, x, -x);
        let speed = T::lit(self.speed_gain) * speed_m_s;
        let limit = self.yaw_limit_rad_s;
        let turning = (T::lit(self.yaw_gain) * yaw_rate_rad_s).max(T::lit(-limit)).min(T::lit(limit));
        let fastest = size(speed) + T::lit(0.5 * track_m) * size(turning);
        let limit = T::lit(self.rim_limit_m_s);
        let share = T::select_ge0(limit - fastest, T::lit(1.0), limit / fastest);
        [share * speed, share * turning]
    }
}

/// A vehicle as the physics sees it. SI; Body FLU with origin at the reference point (the static centre of mass).
#[derive(Clone, Debug, PartialEq)]
pub struct Vehicle {
    /// Name from the card.
    pub name: String,
    /// Total mass, kg.
    pub mass_kg: f64,
    /// Inertia tensor about the centre of mass, Body axes, kg m².
    pub inertia_kg_m2: [[f64; 3]; 3],
    /// True when the inertia is a box estimate because the card gives none.
    pub inertia_estimated: bool,
    /// Wheel centres FL, FR, RL, RR relative to the reference point, Body, at static ride height, m.
    pub wheel_centre_m: [[f64; 3]; WHEELS],
    /// Wheel radius, m.
    pub wheel_radius_m: f64,
    /// Wheel width, m.
    pub wheel_width_m: f64,
    /// Vertical rate of the suspension at each wheel, N/m.
    pub suspension_n_m: [f64; WHEELS],
    /// Vertical damping at each wheel, N s/m.
    pub suspension_n_s_m: [f64; WHEELS],
    /// Meaning of the second command.
    pub second: SecondCommand,
    /// Range of (speed m/s, second) the card admits: `[[min, max]; 2]`.
    pub command_range: [[f64; 2]; 2],
    /// Steering table; `None` for a skid-steer vehicle.
    pub steering: Option<SteeringTable>,
    /// Effective track of the differential drive, m (skid-steer: nominal base; else geometric track).
    pub track_m: f64,
    /// Wheelbase, m.
    pub wheelbase_m: f64,
    /// Drive line.
    pub driveline: Driveline,
    /// How the soil acts on the wheels.
    pub contact_law: ContactLaw,
    /// Pressure by which fresh soil resists being pressed down under the soil contact model, over the speed of that, Pa s/m
    /// ([`WheelGeometry::soil_damping_pa_s_m`](crate::terramechanics::WheelGeometry::soil_damping_pa_s_m)).
    pub soil_damping_pa_s_m: f64,
    /// Gravity, m/s².
    pub gravity_m_s2: f64,
    /// What effects add; all zero for a vehicle as its card says.
    pub effects: EffectTerms,
}

impl Vehicle {
    /// Height of the reference point of a vehicle that stands on level ground, m: its springs at rest.
    pub fn standing_height_m(&self) -> f64 {
        self.wheel_radius_m - self.wheel_centre_m.iter().map(|centre| centre[2]).sum::<f64>() / WHEELS as f64
    }

    /// Static load of each wheel on flat ground, N: the share of the weight that balances the moments of the axles, half to each side.
    pub fn static_load_n(&self) -> [f64; WHEELS] {
        let [front, rear] = [0, 2].map(|i| self.wheel_centre_m[i][0]);
        let weight = self.mass_kg * self.gravity_m_s2;
        let on_front = weight * -rear / (front - rear);
        [0.5 * on_front, 0.5 * on_front, 0.5 * (weight - on_front), 0.5 * (weight - on_front)]
    }

    /// Torque that the drive adds at each wheel against the friction of all of them, N m: a vehicle that tracks its speed with an integral part holds it
    /// in spite of the friction, through open differentials equally at all wheels. A vehicle that servoes its rims adds none. Not asked of one driven by
    /// torque, whose demand grows by itself.
    pub fn drag_made_up_n_m(&self) -> f64 {
        let mean = self.effects.force.wheel_drag_n_m.iter().sum::<f64>() / WHEELS as f64;
        if self.second == SecondCommand::YawRateRadS { 0.0 } else { mean }
    }

    /// Friction torque that is left to the tread of a wheel, N m, for a slope of traction over rim speed of `slope_n_s_m`, the same at both wheels of the
    /// axle.
    ///
    /// What the speed controller makes up is subtracted from every drag. The dragged wheel turns slower than its partner, and the coupling of the
    /// differential passes torque to it: with drags τ, τ' and a slope s, τ - κ (τ - τ') / 2 is left, κ = (2 k / r²) / (s + 2 k / r²). Neglects the limit
    /// of the coupling and the one between the axles.
    pub fn drag_at_tread_n_m<T: Real>(&self, wheel: usize, slope_n_s_m: T) -> T {
        let [own, partner] = [wheel, wheel ^ 1].map(|w| self.effects.force.wheel_drag_n_m[w] - self.drag_made_up_n_m());
        let coupling = T::lit(2.0 * self.driveline.side_coupling_n_m_s / (self.wheel_radius_m * self.wheel_radius_m));
        let passed = coupling / (slope_n_s_m + coupling).max(T::lit(1.0));
        T::lit(own) - passed * T::lit(0.5 * (own - partner))
    }

    /// Servo of the rims with what the drive still has of its limits.
    pub fn limited_rims(&self) -> RimServo {
        let (mut rims, lost) = (self.driveline.rims, &self.effects.actuator);
        if lost.torque_lost != 0.0 {
            rims.rim_limit_m_s *= 1.0 - lost.torque_lost;
        }
        if lost.turn_limit_inverse_s_rad > 0.0 {
            rims.yaw_limit_rad_s = rims.yaw_limit_rad_s.min(1.0 / lost.turn_limit_inverse_s_rad);
        }
        if lost.rim_limit_inverse_s_m > 0.0 {
            rims.rim_limit_m_s = rims.rim_limit_m_s.min(1.0 / lost.rim_limit_inverse_s_m);
        }
        rims.turn_efficiency *= 1.0 + lost.turn_efficiency;
        for (limit, inverse) in rims.acceleration_limit.iter_mut().zip(lost.acceleration_limit_inverse) {
            if inverse > 0.0 {
                *limit = limit.min(1.0 / inverse);
            }
        }
        rims
    }

    /// Time by which the commands of speed and steering arrive late, s: the dead time of the card and what effects add to it.
    pub fn command_delay_s(&self) -> [f64; 2] {
        let [dead, added] = [self.driveline.rims.dead_time_s, self.effects.actuator.delay_s];
        core::array::from_fn(|i| dead[i] + added[i])
    }

    /// Whether commands arrive at the actuators otherwise than they were sent, or leave them with play.
    #[inline]
    pub fn alters_commands(&self) -> bool {
        self.driveline.rims.dead_time_s != [0.0; 2] || self.effects.actuator.alters_commands()
    }

    /// Whether the command lies in the range of the card. Compared in f32, as the service does, so that the ends of the range are admitted in both precisions.
    pub fn admits(&self, control: &Control<f64>) -> bool {
        self.admitted(control) == [true; 2]
    }

    /// The same of the speed and of the second command alone.
    pub fn admitted(&self, control: &Control<f64>) -> [bool; 2] {
        [self.admits_on(0, control.speed_m_s), self.admits_on(1, control.second)]
    }

    /// The same of one of the two, by its place in `command_range`.
    pub fn admits_on(&self, axis: usize, value: f64) -> bool {
        let [low, high] = self.command_range[axis];
        value as f32 >= low as f32 && value as f32 <= high as f32
    }
}
