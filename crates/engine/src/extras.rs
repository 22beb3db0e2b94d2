//! What a prediction may compute beyond states: Jacobians, covariance, risk, what-if soils. What is not asked for costs nothing.

use nesam_adaptation::check_covariance;
use nesam_model::rollout_noise::{NoiseScale, POSE, RolloutNoise, SoilCovariance, StateCovariance};
use nesam_model::{Linearisation, RiskOutputs};
use nesam_physics::{SOIL_DIM, STATE_DIM, SoilCorrection};
use rayon::prelude::*;

use crate::error::EngineError;
use crate::limits::Limits;
use crate::session::SoilEstimate;

/// Groups of trajectories that the sigma points of a soil posterior make: its mean and two for each parameter.
pub const SIGMA_POINTS: usize = 2 * SOIL_DIM + 1;
/// What the correlations of a given covariance may be off by: its numbers travelled as f32.
pub(crate) const COVARIANCE_ROUNDING: f64 = 1e-4;

/// What to compute beyond the states.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PredictExtras {
    /// Derivatives of every state in start, commands and soil correction.
    pub jacobians: bool,
    /// Covariance of every state.
    pub covariance: Option<CovarianceQuery>,
    /// Wheel loads and slips, load transfer, traction reserve.
    pub risk: bool,
    /// Encodes the terrain at every pose instead of interpolating on the pose grid.
    pub exact_terrain: bool,
    /// How far that moves the first candidate.
    pub interpolation_deviation: bool,
    /// Soils to predict for.
    pub soils: WhatIfSoils,
}

/// What the covariance starts from.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CovarianceQuery {
    /// Covariance of the start state; `None` = that of a measured state as the bundle knows it.
    pub start: Option<Box<StateCovariance>>,
}

/// Soils that every candidate is predicted for.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum WhatIfSoils {
    /// The session's estimate alone.
    #[default]
    Estimate,
    /// The session's correction plus each of these, in its coordinates.
    Added(Vec<[f64; SOIL_DIM]>),
    /// The session's correction, then correction ± √6 L_i for the columns L_i of the Cholesky factor of its covariance, + and - in turn: the unscented
    /// transform whose mean and covariance are those of the groups after the first, equally weighted.
    SigmaPoints,
}

/// What came of it; empty where nothing was asked for.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ExtraOutputs {
    /// Groups of trajectories S, 1 without what-if soils.
    pub soil_groups: usize,
    /// Derivatives.
    pub jacobians: Option<Jacobians>,
    /// Covariances with the 90 % regions.
    pub covariance: Option<Covariances>,
    /// Risk of each row and step.
    pub risk: Option<RiskOutputs>,
    /// Horizontal distance between the first candidate and the same one with the terrain encoded at every pose, mean over the horizon, m.
    pub interpolation_deviation_m: Option<f64>,
}

/// Derivatives of the states of every sample, row-major; rows of a state are World x y z roll pitch yaw vx vy vz wx wy wz. NaN after a state that is not
/// finite.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Jacobians {
    /// ∂x_k/∂x_0, (samples, horizon, 12, 12): x_0 is the measured or given state, before any rolling forward.
    pub start: Vec<f32>,
    /// ∂x_k/∂u_j, (samples, horizon, 12, horizon, 2).
    pub controls: Vec<f32>,
    /// ∂x_k/∂Δθ, (samples, horizon, 12, 6), in the coordinates of the session's correction.
    pub soil: Vec<f32>,
}

/// Covariances of the states of every sample.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Covariances {
    /// (samples, horizon, 12, 12), row-major, World.
    pub states: Vec<f32>,
    /// Squared Mahalanobis radius of the region that holds 90 % of the measured (x, y).
    pub region_90_planar: f64,
    /// The same of x, y, z, roll, pitch and yaw alone.
    pub region_90_single: [f64; POSE],
}

impl PredictExtras {
    /// Checks what needs no session.
    ///
    /// # Errors
    /// `EngineError::Invalid` naming the field below `extras` and the limit.
    pub fn check(&self, limits: &Limits, samples: usize) -> Result<(), EngineError> {
        let fail = |field: &str, reason: String| Err(EngineError::invalid(format!("extras.{field}"), reason));
        let groups = match &self.soils {
            WhatIfSoils::Estimate => 1,
            WhatIfSoils::SigmaPoints => SIGMA_POINTS,
            WhatIfSoils::Added(deltas) => {
                if deltas.is_empty() || deltas.len() > limits.soils_max {
                    return fail("soil_deltas", format!("has {} soils, allowed are 1 to {}", deltas.len(), limits.soils_max));
                }
                if let Some(at) = deltas.iter().position(|delta| !delta.iter().all(|v| v.is_finite())) {
                    return fail("soil_deltas", format!("soil {at} holds a number that is not finite"));
                }
                deltas.len()
            }
        };
        let derived = [
            ("jacobians", self.jacobians, limits.jacobian_samples_max),
            ("covariance", self.covariance.is_some(), limits.covariance_samples_max),
            ("exact_terrain", self.exact_terrain, limits.exact_samples_max),
        ];
        if self.exact_terrain && self.interpolation_deviation {
            return fail("interpolation_deviation", "is asked for together with `exact_terrain`, which interpolates nothing".into());
        }
        for (field, asked, limit) in derived {
            if asked && samples > limit {
                return fail(field, format!("is asked for {samples} samples, allowed are up to {limit}"));
            }
            if asked && self.soils != WhatIfSoils::Estimate {
                return fail(field, "is asked for together with what-if soils, allowed is one of the two".into());
            }
        }
        if let Some(CovarianceQuery { start: Some(start) }) = &self.covariance {
            check_covariance(STATE_DIM, start.as_flattened(), COVARIANCE_ROUNDING)
                .map_err(|reason| EngineError::invalid("extras.start_covariance", reason))?;
        }
        if groups * samples > limits.samples_max {
            let field = if self.soils == WhatIfSoils::SigmaPoints { "soil_sigma_points" } else { "soil_deltas" };
            let (most, samples_max) = (limits.samples_max, limits.samples_max / groups);
            return fail(
                field,
                format!("makes {groups} x {samples} trajectories, allowed are {most}: with {groups} soils up to {samples_max} samples"),
            );
        }
        Ok(())
    }

    /// Whether derivatives are needed.
    pub(crate) fn derived(&self) -> bool {
        self.jacobians || self.covariance.is_some()
    }

    /// The corrections to predict for; empty = the session's own alone.
    pub(crate) fn corrections(&self, soil: &SoilEstimate) -> Vec<SoilCorrection> {
        let own = soil.state.correction;
        let moved = |delta: &[f64; SOIL_DIM]| SoilCorrection { delta: core::array::from_fn(|i| own.delta[i] + delta[i]), ..own };
        match &self.soils {
            WhatIfSoils::Estimate => Vec::new(),
            WhatIfSoils::Added(deltas) => deltas.iter().map(moved).collect(),
            WhatIfSoils::SigmaPoints => {
                let factor = cholesky(&soil.covariance);
                let spread = (SOIL_DIM as f64).sqrt();
                let column = |c: usize, sign: f64| moved(&core::array::from_fn(|r| sign * spread * factor[r][c]));
                core::iter::once(own).chain((0..SOIL_DIM).flat_map(|c| [column(c, 1.0), column(c, -1.0)])).collect()
            }
        }
    }

    /// Jacobians and covariances of the steps after the first `rolled`.
    ///
    /// # Errors
    /// `EngineError::NotReady` when covariance is asked for and the bundle does not know its errors so many steps ahead.
    pub(crate) fn derive(
        &self,
        linearisations: &[Linearisation<'_>],
        rolled: usize,
        soil: &SoilEstimate,
        noise: Option<&RolloutNoise>,
    ) -> Result<(Option<Jacobians>, Option<Covariances>), EngineError> {
        let known = |noise: &&RolloutNoise| linearisations.iter().all(|l| l.horizon() <= noise.steps());
        let noise = match (&self.covariance, noise.filter(known)) {
            (Some(query), Some(noise)) => Some((query, noise)),
            (None, _) => None,
            (Some(_), None) => {
                let reason = "needs a bundle that knows its errors so many steps ahead; run `nesam evaluate --calibrate-coverage` for it";
                return Err(EngineError::NotReady { field: "extras.covariance".into(), reason: reason.into() });
            }
        };
        let of_sample = |linearisation: &Linearisation<'_>| {
            let jacobians = linearisation.by_start_and_soil();
            let covariance = noise.map(|(query, noise)| {
                let start = query.start.as_deref().copied().unwrap_or_else(|| noise.start_covariance());
                covariances(linearisation, &jacobians, rolled, &start, &soil.covariance, soil.model_noise_scale(), noise)
            });
            let derivatives = self.jacobians.then(|| {
                let flat = |v: &[f64]| v.iter().map(|v| *v as f32).collect::<Vec<f32>>();
                let steps = &jacobians[rolled..];
                Jacobians {
                    start: steps.iter().flat_map(|j| flat(j.start.as_flattened())).collect(),
                    controls: after(&linearisation.by_controls(), linearisation.horizon(), rolled),
                    soil: steps.iter().flat_map(|j| flat(j.soil.as_flattened())).collect(),
                }
            });
            (derivatives, covariance)
        };
        let parts: Vec<(Option<Jacobians>, Option<Vec<f32>>)> = linearisations.par_iter().map(of_sample).collect();
        let mut all = Jacobians::default();
        let mut states = Vec::new();
        for (derivatives, covariance) in parts {
            let derivatives = derivatives.unwrap_or_default();
            all.start.extend(derivatives.start);
            all.controls.extend(derivatives.controls);
            all.soil.extend(derivatives.soil);
            states.extend(covariance.unwrap_or_default());
        }
        let covariance = noise.map(|(_, noise)| Covariances {
            states,
            region_90_planar: noise.region_90_planar,
            region_90_single: noise.region_90_single,
        });
        Ok((self.jacobians.then_some(all), covariance))
    }
}

/// P_k of the steps after the first `rolled`, (horizon - rolled, 12, 12).
fn covariances(
    linearisation: &Linearisation<'_>,
    jacobians: &[nesam_model::StateJacobian],
    rolled: usize,
    start: &StateCovariance,
    soil: &SoilCovariance,
    scale: NoiseScale,
    noise: &RolloutNoise,
) -> Vec<f32> {
    let mut yaws = linearisation.states().map(|state| state.attitude_rad[2]);
    let mut packed = Vec::with_capacity((jacobians.len() - rolled) * STATE_DIM * STATE_DIM);
    for (k, jacobian) in jacobians.iter().enumerate() {
        // After a state that is not finite, the Jacobians are NaN and so is this.
        let yaw = yaws.next().unwrap_or(f64::NAN);
        if k >= rolled {
            let covariance = noise.covariance(k + 1, yaw, jacobian, start, soil, scale);
            packed.extend(covariance.as_flattened().iter().map(|v| *v as f32));
        }
    }
    packed
}

/// Takes the first `rolled` steps and commands off a (K, 12, K, 2) array.
fn after(jacobian: &[f64], horizon: usize, rolled: usize) -> Vec<f32> {
    let width = horizon * 2;
    let rows = jacobian.chunks_exact(width).skip(rolled * STATE_DIM);
    rows.flat_map(|row| &row[rolled * 2..]).map(|v| *v as f32).collect()
}

/// Lower Cholesky factor of a positive semi-definite matrix; a direction without variance stays zero.
fn cholesky<const N: usize>(a: &[[f64; N]; N]) -> [[f64; N]; N] {
    let mut l = [[0.0; N]; N];
    for c in 0..N {
        let left = a[c][c] - (0..c).map(|k| l[c][k] * l[c][k]).sum::<f64>();
        if left <= 1e-12 * a[c][c].abs() {
            continue;
        }
        l[c][c] = left.sqrt();
        for r in c + 1..N {
            l[r][c] = (a[r][c] - (0..c).map(|k| l[r][k] * l[c][k]).sum::<f64>()) / l[c][c];
        }
    }
    l
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_cholesky_rebuilds_and_leaves_out_what_has_no_variance() {
        let a = [[4.0, 2.0, 0.0], [2.0, 5.0, 0.0], [0.0, 0.0, 0.0]];
        assert_eq!(cholesky(&a), [[2.0, 0.0, 0.0], [1.0, 2.0, 0.0], [0.0; 3]]);
    }

    #[test]
    fn analytic_sigma_points_have_the_mean_and_the_covariance_of_the_posterior() {
        let mut soil = SoilEstimate::begun(Default::default(), [[0.0; SOIL_DIM]; SOIL_DIM]);
        for i in 0..SOIL_DIM {
            soil.state.correction.delta[i] = 0.1 * i as f64;
            soil.covariance[i][i] = 0.5 + i as f64;
        }
        (soil.covariance[0][1], soil.covariance[1][0]) = (0.3, 0.3);
        let points = PredictExtras { soils: WhatIfSoils::SigmaPoints, ..Default::default() }.corrections(&soil);
        assert_eq!(points.len(), SIGMA_POINTS);
        let own = points[0].delta;
        assert_eq!(own, soil.state.correction.delta);
        for r in 0..SOIL_DIM {
            for c in 0..SOIL_DIM {
                let moment: f64 = points[1..].iter().map(|p| (p.delta[r] - own[r]) * (p.delta[c] - own[c])).sum::<f64>() / 12.0;
                assert!((moment - soil.covariance[r][c]).abs() < 1e-12, "{r} {c}: {moment}");
            }
        }
    }

    /// Goal: too many trajectories are told by the field that makes them, with the most that is admitted. Method: one sample more than that for sigma points
    /// and for two soils.
    #[test]
    fn regress_too_many_trajectories_name_what_makes_them() {
        let limits = Limits::default();
        for (soils, field, groups) in [
            (WhatIfSoils::SigmaPoints, "extras.soil_sigma_points", SIGMA_POINTS),
            (WhatIfSoils::Added(vec![[0.0; SOIL_DIM]; 2]), "extras.soil_deltas", 2),
        ] {
            let extras = PredictExtras { soils, ..Default::default() };
            let most = limits.samples_max / groups;
            assert!(extras.check(&limits, most).is_ok());
            let error = extras.check(&limits, most + 1).unwrap_err().to_string();
            assert!(error.contains(field) && error.contains(&format!("up to {most} samples")), "{error}");
        }
    }
}
