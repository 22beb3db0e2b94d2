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
    /// True poses, newest last, for a pose that comes late.
    poses: Vec<(f64, [f64; 6])>,
}

impl Sensors {
    /// Sensors of a vehicle; the same seed gives the same noise.
    pub fn new(seed: u64, effects: &HiddenEffects) -> Self {
        Self { rng: ChaCha8Rng::seed_from_u64(seed), effects: *effects, poses: Vec::new() }
    }

    /// Reads the sensors; to be called once per step.
    pub fn read(&mut self, truth: &Truth) -> Measured {
        let e = self.effects;
        self.poses.push((truth.time_s, std::array::from_fn(|i| truth.state[i])));
        if self.poses.len() > 32 {
            self.poses.remove(0);
        }
        let due = truth.time_s - e.position_latency_s + 1e-6;
        let pose = self.poses.iter().rev().find(|(at, _)| *at <= due).or(self.poses.first()).map_or([0.0; 6], |(_, pose)| *pose);
        let mut noise = |sd: f64| sd * normal(&mut self.rng);
        let position: [f64; 3] = std::array::from_fn(|i| pose[i] + noise(POSITION_M[i]) + if i == 2 { e.map_offset_m } else { 0.0 });
        let attitude: [f64; 3] = std::array::from_fn(|i| pose[3 + i] + noise(ATTITUDE_RAD));
        // The velocity is measured in World and turned by the measured attitude, as in the recorded drives.
        let of = |from: usize| [truth.state[from], truth.state[from + 1], truth.state[from + 2]];
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
