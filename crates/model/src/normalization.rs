//! Scales and ranges that belong to trained weights.

use nesam_physics::{SOIL_DIM, STATE_DIM};
use nesam_terrain::PatchScale;
use serde::{Deserialize, Serialize};

use crate::dims::STATE_CONTROL;
use crate::soil_coordinates;
use crate::token::TokenScale;

/// Everything of a bundle that turns physical numbers into network numbers and back.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normalization {
    /// Step of the model, s.
    pub dt_s: f64,
    /// Sub-steps of the physics in one step.
    pub substeps: usize,
    /// Relative elevation that becomes 1 in a patch, m.
    pub elevation_half_range_m: f32,
    /// Colour that becomes 0, 0..=255 per channel.
    pub semantic_mean: [f32; 3],
    /// Colour difference that becomes 1, per channel.
    pub semantic_half_range: [f32; 3],
    /// Whether the encoders see borders between colours smoothed (`PatchScale::smooth_semantics`); bundles before 0.1.0 do not say and see them hard.
    #[serde(default)]
    pub smooth_semantics: bool,
    /// Mean of the state and control entries of a token, see `token::ENTRY_NAMES`.
    pub token_mean: [f32; STATE_CONTROL],
    /// Scale of the same.
    pub token_scale: [f32; STATE_CONTROL],
    /// What a raw residual of 1 means per step: displacement in the heading frame (m), attitude (rad), velocity (m/s), angular velocity (rad/s).
    pub residual_scale: [f32; STATE_DIM],
    /// Largest |log-ratio| of a wheel's sinkage to the load-balanced one.
    pub sinkage_log_ratio_max: f32,
    /// Scale of each state entry in the training loss, same units and order as the state.
    pub loss_scale: [f32; STATE_DIM],
    /// Raw soil coordinates used without a map or without semantics, and as the bias of an untrained prior.
    pub default_soil_raw: [f32; SOIL_DIM],
    /// Range of speed commands in the training data, m/s.
    pub trained_speed_m_s: [f64; 2],
    /// Range of the second command in the training data.
    pub trained_second: [f64; 2],
    /// Largest |roll| and |pitch| in the training data, rad.
    pub trained_tilt_rad: f64,
}

impl Normalization {
    /// Scale of patches.
    pub fn patch_scale(&self) -> PatchScale {
        PatchScale {
            elevation_half_range_m: self.elevation_half_range_m,
            semantic_mean: self.semantic_mean,
            semantic_half_range: self.semantic_half_range,
            smooth_semantics: self.smooth_semantics,
        }
    }

    /// Scale of tokens.
    pub fn token_scale(&self) -> TokenScale {
        TokenScale { mean: self.token_mean, scale: self.token_scale }
    }

    /// Soil without semantics.
    pub fn default_soil(&self) -> [f64; SOIL_DIM] {
        soil_coordinates::from_raw(&self.default_soil_raw)
    }
}
