//! Filter settings as JSON: what `--filter FILE.json` reads, what a bundle carries, what every report repeats.

use nalgebra::DMatrix;
use nesam_physics::{SOIL_DIM, SoilCoordinates};
use serde::{Deserialize, Serialize};

use crate::calibration::NoiseCalibration;
use crate::conditions::NoiseConditions;
use crate::config::{FilterConfig, Innovation};
use crate::error::AdaptationError;
use crate::noise::{BufferNoise, ChannelNoise, SharedError, VelocityNoise};
use crate::prediction::VELOCITY_DIM;

/// Settings of the soil filter; what is absent in a file stays as it is by default. See `FilterConfig` for what each does.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FilterSettings {
    /// Transitions of one update.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub buffer: Option<usize>,
    /// Steps averaged into one row.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub block: Option<usize>,
    /// `physical` or `logarithmic`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub coordinates: Option<Coordinates>,
    /// `one_step` or `rollout`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub innovation: Option<Innovation>,
    /// √ of the diagonal of P₀, order of the soil vector.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub prior_sd: Option<[f64; SOIL_DIM]>,
    /// √ of the diagonal of Q_B.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub process_sd: Option<[f64; SOIL_DIM]>,
    /// R_B of buffers as they were measured, row by row; goes before `noise`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub noise_covariance: Option<Vec<Vec<f64>>>,
    /// How R_B grows with what the vehicle does.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub noise_conditions: Option<NoiseConditions>,
    /// The part of R_B that carries on from buffer to buffer, row by row; an empty list = none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub shared_error_covariance: Option<Vec<Vec<f64>>>,
    /// Its correlation from one buffer to the next.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub shared_error_correlation: Option<f64>,
    /// Degrees of freedom of Student's t, 0 = normal.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tail_dof: Option<f64>,
    /// Least share of the prior information that a buffer must add.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub excitation_min: Option<f64>,
    /// Classes of ground with a correction of their own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub classes: Option<usize>,
    /// Share of the prior that each has for itself.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub class_share: Option<f64>,
    /// Buffers that say no more than one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub shared_buffers: Option<f64>,
    /// Factors by which the update takes errors of channels to be larger: vx, vy, vz, ωx, ωy, ωz.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub caution: Option<[f64; VELOCITY_DIM]>,
    /// Buffers over which R_B is scaled to the drive, 0 = off.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scale_memory: Option<f64>,
    /// Buffers over which evidence for the correction is remembered, 0 = always trusted.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trust_memory: Option<f64>,
    /// Log odds of the correction before any evidence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub trust_log_odds: Option<f64>,
    /// R_B of channels: vx, vy, vz, ωx, ωy, ωz.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub noise: Option<[ChannelNoise; VELOCITY_DIM]>,
    /// Probability, before a buffer, that the ground has changed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub change_probability: Option<f64>,
    /// Variance where the ground is what it looks like, as a share of the filter's own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub looks_share: Option<f64>,
    /// Tail probability below which a buffer is rejected.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gate_tail_probability: Option<f64>,
    /// Linearisations of one update at most.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub linearisations: Option<usize>,
    /// Estimate and variance stay where the soil can be.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bounded: Option<bool>,
}

/// Coordinates of the estimate.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Coordinates {
    /// As in the paper.
    Physical,
    /// Factors and differences.
    Logarithmic,
}

impl FilterSettings {
    /// Reads a settings file.
    ///
    /// # Errors
    /// `AdaptationError::Settings` with the key and what was expected.
    pub fn from_json(text: &str) -> Result<Self, AdaptationError> {
        serde_json::from_str(text).map_err(|e| AdaptationError::Settings { reason: e.to_string() })
    }

    /// All settings of a filter.
    pub fn of(config: &FilterConfig) -> Self {
        let coordinates = match config.coordinates {
            SoilCoordinates::Physical => Coordinates::Physical,
            SoilCoordinates::Logarithmic => Coordinates::Logarithmic,
        };
        let (noise, noise_covariance) = match &config.noise {
            BufferNoise::Channels(noise) => (Some(noise.channels), None),
            BufferNoise::Sampled(moment) => (None, Some(rows_of(moment))),
        };
        Self {
            buffer: Some(config.buffer),
            block: Some(config.block),
            coordinates: Some(coordinates),
            innovation: Some(config.innovation),
            prior_sd: Some(config.prior_sd),
            process_sd: Some(config.process_sd),
            noise_covariance,
            noise_conditions: config.noise_conditions,
            shared_error_covariance: config.shared_error.as_ref().map(|s| rows_of(&s.covariance)),
            shared_error_correlation: config.shared_error.as_ref().map(|s| s.correlation),
            tail_dof: Some(config.tail_dof),
            excitation_min: Some(config.excitation_min),
            classes: Some(config.classes),
            class_share: Some(config.class_share),
            shared_buffers: Some(config.shared_buffers),
            caution: Some(config.caution),
            scale_memory: Some(config.scale_memory),
            trust_memory: Some(config.trust_memory),
            trust_log_odds: Some(config.trust_log_odds),
            noise,
            change_probability: Some(config.change_probability),
            looks_share: Some(config.looks_share),
            gate_tail_probability: Some(config.gate_tail_probability),
            linearisations: Some(config.linearisations),
            bounded: Some(config.bounded),
        }
    }

    /// These settings over the defaults; with `literal`, over those of the paper's Algorithm 1.
    pub fn over_defaults(&self, literal: bool) -> FilterConfig {
        let physical = literal || self.coordinates == Some(Coordinates::Physical);
        self.over(if physical { FilterConfig::literal() } else { FilterConfig::default() })
    }

    /// These settings over others.
    pub fn over(&self, base: FilterConfig) -> FilterConfig {
        let coordinates = match self.coordinates {
            None => base.coordinates,
            Some(Coordinates::Physical) => SoilCoordinates::Physical,
            Some(Coordinates::Logarithmic) => SoilCoordinates::Logarithmic,
        };
        let noise = match (&self.noise_covariance, self.noise) {
            (Some(rows), _) => BufferNoise::Sampled(matrix_of(rows)),
            (None, Some(channels)) => BufferNoise::Channels(VelocityNoise { channels }),
            (None, None) => base.noise,
        };
        let shared_error = match (&self.shared_error_covariance, self.shared_error_correlation) {
            (Some(rows), _) if rows.is_empty() => None,
            (Some(rows), correlation) => Some(SharedError { covariance: matrix_of(rows), correlation: correlation.unwrap_or(f64::NAN) }),
            (None, Some(correlation)) => base.shared_error.map(|s| SharedError { correlation, ..s }),
            (None, None) => base.shared_error,
        };
        FilterConfig {
            noise_conditions: self.noise_conditions.or(base.noise_conditions),
            shared_error,
            tail_dof: self.tail_dof.unwrap_or(base.tail_dof),
            excitation_min: self.excitation_min.unwrap_or(base.excitation_min),
            classes: self.classes.unwrap_or(base.classes),
            class_share: self.class_share.unwrap_or(base.class_share),
            buffer: self.buffer.unwrap_or(base.buffer),
            block: self.block.unwrap_or(base.block),
            coordinates,
            innovation: self.innovation.unwrap_or(base.innovation),
            prior_sd: self.prior_sd.unwrap_or(base.prior_sd),
            process_sd: self.process_sd.unwrap_or(base.process_sd),
            noise,
            shared_buffers: self.shared_buffers.unwrap_or(base.shared_buffers),
            caution: self.caution.unwrap_or(base.caution),
            scale_memory: self.scale_memory.unwrap_or(base.scale_memory),
            trust_memory: self.trust_memory.unwrap_or(base.trust_memory),
            trust_log_odds: self.trust_log_odds.unwrap_or(base.trust_log_odds),
            change_probability: self.change_probability.unwrap_or(base.change_probability),
            looks_share: self.looks_share.unwrap_or(base.looks_share),
            gate_tail_probability: self.gate_tail_probability.unwrap_or(base.gate_tail_probability),
            linearisations: self.linearisations.unwrap_or(base.linearisations),
            bounded: self.bounded.unwrap_or(base.bounded),
        }
    }
}

fn rows_of(matrix: &DMatrix<f64>) -> Vec<Vec<f64>> {
    matrix.row_iter().map(|row| row.iter().copied().collect()).collect()
}

/// A square matrix; what is missing is not a number and refused later.
fn matrix_of(rows: &[Vec<f64>]) -> DMatrix<f64> {
    DMatrix::from_fn(rows.len(), rows.len(), |r, c| rows[r].get(c).copied().unwrap_or(f64::NAN))
}

/// Schema of [`CalibratedFilter`].
const SCHEMA: &str = "nesam.soil_filter/1";

/// What a bundle carries for the soil filter: settings whose noise was estimated from this model's own errors, and from what.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CalibratedFilter {
    schema: String,
    /// Settings; what is absent is as by default.
    pub settings: FilterSettings,
    /// Drives that the noise was estimated from.
    pub drives: usize,
    /// Buffers that the noise was estimated from.
    pub buffers: usize,
    /// SHA-256 of the data they belong to.
    pub data_hash: String,
}

impl CalibratedFilter {
    /// What was estimated, the shape of the buffers it was estimated for, and the settings that were `given`; all others stay defaults and are not written
    /// down. What carries on from buffer to buffer is a state of its own, unless an empty `shared_error_covariance` was given: then repeated evidence
    /// is counted less.
    pub fn new(found: &NoiseCalibration, given: &FilterSettings, drives: usize, data_hash: &str) -> Self {
        let counted_less = given.shared_error_covariance.as_ref().is_some_and(Vec::is_empty);
        let config = FilterConfig {
            noise: found.noise.clone(),
            noise_conditions: found.conditions,
            shared_error: (!counted_less).then(|| found.shared_error.clone()),
            shared_buffers: given.shared_buffers.unwrap_or(if counted_less { found.shared_buffers } else { 1.0 }),
            ..given.over_defaults(false)
        };
        let all = FilterSettings::of(&config);
        let settings = FilterSettings {
            buffer: all.buffer,
            block: all.block,
            innovation: all.innovation,
            noise: all.noise,
            noise_covariance: all.noise_covariance,
            noise_conditions: all.noise_conditions,
            shared_error_covariance: all.shared_error_covariance,
            shared_error_correlation: all.shared_error_correlation,
            shared_buffers: all.shared_buffers,
            ..given.clone()
        };
        Self { schema: SCHEMA.into(), settings, drives, buffers: found.buffers, data_hash: data_hash.into() }
    }

    /// Reads the file of a bundle.
    ///
    /// # Errors
    /// `AdaptationError::Settings` with the key and what was expected, `Config` when no filter can run with it.
    pub fn from_json(text: &str) -> Result<Self, AdaptationError> {
        let read: Self = serde_json::from_str(text).map_err(|e| AdaptationError::Settings { reason: e.to_string() })?;
        if read.schema != SCHEMA {
            return Err(AdaptationError::Settings { reason: format!("schema is `{}`, this program reads `{SCHEMA}`", read.schema) });
        }
        read.config().check()?;
        Ok(read)
    }

    /// The settings of a filter for a bundle that may carry such a file: the default ones where it carries none.
    ///
    /// # Errors
    /// As [`CalibratedFilter::from_json`].
    pub fn config_of(carried: Option<&str>) -> Result<FilterConfig, AdaptationError> {
        Ok(carried.map(Self::from_json).transpose()?.map_or_else(FilterConfig::default, |filter| filter.config()))
    }

    /// As JSON with a trailing newline.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("finite numbers and text always serialise; this is a bug") + "\n"
    }

    /// The settings over the defaults.
    pub fn config(&self) -> FilterConfig {
        self.settings.over_defaults(false)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regress_settings_round_trip_and_absent_keys_are_defaults() {
        for literal in [false, true] {
            let config = FilterSettings::default().over_defaults(literal);
            let text = serde_json::to_string(&FilterSettings::of(&config)).unwrap();
            assert_eq!(FilterSettings::from_json(&text).unwrap().over_defaults(literal), config);
        }
        let some = FilterSettings::from_json(r#"{"buffer": 20}"#).unwrap().over_defaults(false);
        assert_eq!(some, FilterConfig { buffer: 20, ..FilterConfig::default() });
        let sampled = FilterConfig { noise: BufferNoise::Sampled(DMatrix::identity(12, 12)), ..FilterConfig::default() };
        assert_eq!(FilterSettings::of(&sampled).over(FilterConfig::literal()), sampled);
        let shared_error = SharedError { covariance: DMatrix::identity(12, 12) * 0.2, correlation: 0.6 };
        let conditions = Some(NoiseConditions { mean: [1.0; 4], slope: [0.1; 4] });
        let sampled =
            FilterConfig { shared_error: Some(shared_error.clone()), noise_conditions: conditions, shared_buffers: 1.0, ..sampled };
        assert_eq!(FilterSettings::of(&sampled).over(FilterConfig::literal()), sampled);
        let found = NoiseCalibration { noise: sampled.noise.clone(), shared_buffers: 4.0, shared_error, conditions, buffers: 700 };
        let given = FilterSettings { trust_memory: Some(7.0), ..FilterSettings::default() };
        let carried = CalibratedFilter::new(&found, &given, 30, "hash");
        assert_eq!(CalibratedFilter::from_json(&carried.to_json()).unwrap().config(), FilterConfig { trust_memory: 7.0, ..sampled });
        let counted_less = FilterSettings { shared_error_covariance: Some(Vec::new()), ..FilterSettings::default() };
        let config = CalibratedFilter::new(&found, &counted_less, 30, "hash").config();
        assert_eq!((config.shared_error, config.shared_buffers), (None, 4.0));
        let error = FilterSettings::from_json(r#"{"bufer": 20}"#).unwrap_err().to_string();
        assert!(error.contains("bufer"), "{error}");
    }
}
