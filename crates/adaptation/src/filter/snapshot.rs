//! The state of a filter as plain numbers, to move it to another place.

use nalgebra::DVector;
use nesam_physics::SOIL_DIM;

use super::SoilFilter;
use crate::AdaptationError;
use crate::joint::JointState;

/// Mean and covariance of what a filter estimates together: Δθ of every class of ground, then the shared error where it is followed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct JointSnapshot {
    /// Mean, (n).
    pub mean: Vec<f64>,
    /// Covariance, (n, n) row-major.
    pub covariance: Vec<f64>,
}

/// All that a [`SoilFilter`] has learned, without its settings and without the transitions of a buffer that is not full.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FilterSnapshot {
    /// Δθ⁺, b⁺ and P⁺ of the filter itself.
    pub state: JointSnapshot,
    /// The same with the soil known to be the prior.
    pub plain: JointSnapshot,
    /// Scale of R_B.
    pub noise_scale: f64,
    /// Log odds that the correction helps.
    pub trust_log_odds: f64,
    /// Corrections that later buffers judge, (corrections, 6 · classes) row-major, oldest first.
    pub trust_corrections: Vec<f64>,
    /// Class of the ground under the newest transition.
    pub ground_class: usize,
}

/// A soil correction with its covariance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ClassBelief {
    /// Δθ.
    pub delta: [f64; SOIL_DIM],
    /// P, in the coordinates of the correction.
    pub covariance: [[f64; SOIL_DIM]; SOIL_DIM],
}

impl SoilFilter {
    /// What the filter has learned. Transitions that wait for the next update are not part of it.
    pub fn snapshot(&self) -> FilterSnapshot {
        let Self { config: _, noise: _, rest: _, state, plain, scale, trust, buffer: _, here, considered: _ } = self;
        let (trust_log_odds, corrections) = trust.state();
        FilterSnapshot {
            state: state.snapshot(),
            plain: plain.snapshot(),
            noise_scale: scale.value(),
            trust_log_odds,
            trust_corrections: corrections.iter().flat_map(|v| v.iter().copied()).collect(),
            ground_class: *here,
        }
    }

    /// What the filter itself says of the ground under the newest transition, whether it is trusted or not.
    pub fn belief(&self) -> ClassBelief {
        self.belief_in(&self.state, self.here)
    }

    pub(super) fn belief_in(&self, state: &JointState, class: usize) -> ClassBelief {
        let class = if class < self.config.classes { class } else { 0 };
        let (soils, covariance) = (state.soils(), state.soil_covariance(class));
        ClassBelief {
            delta: core::array::from_fn(|i| soils[SOIL_DIM * class + i]),
            covariance: core::array::from_fn(|r| core::array::from_fn(|c| covariance[(r, c)])),
        }
    }

    /// The filter as if it had learned `belief` before, on log odds that it helps; the first buffer judges it already. `None` for a filter that keeps classes
    /// of ground apart or follows a shared error: a belief about one soil does not say what they are.
    ///
    /// # Errors
    /// As [`SoilFilter::restored`], for a belief that is none.
    pub fn begun_from(&self, belief: &ClassBelief, log_odds: f64) -> Result<Option<Self>, AdaptationError> {
        if self.config.classes != 1 || self.config.shared_error.is_some() {
            return Ok(None);
        }
        let snapshot = FilterSnapshot {
            state: JointSnapshot { mean: belief.delta.to_vec(), covariance: belief.covariance.as_flattened().to_vec() },
            trust_log_odds: log_odds,
            trust_corrections: belief.delta.repeat(crate::trust::JUDGED),
            ..self.snapshot()
        };
        self.clone().restored(&snapshot).map(Some)
    }

    /// A filter with these settings that goes on, bit for bit, where the one of the snapshot stood. The buffer is empty.
    ///
    /// # Errors
    /// `AdaptationError::NotFinite` when a number of the snapshot is not, `Settings` when it is that of a filter with other classes or another shared error, or a covariance in it
    /// is none.
    pub fn restored(mut self, snapshot: &FilterSnapshot) -> Result<Self, AdaptationError> {
        let FilterSnapshot { state, plain, noise_scale, trust_log_odds, trust_corrections, ground_class } = snapshot;
        let joint = [state, plain].into_iter().flat_map(|s| s.mean.iter().chain(&s.covariance));
        if !joint.chain(trust_corrections).chain([noise_scale, trust_log_odds]).all(|v| v.is_finite()) {
            return Err(AdaptationError::NotFinite { what: "snapshot", index: 0 });
        }
        let soils = SOIL_DIM * self.config.classes;
        let other = || AdaptationError::Settings {
            reason: "the snapshot is that of a filter with other classes or another shared error, or holds a covariance that is none"
                .into(),
        };
        if !trust_corrections.len().is_multiple_of(soils) {
            return Err(other());
        }
        self.state = self.state.restored(state).ok_or_else(other)?;
        self.plain = self.plain.restored(plain).ok_or_else(other)?;
        self.scale.restore(*noise_scale);
        self.trust.restore(*trust_log_odds, trust_corrections.chunks_exact(soils).map(DVector::from_column_slice).collect());
        self.here = *ground_class;
        self.buffer.clear();
        Ok(self)
    }
}
