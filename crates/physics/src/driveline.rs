//! The drive line: from commands to rim speeds and road-wheel angles (ADR: how Ω follows from the command).
//!
//! A car-like vehicle tracks the commanded speed of its reference point: its drive line holds every rim a little faster or slower than the
//! ground under it, in proportion to the speed error and to its integral, within a limit. A skid-steer vehicle servoes the rims themselves
//! ([`RimServo`](crate::vehicle::RimServo)). The steering
//! actuator lags the command and is limited in rate. The actuator state depends on commands and measured motion only (see also `integral_observer.rs`), so a
//! server rebuilds it from the history of a session.

use crate::command_path::CommandPath;
use crate::integral_observer::held_by_integral_m;
use crate::scalar::Real;
use crate::state::{Control, VehicleState};
use crate::vehicle::{RimServo, SecondCommand, Vehicle, WHEELS};

/// State of the actuators between steps, in floats or in duals over them.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DrivelineState<T = f64> {
    /// Position of the steering actuator, in the unit of the second command; of a skid-steer vehicle the turning of the rims, rad/s.
    pub steering: T,
    /// Leaky integral of the speed error, m.
    pub speed_error_integral_m: T,
    /// Mean rim speed of a skid-steer vehicle, m/s.
    pub rim_speed_m_s: T,
    /// What the rims of a skid-steer vehicle are asked for between the two lags: (mean speed m/s, turning rad/s).
    pub rim_demand: [T; 2],
    /// Commands between sender and actuators; followed in every step, so that what alters them can begin at any time.
    pub path: CommandPath<T>,
}

/// The number held between two constants.
fn clamp<T: Real>(x: T, low: f64, high: f64) -> T {
    x.max(T::lit(low)).min(T::lit(high))
}

impl<T: Copy> DrivelineState<T> {
    /// The same actuators in another scalar.
    pub fn map<U>(&self, f: impl Fn(T) -> U) -> DrivelineState<U> {
        DrivelineState {
            steering: f(self.steering),
            speed_error_integral_m: f(self.speed_error_integral_m),
            rim_speed_m_s: f(self.rim_speed_m_s),
            rim_demand: self.rim_demand.map(&f),
            path: self.path.map(f),
        }
    }
}

impl<T: Real<Value = f64>> DrivelineState<T> {
    /// Actuators that have settled on a command.
    pub fn settled(control: &Control<T>) -> Self {
        Self {
            steering: control.second,
            speed_error_integral_m: T::lit(0.0),
            rim_speed_m_s: control.speed_m_s,
            rim_demand: [control.speed_m_s, control.second],
            path: CommandPath::settled(control),
        }
    }

    /// Actuators where the drive begins: a skid-steer vehicle's rims turn as its measured motion tells, a car's have settled on the command. The integral of a car under
    /// torque holds what a weak engine asks for beyond the usual resistance, and of one that stands nothing: what holds the resistance comes as it drives.
    pub fn starting(vehicle: &Vehicle, state: &VehicleState<T>, control: &Control<T>) -> Self {
        if vehicle.second != SecondCommand::YawRateRadS {
            let held_m = held_by_integral_m(vehicle, state.velocity_m_s[0], control.speed_m_s);
            return Self { speed_error_integral_m: held_m, ..Self::settled(control) };
        }
        let servo = &vehicle.limited_rims();
        let measured = before_linkage(vehicle, state.angular_velocity_rad_s[2] / T::lit(servo.turn_efficiency));
        let turning = clamp(measured, -servo.yaw_limit_rad_s, servo.yaw_limit_rad_s);
        Self::turning(vehicle, [state.velocity_m_s[0], turning])
    }

    /// Actuators of a skid-steer vehicle whose rims have settled on a twist, mean rim speed (m/s) and turning (rad/s), see [`rim_twist`]; before, it was told
    /// what its servo makes this twist of. A command that is late or lagged so begins at what the rims do, not at what they are now told.
    pub fn turning(vehicle: &Vehicle, twist: [T; 2]) -> Self {
        let servo = &vehicle.driveline.rims;
        let gains = [servo.speed_gain * (1.0 + vehicle.effects.actuator.speed_gain), servo.yaw_gain];
        let [speed_m_s, second] = core::array::from_fn(|i| twist[i] * T::lit(1.0 / gains[i]));
        let mut path = CommandPath::settled(&Control { speed_m_s, second });
        path.play = twist[1]; // the play lies behind the servo
        Self { steering: twist[1], speed_error_integral_m: T::lit(0.0), rim_speed_m_s: twist[0], rim_demand: twist, path }
    }

    /// The rims of a skid-steer vehicle after `dt_s` under a command.
    fn advance_rims(&self, vehicle: &Vehicle, control: &Control<T>, dt_s: f64) -> Self {
        let servo = &vehicle.limited_rims();
        let kept = |lag_s: f64| T::lit(if lag_s > 0.0 { (-dt_s / lag_s).exp() } else { 0.0 });
        let (speed, turning) = (kept(servo.speed_lag_s), kept(servo.yaw_lag_s));
        let target = servo.target(control.speed_m_s, control.second, vehicle.track_m);
        let demand: [T; 2] = core::array::from_fn(|i| {
            let lagged = target[i] + [speed, turning][i] * (self.rim_demand[i] - target[i]);
            if servo.acceleration_limit[i] >= RimServo::NO_LIMIT {
                return lagged;
            }
            let most = servo.acceleration_limit[i] * dt_s;
            self.rim_demand[i] + clamp(lagged - self.rim_demand[i], -most, most)
        });
        Self {
            steering: demand[1] + turning * (self.steering - demand[1]),
            speed_error_integral_m: T::lit(0.0),
            rim_speed_m_s: demand[0] + speed * (self.rim_speed_m_s - demand[0]),
            rim_demand: demand,
            path: self.path,
        }
    }

    /// Advances the actuators by `dt_s` under a command, given the measured or predicted forward speed.
    ///
    /// Exact first-order lag for a held command, limited in rate; the integral of the speed error leaks with the card's time constant.
    pub fn advance(&self, vehicle: &Vehicle, control: &Control<T>, forward_m_s: T, dt_s: f64) -> Self {
        if vehicle.alters_commands() {
            return self.advance_altered(vehicle, control, forward_m_s, dt_s);
        }
        let mut next = if vehicle.second == SecondCommand::YawRateRadS {
            self.advance_rims(vehicle, control, dt_s)
        } else {
            Self {
                steering: steered(vehicle, self.steering, control.second, dt_s),
                speed_error_integral_m: self.integrated(vehicle, control.speed_m_s, forward_m_s, dt_s),
                ..*self
            }
        };
        next.path.pass(control, next.steering);
        next
    }

    /// The same where commands arrive late, lagged or enlarged, or leave the steering with play. The way of the commands and a car's steering advance in
    /// pieces of the step; the rest sees the mean of what arrives.
    #[cold]
    #[inline(never)]
    fn advance_altered(&self, vehicle: &Vehicle, control: &Control<T>, forward_m_s: T, dt_s: f64) -> Self {
        let skid = vehicle.second == SecondCommand::YawRateRadS;
        let mut path = self.path;
        let mut steering = self.steering;
        let arrived = path.advance(vehicle, control, dt_s, |second, piece_s| {
            if !skid {
                steering = steered(vehicle, steering, second, piece_s);
            }
        });
        let mut next = if skid {
            self.advance_rims(vehicle, &arrived, dt_s)
        } else {
            Self { steering, speed_error_integral_m: self.integrated(vehicle, arrived.speed_m_s, forward_m_s, dt_s), ..*self }
        };
        let half_play = T::lit(0.5 * vehicle.effects.actuator.steering_play);
        path.play = path.play.max(next.steering - half_play).min(next.steering + half_play);
        next.path = path;
        next
    }

    /// Leaky integral of the speed error after `dt_s`.
    fn integrated(&self, vehicle: &Vehicle, speed_m_s: T, forward_m_s: T, dt_s: f64) -> T {
        let line = &vehicle.driveline;
        let leak = T::lit((-dt_s / line.speed_integral_leak_s).exp());
        let limit = line.speed_integral_limit_m;
        let integral = self.speed_error_integral_m * leak + (speed_m_s - forward_m_s) * T::lit(dt_s);
        clamp(integral, -limit, limit)
    }

    /// Speed that the drive is told over the step that led to these actuators, m/s: what arrives of the command where effects alter it.
    pub(crate) fn told_speed_m_s(&self, vehicle: &Vehicle, control: &Control<T>) -> T {
        if vehicle.alters_commands() { self.path.speed_over_step_m_s } else { control.speed_m_s }
    }

    /// Speeds of the left and right rims of a skid-steer base at an instant, m/s: what its wheel encoders tell.
    pub fn rim_speeds_m_s(&self, vehicle: &Vehicle) -> [T; 2] {
        let half_turn =
            T::lit(0.5 * (vehicle.track_m + vehicle.effects.actuator.track_m)) * behind_linkage(vehicle, self.position(vehicle));
        [self.rim_speed_m_s - half_turn, self.rim_speed_m_s + half_turn]
    }

    /// Position of the steering behind its play.
    fn position(&self, vehicle: &Vehicle) -> T {
        if vehicle.effects.actuator.steering_play != 0.0 { self.path.play } else { self.steering }
    }

    /// Road-wheel angles FL, FR, RL, RR at an instant, rad.
    pub fn road_wheel_angles(&self, vehicle: &Vehicle) -> [T; WHEELS] {
        road_wheel_angles(vehicle, behind_linkage(vehicle, self.position(vehicle)))
    }
}

/// Speeds of the left and right rims of a skid-steer base whose wheels turn so (FL, FR, RL, RR, rad/s), m/s.
pub fn rim_speeds_m_s(vehicle: &Vehicle, wheel_speed_rad_s: &[f64; WHEELS]) -> [f64; 2] {
    core::array::from_fn(|side| 0.5 * (wheel_speed_rad_s[side] + wheel_speed_rad_s[side + 2]) * vehicle.wheel_radius_m)
}

/// Mean speed (m/s) and turning (rad/s, positive left) that the servo of a skid-steer base holds where its wheels turn so (FL, FR, RL, RR, rad/s): the way
/// back from wheels to actuators, through what effects change between them.
pub fn rim_twist(vehicle: &Vehicle, wheel_speed_rad_s: &[f64; WHEELS]) -> [f64; 2] {
    let [left, right] = rim_speeds_m_s(vehicle, wheel_speed_rad_s);
    let turning = (right - left) / (vehicle.track_m + vehicle.effects.actuator.track_m);
    [0.5 * (left + right), before_linkage(vehicle, turning)]
}

/// The rims of a skid-steer base run freely from commands: its actuators at every sample after the first, at which its wheels turn so (FL, FR, RL, RR, rad/s).
pub fn free_run<'a>(
    vehicle: &'a Vehicle,
    first_rad_s: &[f64; WHEELS],
    controls: &'a [Control<f64>],
    dt_s: f64,
) -> impl Iterator<Item = DrivelineState> + use<'a> {
    let begun = DrivelineState::turning(vehicle, rim_twist(vehicle, first_rad_s));
    controls.iter().scan(begun, move |state, control| {
        *state = state.advance(vehicle, control, 0.0, dt_s);
        Some(*state)
    })
}

/// Position of a car's steering actuator after `dt_s` under a command.
fn steered<T: Real>(vehicle: &Vehicle, steering: T, command: T, dt_s: f64) -> T {
    let line = &vehicle.driveline;
    let travel = line.steering_rate_limit_per_s * dt_s;
    let target = command - steering;
    let lagged = if line.steering_lag_s > 0.0 { target * T::lit(1.0 - (-dt_s / line.steering_lag_s).exp()) } else { target };
    steering + clamp(lagged, -travel, travel)
}

/// What steering ratio and offset make of a position of the actuator.
fn behind_linkage<T: Real>(vehicle: &Vehicle, position: T) -> T {
    let terms = &vehicle.effects.actuator;
    let position = if terms.steering_ratio != 0.0 { position * T::lit(1.0 + terms.steering_ratio) } else { position };
    position + T::lit(terms.steering_offset)
}

/// Position of the actuator of which steering ratio and offset make this: the inverse of [`behind_linkage`].
fn before_linkage<T: Real>(vehicle: &Vehicle, behind: T) -> T {
    let terms = &vehicle.effects.actuator;
    let position = behind - T::lit(terms.steering_offset);
    if terms.steering_ratio != 0.0 { position / T::lit(1.0 + terms.steering_ratio) } else { position }
}

/// Smooth saturation d / sqrt(1 + (d / limit)²) of a demand: slope one at zero, the limit far out.
#[inline(always)]
pub(crate) fn limited<T: Real>(demand_m_s: T, limit_m_s: T) -> T {
    let share = demand_m_s / limit_m_s;
    demand_m_s / (T::lit(1.0) + share * share).sqrt()
}

/// The demand that [`limited`] makes this of, which lies inside the limit.
pub(crate) fn unlimited(limited_m_s: f64, limit_m_s: f64) -> f64 {
    limited_m_s / (1.0 - (limited_m_s / limit_m_s).powi(2)).sqrt()
}

/// What the wheels are told during one step; constants of the step (no derivative flows through the actuators).
#[derive(Clone, Copy, Debug)]
pub struct WheelCommand<T> {
    /// Road-wheel angle, rad, positive left.
    pub angle_rad: [T; WHEELS],
    /// Rim speed = `rim_base_m_s` + `rim_follow` · (wheel's own forward speed) + `rim_gain` · (speed command - forward speed of the vehicle).
    pub rim_base_m_s: [T; WHEELS],
    /// 1 when the rim follows the ground under it (speed-controlled vehicle), 0 when it is servoed or measured.
    pub rim_follow: T,
    /// Over-speed per speed error, -.
    pub rim_gain: T,
    /// Over-speed limit, m/s.
    pub overspeed_limit_m_s: T,
    /// Speed command, m/s.
    pub speed_m_s: T,
}

/// Linear interpolation in an ascending table, carried on beyond its ends with the slope there: a linkage does not end where a data sheet does.
fn interpolate<T: Real<Value = f64>>(x: T, grid: &[f64], values: &[f64]) -> T {
    let Some(last) = grid.len().checked_sub(1).filter(|last| *last > 0) else { return T::lit(values[0]) };
    let i = grid.partition_point(|&g| g <= x.value()).clamp(1, last) - 1;
    let share = (x - T::lit(grid[i])) / T::lit(grid[i + 1] - grid[i]);
    T::lit(values[i]) + share * T::lit(values[i + 1] - values[i])
}

/// Road-wheel angles FL, FR, RL, RR of an actuator position, rad. Positions beyond the table, where an offset or a ratio takes them, go on with its slope.
pub fn road_wheel_angles<T: Real<Value = f64>>(vehicle: &Vehicle, steering: T) -> [T; WHEELS] {
    let zero = T::lit(0.0);
    match (&vehicle.steering, vehicle.second) {
        (Some(table), SecondCommand::SteeringNormalised) => [
            interpolate(steering, &table.command, &table.front_left_rad),
            interpolate(steering, &table.command, &table.front_right_rad),
            zero,
            zero,
        ],
        (_, SecondCommand::RoadWheelAngleRad) => [steering, steering, zero, zero],
        _ => [zero; WHEELS],
    }
}

/// Second command at which the front wheels stand at this angle on average, rad, positive left: the inverse of [`road_wheel_angles`] up to the ends of
/// the table and on with the slope there. `None` for a vehicle that is not steered.
pub fn steering_command_of(vehicle: &Vehicle, road_wheel_angle_rad: f64) -> Option<f64> {
    match (&vehicle.steering, vehicle.second) {
        (Some(table), SecondCommand::SteeringNormalised) => {
            let mean: Vec<f64> =
                table.front_left_rad.iter().zip(&table.front_right_rad).map(|(left, right)| 0.5 * (left + right)).collect();
            Some(interpolate(road_wheel_angle_rad, &mean, &table.command))
        }
        (_, SecondCommand::RoadWheelAngleRad) => Some(road_wheel_angle_rad),
        _ => None,
    }
}

/// What the command makes of the wheels over one step, from the mean actuator position of the step; constants in the scalar of the step.
pub fn command_wheels<T: Real>(
    vehicle: &Vehicle,
    before: &DrivelineState,
    after: &DrivelineState,
    control: &Control<f64>,
) -> WheelCommand<T> {
    let told = differentiable_wheels(vehicle, before, after, control);
    WheelCommand {
        angle_rad: told.angle_rad.map(T::lit),
        rim_base_m_s: told.rim_base_m_s.map(T::lit),
        rim_follow: T::lit(told.rim_follow),
        rim_gain: T::lit(told.rim_gain),
        overspeed_limit_m_s: T::lit(told.overspeed_limit_m_s),
        speed_m_s: T::lit(told.speed_m_s),
    }
}

/// The same with the derivatives that actuators and command carry: what a Jacobian in the commands needs.
pub fn differentiable_wheels<T: Real<Value = f64>>(
    vehicle: &Vehicle,
    before: &DrivelineState<T>,
    after: &DrivelineState<T>,
    control: &Control<T>,
) -> WheelCommand<T> {
    let line = &vehicle.driveline;
    let half = T::lit(0.5);
    let actuator = &vehicle.effects.actuator;
    let position = match actuator.steering_play {
        0.0 => half * (before.steering + after.steering),
        _ => half * (before.path.play + after.path.play),
    };
    let steering = behind_linkage(vehicle, position);
    let skid = vehicle.second == SecondCommand::YawRateRadS;
    let told_m_s = after.told_speed_m_s(vehicle, control);
    let mut base = [T::lit(line.speed_integral_gain_per_s) * before.speed_error_integral_m; WHEELS];
    if let Some(torque) = &line.torque {
        let held = torque.held_m_s(told_m_s);
        base = base.map(|b| b + held);
    }
    if skid {
        let half_turn = T::lit(0.5 * (vehicle.track_m + actuator.track_m)) * steering;
        let speed = half * (before.rim_speed_m_s + after.rim_speed_m_s);
        let (left, right) = (speed - half_turn, speed + half_turn);
        base = [left, right, left, right];
    }
    WheelCommand {
        angle_rad: road_wheel_angles(vehicle, steering),
        rim_base_m_s: base,
        rim_follow: T::lit(if skid { 0.0 } else { 1.0 }),
        rim_gain: T::lit(if skid { 0.0 } else { line.speed_gain }),
        overspeed_limit_m_s: T::lit(line.overspeed_limit_m_s * if line.torque.is_some() { 1.0 } else { 1.0 - actuator.torque_lost }),
        speed_m_s: told_m_s,
    }
}

/// Wheels driven by measured rim speeds and road-wheel angles (`--inputs wheels`).
pub fn measured_wheels<T: Real>(vehicle: &Vehicle, wheel_speed_rad_s: &[f64; WHEELS], angle_rad: &[f64; WHEELS]) -> WheelCommand<T> {
    WheelCommand {
        angle_rad: angle_rad.map(T::lit),
        rim_base_m_s: wheel_speed_rad_s.map(|w| T::lit(w * vehicle.wheel_radius_m)),
        rim_follow: T::lit(0.0),
        rim_gain: T::lit(0.0),
        overspeed_limit_m_s: T::lit(1.0),
        speed_m_s: T::lit(0.0),
    }
}

impl<T: Real> WheelCommand<T> {
    /// The same from a speed control that demands so much more, m/s: what its integral holds beyond what the command knows of.
    #[inline(always)]
    pub fn demanding_more(self, more_m_s: T) -> Self {
        Self { rim_base_m_s: self.rim_base_m_s.map(|base| base + more_m_s), ..self }
    }

    /// Rim speed of wheel `i`, m/s, given its own and the vehicle's forward speed.
    #[inline(always)]
    pub fn rim_speed_m_s(&self, i: usize, wheel_forward_m_s: T, vehicle_forward_m_s: T) -> T {
        let overspeed = self.demand_m_s(i, vehicle_forward_m_s);
        self.servo_m_s(i) + self.rim_follow * wheel_forward_m_s + overspeed
    }

    /// What the speed control demands of wheel `i`, m/s: the over-speed of its rim, or what its torque is proportional to; 0 where the rim is servoed.
    #[inline(always)]
    pub fn demand_m_s(&self, i: usize, vehicle_forward_m_s: T) -> T {
        let demand = self.rim_base_m_s[i] * self.rim_follow + self.rim_gain * (self.speed_m_s - vehicle_forward_m_s);
        limited(demand, self.overspeed_limit_m_s)
    }

    /// Rim speed of wheel `i` where it is servoed or measured, m/s, else 0.
    #[inline(always)]
    pub fn servo_m_s(&self, i: usize) -> T {
        self.rim_base_m_s[i] * (T::lit(1.0) - self.rim_follow)
    }

    /// -∂(rim speed - wheel's forward speed)/∂(forward speed): how strongly a gain in speed eats the over-speed.
    #[inline(always)]
    pub fn slip_feedback(&self) -> T {
        self.rim_follow * self.rim_gain + (T::lit(1.0) - self.rim_follow)
    }
}
