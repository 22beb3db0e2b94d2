//! A small sampling planner (MPPI; Williams et al. 2017), to show what asks the service and how.

use nesam_physics::{Control, Vehicle};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Candidate sequences per cycle.
pub const CANDIDATES: usize = 64;
/// Steps of each candidate.
pub const HORIZON: usize = 32;
/// Correlation of the noise between steps.
const NOISE_CORRELATION: f64 = 0.8;
/// Standard deviation of the noise as a share of the command range (speed, second).
const NOISE_SHARE: [f64; 2] = [0.03, 0.08];
/// Cost spread at which a candidate loses e-fold weight, relative to the spread of the costs.
const TEMPERATURE: f64 = 0.15;
/// Cost of one radian squared of roll or pitch against one metre squared off the path.
const TILT_WEIGHT: f64 = 4.0;
/// Cost added to a candidate that the service says something against.
const INVALID_COST: f64 = 1e3;

/// The planner: its plan, and the noise it explores with.
pub struct Planner {
    plan: Vec<Control<f64>>,
    range: [[f64; 2]; 2],
    rng: ChaCha8Rng,
    candidates: Vec<Control<f64>>,
}

/// What one cycle decided.
#[derive(Clone, Copy, Debug)]
pub struct Decision {
    /// Command to send next.
    pub command: Control<f64>,
    /// Mean squared distance of the best candidate from the path, with its tilt.
    pub best_cost: f64,
}

impl Planner {
    /// A planner without a plan yet.
    pub fn new(vehicle: &Vehicle, seed: u64) -> Self {
        Self { plan: Vec::new(), range: vehicle.command_range, rng: ChaCha8Rng::seed_from_u64(seed), candidates: Vec::new() }
    }

    /// Candidates for one cycle, row-major (candidates, horizon, 2). Row 0 is what the recorded driver does, so that its prediction can be compared
    /// with what the vehicle then did; row 1 is the plan; the others are the plan with correlated noise.
    pub fn candidates(&mut self, driver: &[Control<f64>]) -> Vec<f32> {
        if self.plan.len() != driver.len() {
            self.plan = driver.to_vec();
        }
        self.candidates.clear();
        self.candidates.extend_from_slice(driver);
        self.candidates.extend(self.plan.clone());
        for _ in 2..CANDIDATES {
            let mut noise = [0.0; 2];
            for step in 0..driver.len() {
                for (i, n) in noise.iter_mut().enumerate() {
                    let fresh = NOISE_SHARE[i] * (self.range[i][1] - self.range[i][0]) * normal(&mut self.rng);
                    *n = NOISE_CORRELATION * *n + (1.0 - NOISE_CORRELATION * NOISE_CORRELATION).sqrt() * fresh;
                }
                let base = self.plan[step];
                let clamp = |value: f64, i: usize| value.clamp(self.range[i][0], self.range[i][1]);
                self.candidates.push(Control { speed_m_s: clamp(base.speed_m_s + noise[0], 0), second: clamp(base.second + noise[1], 1) });
            }
        }
        self.candidates.iter().flat_map(|c| [c.speed_m_s as f32, c.second as f32]).collect()
    }

    /// Weighs the predicted candidates and moves the plan. `poses` is (candidates, horizon) of x, y, roll, pitch; `path` the x, y to follow.
    pub fn decide(&mut self, poses: &[[f64; 4]], validity: &[u32], path: &[[f64; 2]]) -> Decision {
        let horizon = self.plan.len();
        let costs: Vec<f64> = (0..CANDIDATES)
            .map(|n| {
                let rows = &poses[n * horizon..(n + 1) * horizon];
                let off: f64 = rows.iter().zip(path).map(|(p, g)| step_cost(p, g)).sum::<f64>() / horizon as f64;
                let cost = if off.is_finite() { off } else { INVALID_COST };
                cost + if validity[n] & nesam_model::flag::NOT_FINITE == 0 { 0.0 } else { INVALID_COST }
            })
            .collect();
        let best = costs.iter().copied().fold(f64::INFINITY, f64::min);
        let spread = (costs.iter().sum::<f64>() / costs.len() as f64 - best).max(1e-9);
        let weights: Vec<f64> = costs.iter().map(|c| (-(c - best) / (TEMPERATURE * spread)).exp()).collect();
        let total: f64 = weights.iter().sum();
        for step in 0..horizon {
            let mean = |pick: fn(&Control<f64>) -> f64| {
                weights.iter().enumerate().map(|(n, w)| w * pick(&self.candidates[n * horizon + step])).sum::<f64>() / total
            };
            self.plan[step] = Control { speed_m_s: mean(|c| c.speed_m_s), second: mean(|c| c.second) };
        }
        let command = self.plan[0];
        self.plan.rotate_left(1);
        if let [.., before, last] = &mut self.plan[..] {
            *last = *before;
        }
        Decision { command, best_cost: best }
    }
}

fn step_cost(pose: &[f64; 4], goal: &[f64; 2]) -> f64 {
    let [x, y, roll, pitch] = pose;
    (x - goal[0]).powi(2) + (y - goal[1]).powi(2) + TILT_WEIGHT * (roll * roll + pitch * pitch)
}

/// Standard normal by Box and Muller.
fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let (a, b): (f64, f64) = (rng.random_range(f64::EPSILON..1.0), rng.random_range(0.0..std::f64::consts::TAU));
    (-2.0 * a.ln()).sqrt() * b.cos()
}
