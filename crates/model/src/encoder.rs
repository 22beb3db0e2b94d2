//! The frozen terrain encoders (paper §IV-B) for inference: three 3×3 convolutions of stride 2, ReLU between them.
//!
//! The paper fixes the output, 18×16×16, not the widths; 8 and 16 channels keep one pair of encoders at 10 MFLOP. Sixteen neighbouring pixels of an output row
//! are one vector; the layers themselves are in `fused::convolution`.

use nesam_terrain::{PATCH_PX, Patch};

use crate::ModelError;
use crate::dims::{CONTEXT, FEATURE_CHANNELS, FEATURES};
use crate::fused::{Convolution, Image, Kernel, LANES, Path, Vector};
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

/// One encoder.
#[derive(Clone, Debug)]
struct Encoder {
    channels: usize,
    conv1: Convolution<8>,
    conv2: Convolution<8>,
    conv3: Convolution<9>,
}

/// Both encoders.
#[derive(Clone, Debug)]
pub struct TerrainEncoders {
    elevation: Encoder,
    semantic: Encoder,
    path: Path,
}

/// Buffers of one worker, reused between patches.
#[derive(Clone, Debug)]
pub struct EncoderScratch {
    input: Image,
    first: Image,
    second: Image,
}

impl Default for EncoderScratch {
    fn default() -> Self {
        Self {
            input: Image::new(3, PATCH_PX),
            first: Image::new(ENCODER_WIDTHS[0], PATCH_PX / 2),
            second: Image::new(ENCODER_WIDTHS[1], PATCH_PX / 4),
        }
    }
}

impl Encoder {
    fn new(weights: &Weights, name: &str, channels: usize) -> Result<Self, ModelError> {
        let inputs = [channels, ENCODER_WIDTHS[0], ENCODER_WIDTHS[1]];
        let array = |layer: usize| -> Result<(&[f32], &[f32]), ModelError> {
            let (name, filters) = (format!("encoder.{name}.conv{}", layer + 1), ENCODER_WIDTHS[layer]);
            let weight = weights.get(&format!("{name}.weight"), &[filters, 9 * inputs[layer]])?;
            Ok((weight, weights.get(&format!("{name}.bias"), &[filters])?))
        };
        let [one, two, three] = [array(0)?, array(1)?, array(2)?];
        Ok(Self {
            channels,
            conv1: Convolution::new(one.0, one.1, PATCH_PX),
            conv2: Convolution::new(two.0, two.1, PATCH_PX / 2),
            conv3: Convolution::new(three.0, three.1, PATCH_PX / 4),
        })
    }

    /// Planes (channel, row, column) -> features (row, column, channel).
    #[inline(always)]
    fn encode<V: Vector>(&self, planes: &[f32], scratch: &mut EncoderScratch, features: &mut [f32]) {
        let EncoderScratch { input, first, second } = scratch;
        for (channel, plane) in planes.chunks_exact(PATCH_PX * PATCH_PX).enumerate().take(self.channels) {
            for (row, pixels) in plane.chunks_exact(PATCH_PX).enumerate() {
                for (group, pixels) in pixels.as_chunks::<LANES>().0.iter().enumerate() {
                    input.put(channel, row, group, pixels);
                }
            }
        }
        self.conv1.run::<V>(input, true, |filter, row, group, pixels| first.put(filter, row, group, pixels));
        self.conv2.run::<V>(first, true, |filter, row, group, pixels| second.put(filter, row, group, pixels));
        self.conv3.run::<V>(second, false, |filter, row, _, pixels| {
            for (column, value) in pixels.iter().enumerate() {
                features[(row * LANES + column) * FEATURE_CHANNELS + filter] = *value;
            }
        });
    }
}

/// Both encoders on one patch.
struct Encode<'a> {
    encoders: &'a TerrainEncoders,
    patch: &'a Patch,
    scratch: &'a mut EncoderScratch,
    context: &'a mut [f32],
}

impl Kernel for Encode<'_> {
    type Output = ();
    #[inline(always)]
    fn run<V: Vector>(self) {
        let (elevation, semantic) = self.context.split_at_mut(FEATURES);
        self.encoders.elevation.encode::<V>(&self.patch.elevation, self.scratch, elevation);
        self.encoders.semantic.encode::<V>(&self.patch.semantic, self.scratch, semantic);
    }
}

impl TerrainEncoders {
    /// From the arrays `encoder.{elevation,semantic}.conv{1,2,3}.{weight,bias}`.
    ///
    /// # Errors
    /// `ModelError::Weights` naming the array at fault.
    pub fn new(weights: &Weights) -> Result<Self, ModelError> {
        Ok(Self {
            elevation: Encoder::new(weights, "elevation", 1)?,
            semantic: Encoder::new(weights, "semantic", 3)?,
            path: Path::fastest(),
        })
    }

    /// Terrain context c = z_e ‖ z_s of a patch: two maps (16, 16, 18), the elevation one first.
    pub fn encode(&self, patch: &Patch, scratch: &mut EncoderScratch, context: &mut [f32]) {
        assert_eq!(context.len(), CONTEXT, "context has {CONTEXT} values; this is a bug");
        self.path.run(Encode { encoders: self, patch, scratch, context });
    }

    /// The same on another path.
    pub fn on(&self, path: Path) -> Self {
        Self { path, ..self.clone() }
    }
}
