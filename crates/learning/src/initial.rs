//! Untrained weights from a seed.

use nesam_model::encoder::{ENCODERS, encoder_shapes};
use nesam_model::reference::trainable_shapes;
use nesam_model::{Normalization, Weights};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

/// Gain of the last layer of each head: small, so that training starts from the symbolic model.
const HEAD_GAIN: f32 = 0.02;

/// Weights of the kinodynamic model and of untrained encoders, drawn from N(0, 1 / inputs); norms one, biases zero, soil bias at the default soil.
pub fn initial_weights(seed: u64, scales: &Normalization) -> Weights {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut weights = Weights::default();
    let encoders = ENCODERS.iter().flat_map(|(name, channels)| encoder_shapes(name, *channels));
    for (name, shape) in trainable_shapes().into_iter().chain(encoders) {
        let count = shape.iter().product();
        let values: Vec<f32> = if name.ends_with(".bias") {
            if name == "soil.out.bias" { scales.default_soil_raw.to_vec() } else { vec![0.0; count] }
        } else if name.contains("norm") {
            vec![1.0; count]
        } else {
            let inputs = *shape.last().expect("no weight is a scalar; this is a bug") as f32;
            let gain = match name.as_str() {
                "sinkage.weight" | "residual.weight" | "soil.out.weight" => HEAD_GAIN * inputs.sqrt(),
                "position" => 0.02 * inputs.sqrt(),
                "token.context.weight" => 0.3,
                name if name.starts_with("encoder.") || name.starts_with("soil.") => 2f32.sqrt(),
                _ => 1.0,
            };
            let normal = Normal::new(0.0, gain / inputs.sqrt()).expect("the deviation is positive; this is a bug");
            (0..count).map(|_| normal.sample(&mut rng)).collect()
        };
        weights.insert(name, &shape, values);
    }
    weights
}
