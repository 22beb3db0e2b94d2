//! Covariance along a rollout: P_k = J_x P_x J_xᵀ + J_θ P_θ J_θᵀ + s Q_k.

use nesam_physics::{SOIL_DIM, STATE_DIM};
use serde::{Deserialize, Serialize};

use crate::ModelError;
use crate::tangent::StateJacobian;

/// Covariance of a state, order and units of the state.
pub type StateCovariance = [[f64; STATE_DIM]; STATE_DIM];
/// Covariance of a soil correction in its coordinates.
pub type SoilCovariance = [[f64; SOIL_DIM]; SOIL_DIM];

/// Dimensions of a pose, for which single 90 % regions are calibrated: x, y, z, roll, pitch, yaw.
pub const POSE: usize = 6;
/// Schema of [`RolloutNoise`].
const SCHEMA: &str = "nesam.rollout_noise/1";
/// Index of the height in a state.
const HEIGHT: usize = 2;
/// Numbers of a lower triangle.
const TRIANGLE: usize = STATE_DIM * (STATE_DIM + 1) / 2;

/// How many times Q_k counts for a drive on which the model errs more, or less, than its bundle says.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NoiseScale {
    /// Of the height.
    pub height: f64,
    /// Of everything else.
    pub rest: f64,
}

impl NoiseScale {
    /// As the bundle says.
    pub const USUAL: Self = Self::alike(1.0);

    /// The same for all.
    pub const fn alike(scale: f64) -> Self {
        Self { height: scale, rest: scale }
    }

    /// Of one entry of a covariance. An entry between two that count s and t times counts √(s t) times, so that no variance becomes negative.
    pub fn of(&self, row: usize, column: usize) -> f64 {
        match (row == HEIGHT, column == HEIGHT) {
            (true, true) => self.height,
            (false, false) => self.rest,
            _ => (self.height * self.rest).sqrt(),
        }
    }
}

/// What a bundle knows of its own errors: how far measured states lie from rollouts when start and soil are accounted for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RolloutNoise {
    schema: String,
    /// Standard deviations of a measured start, order and units of the state: those of the sensors.
    pub start_sd: [f64; STATE_DIM],
    /// Lower triangle of Q_k by rows for k = 1, 2, …, positions and their correlations in the heading frame of the predicted state. Holds the error of the
    /// model and the noise of the state that is measured at the end.
    residual: Vec<Vec<f64>>,
    /// Squared Mahalanobis radius of the region that holds 90 % of the measured (x, y).
    pub region_90_planar: f64,
    /// The same of the interval of each pose dimension alone.
    pub region_90_single: [f64; POSE],
    /// Drives behind the numbers.
    pub drives: usize,
    /// Windows behind the numbers.
    pub windows: usize,
    /// SHA-256 of the data they belong to.
    pub data_hash: String,
}

impl RolloutNoise {
    /// From the covariances of the steps k = 1, 2, …, whose lower triangles are read. Regions are those of a Gaussian until they are calibrated.
    pub fn new(start_sd: [f64; STATE_DIM], residual: &[StateCovariance]) -> Self {
        let triangle = |q: &StateCovariance| (0..STATE_DIM).flat_map(|r| q[r][..=r].to_vec()).collect();
        Self {
            schema: SCHEMA.into(),
            start_sd,
            residual: residual.iter().map(triangle).collect(),
            region_90_planar: 4.605, // 90 % quantile of χ² with two degrees of freedom, and with one
            region_90_single: [2.706; POSE],
            drives: 0,
            windows: 0,
            data_hash: String::new(),
        }
    }

    /// Reads the file of a bundle.
    ///
    /// # Errors
    /// `ModelError::RolloutNoise` with what was wrong: not JSON, another schema, a triangle of another length, a number out of range.
    pub fn from_json(text: &str) -> Result<Self, ModelError> {
        let fail = |reason: String| Err(ModelError::RolloutNoise { reason });
        let read: Self = serde_json::from_str(text).map_err(|e| ModelError::RolloutNoise { reason: e.to_string() })?;
        if read.schema != SCHEMA {
            return fail(format!("schema is `{}`, this program reads `{SCHEMA}`", read.schema));
        }
        if let Some(k) = read.residual.iter().position(|q| q.len() != TRIANGLE || !q.iter().all(|v| v.is_finite())) {
            return fail(format!("residual[{k}] must hold {TRIANGLE} finite numbers"));
        }
        if !read.start_sd.iter().all(|sd| sd.is_finite() && *sd >= 0.0) {
            return fail(format!("start_sd is {:?}; all twelve must be at least 0", read.start_sd));
        }
        let radii = || core::iter::once(&read.region_90_planar).chain(&read.region_90_single);
        if read.residual.is_empty() || !radii().all(|r| r.is_finite() && *r > 0.0) {
            return fail("needs at least one step and positive radii".into());
        }
        Ok(read)
    }

    /// As JSON with a trailing newline.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("finite numbers and text always serialise; this is a bug") + "\n"
    }

    /// Steps for which it is known.
    pub fn steps(&self) -> usize {
        self.residual.len()
    }

    /// P_x of a measured start: sensors that err independently.
    pub fn start_covariance(&self) -> StateCovariance {
        core::array::from_fn(|r| core::array::from_fn(|c| if r == c { self.start_sd[r].powi(2) } else { 0.0 }))
    }

    /// Q_k of step `k` (1 …), positions in the heading frame.
    ///
    /// # Panics
    /// When `k` is 0 or beyond [`RolloutNoise::steps`].
    pub fn residual(&self, k: usize) -> StateCovariance {
        let triangle = &self.residual[k - 1];
        core::array::from_fn(|r| {
            core::array::from_fn(|c| {
                let (low, high) = (r.min(c), r.max(c));
                triangle[high * (high + 1) / 2 + low]
            })
        })
    }

    /// s Q_k of (x, y, z) at each of these steps, x and y in the heading frame; `None` where one is beyond [`RolloutNoise::steps`].
    pub fn of_position<const N: usize>(&self, ahead: [usize; N], scale: f64) -> Option<[[[f64; 3]; 3]; N]> {
        let known = ahead.iter().all(|k| (1..=self.steps()).contains(k));
        known.then(|| {
            ahead.map(|k| {
                let q = self.residual(k);
                core::array::from_fn(|r| core::array::from_fn(|c| scale * q[r][c]))
            })
        })
    }

    /// P_k in World of step `k` (1 …) whose predicted yaw and derivatives are given, for covariances of start and soil; Q_k counts as `scale` says.
    pub fn covariance(
        &self,
        k: usize,
        yaw_rad: f64,
        jacobian: &StateJacobian,
        start: &StateCovariance,
        soil: &SoilCovariance,
        scale: NoiseScale,
    ) -> StateCovariance {
        let (of_start, of_soil) = (sandwich(&jacobian.start, start), sandwich(&jacobian.soil, soil));
        let of_model = turned(&self.residual(k), yaw_rad);
        core::array::from_fn(|r| core::array::from_fn(|c| of_start[r][c] + of_soil[r][c] + scale.of(r, c) * of_model[r][c]))
    }
}

/// J P Jᵀ, symmetric to the last bit.
pub fn sandwich<const N: usize>(jacobian: &[[f64; N]; STATE_DIM], covariance: &[[f64; N]; N]) -> StateCovariance {
    let half: [[f64; N]; STATE_DIM] =
        core::array::from_fn(|r| core::array::from_fn(|c| (0..N).map(|i| jacobian[r][i] * covariance[i][c]).sum()));
    let entry = |r: usize, c: usize| -> f64 { (0..N).map(|i| half[r][i] * jacobian[c][i]).sum() };
    core::array::from_fn(|r| core::array::from_fn(|c| entry(r.max(c), r.min(c))))
}

/// R P Rᵀ with the rotation of the horizontal position by a yaw: from the heading frame to World, or back with the opposite angle.
pub fn turned(covariance: &StateCovariance, yaw_rad: f64) -> StateCovariance {
    let (sin, cos) = yaw_rad.sin_cos();
    let mut rotation: StateCovariance = core::array::from_fn(|r| core::array::from_fn(|c| if r == c { 1.0 } else { 0.0 }));
    rotation[0][..2].copy_from_slice(&[cos, -sin]);
    rotation[1][..2].copy_from_slice(&[sin, cos]);
    sandwich(&rotation, covariance)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn some() -> StateCovariance {
        core::array::from_fn(|r| core::array::from_fn(|c| if r == c { 2.0 + r as f64 } else { 0.01 * (r + c) as f64 }))
    }

    #[test]
    fn analytic_without_start_and_soil_only_the_residual_is_left() {
        let noise = RolloutNoise::new([0.0; STATE_DIM], &[some(), some()]);
        let nothing = StateJacobian { start: [[1.0; STATE_DIM]; STATE_DIM], soil: [[1.0; SOIL_DIM]; STATE_DIM] };
        let p = noise.covariance(2, 0.0, &nothing, &noise.start_covariance(), &[[0.0; SOIL_DIM]; SOIL_DIM], NoiseScale::USUAL);
        assert_eq!(p, some());
    }

    #[test]
    fn analytic_a_height_that_errs_more_leaves_the_rest_as_it_is() {
        let noise = RolloutNoise::new([0.0; STATE_DIM], &[some()]);
        let nothing = StateJacobian { start: [[0.0; STATE_DIM]; STATE_DIM], soil: [[0.0; SOIL_DIM]; STATE_DIM] };
        let scale = NoiseScale { height: 9.0, rest: 4.0 };
        let p = noise.covariance(1, 0.0, &nothing, &noise.start_covariance(), &[[0.0; SOIL_DIM]; SOIL_DIM], scale);
        for (r, c, times) in [(0, 0, 4.0), (0, 1, 4.0), (2, 2, 9.0), (2, 3, 6.0), (8, 2, 6.0), (11, 11, 4.0)] {
            assert_eq!(p[r][c], times * some()[r][c], "{r} {c}");
        }
        assert_eq!([1.7, 0.3].map(|s| NoiseScale::alike(s).of(2, 3)), [1.7, 0.3]);
    }

    #[test]
    fn analytic_a_quarter_turn_exchanges_ahead_and_left() {
        let [before, after] = [some(), turned(&some(), core::f64::consts::FRAC_PI_2)];
        assert!((after[0][0] - before[1][1]).abs() < 1e-12 && (after[1][1] - before[0][0]).abs() < 1e-12);
        assert!((after[0][1] + before[0][1]).abs() < 1e-12 && (after[0][4] + before[1][4]).abs() < 1e-12);
        assert_eq!(after[4][7], before[4][7]);
    }

    #[test]
    fn regress_files_round_trip_and_wrong_ones_are_refused() {
        let noise = RolloutNoise::new([0.1; STATE_DIM], &[some()]);
        assert_eq!(RolloutNoise::from_json(&noise.to_json()).unwrap(), noise);
        for (from, to) in
            [("rollout_noise/1", "rollout_noise/2"), ("\"region_90_planar\":4.605", "\"region_90_planar\":-1.0"), ("[[", "[[1.0,")]
        {
            let text = noise.to_json().replacen(from, to, 1);
            assert!(RolloutNoise::from_json(&text).is_err(), "{to}");
        }
    }
}
