//! The predictor: a bundle ready to answer rollouts.

use std::sync::Arc;

use nesam_physics::SOIL_DIM;
use nesam_terrain::{Pose2, WorldMap};

use crate::bundle::ModelBundle;
use crate::rollout::{Rollout, RolloutQuery};
use crate::{HISTORY, MAX_HORIZON, ModelError};

/// A loaded bundle that answers rollout queries. `Send + Sync`; shared behind an `Arc`.
#[derive(Debug)]
pub struct Predictor {
    bundle: Arc<ModelBundle>,
}

impl Predictor {
    /// Prepares the bundle for inference.
    pub fn new(bundle: Arc<ModelBundle>) -> Self {
        Self { bundle }
    }

    /// The bundle behind the predictions.
    pub fn bundle(&self) -> &ModelBundle {
        &self.bundle
    }

    /// Rolls every candidate out from the start (paper Eq. 1 applied K times). Row n of a batch equals the query of n alone, bit for bit.
    ///
    /// # Errors
    /// `ModelError::Query` naming the field when shapes disagree, the horizon is 0 or above [`MAX_HORIZON`], or a number is not finite.
    pub fn rollout(&self, query: &RolloutQuery<'_>) -> Result<Rollout, ModelError> {
        let _ = (query, HISTORY, MAX_HORIZON);
        Err(ModelError::Query { field: "bundle", reason: "not wired yet".into() })
    }

    /// Nominal soil θ̄ under a pose (paper §III-B: h_θ of the semantic patch); the stated default without map or semantics.
    pub fn soil_prior(&self, map: Option<&WorldMap>, pose: Pose2) -> [f64; SOIL_DIM] {
        let _ = (map, pose);
        self.bundle.default_soil
    }
}
