//! What a filter learned and how sure it is, held against soil that is known.

use std::sync::Arc;

use nalgebra::{SMatrix, SVector};
use nesam_adaptation::chi_square_tail;
use nesam_physics::SOIL_DIM;
use nesam_trajectories::Trajectory;
use serde::Serialize;

use crate::adapt::DriveAdaptation;
use crate::bootstrap::Resamples;
use crate::true_soil::TrueSoil;

/// Standard deviations of a 90 % interval.
const NINETY: f64 = 1.645;

/// Whether a sum of squares of this many degrees of freedom lies inside the two-sided 95 % interval of χ².
pub(crate) fn inside_95(dof: usize, sum: f64) -> bool {
    (0.025..=0.975).contains(&chi_square_tail(dof, sum))
}

/// One belief held against the truth.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Held {
    /// eᵀ P⁻¹ e of the error e = truth - estimate; infinite where P has no Cholesky factor.
    pub(crate) nees: f64,
    /// Whether the 90 % interval of each parameter holds the truth.
    pub(crate) inside: [bool; SOIL_DIM],
}

impl Held {
    /// An error and the covariance that was believed.
    pub(crate) fn of(error: &[f64; SOIL_DIM], covariance: &SMatrix<f64, SOIL_DIM, SOIL_DIM>) -> Self {
        let e = SVector::from(*error);
        Self {
            nees: covariance.cholesky().map_or(f64::INFINITY, |factor| e.dot(&factor.solve(&e))),
            inside: std::array::from_fn(|i| error[i].abs() <= NINETY * covariance[(i, i)].sqrt()),
        }
    }

    /// Whether NEES lies inside the two-sided 95 % interval of χ².
    pub(crate) fn nees_inside_95(&self) -> bool {
        inside_95(SOIL_DIM, self.nees)
    }

    /// Whether it lies above: the belief is surer than it should be.
    pub(crate) fn nees_above_95(&self) -> bool {
        chi_square_tail(SOIL_DIM, self.nees) < 0.025
    }
}

/// How what was learned agrees with the simulator's own soil under the vehicle, over all accepted updates of all drives. The soil that predicts best is not quite that
/// soil, because it makes up for what else is wrong in the model; this says by how much more than the filter believes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct KnownSoil {
    /// Updates that were compared.
    pub updates: usize,
    /// Median of NEES over its six degrees of freedom (0.89 for a consistent filter).
    pub nees_median_over_dof: f64,
    /// Share of updates with NEES inside the two-sided 95 % interval of χ².
    pub nees_inside_95: f64,
    /// Its 95 % interval by drive.
    pub nees_inside_95_ci95: Option<[f64; 2]>,
    /// Share of the 90 % intervals that hold the true parameter, all parameters.
    pub coverage_90: f64,
    /// Its 95 % interval by drive.
    pub coverage_90_ci95: Option<[f64; 2]>,
    /// The same by parameter.
    pub coverage_90_by_parameter: [f64; SOIL_DIM],
    /// Root mean square error of what was learned over that of the prior, by parameter; below 1 = learning came nearer to the true soil.
    pub error_over_prior: [f64; SOIL_DIM],
}

impl KnownSoil {
    /// In words; what there is of each parameter is in [`KnownSoil::by_parameter`].
    pub fn sentence(&self) -> String {
        let between = |ci95: Option<[f64; 2]>| ci95.map_or(String::new(), |[low, high]| format!(" [{low:.2}, {high:.2}]"));
        format!(
            "Held against the simulator's own soil after {} updates: median of NEES over 6 {:.2} (0.89 for a consistent filter), share inside its 95 % \
             interval {:.2}{}; share of 90 % intervals that hold the true parameter {:.2}{}.",
            self.updates,
            self.nees_median_over_dof,
            self.nees_inside_95,
            between(self.nees_inside_95_ci95),
            self.coverage_90,
            between(self.coverage_90_ci95)
        )
    }

    /// Rows of a table over the parameters, with their names.
    pub fn by_parameter(&self) -> [(&'static str, &[f64; SOIL_DIM]); 2] {
        [("90 % intervals hold", &self.coverage_90_by_parameter), ("error over the prior's", &self.error_over_prior)]
    }

    /// Of drives whose true soil is known; `None` without an accepted update there.
    pub fn of(drives: &[Trajectory], filtered: &[DriveAdaptation], truth: &[Arc<TrueSoil>], resamples: &Resamples) -> Option<Self> {
        let (mut held, mut of_drive, mut squared) = (Vec::new(), Vec::new(), [[0.0; 2]; SOIL_DIM]);
        for (d, ((drive, filtered), truth)) in drives.iter().zip(filtered).zip(truth).enumerate() {
            for timed in filtered.updates.iter().filter(|timed| !timed.update.rejected) {
                let [x_m, y_m, _] = drive.states[timed.sample].position_m;
                let Some(soil) = truth.soil_at([x_m, y_m]) else { continue };
                let posterior = &timed.update.posterior;
                let away = posterior.correction.coordinates.between(&timed.prior, &soil);
                let error = std::array::from_fn(|i| away[i] - posterior.correction.delta[i]);
                held.push(Held::of(&error, &SMatrix::from_fn(|r, c| posterior.covariance[r][c])));
                of_drive.push(d);
                for i in 0..SOIL_DIM {
                    squared[i] = [squared[i][0] + error[i].powi(2), squared[i][1] + away[i].powi(2)];
                }
            }
        }
        let count = held.len() as f64;
        let share = |of: &dyn Fn(&Held) -> f64| held.iter().map(of).sum::<f64>() / count;
        let interval = |of: &dyn Fn(&Held) -> f64| resamples.mean_interval(&held.iter().map(of).collect::<Vec<_>>(), &of_drive);
        let nees = |h: &Held| f64::from(u8::from(h.nees_inside_95()));
        let covered = |h: &Held| h.inside.iter().filter(|inside| **inside).count() as f64 / SOIL_DIM as f64;
        (!held.is_empty()).then(|| Self {
            updates: held.len(),
            nees_median_over_dof: crate::median(&held.iter().map(|h| h.nees / SOIL_DIM as f64).collect::<Vec<_>>()),
            nees_inside_95: share(&nees),
            nees_inside_95_ci95: interval(&nees),
            coverage_90: share(&covered),
            coverage_90_ci95: interval(&covered),
            coverage_90_by_parameter: std::array::from_fn(|i| share(&|h| f64::from(u8::from(h.inside[i])))),
            error_over_prior: squared.map(|[learned, prior]| (learned / prior).sqrt()),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_a_belief_by_hand() {
        // e = (3, 0, …) with a variance of 4 and of 1 elsewhere: NEES 9/4, inside ±1.645 · 2.
        let mut covariance = SMatrix::<f64, SOIL_DIM, SOIL_DIM>::identity();
        covariance[(0, 0)] = 4.0;
        let mut error = [0.0; SOIL_DIM];
        (error[0], error[5]) = (3.0, 1.7);
        let held = Held::of(&error, &covariance);
        assert!((held.nees - (2.25 + 1.7 * 1.7)).abs() < 1e-12);
        assert_eq!(held.inside, [true, true, true, true, true, false]);
        // χ² of six has 95 % between 1.24 and 14.45.
        assert!(held.nees_inside_95() && !Held::of(&[0.1; SOIL_DIM], &covariance).nees_inside_95());
        let sure = Held::of(&[0.0, 4.0, 0.0, 0.0, 0.0, 0.0], &covariance);
        assert!(!sure.nees_inside_95() && sure.nees_above_95() && !held.nees_above_95());
    }
}
