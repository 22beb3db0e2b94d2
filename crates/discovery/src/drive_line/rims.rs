//! Drives of a base as its rims tell them: what the drive line makes of the commands, run freely and held against them.

use nesam_physics::driveline::{DrivelineState, free_run, rim_speeds_m_s};
use nesam_physics::effects::Effect;
use nesam_physics::{Control, RimServo, Vehicle, WHEELS};
use nesam_trajectories::{Trajectory, limited_starts};
use rayon::prelude::*;

use super::measured_wheels;
use super::sized::Sized;
use crate::candidates::Candidate;
use crate::work::Work;

/// Most steps of drives that are looked at (chosen: half a minute on two cores), and the fewest of each drive.
const STEPS_MAX: usize = 30_000;
const STEPS_MIN: usize = 20;

/// Stands for a drive without wheel speeds: a first sample, from which nothing is run.
static UNMEASURED: [[f64; WHEELS]; 1] = [[0.0; WHEELS]];

/// A drive: commands, wheel speeds (rad/s) and rim speeds left and right (m/s).
#[derive(Debug)]
pub(super) struct Log<'a> {
    pub controls: &'a [Control<f64>],
    pub wheel_speed_rad_s: &'a [[f64; WHEELS]],
    pub rims_m_s: Vec<[f64; 2]>,
}

/// Drives of a base, and what may explain them.
#[derive(Debug)]
pub(super) struct Rims<'a> {
    pub vehicle: &'a Vehicle,
    pub dt_s: f64,
    pub logs: Vec<Log<'a>>,
    pub family: Vec<Candidate>,
    /// Who is told how far the search is.
    pub work: Work<'a>,
}

impl<'a> Rims<'a> {
    pub(super) fn of(vehicle: &'a Vehicle, drives: &'a [Trajectory], family: Vec<Candidate>, work: Work<'a>) -> Self {
        let most = (STEPS_MAX / drives.len()).max(STEPS_MIN);
        let log = |drive: &'a Trajectory| {
            // One without wheel speeds says nothing.
            let wheels = measured_wheels(drive).unwrap_or(&UNMEASURED);
            let wheels = &wheels[..wheels.len().min(most + 1)];
            let rims_m_s = wheels.iter().map(|wheels| rim_speeds_m_s(vehicle, wheels)).collect();
            Log { controls: &drive.controls, wheel_speed_rad_s: wheels, rims_m_s }
        };
        // A card that has a limit of the wheel speeds is tried with a share of it, one that has none with a limit.
        let limited = vehicle.limited_rims().rim_limit_m_s < RimServo::NO_LIMIT;
        let alias = if limited { "wheel_speed_limit" } else { "torque_limit" };
        let family = family.into_iter().filter(|c| c.id() != alias).collect();
        let mut logs: Vec<Log<'a>> = drives.iter().map(log).collect();
        let limited = limited_starts(&logs.iter().map(|log| &log.rims_m_s).collect::<Vec<_>>());
        for (log, _) in logs.iter_mut().zip(limited).filter(|(_, limited)| *limited) {
            log.rims_m_s.truncate(1);
            log.wheel_speed_rad_s = &log.wheel_speed_rad_s[..1];
        }
        Self { vehicle, dt_s: drives[0].dt_s, logs, family, work }
    }

    pub(super) fn effects(&self, terms: &[usize], values: &[f64]) -> Vec<Effect> {
        terms.iter().zip(values).map(|(term, value)| self.family[*term].effect(&[*value])).collect()
    }

    /// The vehicle with what was found.
    pub(super) fn with(&self, sized: &Sized) -> Vehicle {
        self.vehicle.with_effects(&self.effects(&sized.terms, &sized.values))
    }

    /// The free run of a drive line, from the first sample of a drive: its state at every other sample.
    pub(super) fn run<'r>(&self, vehicle: &'r Vehicle, log: &Log<'r>) -> impl Iterator<Item = DrivelineState> + use<'r> {
        free_run(vehicle, &log.wheel_speed_rad_s[0], &log.controls[..log.rims_m_s.len() - 1], self.dt_s)
    }

    /// Measured minus free run of both rims, m/s, at every sample of a drive but the first.
    pub(super) fn deviations<'r>(&self, vehicle: &'r Vehicle, log: &'r Log<'r>) -> impl Iterator<Item = f64> {
        self.run(vehicle, log).zip(&log.rims_m_s[1..]).flat_map(move |(state, measured)| {
            let run = state.rim_speeds_m_s(vehicle);
            [measured[0] - run[0], measured[1] - run[1]]
        })
    }

    /// Squared error of each drive with effects of these sizes.
    fn by_drive(&self, terms: &[usize], values: &[f64]) -> Vec<f64> {
        let vehicle = self.vehicle.with_effects(&self.effects(terms, values));
        self.logs.par_iter().map(|log| self.deviations(&vehicle, log).map(|v| v * v).sum()).collect()
    }

    pub(super) fn sized(&self, terms: Vec<usize>, values: Vec<f64>) -> Sized {
        let by_drive = self.by_drive(&terms, &values);
        Sized { terms, values, by_drive }
    }

    /// A size in the order of which an effect is sought: its own, or that of the catalogue where it is smaller.
    pub(super) fn scale(&self, term: usize, value: f64) -> f64 {
        let free = &self.family[term].free()[0];
        value.abs().max(if free.mean == 0.0 { free.step } else { 0.0 })
    }
}
