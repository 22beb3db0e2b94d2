//! Scales and ranges that belong to trained weights.

use std::ops::RangeInclusive;

use nesam_physics::{SOIL_DIM, STATE_DIM};
use nesam_terrain::PatchScale;
use serde::{Deserialize, Serialize};

use crate::dims::{HIDDEN, STATE_CONTROL};
use crate::soil_coordinates;
use crate::token::TokenScale;

/// Steps that a model may have, s.
const STEPS_S: RangeInclusive<f64> = 0.01..=1.0;
/// Sub-steps that a step may have: none moves no vehicle, and each costs as much as a step of its own.
const SUBSTEPS: RangeInclusive<usize> = 1..=64;

/// Everything of a bundle that turns physical numbers into network numbers and back.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normalization {
    /// Step of the model, s, 0.01..=1.
    pub dt_s: f64,
    /// Sub-steps of the physics in one step, 1..=64.
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
    /// Mean of the state and control entries of a token, see `token_entries`.
    pub token_mean: [f32; STATE_CONTROL],
    /// Scale of the same.
    pub token_scale: [f32; STATE_CONTROL],
    /// What a raw residual of 1 means per step: displacement in the heading frame (m), attitude (rad), velocity (m/s), angular velocity (rad/s).
    pub residual_scale: [f32; STATE_DIM],
    /// Largest |log-ratio| of a wheel's sinkage to the load-balanced one.
    pub sinkage_log_ratio_max: f32,
    /// Scale of each state entry in the training loss, same units and order as the state.
    pub loss_scale: [f32; STATE_DIM],
    /// Raw soil coordinates that an untrained prior begins with, also used without a map or without semantics where there is no [`StandIn`].
    pub default_soil_raw: [f32; SOIL_DIM],
    /// Range of speed commands in the training data, m/s.
    pub trained_speed_m_s: [f64; 2],
    /// Range of the second command in the training data.
    pub trained_second: [f64; 2],
    /// Largest |roll| and |pitch| in the training data, rad.
    pub trained_tilt_rad: f64,
    /// What stands in for ground that no map shows; bundles trained without colours have none, and those before 0.1.0.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stand_in: Option<StandIn>,
}

/// What stands in for ground that no map shows, for a network that was trained on maps with colours alone: means along the drives that trained it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StandIn {
    /// What colours add to the context W_c c of the same ground without them, (128).
    pub colours: Vec<f32>,
    /// Context W_c c, (128): of ground without a map.
    pub ground: Vec<f32>,
    /// Soil prior in raw coordinates: the soil without a map or without colours.
    pub soil_raw: [f32; SOIL_DIM],
    /// Standard deviation of the soil prior, of the logarithms of k_φ, k_c, c and K and of n and φ (rad) themselves.
    pub soil_sd: [f64; SOIL_DIM],
}

impl Normalization {
    /// Whether a model can be run with these numbers: a step of 0.01..=1 s in 1..=64 sub-steps, scales that are finite and above 0, means and default soil
    /// that are finite, and trained ranges that are finite and ascend.
    ///
    /// # Errors
    /// The key at fault, its value and what is allowed.
    pub fn check(&self) -> Result<(), String> {
        if !STEPS_S.contains(&self.dt_s) {
            return Err(format!("`dt_s` is {}, allowed are {} to {} s", self.dt_s, STEPS_S.start(), STEPS_S.end()));
        }
        if !SUBSTEPS.contains(&self.substeps) {
            return Err(format!("`substeps` is {}, allowed are {} to {}", self.substeps, SUBSTEPS.start(), SUBSTEPS.end()));
        }
        let scales: [(&str, &[f32]); 6] = [
            ("elevation_half_range_m", &[self.elevation_half_range_m]),
            ("semantic_half_range", &self.semantic_half_range),
            ("token_scale", &self.token_scale),
            ("residual_scale", &self.residual_scale),
            ("sinkage_log_ratio_max", &[self.sinkage_log_ratio_max]),
            ("loss_scale", &self.loss_scale),
        ];
        for (key, values) in scales {
            if let Some(value) = values.iter().find(|value| !(value.is_finite() && **value > 0.0)) {
                return Err(format!("`{key}` holds {value}, allowed are finite numbers above 0"));
            }
        }
        let centres: [(&str, &[f32]); 3] =
            [("semantic_mean", &self.semantic_mean), ("token_mean", &self.token_mean), ("default_soil_raw", &self.default_soil_raw)];
        for (key, values) in centres {
            if let Some(value) = values.iter().find(|value| !value.is_finite()) {
                return Err(format!("`{key}` holds {value}, allowed are finite numbers"));
            }
        }
        for (key, range) in [("trained_speed_m_s", self.trained_speed_m_s), ("trained_second", self.trained_second)] {
            if !(range.iter().all(|end| end.is_finite()) && range[0] <= range[1]) {
                return Err(format!("`{key}` is {range:?}, allowed is [min, max] of finite numbers with min <= max"));
            }
        }
        if !(self.trained_tilt_rad.is_finite() && self.trained_tilt_rad >= 0.0) {
            return Err(format!("`trained_tilt_rad` is {}, allowed are finite numbers from 0", self.trained_tilt_rad));
        }
        self.stand_in.as_ref().map_or(Ok(()), StandIn::check)
    }

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

    /// Soil without a map or without semantics, raw.
    pub fn unseen_soil_raw(&self) -> &[f32; SOIL_DIM] {
        self.stand_in.as_ref().map_or(&self.default_soil_raw, |stand_in| &stand_in.soil_raw)
    }

    /// The same, order of `SOIL_NAMES`.
    pub fn default_soil(&self) -> [f64; SOIL_DIM] {
        soil_coordinates::from_raw(self.unseen_soil_raw())
    }

    /// Takes another soil where a map tells of none.
    pub fn set_default_soil(&mut self, soil: &[f64; SOIL_DIM]) {
        let raw = soil_coordinates::to_raw(soil);
        *self.stand_in.as_mut().map_or(&mut self.default_soil_raw, |stand_in| &mut stand_in.soil_raw) = raw;
    }
}

impl StandIn {
    fn check(&self) -> Result<(), String> {
        for (key, values) in [("colours", &self.colours), ("ground", &self.ground)] {
            if values.len() != HIDDEN || !values.iter().all(|value| value.is_finite()) {
                return Err(format!("`stand_in.{key}` holds {} numbers, allowed are {HIDDEN} that are finite", values.len()));
            }
        }
        if !self.soil_raw.iter().all(|value| value.is_finite()) {
            return Err(format!("`stand_in.soil_raw` is {:?}, allowed are finite numbers", self.soil_raw));
        }
        if !self.soil_sd.iter().all(|sd| sd.is_finite() && *sd >= 0.0) {
            return Err(format!("`stand_in.soil_sd` is {:?}, allowed are finite numbers from 0", self.soil_sd));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    fn shipped() -> Normalization {
        let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../deploy/bundles/hmmwv-nominal/normalization.toml");
        toml::from_str(&std::fs::read_to_string(file).expect("readable")).expect("a shipped normalization")
    }

    /// What is refused of the shipped numbers after a change to them.
    fn refused(change: impl FnOnce(&mut Normalization)) -> Option<String> {
        let mut changed = shipped();
        change(&mut changed);
        changed.check().err()
    }

    /// Goal: no number of a bundle stops or falsifies a prediction unsaid. Method: the shipped numbers with one of them changed, each to every edge.
    #[test]
    fn regress_numbers_that_no_model_runs_with_are_refused_by_their_key() {
        assert_eq!(shipped().check(), Ok(()));
        let says = |found: Option<String>, key: &str, allowed: &str, what: &str| {
            let message = found.unwrap_or_else(|| panic!("{key} = {what} was let through"));
            assert!(message.contains(&format!("`{key}`")) && message.contains(allowed), "{key} = {what}: {message}");
        };
        for dt_s in [0.0, -0.1, 0.009, 1.01, f64::NAN, f64::INFINITY] {
            says(refused(|n| n.dt_s = dt_s), "dt_s", "0.01 to 1 s", &dt_s.to_string());
        }
        for substeps in [0, 65, 1_000_000_000] {
            says(refused(|n| n.substeps = substeps), "substeps", "1 to 64", &substeps.to_string());
        }
        for scale in [0.0, -1.0, f32::NAN, f32::INFINITY] {
            let (what, allowed) = (scale.to_string(), "finite numbers above 0");
            says(refused(|n| n.elevation_half_range_m = scale), "elevation_half_range_m", allowed, &what);
            says(refused(|n| n.semantic_half_range[2] = scale), "semantic_half_range", allowed, &what);
            says(refused(|n| n.token_scale[STATE_CONTROL - 1] = scale), "token_scale", allowed, &what);
            says(refused(|n| n.residual_scale[STATE_DIM - 1] = scale), "residual_scale", allowed, &what);
            says(refused(|n| n.sinkage_log_ratio_max = scale), "sinkage_log_ratio_max", allowed, &what);
            says(refused(|n| n.loss_scale[0] = scale), "loss_scale", allowed, &what);
        }
        for value in [f32::NAN, f32::NEG_INFINITY] {
            let (what, allowed) = (value.to_string(), "finite numbers");
            says(refused(|n| n.semantic_mean[1] = value), "semantic_mean", allowed, &what);
            says(refused(|n| n.token_mean[3] = value), "token_mean", allowed, &what);
            says(refused(|n| n.default_soil_raw[5] = value), "default_soil_raw", allowed, &what);
        }
        for range in [[1.0, 0.0], [f64::NAN, 1.0], [0.0, f64::INFINITY]] {
            let what = format!("{range:?}");
            says(refused(|n| n.trained_speed_m_s = range), "trained_speed_m_s", "min <= max", &what);
            says(refused(|n| n.trained_second = range), "trained_second", "min <= max", &what);
        }
        for tilt_rad in [-0.1, f64::NAN] {
            says(refused(|n| n.trained_tilt_rad = tilt_rad), "trained_tilt_rad", "from 0", &tilt_rad.to_string());
        }
        let stand_in =
            StandIn { colours: vec![0.1; HIDDEN], ground: vec![0.2; HIDDEN], soil_raw: [0.0; SOIL_DIM], soil_sd: [0.3; SOIL_DIM] };
        let with = |change: fn(&mut StandIn)| {
            let mut changed = stand_in.clone();
            change(&mut changed);
            refused(|n| n.stand_in = Some(changed))
        };
        assert_eq!(with(|_| {}), None);
        says(with(|s| s.colours.truncate(5)), "stand_in.colours", "128", "five");
        says(with(|s| s.ground[7] = f32::NAN), "stand_in.ground", "finite", "NaN");
        says(with(|s| s.soil_raw[2] = f32::INFINITY), "stand_in.soil_raw", "finite", "infinity");
        says(with(|s| s.soil_sd[5] = -0.1), "stand_in.soil_sd", "from 0", "-0.1");
    }

    #[test]
    fn property_the_edges_of_what_is_allowed_are_allowed() {
        for (dt_s, substeps) in [(0.01, 1), (1.0, 64), (0.05, 2)] {
            assert_eq!(refused(|n| (n.dt_s, n.substeps) = (dt_s, substeps)), None);
        }
        // A vehicle that always stood still, or was always told the same.
        assert_eq!(refused(|n| (n.trained_speed_m_s, n.trained_second, n.trained_tilt_rad) = ([0.0; 2], [0.2; 2], 0.0)), None);
    }
}
