//! What was predicted, held until the vehicle has got there.

use std::sync::Arc;

use nesam_evaluation::{Pose, constant_velocity, horizontal_distance, median, pose_of, quantile_sorted};
use nesam_trajectories::Trajectory;

/// Steps ahead at which predictions are compared: 1 s and 3.2 s.
pub const HORIZONS: [usize; 2] = [10, 32];

/// Compares predictions with what was then measured.
pub struct Ledger {
    drive: Arc<Trajectory>,
    errors: [Vec<Pair>; 2],
    latency_s: Vec<f64>,
}

/// Horizontal error of one prediction, m.
#[derive(Clone, Copy, Debug)]
struct Pair {
    from: usize,
    nesam_m: f64,
    constant_velocity_m: f64,
}

/// Errors at one horizon.
#[derive(Clone, Copy, Debug)]
pub struct Score {
    /// Seconds ahead.
    pub ahead_s: f64,
    /// Predictions compared.
    pub count: usize,
    /// Mean horizontal error of the service, m.
    pub nesam_m: f64,
    /// Mean horizontal error when the measured twist goes on, m.
    pub constant_velocity_m: f64,
}

impl Ledger {
    /// An empty ledger for a drive.
    pub fn new(drive: Arc<Trajectory>) -> Self {
        Self { drive, errors: [Vec::new(), Vec::new()], latency_s: Vec::new() }
    }

    /// Enters a prediction made at sample `from` (poses after steps 1…K of what the driver then commanded) and its round-trip time.
    pub fn enter(&mut self, from: usize, poses: &[[f64; 2]], latency_s: f64) {
        self.latency_s.push(latency_s);
        let start = &self.drive.states[from];
        let carried_on = constant_velocity(start, HORIZONS[1], self.drive.dt_s);
        for (errors, ahead) in self.errors.iter_mut().zip(HORIZONS) {
            let (Some(state), Some([x, y])) = (self.drive.states.get(from + ahead), poses.get(ahead - 1)) else { continue };
            let measured: Pose = pose_of(state);
            errors.push(Pair {
                from,
                nesam_m: (x - measured[0]).hypot(y - measured[1]),
                constant_velocity_m: horizontal_distance(&carried_on[ahead - 1], &measured),
            });
        }
    }

    /// Error at sample `now` of a prediction made 3.2 s before (or up to half a second earlier than that), m.
    pub fn error_now_m(&self, now: usize) -> Option<f64> {
        let made = now.checked_sub(HORIZONS[1])?;
        self.errors[1].iter().rev().find(|p| p.from <= made).filter(|p| p.from + 5 >= made).map(|p| p.nesam_m)
    }

    /// Scores over all predictions whose time has come by sample `now`.
    pub fn scores(&self, now: usize) -> [Score; 2] {
        std::array::from_fn(|h| {
            let due: Vec<&Pair> = self.errors[h].iter().filter(|p| p.from + HORIZONS[h] <= now).collect();
            let mean = |pick: fn(&Pair) -> f64| due.iter().map(|p| pick(p)).sum::<f64>() / due.len() as f64;
            Score {
                ahead_s: HORIZONS[h] as f64 * self.drive.dt_s,
                count: due.len(),
                nesam_m: mean(|p| p.nesam_m),
                constant_velocity_m: mean(|p| p.constant_velocity_m),
            }
        })
    }

    /// Median round-trip time so far, s.
    pub fn latency_median_s(&self) -> f64 {
        median(&self.latency_s)
    }

    /// Round-trip times at the shares given (0.5 = median), s.
    pub fn latency_quantiles_s(&self, shares: &[f64]) -> Vec<f64> {
        let mut sorted = self.latency_s.clone();
        sorted.sort_by(f64::total_cmp);
        shares.iter().map(|s| quantile_sorted(&sorted, *s)).collect()
    }

    /// Predictions entered.
    pub fn queries(&self) -> usize {
        self.latency_s.len()
    }
}
