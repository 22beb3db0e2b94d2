//! How much more slowly than the card has it a base turns than its rims.

use nesam_physics::driveline::rim_twist;
use nesam_physics::effects::ScheduledEffect;
use nesam_trajectories::Trajectory;

use super::proof::{Told, finding};
use super::rims::{Log, Rims};
use super::sized::{Sized, T_MIN};
use crate::candidates::Candidate;
use crate::claims::{Finding, t_975};

/// Relative change of the turn efficiency from which it counts.
const EFFICIENCY_MIN: f64 = 0.05;

/// How much more slowly than the card has it a base turns than its rims.
#[derive(Debug)]
pub(super) struct Turning {
    pub candidate: Candidate,
    pub factor: f64,
    /// Without each drive.
    pub without: Vec<f64>,
    pub finding: Finding,
}

impl Turning {
    pub(super) fn effect(&self, factor: f64) -> ScheduledEffect {
        self.candidate.effect(&[factor]).into()
    }
}

impl Rims<'_> {
    /// The yaw rate of the vehicle per turning of its rims, as a factor on that of its card; `None` where nobody measured the yaw rate, or it is as the card has it. The
    /// turning of the free run, which has no noise, is the instrument of that which was measured.
    pub(super) fn turn_efficiency(&self, found: &Sized, drives: &[Trajectory], candidate: Candidate, hypothesis: usize) -> Option<Turning> {
        if !drives.iter().all(|d| d.measured.angular_velocity[2]) {
            return None;
        }
        let vehicle = self.with(found);
        let stated = vehicle.limited_rims().turn_efficiency;
        let said = |(log, drive): (&Log<'_>, &Trajectory)| {
            let measured = log.wheel_speed_rad_s[1..].iter().zip(&drive.states[1..]);
            self.run(&vehicle, log).zip(measured).fold([0.0; 2], |[turned, rims], (run, (wheels, state))| {
                let yaw_rate = state.angular_velocity_rad_s[2] / stated;
                [turned + run.steering * yaw_rate, rims + run.steering * rim_twist(&vehicle, wheels)[1]]
            })
        };
        let by_drive: Vec<[f64; 2]> = self.logs.iter().zip(drives).map(said).collect();
        let [turned, rims] = by_drive.iter().fold([0.0; 2], |sum, own| [sum[0] + own[0], sum[1] + own[1]]);
        let factor = turned / rims;
        let [low, high] = candidate.range(0);
        if !(rims > 0.0 && factor > low && factor < high) {
            return None;
        }
        let sd = by_drive.iter().map(|[turned, rims]| (turned - factor * rims).powi(2)).sum::<f64>().sqrt() / rims;
        let z = (factor - 1.0).abs() / sd.max(1e-300);
        let own = Told { z, difference: z * z, stability: 1.0, half_95: t_975(by_drive.len()) * sd, rivals: Vec::new() };
        let without = by_drive.iter().map(|[t, r]| ((turned - t) / (rims - r)).clamp(low, high)).collect();
        let finding = finding(candidate, hypothesis, factor, own);
        (z >= T_MIN && (factor - 1.0).abs() >= EFFICIENCY_MIN).then_some(Turning { candidate, factor, without, finding })
    }
}
