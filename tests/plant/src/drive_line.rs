//! From commands to torques at the hubs and angles of the road wheels.

use crate::card::PlantVehicle;
use crate::effects::HiddenEffects;
use crate::plant::{Command, WHEELS};

/// Engine torque at full and at closed throttle (N m) over engine speed (rad/s), read off the recorded engine of the training drives (throttle 0 to 0.47,
/// 1 to 233 rad/s; linear in the throttle there).
const ENGINE: [[f64; 3]; 9] = [
    [0.0, 350.0, -5.0],
    [50.0, 450.0, -14.0],
    [95.0, 520.0, -21.0],
    [112.0, 1030.0, -25.0],
    [140.0, 1150.0, -30.0],
    [165.0, 1130.0, -31.0],
    [190.0, 1020.0, -38.0],
    [230.0, 880.0, -52.0],
    [300.0, 600.0, -70.0],
];
/// Engine speeds at which the gearbox changes up and down, rad/s (the ends of the ranges that the recorded gears cover).
const SHIFT_UP_RAD_S: f64 = 231.0;
const SHIFT_DOWN_RAD_S: f64 = 105.0;
/// Rim over-speed at which the throttle begins to fade and at which it is closed, m/s (data sheet).
const TRACTION_M_S: [f64; 2] = [1.5, 4.0];
/// Rim over ground speed at which the brake is gone and at which it is whole (data sheet).
const ANTI_LOCK: [f64; 2] = [0.5, 0.75];
/// Wheel speed over which a friction torque turns round, rad/s: as the reference simulator's.
const FRICTION_FADE_RAD_S: f64 = 0.15;

/// Controller, gearbox and steering actuator.
#[derive(Clone, Debug, Default)]
pub(crate) struct DriveLine {
    integral_m: f64,
    gear: usize,
    /// Position of the steering actuator, normalised.
    pub(crate) steering: f64,
    /// Commands with the time at which they were given, newest last, for dead times.
    given: Vec<(f64, Command)>,
}

/// What the drive line gives the four hubs.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Torques {
    /// Drive torque, N m.
    pub(crate) drive_n_m: [f64; WHEELS],
    /// Largest friction torque (brake and drag), N m.
    pub(crate) friction_n_m: [f64; WHEELS],
}

impl DriveLine {
    /// Gives a command at an instant.
    pub(crate) fn command(&mut self, time_s: f64, command: Command) {
        self.given.push((time_s, command));
        if self.given.len() > 64 {
            self.given.remove(0);
        }
    }

    /// The command in effect after a dead time.
    fn heard(&self, time_s: f64, delay_s: f64) -> Command {
        let due = self.given.iter().rev().find(|(given_s, _)| given_s + delay_s <= time_s + 1e-9);
        due.or(self.given.first()).map_or(Command::default(), |(_, command)| *command)
    }

    /// Advances by one step; `speed_m_s` is the forward speed of the reference point.
    pub(crate) fn step(
        &mut self,
        vehicle: &PlantVehicle,
        effects: &HiddenEffects,
        time_s: f64,
        speed_m_s: f64,
        wheel_rad_s: &[f64; WHEELS],
        dt_s: f64,
    ) -> Torques {
        self.steer(vehicle, effects, time_s, dt_s);
        let wanted = self.heard(time_s, effects.speed_delay_s).speed_m_s * (1.0 + effects.speed_gain);
        let error = wanted - speed_m_s;
        let pedal = vehicle.kp * error + vehicle.ki * self.integral_m;
        // The integral stands still while the pedal is at an end and the error would push it further.
        let stuck = (pedal >= 1.0 && error > 0.0) || (pedal <= -vehicle.brake_pedal_max && error < 0.0);
        if !stuck {
            self.integral_m += error * dt_s;
        }
        let fastest = wheel_rad_s.iter().copied().fold(f64::NEG_INFINITY, f64::max) * vehicle.radius_m;
        let over = fastest - speed_m_s;
        let traction = 1.0 - ((over - TRACTION_M_S[0]) / (TRACTION_M_S[1] - TRACTION_M_S[0])).clamp(0.0, 1.0);
        let throttle = pedal.clamp(0.0, 1.0) * traction;
        let brake = (-pedal).clamp(0.0, vehicle.brake_pedal_max);
        let mut torques = Torques { drive_n_m: self.drive(vehicle, effects, throttle, wheel_rad_s), friction_n_m: [0.0; WHEELS] };
        for (wheel, friction) in torques.friction_n_m.iter_mut().enumerate() {
            let share = (wheel_rad_s[wheel] * vehicle.radius_m).abs() / speed_m_s.abs().max(0.1);
            let held = ((share - ANTI_LOCK[0]) / (ANTI_LOCK[1] - ANTI_LOCK[0])).clamp(0.0, 1.0);
            let held = if speed_m_s.abs() < 0.3 { 1.0 } else { held };
            *friction = vehicle.brake_max_n_m * brake * held;
        }
        torques.friction_n_m[effects.wheel_drag_wheel] += effects.wheel_drag_n_m;
        torques
    }

    fn steer(&mut self, vehicle: &PlantVehicle, effects: &HiddenEffects, time_s: f64, dt_s: f64) {
        let wanted = self.heard(time_s, effects.steering_delay_s).steering.clamp(-1.0, 1.0);
        let rate = (wanted - self.steering) / (vehicle.steering_lag_s + effects.steering_lag_s);
        self.steering += rate.clamp(-vehicle.steering_rate_per_s, vehicle.steering_rate_per_s) * dt_s;
    }

    fn drive(&mut self, vehicle: &PlantVehicle, effects: &HiddenEffects, throttle: f64, wheel: &[f64; WHEELS]) -> [f64; WHEELS] {
        let mean = 0.25 * wheel.iter().sum::<f64>();
        let last = vehicle.ratios.len().saturating_sub(1);
        let engine_rad_s = mean.abs() * vehicle.ratios[self.gear];
        if engine_rad_s > SHIFT_UP_RAD_S && self.gear < last {
            self.gear += 1;
        } else if engine_rad_s < SHIFT_DOWN_RAD_S && self.gear > 0 {
            self.gear -= 1;
        }
        let ratio = vehicle.ratios[self.gear];
        let [full, closed] = engine_torque(mean.abs() * ratio);
        let engine = (closed + throttle * (full - closed)) * (1.0 - effects.torque_limit);
        let each = 0.25 * engine * ratio;
        let couple = |slower: f64, faster: f64| {
            (vehicle.coupling_n_m_s * (slower - faster)).clamp(-vehicle.coupling_max_n_m, vehicle.coupling_max_n_m)
        };
        let front = couple(wheel[1], wheel[0]);
        let rear = couple(wheel[3], wheel[2]);
        let centre = couple(0.5 * (wheel[2] + wheel[3]), 0.5 * (wheel[0] + wheel[1]));
        [each + front + centre, each - front + centre, each + rear - centre, each - rear - centre]
    }
}

/// Torque at full and closed throttle, N m.
fn engine_torque(speed_rad_s: f64) -> [f64; 2] {
    let above = ENGINE.iter().position(|row| row[0] >= speed_rad_s).unwrap_or(ENGINE.len() - 1).max(1);
    let (low, high) = (ENGINE[above - 1], ENGINE[above]);
    let share = ((speed_rad_s - low[0]) / (high[0] - low[0])).clamp(0.0, 1.0);
    [1, 2].map(|i| low[i] + share * (high[i] - low[i]))
}

/// Wheel speed after a step under a drive torque, a friction torque and soil that resists it: implicit in what opposes the spin, so that no step can overshoot.
pub(crate) fn spin_after(spin: f64, inertia: f64, driving_n_m: f64, friction_n_m: f64, soil_damping: f64, dt_s: f64) -> f64 {
    let friction_damping = friction_n_m / spin.abs().max(FRICTION_FADE_RAD_S);
    let pushed = spin + dt_s / inertia * (driving_n_m + soil_damping * spin);
    pushed / (1.0 + dt_s / inertia * (soil_damping + friction_damping))
}
