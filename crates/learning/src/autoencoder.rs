//! Pre-training of the terrain encoders as autoencoders (paper §IV-B): MSE, Adam, batch 64; the decoder is thrown away.

use std::collections::HashMap;
use std::sync::Arc;

use candle_core::{Device, Result, Tensor, Var};
use nesam_model::Weights;
use nesam_model::encoder::{ENCODER_WIDTHS, encoder_shapes};
use nesam_model::reference::{Conv, conv2d, pixel_shuffle};
use nesam_terrain::{PATCH_PX, Patch, PatchScale, Pose2, WorldMap, sample_patch};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use crate::adam::Adam;

/// Where patches are drawn: places that were driven, in any heading.
pub type Places = Vec<(Arc<WorldMap>, f64, f64)>;

/// What a pre-training run was told.
#[derive(Clone, Copy, Debug)]
pub struct PretrainPlan {
    /// Optimiser steps.
    pub steps: usize,
    /// Patches per step (paper: 64).
    pub batch: usize,
    /// Learning rate (paper: 1e-4; a larger one with cosine decay needs fewer steps).
    pub rate: f64,
    /// Seed.
    pub seed: u64,
}

/// Result of pre-training one encoder.
#[derive(Clone, Debug)]
pub struct Pretrained {
    /// Arrays `encoder.<name>.*`.
    pub weights: Weights,
    /// Mean squared error as a share of the variance of the patches, over the last tenth of the steps; `None` where so few were made that none is in it, or
    /// where the patches do not vary.
    pub unexplained: Option<f64>,
}

struct Autoencoder {
    variables: Vec<(String, Var)>,
    channels: usize,
}

/// Names and shapes of the decoder: three convolutions, each followed by an up-sampling of two.
fn decoder_shapes(channels: usize) -> Vec<(String, Vec<usize>)> {
    let widths = [ENCODER_WIDTHS[2], ENCODER_WIDTHS[1], ENCODER_WIDTHS[0], channels];
    (0..3)
        .flat_map(|l| {
            [(format!("decoder{l}.weight"), vec![4 * widths[l + 1], 9 * widths[l]]), (format!("decoder{l}.bias"), vec![4 * widths[l + 1]])]
        })
        .collect()
}

impl Autoencoder {
    fn new(name: &str, channels: usize, device: &Device, rng: &mut ChaCha8Rng) -> Result<Self> {
        let variables = encoder_shapes(name, channels)
            .into_iter()
            .chain(decoder_shapes(channels))
            .map(|(name, shape)| {
                let count: usize = shape.iter().product();
                let values: Vec<f32> = if name.ends_with("bias") {
                    vec![0.0; count]
                } else {
                    let normal = Normal::new(0.0, (2.0 / shape[1] as f32).sqrt()).expect("positive; this is a bug");
                    (0..count).map(|_| normal.sample(rng)).collect()
                };
                Ok((name, Var::from_tensor(&Tensor::from_vec(values, shape, device)?)?))
            })
            .collect::<Result<_>>()?;
        Ok(Self { variables, channels })
    }

    fn layer(&self, index: usize) -> (&Tensor, &Tensor) {
        (self.variables[2 * index].1.as_tensor(), self.variables[2 * index + 1].1.as_tensor())
    }

    /// Mean squared reconstruction error of images (batch, 128, 128, channels).
    fn loss(&self, images: &Tensor) -> Result<Tensor> {
        let mut x = images.clone();
        let inputs = [self.channels, ENCODER_WIDTHS[0], ENCODER_WIDTHS[1]];
        for (l, &channels) in inputs.iter().enumerate() {
            let (weight, bias) = self.layer(l);
            x = conv2d(&x, Conv { px: PATCH_PX >> l, channels, stride: 2 }, weight, bias)?;
            if l < 2 {
                x = x.relu()?;
            }
        }
        let widths = [ENCODER_WIDTHS[2], ENCODER_WIDTHS[1], ENCODER_WIDTHS[0]];
        for (l, &channels) in widths.iter().enumerate() {
            let (weight, bias) = self.layer(3 + l);
            x = pixel_shuffle(&conv2d(&x, Conv { px: (PATCH_PX / 8) << l, channels, stride: 1 }, weight, bias)?)?;
            if l < 2 {
                x = x.relu()?;
            }
        }
        (x - images)?.sqr()?.mean_all()
    }
}

/// Trains one encoder (`name` is `elevation` or `semantic`) on a device; `progress(step, loss)` is called after each step. `None` where it was interrupted, which
/// is asked before each step.
///
/// # Errors
/// A candle error.
pub fn pretrain(
    name: &str,
    places: &Places,
    scale: &PatchScale,
    plan: &PretrainPlan,
    device: &Device,
    mut progress: impl FnMut(usize, f32),
    interrupted: &dyn Fn() -> bool,
) -> Result<Option<Pretrained>> {
    let channels = if name == "elevation" { 1 } else { 3 };
    let mut rng = ChaCha8Rng::seed_from_u64(plan.seed);
    let autoencoder = Autoencoder::new(name, channels, device, &mut rng)?;
    let mut adam = Adam::default();
    let mut patch = Patch::new();
    let (mut squared_error, mut variance) = (0.0, 0.0);
    for step in 0..plan.steps {
        if interrupted() {
            return Ok(None);
        }
        let mut pixels = Vec::with_capacity(plan.batch * PATCH_PX * PATCH_PX * channels);
        for _ in 0..plan.batch {
            let (map, x, y) = &places[rng.random_range(0..places.len())];
            let near = |centre: f64, rng: &mut ChaCha8Rng| centre + rng.random_range(-2.0..2.0);
            let pose = Pose2 { x_m: near(*x, &mut rng), y_m: near(*y, &mut rng), yaw_rad: rng.random_range(0.0..core::f64::consts::TAU) };
            sample_patch(map, pose, scale, &mut patch);
            let planes = if channels == 1 { &patch.elevation } else { &patch.semantic };
            let area = PATCH_PX * PATCH_PX;
            pixels.extend((0..area).flat_map(|i| (0..channels).map(move |c| planes[c * area + i])));
        }
        let images = Tensor::from_vec(pixels, (plan.batch, PATCH_PX, PATCH_PX, channels), device)?;
        let loss = autoencoder.loss(&images)?;
        let store = loss.backward()?;
        let mut gradients = HashMap::new();
        for (name, var) in &autoencoder.variables {
            if let Some(gradient) = store.get(var) {
                gradients.insert(name.clone(), gradient.flatten_all()?.to_vec1()?);
            }
        }
        adam.update(&autoencoder.variables, &gradients, crate::schedule::cosine(plan.rate, step, plan.steps), 1.0, 0.0)?;
        let loss = loss.to_scalar::<f32>()?;
        if step * 10 >= plan.steps * 9 {
            let mean = images.mean_all()?;
            variance += f64::from(images.broadcast_sub(&mean)?.sqr()?.mean_all()?.to_scalar::<f32>()?);
            squared_error += f64::from(loss);
        }
        progress(step + 1, loss);
    }
    let mut weights = Weights::default();
    for (name, var) in autoencoder.variables.iter().filter(|(name, _)| name.starts_with("encoder.")) {
        weights.insert(name.clone(), var.dims(), var.flatten_all()?.to_vec1()?);
    }
    let unexplained = (variance > 0.0).then(|| squared_error / variance);
    Ok(Some(Pretrained { weights, unexplained }))
}

#[cfg(test)]
mod tests {
    use nesam_terrain::GridGeometry;

    use super::*;

    /// Goal: pre-training stops before the next step when it is told to, and says of its errors what it measured. Method: two patches of ground that rises
    /// along x, told to stop after one of three steps; then one step alone, of which none is in the last tenth, and ten.
    #[test]
    fn property_pre_training_stops_when_told_and_gives_no_number_that_it_did_not_measure() {
        let geometry = GridGeometry { origin_m: [0.0; 2], resolution_m: 0.5, width: 40, height: 40 };
        let heights = (0..1600).map(|i| (i % 40) as f32 * 0.1).collect();
        let places = vec![(Arc::new(WorldMap::from_layers("slope", 1, geometry, heights, None).unwrap()), 10.0, 10.0)];
        let pretrained = |steps: usize, stop_after: usize| {
            let plan = PretrainPlan { steps, batch: 2, rate: 1e-3, seed: 1 };
            let done = core::cell::Cell::new(0);
            let stop = || done.get() >= stop_after;
            let of = pretrain("elevation", &places, &PatchScale::default(), &plan, &Device::Cpu, |step, _| done.set(step), &stop);
            (of.unwrap(), done.get())
        };
        let (stopped, done) = pretrained(3, 1);
        assert!(stopped.is_none() && done == 1);
        assert_eq!(pretrained(1, 9).0.unwrap().unexplained, None);
        assert!(pretrained(10, 99).0.unwrap().unexplained.unwrap().is_finite());
    }
}
