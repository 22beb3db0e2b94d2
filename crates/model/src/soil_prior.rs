//! The soil prior h_θ for inference (paper §IV-B): conv 18→32→64 with stride 2, mean, MLP 64→64→6, SiLU.

use nesam_physics::SOIL_DIM;

use crate::ModelError;
use crate::dims::{FEATURE_CHANNELS, FEATURE_PX, SOIL_PRIOR_PARAMETERS};
use crate::weights::Weights;

/// The soil prior head.
#[derive(Clone, Debug)]
pub struct SoilPrior {
    conv1: Vec<[f32; 32]>,
    bias1: [f32; 32],
    conv2: Vec<[f32; 64]>,
    bias2: [f32; 64],
    hidden: Vec<f32>,
    hidden_bias: Vec<f32>,
    out: Vec<f32>,
    out_bias: Vec<f32>,
}

fn silu(x: f32) -> f32 {
    x / (1.0 + (-x).exp())
}

fn transposed<const O: usize>(weight: &[f32], inputs: usize) -> Vec<[f32; O]> {
    (0..inputs).map(|k| core::array::from_fn(|o| weight[o * inputs + k])).collect()
}

/// Stride-2 3×3 convolution with zero padding and SiLU of an image (px, px, channels).
fn conv_silu<const O: usize>(image: &[f32], px: usize, channels: usize, weight: &[[f32; O]], bias: &[f32; O]) -> Vec<[f32; O]> {
    let out = px / 2;
    let mut result = Vec::with_capacity(out * out);
    for oy in 0..out {
        for ox in 0..out {
            let mut acc = *bias;
            for ky in 0..3 {
                let y = (2 * oy + ky) as isize - 1;
                for kx in 0..3 {
                    let x = (2 * ox + kx) as isize - 1;
                    if y < 0 || x < 0 {
                        continue; // stride 2 on an even size only reaches past the first row and column
                    }
                    let at = (y as usize * px + x as usize) * channels;
                    let rows = &weight[(ky * 3 + kx) * channels..(ky * 3 + kx + 1) * channels];
                    for (value, row) in image[at..at + channels].iter().zip(rows) {
                        for o in 0..O {
                            acc[o] = value.mul_add(row[o], acc[o]);
                        }
                    }
                }
            }
            result.push(acc.map(silu));
        }
    }
    result
}

impl SoilPrior {
    /// From the arrays `soil.{conv1,conv2,hidden,out}.{weight,bias}`.
    ///
    /// # Errors
    /// `ModelError::Weights` naming the array at fault, or when the head does not have the paper's 28 262 parameters.
    pub fn new(weights: &Weights) -> Result<Self, ModelError> {
        let parameters = weights.parameters("soil.");
        if parameters != SOIL_PRIOR_PARAMETERS {
            let reason = format!("has {parameters} parameters, expected {SOIL_PRIOR_PARAMETERS}");
            return Err(ModelError::Weights { name: "soil".into(), reason });
        }
        let array = |name: &str, shape: &[usize]| weights.get(name, shape);
        let bias = |name: &str, n: usize| weights.get(name, &[n]);
        Ok(Self {
            conv1: transposed(array("soil.conv1.weight", &[32, 9 * FEATURE_CHANNELS])?, 9 * FEATURE_CHANNELS),
            bias1: bias("soil.conv1.bias", 32)?.try_into().expect("shape was checked; this is a bug"),
            conv2: transposed(array("soil.conv2.weight", &[64, 9 * 32])?, 9 * 32),
            bias2: bias("soil.conv2.bias", 64)?.try_into().expect("shape was checked; this is a bug"),
            hidden: array("soil.hidden.weight", &[64, 64])?.to_vec(),
            hidden_bias: bias("soil.hidden.bias", 64)?.to_vec(),
            out: array("soil.out.weight", &[SOIL_DIM, 64])?.to_vec(),
            out_bias: bias("soil.out.bias", SOIL_DIM)?.to_vec(),
        })
    }

    /// Raw soil coordinates of semantic features (16, 16, 18); `soil_coordinates::from_raw` makes them a soil.
    pub fn raw(&self, features: &[f32]) -> [f32; SOIL_DIM] {
        let first = conv_silu(features, FEATURE_PX, FEATURE_CHANNELS, &self.conv1, &self.bias1);
        let second = conv_silu(first.as_flattened(), FEATURE_PX / 2, 32, &self.conv2, &self.bias2);
        let mut pooled = [0f32; 64];
        for pixel in &second {
            for (sum, value) in pooled.iter_mut().zip(pixel) {
                *sum += value / second.len() as f32;
            }
        }
        let dense = |weight: &[f32], bias: &[f32], x: &[f32], o: usize| {
            bias[o] + weight[o * x.len()..(o + 1) * x.len()].iter().zip(x).map(|(w, v)| w * v).sum::<f32>()
        };
        let hidden: Vec<f32> = (0..64).map(|o| silu(dense(&self.hidden, &self.hidden_bias, &pooled, o))).collect();
        core::array::from_fn(|o| dense(&self.out, &self.out_bias, &hidden, o))
    }
}
