//! The soil prior h_θ for inference (paper §IV-B): conv 18→32→64 with stride 2, mean, MLP 64→64→6, SiLU.

use nesam_physics::SOIL_DIM;

use crate::ModelError;
use crate::dims::{FEATURE_CHANNELS, FEATURE_PX, SOIL_PRIOR_PARAMETERS};
use crate::fused::{After, Lane, PANEL, Packed, Row, Vector, add_rows, linear, linear_of};
use crate::weights::Weights;

/// Filters of the two convolutions.
const FILTERS: [usize; 2] = [32, 64];
/// Width of the hidden layer.
const HIDDEN_UNITS: usize = 64;

/// The soil prior head, many patches at a time in lanes.
#[derive(Clone, Debug)]
pub struct SoilPrior {
    conv1: Packed,
    conv2: Packed,
    hidden: Packed,
    out: Packed,
}

/// A stride-2 3×3 convolution with zero padding and SiLU of images (px, px, channels) as rows; calls `store(pixel, filters)` for each output pixel.
#[inline(always)]
fn convolve<V: Vector, const H: usize>(
    matrix: &Packed,
    image: &[Row<H>],
    px: usize,
    filters: &mut [Row<H>],
    mut store: impl FnMut(usize, &[Row<H>]),
) {
    let channels = image.len() / (px * px);
    let black = [Lane::ZERO; H];
    let mut inputs: Vec<&Row<H>> = vec![&black; 9 * channels];
    for pixel in 0..px * px / 4 {
        let (oy, ox) = (pixel / (px / 2), pixel % (px / 2));
        for (tap, inputs) in inputs.chunks_exact_mut(channels).enumerate() {
            // Stride 2 on an even size only reaches past the first row and column.
            let (y, x) = ((2 * oy + tap / 3).checked_sub(1), (2 * ox + tap % 3).checked_sub(1));
            for (c, input) in inputs.iter_mut().enumerate() {
                *input = match (y, x) {
                    (Some(y), Some(x)) => &image[(y * px + x) * channels + c],
                    _ => &black,
                };
            }
        }
        linear_of::<V, H, _>(matrix, After::Silu, Rows(&inputs), filters.chunks_exact_mut(PANEL));
        store(pixel, filters);
    }
}

/// Rows that lie anywhere.
#[derive(Clone, Copy)]
struct Rows<'a, 'b, const H: usize>(&'b [&'a Row<H>]);

impl<'a, 'b, const H: usize> IntoIterator for Rows<'a, 'b, H> {
    type Item = &'a Row<H>;
    type IntoIter = core::iter::Copied<core::slice::Iter<'b, &'a Row<H>>>;
    #[inline(always)]
    fn into_iter(self) -> Self::IntoIter {
        self.0.iter().copied()
    }
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
        let layer = |name: &str, outputs: usize, inputs: usize| -> Result<Packed, ModelError> {
            let weight = weights.get(&format!("soil.{name}.weight"), &[outputs, inputs])?;
            Ok(Packed::from_rows(weight, weights.get(&format!("soil.{name}.bias"), &[outputs])?))
        };
        Ok(Self {
            conv1: layer("conv1", FILTERS[0], 9 * FEATURE_CHANNELS)?,
            conv2: layer("conv2", FILTERS[1], 9 * FILTERS[0])?,
            hidden: layer("hidden", HIDDEN_UNITS, FILTERS[1])?,
            out: layer("out", SOIL_DIM, HIDDEN_UNITS)?,
        })
    }

    /// Raw soil coordinates (6) of semantic features (16, 16, 18), a patch in each lane; `soil_coordinates::from_raw` makes them a soil.
    #[inline(always)]
    pub(crate) fn raw<V: Vector, const H: usize>(&self, features: &[Row<H>]) -> [Row<H>; SOIL_DIM] {
        let zero = [Lane::ZERO; H];
        let (half, quarter) = (FEATURE_PX / 2, FEATURE_PX / 4);
        let mut first = vec![zero; half * half * FILTERS[0]];
        let mut filters = [zero; FILTERS[0]];
        convolve::<V, H>(&self.conv1, features, FEATURE_PX, &mut filters, |pixel, filters| {
            first[pixel * FILTERS[0]..(pixel + 1) * FILTERS[0]].copy_from_slice(filters);
        });
        let mut second = vec![zero; quarter * quarter * FILTERS[1]];
        let mut filters = [zero; FILTERS[1]];
        convolve::<V, H>(&self.conv2, &first, half, &mut filters, |pixel, filters| {
            second[pixel * FILTERS[1]..(pixel + 1) * FILTERS[1]].copy_from_slice(filters);
        });
        let mut pooled = [zero; FILTERS[1]];
        for pixel in second.chunks_exact(FILTERS[1]) {
            add_rows::<V, H>(&mut pooled, pixel);
        }
        let share = V::splat(1.0 / (quarter * quarter) as f32);
        for row in &mut pooled {
            for h in 0..H {
                V::load(&row[h].0).mul(share).store(&mut row[h].0);
            }
        }
        let mut hidden = [zero; HIDDEN_UNITS];
        linear::<V, H>(&self.hidden, After::Silu, &pooled, &mut hidden);
        let mut out = [zero; 8];
        linear::<V, H>(&self.out, After::Store, &hidden, &mut out);
        core::array::from_fn(|i| out[i])
    }
}
