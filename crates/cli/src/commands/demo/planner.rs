//! The demo's planner: the sampling planner of `nesam-navigation` on the path that the recorded driver took.

use nesam_navigation::{Decision, Mppi, MppiSettings};
use nesam_physics::{Control, Vehicle};

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

/// The planner; without a plan until it has seen what the driver does.
pub struct Planner {
    settings: MppiSettings,
    seed: u64,
    mppi: Option<Mppi>,
}

impl Planner {
    /// A planner without a plan yet.
    pub fn new(vehicle: &Vehicle, seed: u64) -> Self {
        let limits = vehicle.command_range;
        let noise_sd = std::array::from_fn(|i| NOISE_SHARE[i] * (limits[i][1] - limits[i][0]));
        let settings =
            MppiSettings { candidates: CANDIDATES, limits, noise_sd, noise_correlation: NOISE_CORRELATION, temperature: TEMPERATURE };
        Self { settings, seed, mppi: None }
    }

    /// Candidates for one cycle, row-major (candidates, horizon, 2). Row 0 is what the recorded driver does, so that its prediction can be compared
    /// with what the vehicle then did; row 1 is the plan; the others are the plan with correlated noise.
    pub fn candidates(&mut self, driver: &[Control<f64>]) -> Vec<f32> {
        self.mppi.get_or_insert_with(|| Mppi::new(self.settings, driver.to_vec(), self.seed)).propose(driver)
    }

    /// Weighs the predicted candidates and moves the plan. `poses` is (candidates, horizon) of x, y, roll, pitch; `path` the x, y to follow. `None` before
    /// the first candidates.
    pub fn decide(&mut self, poses: &[[f64; 4]], validity: &[u32], path: &[[f64; 2]]) -> Option<Decision> {
        let costs: Vec<f64> = poses
            .chunks_exact(HORIZON)
            .zip(validity)
            .map(|(rows, flags)| {
                let off: f64 = rows.iter().zip(path).map(|(p, g)| step_cost(p, g)).sum::<f64>() / HORIZON as f64;
                let cost = if off.is_finite() { off } else { INVALID_COST };
                cost + if flags & nesam_model::flag::NOT_FINITE == 0 { 0.0 } else { INVALID_COST }
            })
            .collect();
        self.mppi.as_mut().map(|mppi| mppi.decide(&costs))
    }
}

fn step_cost(pose: &[f64; 4], goal: &[f64; 2]) -> f64 {
    let [x, y, roll, pitch] = pose;
    (x - goal[0]).powi(2) + (y - goal[1]).powi(2) + TILT_WEIGHT * (roll * roll + pitch * pitch)
}
