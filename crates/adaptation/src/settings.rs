//! Filter settings as JSON: what `--filter FILE.json` reads, what a bundle carries, what every report repeats.

use nalgebra::DMatrix;
use nesam_physics::{SOIL_DIM, SoilCoordinates};
use serde::{Deserialize, Serialize};

use crate::calibration::NoiseCalibration;
use crate::config::{FilterConfig, Innovation};
use crate::error::AdaptationError;
use crate::noise::{BufferNoise, ChannelNoise, VelocityNoise};
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
    /// Buffers that say no more than one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub shared_buffers: Option<f64>,
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
            BufferNoise::Sampled(moment) => (None, Some(moment.row_iter().map(|row| row.iter().copied().collect()).collect())),
        };
        Self {
            buffer: Some(config.buffer),
            block: Some(config.block),
            coordinates: Some(coordinates),
            innovation: Some(config.innovation),
            prior_sd: Some(config.prior_sd),
            process_sd: Some(config.process_sd),
            noise_covariance,
            shared_buffers: Some(config.shared_buffers),
            scale_memory: Some(config.scale_memory),
            trust_memory: Some(config.trust_memory),
            trust_log_odds: Some(config.trust_log_odds),
            noise,
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
            (Some(rows), _) => {
                BufferNoise::Sampled(DMatrix::from_fn(rows.len(), rows.len(), |r, c| rows[r].get(c).copied().unwrap_or(f64::NAN)))
            }
            (None, Some(channels)) => BufferNoise::Channels(VelocityNoise { channels }),
            (None, None) => base.noise,
        };
        FilterConfig {
            buffer: self.buffer.unwrap_or(base.buffer),
            block: self.block.unwrap_or(base.block),
            coordinates,
            innovation: self.innovation.unwrap_or(base.innovation),
            prior_sd: self.prior_sd.unwrap_or(base.prior_sd),
            process_sd: self.process_sd.unwrap_or(base.process_sd),
            noise,
            shared_buffers: self.shared_buffers.unwrap_or(base.shared_buffers),
            scale_memory: self.scale_memory.unwrap_or(base.scale_memory),
            trust_memory: self.trust_memory.unwrap_or(base.trust_memory),
            trust_log_odds: self.trust_log_odds.unwrap_or(base.trust_log_odds),
            gate_tail_probability: self.gate_tail_probability.unwrap_or(base.gate_tail_probability),
            linearisations: self.linearisations.unwrap_or(base.linearisations),
            bounded: self.bounded.unwrap_or(base.bounded),
        }
    }
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
    /// What was estimated and the shape of the buffers it was estimated for; other settings stay defaults and are not written down.
    pub fn new(found: &NoiseCalibration, shape: &FilterConfig, drives: usize, data_hash: &str) -> Self {
        let all = FilterSettings::of(&FilterConfig { noise: found.noise.clone(), ..shape.clone() });
        let settings = FilterSettings {
            buffer: all.buffer,
            block: all.block,
            innovation: all.innovation,
            noise: all.noise,
            noise_covariance: all.noise_covariance,
            shared_buffers: Some(found.shared_buffers),
            ..FilterSettings::default()
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
        let found = NoiseCalibration { noise: sampled.noise.clone(), shared_buffers: sampled.shared_buffers, buffers: 700 };
        let carried = CalibratedFilter::new(&found, &sampled, 30, "hash");
        assert_eq!(CalibratedFilter::from_json(&carried.to_json()).unwrap().config(), sampled);
        let error = FilterSettings::from_json(r#"{"bufer": 20}"#).unwrap_err().to_string();
        assert!(error.contains("bufer"), "{error}");
    }
}
