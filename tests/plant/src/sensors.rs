//! What the sensors say.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::effects::HiddenEffects;
use crate::math::{Rotation, add};
use crate::plant::{Truth, WHEELS};

/// Standard deviations of the recorded drives: position (x, y, z) m, attitude rad, velocity m/s, gyro rad/s, wheel speed (relative), road-wheel angle rad.
const POSITION_M: [f64; 3] = [0.015, 0.015, 0.02];
const ATTITUDE_RAD: f64 = 0.1 * std::f64::consts::PI / 180.0;
const VELOCITY_M_S: f64 = 0.025;
const GYRO_RAD_S: f64 = 0.002;
const WHEEL_SPEED: f64 = 0.005;
const ROAD_WHEEL_RAD: f64 = 0.05 * std::f64::consts::PI / 180.0;

/// One reading of all sensors, in the form of [`Truth`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured {
    /// As [`Truth::state`].
    pub state: [f64; 12],
    /// As [`Truth::wheel_rad_s`].
    pub wheel_rad_s: [f64; WHEELS],
    /// As [`Truth::road_wheel_rad`].
    pub road_wheel_rad: [f64; 2],
}

/// White noise, and the hidden effects that sit in sensors.
#[derive(Clone, Debug)]
pub struct Sensors {
    rng: ChaCha8Rng,
    effects: HiddenEffects,
    /// True positions, newest last, for one that comes late.
    positions: Vec<(f64, [f64; 3])>,
}

impl Sensors {
    /// Sensors of a vehicle; the same seed gives the same noise.
    pub fn new(seed: u64, effects: &HiddenEffects) -> Self {
        Self { rng: ChaCha8Rng::seed_from_u64(seed), effects: *effects, positions: Vec::new() }
    }

    /// The true position at an instant, on a straight line between those of the steps around it; the first one before it.
    fn position_at(&self, time_s: f64) -> [f64; 3] {
        let after = self.positions.partition_point(|(at, _)| *at < time_s).min(self.positions.len() - 1);
        let ((from_s, from), (to_s, to)) = (self.positions[after.saturating_sub(1)], self.positions[after]);
        let share = if to_s > from_s { ((time_s - from_s) / (to_s - from_s)).clamp(0.0, 1.0) } else { 1.0 };
        std::array::from_fn(|i| (1.0 - share) * from[i] + share * to[i])
    }

    /// Reads the sensors; to be called once per step.
    pub fn read(&mut self, truth: &Truth) -> Measured {
        let e = self.effects;
        let of = |from: usize| [truth.state[from], truth.state[from + 1], truth.state[from + 2]];
        self.positions.push((truth.time_s, of(0)));
        if self.positions.len() > 32 {
            self.positions.remove(0);
        }
        let late = self.position_at(truth.time_s - e.position_latency_s);
        let mut noise = |sd: f64| sd * normal(&mut self.rng);
        let position: [f64; 3] = std::array::from_fn(|i| late[i] + noise(POSITION_M[i]) + if i == 2 { e.map_offset_m } else { 0.0 });
        let attitude: [f64; 3] = of(3).map(|angle| angle + noise(ATTITUDE_RAD));
        // The velocity is measured in World and turned by the measured attitude, as in the recorded drives.
        let world = Rotation::from_attitude(of(3)).to_world(of(6));
        let measured = add(world.map(|v| v * (1.0 + e.velocity_scale)), std::array::from_fn(|_| noise(VELOCITY_M_S)));
        let velocity = Rotation::from_attitude(attitude).to_body(measured);
        let rate: [f64; 3] = std::array::from_fn(|i| {
            truth.state[9 + i] * (1.0 + e.gyro_scale) + noise(GYRO_RAD_S) + if i == 2 { e.gyro_bias_rad_s } else { 0.0 }
        });
        Measured {
            state: std::array::from_fn(|i| [position, attitude, velocity, rate][i / 3][i % 3]),
            wheel_rad_s: truth.wheel_rad_s.map(|v| v * (1.0 + noise(WHEEL_SPEED))),
            road_wheel_rad: truth.road_wheel_rad.map(|v| v + noise(ROAD_WHEEL_RAD)),
        }
    }
}

/// Standard normal by the polar method of Marsaglia.
fn normal(rng: &mut ChaCha8Rng) -> f64 {
    loop {
        let (u, v): (f64, f64) = (rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0));
        let s = u * u + v * v;
        if s > 0.0 && s < 1.0 {
            return u * (-2.0 * s.ln() / s).sqrt();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: a late position is late by the latency and not by whole steps. Method: positions of a straight drive at the steps; instants at, between and before them.
    #[test]
    fn analytic_a_late_position_lies_between_steps() {
        let mut sensors = Sensors::new(1, &HiddenEffects::default());
        sensors.positions = (0..4).map(|k| (0.1 * f64::from(k), [f64::from(k), 0.0, -2.0 * f64::from(k)])).collect();
        for (time_s, x) in [(0.3, 3.0), (0.2, 2.0), (0.238, 2.38), (0.1, 1.0), (0.01, 0.1), (0.0, 0.0), (-0.5, 0.0)] {
            let at = sensors.position_at(time_s);
            assert!((at[0] - x).abs() < 1e-9 && (at[2] + 2.0 * x).abs() < 1e-9, "{time_s}: {at:?}");
        }
    }
}
