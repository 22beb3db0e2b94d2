//! Filter settings as JSON: what `--filter FILE.json` reads and every report repeats.

use nesam_adaptation::{ChannelNoise, FilterConfig, VELOCITY_DIM, VelocityNoise};
use nesam_physics::{SOIL_DIM, SoilCoordinates};
use serde::{Deserialize, Serialize};

use crate::error::EvaluationError;

/// Settings of the soil filter; what is absent in a file stays as it is by default. See `FilterConfig` for what each does.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FilterSettings {
    /// Transitions of one update.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub buffer: Option<usize>,
    /// `physical` or `logarithmic`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub coordinates: Option<Coordinates>,
    /// √ of the diagonal of P₀, order of the soil vector.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub prior_sd: Option<[f64; SOIL_DIM]>,
    /// √ of the diagonal of Q_B.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub process_sd: Option<[f64; SOIL_DIM]>,
    /// R_B: vx, vy, vz, ωx, ωy, ωz.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub noise: Option<[NoiseSettings; VELOCITY_DIM]>,
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

/// Noise of one channel, m/s or rad/s.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoiseSettings {
    /// Independent from step to step.
    pub white_sd: f64,
    /// Carried over from step to step.
    pub coloured_sd: f64,
    /// How much of it.
    pub correlation: f64,
}

/// Noise as JSON.
pub fn noise_settings(noise: &VelocityNoise) -> [NoiseSettings; VELOCITY_DIM] {
    noise.channels.map(|c| NoiseSettings { white_sd: c.white_sd, coloured_sd: c.coloured_sd, correlation: c.correlation })
}

impl FilterSettings {
    /// Reads a settings file.
    ///
    /// # Errors
    /// `EvaluationError::FilterSettings` with the key and what was expected.
    pub fn from_json(text: &str) -> Result<Self, EvaluationError> {
        serde_json::from_str(text).map_err(|e| EvaluationError::FilterSettings { reason: e.to_string() })
    }

    /// All settings of a filter.
    pub fn of(config: &FilterConfig) -> Self {
        let coordinates = match config.coordinates {
            SoilCoordinates::Physical => Coordinates::Physical,
            SoilCoordinates::Logarithmic => Coordinates::Logarithmic,
        };
        Self {
            buffer: Some(config.buffer),
            coordinates: Some(coordinates),
            prior_sd: Some(config.prior_sd),
            process_sd: Some(config.process_sd),
            noise: Some(noise_settings(&config.noise)),
            gate_tail_probability: Some(config.gate_tail_probability),
            linearisations: Some(config.linearisations),
            bounded: Some(config.bounded),
        }
    }

    /// These settings over the defaults; with `literal`, over those of the paper's Algorithm 1.
    pub fn over_defaults(&self, literal: bool) -> FilterConfig {
        let physical = literal || self.coordinates == Some(Coordinates::Physical);
        let base = if physical { FilterConfig::literal() } else { FilterConfig::default() };
        let coordinates = match self.coordinates {
            None => base.coordinates,
            Some(Coordinates::Physical) => SoilCoordinates::Physical,
            Some(Coordinates::Logarithmic) => SoilCoordinates::Logarithmic,
        };
        let channel = |n: NoiseSettings| ChannelNoise { white_sd: n.white_sd, coloured_sd: n.coloured_sd, correlation: n.correlation };
        FilterConfig {
            buffer: self.buffer.unwrap_or(base.buffer),
            coordinates,
            prior_sd: self.prior_sd.unwrap_or(base.prior_sd),
            process_sd: self.process_sd.unwrap_or(base.process_sd),
            noise: self.noise.map_or(base.noise, |n| VelocityNoise { channels: n.map(channel) }),
            gate_tail_probability: self.gate_tail_probability.unwrap_or(base.gate_tail_probability),
            linearisations: self.linearisations.unwrap_or(base.linearisations),
            bounded: self.bounded.unwrap_or(base.bounded),
        }
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
        let error = FilterSettings::from_json(r#"{"bufer": 20}"#).unwrap_err().to_string();
        assert!(error.contains("bufer"), "{error}");
    }
}
