//! The frozen terrain encoders (paper §IV-B) for inference: three 3×3 convolutions of stride 2, ReLU between them.
//!
//! The paper fixes the output, 18×16×16, not the widths; 8 and 16 channels keep one pair of encoders at 10 MFLOP. Images are stored
//! (row, column, channel). Each output row is computed from a zero-padded copy, so the inner loops have no branches.

use nesam_terrain::{PATCH_PX, Patch};
use wide::f32x8;

use crate::ModelError;
use crate::dims::{CONTEXT, FEATURE_CHANNELS, FEATURES};
use crate::weights::Weights;

/// Filters of the three layers.
pub const ENCODER_WIDTHS: [usize; 3] = [8, 16, FEATURE_CHANNELS];
/// Names of the two encoders and their input channels.
pub const ENCODERS: [(&str, usize); 2] = [("elevation", 1), ("semantic", 3)];

/// Names and shapes of the arrays of one encoder; weight (filters, 3 · 3 · channels) ordered (row, column, channel).
pub fn encoder_shapes(name: &str, channels: usize) -> Vec<(String, Vec<usize>)> {
    let inputs = [channels, ENCODER_WIDTHS[0], ENCODER_WIDTHS[1]];
    (0..3)
        .flat_map(|l| {
            let layer = format!("encoder.{name}.conv{}", l + 1);
            [(format!("{layer}.weight"), vec![ENCODER_WIDTHS[l], 9 * inputs[l]]), (format!("{layer}.bias"), vec![ENCODER_WIDTHS[l]])]
        })
        .collect()
}

/// One layer: weights transposed to (9 · channels, 8 V) so that the filters are the lanes of V vectors.
#[derive(Clone, Debug)]
struct Layer<const V: usize> {
    channels: usize,
    weight: Vec<[f32x8; V]>,
    bias: [f32x8; V],
}

/// `values(o)` for o < filters as V vectors, zero beyond.
fn vectors<const V: usize>(filters: usize, values: impl Fn(usize) -> f32) -> [f32x8; V] {
    core::array::from_fn(|v| f32x8::from(core::array::from_fn::<f32, 8, _>(|l| if v * 8 + l < filters { values(v * 8 + l) } else { 0.0 })))
}

impl<const V: usize> Layer<V> {
    fn new(weights: &Weights, name: &str, filters: usize, channels: usize) -> Result<Self, ModelError> {
        let inputs = 9 * channels;
        let source = weights.get(&format!("{name}.weight"), &[filters, inputs])?;
        let bias = weights.get(&format!("{name}.bias"), &[filters])?;
        let weight = (0..inputs).map(|k| vectors(filters, |o| source[o * inputs + k])).collect();
        Ok(Self { channels, weight, bias: vectors(filters, |o| bias[o]) })
    }

    /// Stride-2 convolution of a padded image ((px + 2)², channels); `store(row, column, filters)` takes each output pixel.
    /// `P` output pixels are computed together to keep the arithmetic units busy.
    fn run<const P: usize>(&self, padded: &[f32], px: usize, relu: bool, mut store: impl FnMut(usize, usize, &[f32])) {
        let (c, out) = (self.channels, px / 2);
        let stride = (px + 2) * c;
        let run = 3 * c;
        for oy in 0..out {
            for ox in (0..out).step_by(P) {
                let mut acc = [self.bias; P];
                for ky in 0..3 {
                    let start = (2 * oy + ky) * stride + 2 * ox * c;
                    // One slice that covers all P neighbourhoods of this row, so that the bounds are checked once.
                    let pixels = &padded[start..start + 2 * (P - 1) * c + run];
                    for (k, weight) in self.weight[ky * run..(ky + 1) * run].iter().enumerate() {
                        for (p, acc) in acc.iter_mut().enumerate() {
                            let x = f32x8::splat(pixels[2 * p * c + k]);
                            for v in 0..V {
                                acc[v] = x.mul_add(weight[v], acc[v]);
                            }
                        }
                    }
                }
                for (p, values) in acc.iter().enumerate() {
                    let values = values.map(|v| if relu { v.max(f32x8::ZERO) } else { v }.to_array());
                    store(oy, ox + p, values.as_flattened());
                }
            }
        }
    }
}

/// One encoder.
#[derive(Clone, Debug)]
struct Encoder {
    conv1: Layer<1>,
    conv2: Layer<2>,
    conv3: Layer<3>,
}

/// Both encoders.
#[derive(Clone, Debug)]
pub struct TerrainEncoders {
    elevation: Encoder,
    semantic: Encoder,
}

/// Buffers of one worker, reused between patches.
#[derive(Clone, Debug)]
pub struct EncoderScratch {
    input: Vec<f32>,
    first: Vec<f32>,
    second: Vec<f32>,
}

impl Default for EncoderScratch {
    fn default() -> Self {
        let padded = |px: usize, c: usize| vec![0.0; (px + 2) * (px + 2) * c];
        Self { input: padded(PATCH_PX, 3), first: padded(PATCH_PX / 2, 8), second: padded(PATCH_PX / 4, 16) }
    }
}

impl Encoder {
    fn new(weights: &Weights, name: &str, channels: usize) -> Result<Self, ModelError> {
        let layer = |i: usize| format!("encoder.{name}.conv{i}");
        Ok(Self {
            conv1: Layer::new(weights, &layer(1), ENCODER_WIDTHS[0], channels)?,
            conv2: Layer::new(weights, &layer(2), ENCODER_WIDTHS[1], ENCODER_WIDTHS[0])?,
            conv3: Layer::new(weights, &layer(3), ENCODER_WIDTHS[2], ENCODER_WIDTHS[1])?,
        })
    }

    /// Planes (channel, row, column) -> features (row, column, channel).
    fn encode(&self, planes: &[f32], scratch: &mut EncoderScratch, features: &mut [f32]) {
        let c = self.conv1.channels;
        let width = PATCH_PX + 2;
        for y in 0..PATCH_PX {
            for (channel, plane) in planes.chunks_exact(PATCH_PX * PATCH_PX).enumerate() {
                let row = &plane[y * PATCH_PX..(y + 1) * PATCH_PX];
                let target = &mut scratch.input[((y + 1) * width + 1) * c..((y + 2) * width - 1) * c];
                for (pixel, &value) in target.chunks_exact_mut(c).zip(row) {
                    pixel[channel] = value;
                }
            }
            // The buffer is shared by images of one and three channels: keep the border of this layout zero.
            scratch.input[(y + 1) * width * c..((y + 1) * width + 1) * c].fill(0.0);
            scratch.input[((y + 2) * width - 1) * c..(y + 2) * width * c].fill(0.0);
        }
        scratch.input[..width * c].fill(0.0);
        scratch.input[width * (width - 1) * c..width * width * c].fill(0.0);

        let (first, second) = (&mut scratch.first, &mut scratch.second);
        let w1 = PATCH_PX / 2 + 2;
        self.conv1.run::<8>(&scratch.input[..width * width * c], PATCH_PX, true, |y, x, v| {
            let at = ((y + 1) * w1 + x + 1) * 8;
            first[at..at + 8].copy_from_slice(v);
        });
        let w2 = PATCH_PX / 4 + 2;
        self.conv2.run::<4>(first, PATCH_PX / 2, true, |y, x, v| {
            let at = ((y + 1) * w2 + x + 1) * 16;
            second[at..at + 16].copy_from_slice(v);
        });
        self.conv3.run::<4>(second, PATCH_PX / 4, false, |y, x, v| {
            let at = (y * (PATCH_PX / 8) + x) * FEATURE_CHANNELS;
            features[at..at + FEATURE_CHANNELS].copy_from_slice(&v[..FEATURE_CHANNELS]);
        });
    }
}

impl TerrainEncoders {
    /// From the arrays `encoder.{elevation,semantic}.conv{1,2,3}.{weight,bias}`.
    ///
    /// # Errors
    /// `ModelError::Weights` naming the array at fault.
    pub fn new(weights: &Weights) -> Result<Self, ModelError> {
        Ok(Self { elevation: Encoder::new(weights, "elevation", 1)?, semantic: Encoder::new(weights, "semantic", 3)? })
    }

    /// Terrain context c = z_e ‖ z_s of a patch: two maps (16, 16, 18), the elevation one first.
    pub fn encode(&self, patch: &Patch, scratch: &mut EncoderScratch, context: &mut [f32]) {
        assert_eq!(context.len(), CONTEXT, "context has {CONTEXT} values; this is a bug");
        let (elevation, semantic) = context.split_at_mut(FEATURES);
        self.elevation.encode(&patch.elevation, scratch, elevation);
        self.semantic.encode(&patch.semantic, scratch, semantic);
    }
}
