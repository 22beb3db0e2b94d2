//! Model predictive path integral control (Williams et al. 2017): a plan that is moved towards the better ones of its noisy copies.

use nesam_physics::Control;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// How the planner explores and weighs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MppiSettings {
    /// Candidate sequences of a cycle, the fixed ones included.
    pub candidates: usize,
    /// Admitted commands: speed (m/s) and second command, both ends included.
    pub limits: [[f64; 2]; 2],
    /// Standard deviation of the noise of speed (m/s) and second command.
    pub noise_sd: [f64; 2],
    /// Correlation of the noise from step to step.
    pub noise_correlation: f64,
    /// Cost at which a candidate loses the factor e in weight, over mean minus least cost of the cycle.
    pub temperature: f64,
}

/// The planner: its plan, and the noise it explores with.
#[derive(Clone, Debug)]
pub struct Mppi {
    settings: MppiSettings,
    plan: Vec<Control<f64>>,
    rng: ChaCha8Rng,
    candidates: Vec<Control<f64>>,
}

/// What one cycle decided.
#[derive(Clone, Copy, Debug)]
pub struct Decision {
    /// First command of the new plan.
    pub command: Control<f64>,
    /// Cost of the best candidate.
    pub best_cost: f64,
}

impl Mppi {
    /// A planner that begins with a plan; its length is the horizon.
    pub fn new(settings: MppiSettings, plan: Vec<Control<f64>>, seed: u64) -> Self {
        Self { settings, plan, rng: ChaCha8Rng::seed_from_u64(seed), candidates: Vec::new() }
    }

    /// Admitted speed commands from now on, m/s.
    pub fn limit_speed(&mut self, limits_m_s: [f64; 2]) {
        self.settings.limits[0] = limits_m_s;
    }

    /// Candidates of a cycle, row-major (candidates, horizon, 2): the `fixed` sequences (whole horizons), the plan, then the plan with correlated noise.
    pub fn propose(&mut self, fixed: &[Control<f64>]) -> Vec<f32> {
        let horizon = self.plan.len();
        self.candidates.clear();
        self.candidates.extend_from_slice(fixed);
        self.candidates.extend_from_slice(&self.plan);
        let correlation = self.settings.noise_correlation;
        let fresh_share = (1.0 - correlation * correlation).sqrt();
        for _ in self.candidates.len() / horizon..self.settings.candidates {
            let mut noise = [0.0; 2];
            for step in 0..horizon {
                for (n, sd) in noise.iter_mut().zip(self.settings.noise_sd) {
                    *n = correlation * *n + fresh_share * sd * normal(&mut self.rng);
                }
                let base = self.plan[step];
                let clamp = |value: f64, i: usize| value.clamp(self.settings.limits[i][0], self.settings.limits[i][1]);
                self.candidates.push(Control { speed_m_s: clamp(base.speed_m_s + noise[0], 0), second: clamp(base.second + noise[1], 1) });
            }
        }
        self.candidates.iter().flat_map(Control::packed).collect()
    }

    /// Moves the plan to the weighted mean of the candidates, one cost each, and takes its first command off it.
    pub fn decide(&mut self, costs: &[f64]) -> Decision {
        let best_cost = self.improve(costs);
        Decision { command: self.next_command(), best_cost }
    }

    /// Moves the plan to the weighted mean of the candidates, one cost each; gives the least cost.
    pub fn improve(&mut self, costs: &[f64]) -> f64 {
        let horizon = self.plan.len();
        let best = costs.iter().copied().fold(f64::INFINITY, f64::min);
        let spread = (costs.iter().sum::<f64>() / costs.len() as f64 - best).max(1e-9);
        let weights: Vec<f64> = costs.iter().map(|c| (-(c - best) / (self.settings.temperature * spread)).exp()).collect();
        let total: f64 = weights.iter().sum();
        for step in 0..horizon {
            let mean = |pick: fn(&Control<f64>) -> f64| {
                weights.iter().enumerate().map(|(n, w)| w * pick(&self.candidates[n * horizon + step])).sum::<f64>() / total
            };
            self.plan[step] = Control { speed_m_s: mean(|c| c.speed_m_s), second: mean(|c| c.second) };
        }
        best
    }

    /// Takes the first command off the plan; the last one is repeated at its end.
    pub fn next_command(&mut self) -> Control<f64> {
        let command = self.plan[0];
        self.plan.rotate_left(1);
        if let [.., before, last] = &mut self.plan[..] {
            *last = *before;
        }
        command
    }
}

/// Standard normal by Box and Muller.
fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let (a, b): (f64, f64) = (rng.random_range(f64::EPSILON..1.0), rng.random_range(0.0..std::f64::consts::TAU));
    (-2.0 * a.ln()).sqrt() * b.cos()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Goal: the planner finds the least cost of a convex problem. Method: cost = mean squared distance of the commands from (2, 0.5), from a plan at (1, 0).
    #[test]
    fn analytic_plan_converges_to_the_minimum() {
        let settings = MppiSettings {
            candidates: 128,
            limits: [[0.0, 4.0], [-1.0, 1.0]],
            noise_sd: [0.2, 0.1],
            noise_correlation: 0.8,
            temperature: 0.15,
        };
        let mut planner = Mppi::new(settings, vec![Control { speed_m_s: 1.0, second: 0.0 }; 10], 3);
        let mut last = None;
        for _ in 0..80 {
            let rows = planner.propose(&[]);
            assert_eq!(rows.len(), 128 * 10 * 2);
            let cost = |row: &[f32]| {
                row.chunks(2).map(|c| (f64::from(c[0]) - 2.0).powi(2) + 4.0 * (f64::from(c[1]) - 0.5).powi(2)).sum::<f64>() / 10.0
            };
            let costs: Vec<f64> = rows.chunks(20).map(cost).collect();
            last = Some(planner.decide(&costs));
        }
        let command = last.unwrap().command;
        assert!((command.speed_m_s - 2.0).abs() < 0.1 && (command.second - 0.5).abs() < 0.06, "{command:?}");
    }
}
